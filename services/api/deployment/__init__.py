"""Secrets of a deployment and the change of its passwords."""
