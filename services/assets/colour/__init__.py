"""Colours of an asset: what a camera's channels are in linear sRGB, in ACEScg and as spectra."""
