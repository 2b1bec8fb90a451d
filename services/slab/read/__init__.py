"""Reading a slab's folder: images, exposures, and what is wrong with them before a fit begins."""
