"""Flat slabs: the fit of a material to images of a cell, and totals of layers with derivatives by the walk of the
teeth.
"""
