"""Benchmarks of numerical stability at extreme parameters and in difficult scenes."""
