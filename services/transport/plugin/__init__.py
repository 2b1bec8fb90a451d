"""The Mitsuba integrator that renders measured teeth in any scene."""
