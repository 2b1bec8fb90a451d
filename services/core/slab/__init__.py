"""A material in a cell, as all packages share it: its folder, its exposures and the names of its dictionaries."""
