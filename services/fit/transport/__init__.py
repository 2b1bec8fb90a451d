"""The nested-media walk: images under all lights at once, with derivatives."""
