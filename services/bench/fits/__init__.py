"""Benchmarks of the fits of teeth and jaws: error against processor time."""
