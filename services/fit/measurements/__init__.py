"""Measurements of a fit: pixels with their weights, in blocks, and how the instrument took them."""
