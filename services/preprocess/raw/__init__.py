"""Raw folders: from a camera's counts to radiance with the variance of every pixel."""
