"""Fits of teeth and jaws, timed against their error."""
