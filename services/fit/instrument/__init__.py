"""Errors of the instrument: gain, lights and flare as coordinates of a fit, with the calibration's covariance."""
