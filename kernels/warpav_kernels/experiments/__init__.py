"""Losses of the benchmark."""
