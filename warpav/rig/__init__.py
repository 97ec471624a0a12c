"""Cameras and the rigs that carry them."""
