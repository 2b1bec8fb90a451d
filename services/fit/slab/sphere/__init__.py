"""Totals of a slab from an integrating sphere to absorption and reduced scattering, and a slab over black and white."""
