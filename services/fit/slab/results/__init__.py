"""What a slab fit gives: the record, its report, its phase function for Mitsuba."""
