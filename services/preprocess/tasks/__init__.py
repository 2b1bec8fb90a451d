"""Dask tasks of a preparation, and the files that they share."""
