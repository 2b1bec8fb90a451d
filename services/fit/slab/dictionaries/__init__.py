"""Dictionaries of phase functions, one a file; ``services/core/slab/dictionaries.py`` lists them."""
