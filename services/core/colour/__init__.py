"""Colours as the CIE defines them: L*a*b*, colour differences, the standard observer under daylight."""
