"""Preparation: speed of each step beside the bare library calls that it is made of."""
