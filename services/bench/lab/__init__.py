"""The virtual laboratory measured: from its raw frames to a tooth's optics, and how far that is from the truth."""
