"""Plane fits and the Poisson equation."""
