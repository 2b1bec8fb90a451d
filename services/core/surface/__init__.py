"""Options of surfaces that refract."""
