"""What a person states about the light of a dome, and what was lit under that."""
