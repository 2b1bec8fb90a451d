"""Calibrations that are stored under names and that jobs refer to."""
