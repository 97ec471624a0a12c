"""Detection probability, and images as a network takes them."""
