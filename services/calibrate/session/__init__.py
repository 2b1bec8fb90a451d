"""Calibration of a rig from the calibration frames of a raw folder: the steps, the record and the report."""
