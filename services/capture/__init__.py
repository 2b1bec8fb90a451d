"""Plan, dome and cameras, real and simulated; writes the capture store."""
