"""The fit of a whole jaw."""
