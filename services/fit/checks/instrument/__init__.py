"""What a fit found of the instrument: its errors as estimates and as sentences."""
