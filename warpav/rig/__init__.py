"""Floor 2: cameras and the rigs that carry them."""
