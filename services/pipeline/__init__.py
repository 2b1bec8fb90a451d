"""A job's stages on Dask, its workers and its event log: all that ``dentine run`` needs."""
