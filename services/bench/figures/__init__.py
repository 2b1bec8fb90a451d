"""Figures of what a fit does, made from fits that the command line runs:
``python -m services.bench.figures --out DIR``.
"""
