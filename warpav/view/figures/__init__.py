"""Figures in 2D, as files or as SVG text: of runs, rigs, detections, statistics and captures.

Importing a module of this package imports neither matplotlib nor pyvista.
"""
