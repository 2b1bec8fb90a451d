"""What an instrument may have wrong: gain, lights and flare as coordinates of a fit, with the calibration's
covariance.
"""
