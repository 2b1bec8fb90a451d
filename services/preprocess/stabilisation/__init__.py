"""How the jaws moved between frames, and frames as if they had not."""
