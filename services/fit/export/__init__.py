"""Export of a fit: Mitsuba scene, parameters, report."""
