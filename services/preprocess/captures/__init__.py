"""Folders of linear images, and captures of the rig, as sources."""
