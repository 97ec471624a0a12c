"""Figures in 2D, as files or as SVG text: of runs, rigs, detections, statistics and captures.

Importing a module of this package imports neither matplotlib nor pyvista.
"""

from warpav.core.face import face_of

__all__, __getattr__ = face_of(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
