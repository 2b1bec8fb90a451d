"""Assets of a fit: scenes, textures, parameters and report, as people open them."""
