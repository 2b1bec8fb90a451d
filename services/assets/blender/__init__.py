"""Exporter to Blender: a script that builds the scene."""
