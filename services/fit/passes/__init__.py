"""Passes of a fit: renders and derivatives of all blocks as tasks, and their sums."""
