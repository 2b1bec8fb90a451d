"""Derivatives of images with respect to borders, shapes and stains."""
