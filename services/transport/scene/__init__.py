"""The scene that walks go through: its recipe, media, solids and checks."""
