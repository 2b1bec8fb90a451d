"""Inputs of a fit: measured pixels with their weights, and the layout of stain textures."""
