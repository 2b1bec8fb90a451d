"""Manual operation of the dome: its state, one light, ALL OFF, preflight."""
