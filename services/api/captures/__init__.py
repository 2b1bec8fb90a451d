"""Uploaded captures: their files, checks and records."""
