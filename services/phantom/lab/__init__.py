"""A virtual laboratory: the raw frames that a rig would take of a mouth and for its calibration, with their truth."""
