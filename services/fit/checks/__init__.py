"""Checks of a fit: image errors, standard errors, alignment, undetermined parameters, and advice for the
next capture.
"""
