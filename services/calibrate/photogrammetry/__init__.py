"""Cameras and lights from the model of a photogrammetry program."""
