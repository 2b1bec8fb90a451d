"""Lights: connections to them and maps of what they reach."""
