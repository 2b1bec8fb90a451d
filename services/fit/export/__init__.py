"""The asset: Mitsuba scene, parameters, report."""
