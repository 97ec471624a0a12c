"""Detectors, matching and average precision."""

from warpav.core.face import face_of

__all__, __getattr__ = face_of(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
