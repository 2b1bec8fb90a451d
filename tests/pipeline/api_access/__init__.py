"""Access control of the API."""
