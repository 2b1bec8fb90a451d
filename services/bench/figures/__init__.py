"""Figures that compare fits with photographs, made from fits by the command line:
``python -m services.bench.figures --out DIR``.
"""
