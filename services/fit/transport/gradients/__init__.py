"""Derivatives of images by moving borders, shapes and stains."""
