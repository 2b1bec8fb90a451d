"""How good the images are: counts, brightness and motion, and the page that shows them."""
