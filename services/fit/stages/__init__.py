"""Stages of a fit: which parameters are free when, step by step, for a tooth and for a jaw."""
