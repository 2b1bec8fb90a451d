"""Scans: reading, segmentation into teeth, and closing of teeth by roots."""
