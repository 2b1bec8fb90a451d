"""Measurement of a tooth's optics from the raw frames of a virtual laboratory, and comparison with the truth."""
