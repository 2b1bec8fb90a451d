"""Calibration of lights: positions from highlights on mirror spheres, intensities from white spheres."""
