"""Records, errors, settings and stores, which cross process boundaries.

This package imports no service and nothing heavier than NumPy, pydantic and zarr.
"""
