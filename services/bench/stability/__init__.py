"""Numerical stability at the corners of the parameters and in difficult scenes."""
