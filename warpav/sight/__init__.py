"""Sight: which cameras see what around the vehicle, and what has to be seen there."""

from warpav.core.face import face_of

__all__, __getattr__ = face_of(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
