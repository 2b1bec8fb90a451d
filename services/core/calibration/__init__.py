"""The calibration of a rig: cameras, lights and their uncertainty."""
