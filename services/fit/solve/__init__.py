"""Solvers of a fit: table search, Gauss-Newton, Adam, stain textures, and the uncertainty of the solution."""
