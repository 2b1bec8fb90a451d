"""A raw folder's calibration frames, step by step, to a calibration record."""
