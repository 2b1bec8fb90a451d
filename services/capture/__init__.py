"""Capture with a rig: plan, dome and cameras, real and simulated; writes the capture store."""
