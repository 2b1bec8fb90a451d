"""What all rooms know of a raw folder: its description ``raw.toml``, and the counts of its frames."""
