"""What crosses a process boundary. Imports no service and nothing heavier than NumPy, pydantic and zarr."""
