"""Raw folders, as all packages share them: the description ``raw.toml``, and the counts of the frames."""
