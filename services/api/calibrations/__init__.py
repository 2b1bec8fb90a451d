"""Calibrations that captures and jobs name."""
