"""Experiments: the thesis's tables again, and our own."""
