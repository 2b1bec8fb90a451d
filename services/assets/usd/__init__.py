"""USD: surfaces with preview and OpenPBR materials, and the coefficients as attributes."""
