"""Table search, Gauss-Newton, uncertainty."""
