"""Designing a measurement: the smallest standard errors that images allow, and which further measurement helps most."""
