"""Uploads by the tus protocol."""
