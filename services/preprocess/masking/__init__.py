"""Which pixels a fit may use: highlights, shadows, masks by hand."""
