"""Random walks through teeth, from their start to a light, and what they score."""
