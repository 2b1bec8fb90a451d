"""What a fit is made from: measured pixels with their weights, and the textures of stains."""
