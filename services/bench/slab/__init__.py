"""Benchmarks of slabs: speed of total reflectance and transmittance, and recovery of a medium from images of a cell."""
