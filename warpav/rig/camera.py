"""The camera model: a pinhole without skew."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class CameraModel:
    """A pinhole camera, square pixels, principal point in the middle of the image.

    Attributes:
        width_px: Image width [px], at least 8.
        height_px: Image height [px], at least 8.
        fov_rad: Horizontal field of view [rad], in (0, pi).
        near_m: Surfaces nearer than this along the optical axis are cut away [m], positive.
    """

    width_px: int = 256
    height_px: int = 256
    fov_rad: float = math.pi / 2
    near_m: float = 0.1

    def __post_init__(self) -> None:
        if self.width_px < 8 or self.height_px < 8:
            raise ValueError(f"an image needs at least 8 x 8 pixels, got {self.width_px} x {self.height_px}")
        if not 0.0 < self.fov_rad < math.pi:
            raise ValueError(f"fov_rad must lie between 0 and pi, got {self.fov_rad}")
        if not self.near_m > 0.0:
            raise ValueError(f"near_m must be positive, got {self.near_m}")

    @property
    def focal_px(self) -> float:
        """Focal length [px]."""
        return 0.5 * self.width_px / math.tan(0.5 * self.fov_rad)

    @property
    def intrinsics(self) -> np.ndarray:
        """The 3 x 3 matrix that maps camera coordinates to homogeneous pixels; pixel centres lie at +0.5."""
        focal = self.focal_px
        return np.array([[focal, 0.0, 0.5 * self.width_px], [0.0, focal, 0.5 * self.height_px], [0.0, 0.0, 1.0]])


def rotational_additions(fov_rad: float) -> tuple[int, float]:
    """How often, and by what angle, a camera turns to look all round.

    ``2 pi mod F = 0`` cannot be tested in floating point; rounding alone gives the same value there. A field of view
    that is not near a divisor of the circle leaves blind seams or overlaps, as in the thesis.

    Equation: 2 (same value: rounding alone covers both cases)

    Args:
        fov_rad: Horizontal field of view F [rad], in (0, pi).

    Returns:
        Number of additions, at least 2, and ``F_closest`` [rad] between neighbours. Halves are rounded to even.
    """
    turns = round(2.0 * math.pi / fov_rad, 6)  # 48 degrees: 7.5, not the 7.499999999999999 of floats
    count = max(round(turns), 2)
    return count, 2.0 * math.pi / count
