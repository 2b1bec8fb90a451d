"""Masks of prepared captures, drawn and corrected by hand."""
