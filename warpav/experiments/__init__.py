"""Experiments: the thesis's tables again, and our own."""

from warpav.core.face import face_of

__all__, __getattr__ = face_of(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
