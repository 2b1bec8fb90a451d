"""What a fit is worth: errors, ±, alignment, what images cannot tell, and what to capture next."""
