"""Calibration of a rig from photographs of boards, spheres and charts, with the uncertainty of every result."""
