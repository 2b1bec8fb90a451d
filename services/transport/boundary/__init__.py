"""How the outer face of a scene treats light: one file for each model."""
