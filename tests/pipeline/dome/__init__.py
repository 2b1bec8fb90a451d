"""The dome by hand, over the API."""
