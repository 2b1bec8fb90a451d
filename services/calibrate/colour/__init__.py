"""Colour calibration: the transform from a camera's channels to XYZ, fitted to the patches of a chart."""
