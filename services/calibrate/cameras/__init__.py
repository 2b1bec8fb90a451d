"""Boards in photographs, lenses, and where all cameras of a rig stand."""
