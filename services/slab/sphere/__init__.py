"""Absorption and reduced scattering of a slab from its totals in an integrating sphere, and its look over black and
white.
"""
