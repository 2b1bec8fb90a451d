"""The engine's images and derivatives, timed against stock Mitsuba and plain walks."""
