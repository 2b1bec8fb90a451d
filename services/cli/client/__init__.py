"""The commands that speak to a server; they need the base install alone."""
