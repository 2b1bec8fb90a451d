"""Benchmarks of the engine's images and derivatives against stock Mitsuba and plain walks."""
