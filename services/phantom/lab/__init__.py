"""A virtual laboratory: the raw frames that a rig would leave of a mouth and of its calibration, and the truth behind
them.
"""
