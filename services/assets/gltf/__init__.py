"""glTF 2.0: surfaces with preview materials, and the coefficients beside them."""
