"""All that draws, in 2D and 3D; `plot` is its front door."""

from warpav.core.face import face_of

__all__, __getattr__ = face_of(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
