"""Benchmarks of the preparation: speed of each step beside the bare library calls that do its arithmetic."""
