"""The dome worked by hand over the API."""
