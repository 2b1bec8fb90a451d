"""The fit of one tooth."""
