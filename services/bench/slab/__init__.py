"""Slabs: how fast totals come, and how well a cell's images give back what made them."""
