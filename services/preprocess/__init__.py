"""Radiometry, stabilisation, highlight and valid masks; writes the prepared store."""
