"""A server under load: a program of its own measures it, see ``tests.benchmarks.load``."""
