"""Coordinates of a fit: parameters of the media, errors of the instrument, and what is known of them beforehand."""
