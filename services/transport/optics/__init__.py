"""Optics of media: parameters, phase functions, Fresnel reflection, half space."""
