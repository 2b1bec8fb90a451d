"""The inverse problem: normal equations of independent batches, Gauss-Newton, the prior, the standard errors."""
