"""Rasterisation: triangles to samples, areas, extents and their derivatives."""
