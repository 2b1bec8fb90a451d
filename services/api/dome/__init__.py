"""The dome by hand: look, one light, ALL OFF, preflight."""
