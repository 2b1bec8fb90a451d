"""Dictionaries of phase functions, one in each file; ``services/core/slab/dictionaries.py`` lists them."""
