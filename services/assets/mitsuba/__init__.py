"""Exporter to Mitsuba: scenes as dictionaries and as XML files."""
