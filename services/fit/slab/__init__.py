"""Flat slabs: totals and their derivatives, by the same walk as the fit."""
