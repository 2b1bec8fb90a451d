"""Where lights are, by their highlights on mirror spheres, and how bright they are, by white ones."""
