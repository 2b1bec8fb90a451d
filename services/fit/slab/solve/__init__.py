"""The inverse: normal equations of independent batches, Gauss-Newton, the prior, the ±."""
