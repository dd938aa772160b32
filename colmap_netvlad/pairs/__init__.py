"""Rankings -> the image pairs to match, and lists of them."""
