"""Where an asset comes from, whether it is as it was written, and whether it can be made again."""
