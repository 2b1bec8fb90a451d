"""Cameras, real and simulated."""
