"""Masks of the pixels that a fit may use: highlights, shadows and manual masks."""
