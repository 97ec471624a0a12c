"""Kernels of who sees what."""
