"""Scans: reading them, parting them into teeth, and closing teeth by roots."""
