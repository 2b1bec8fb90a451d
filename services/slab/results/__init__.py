"""Results of a slab fit: the record, its report, its phase function for Mitsuba."""
