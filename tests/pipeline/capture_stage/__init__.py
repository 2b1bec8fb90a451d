"""The capture stage with the simulated dome and cameras."""
