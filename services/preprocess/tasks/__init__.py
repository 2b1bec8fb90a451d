"""The Dask tasks that a preparation is made of, and what they leave for each other."""
