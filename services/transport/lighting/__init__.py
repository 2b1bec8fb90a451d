"""Lights of a scene: their choice, shadow rays to them, and depth maps as seen from them."""
