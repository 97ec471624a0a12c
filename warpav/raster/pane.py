"""Panes: parts of a body that some views look through, and what of a mesh they take away."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from warpav.raster.mesh import Mesh

_MIN_FACING = math.cos(math.radians(30.0))
"""Least cosine between a triangle of the pane and the pane's normal: what only ends at the pane stays, as a scuttle."""

_SAME_M = 0.02  # a pane whose corners are so near to those of its mirror image is its own mirror image [m]

_STEPS = 6  # a triangle is cut into so many squared parts


@dataclass(frozen=True)
class Pane:
    """A prism over a convex outline: triangles inside of it that face along it are clear.

    A triangle is clear if at least half of it lies inside, and its normal is within 30 degrees of the pane's.
    """

    name: str  # what it is called, such as ``windscreen``
    normal: tuple[float, float, float]  # outwards, unit length
    # Corners of its outline in the world frame, in order along the border, at least 3 [m]; along the normal they are
    # projected
    outline_m: tuple[tuple[float, float, float], ...]
    # Least and greatest height of what is clear along the normal, over the plane through the middle of the outline [m]
    reach_m: tuple[float, float]

    def __post_init__(self) -> None:
        if not abs(math.hypot(*self.normal) - 1.0) < 1e-3:
            raise ValueError(f"normal: expected a unit vector, got {self.normal}")
        if not self.reach_m[0] < self.reach_m[1]:
            raise ValueError(f"reach_m: expected a range, the lower end first, got {self.reach_m}")
        if len(self.outline_m) < 3 or not self.area_m2 > 0.0:
            raise ValueError(f"outline_m: expected the corners of a polygon, got {self.outline_m}")

    @cached_property
    def _axes(self) -> np.ndarray:
        """Rows U and V across the pane and its normal N, float64 [3, 3]."""
        normal = np.asarray(self.normal, np.float64)
        normal = normal / np.linalg.norm(normal)
        u = np.cross(normal, np.eye(3)[int(np.abs(normal).argmin())])
        u /= np.linalg.norm(u)
        return np.stack([u, np.cross(normal, u), normal])

    @cached_property
    def _middle_m(self) -> np.ndarray:
        return np.mean(self.outline_m, axis=0)

    @cached_property
    def _corner_m(self) -> np.ndarray:
        """The outline across the normal, counter-clockwise, float64 [corner, 2]."""
        corner = (np.asarray(self.outline_m) - self._middle_m) @ self._axes[:2].T
        return corner if _doubled_area(corner) >= 0.0 else corner[::-1]

    @property
    def area_m2(self) -> float:
        """Area of the outline across the normal [m^2]."""
        return 0.5 * abs(_doubled_area(self._corner_m))

    def holds(self, point_m: np.ndarray) -> np.ndarray:
        """Which points [..., 3] lie inside the prism, bool [...]."""
        local = (np.asarray(point_m, np.float64) - self._middle_m) @ self._axes.T
        inside = (local[..., 2] >= self.reach_m[0]) & (local[..., 2] <= self.reach_m[1])
        for start, end in zip(self._corner_m, np.roll(self._corner_m, -1, axis=0), strict=True):
            (dx, dy), at = end - start, local[..., :2] - start
            inside &= dx * at[..., 1] - dy * at[..., 0] >= 0.0
        return inside

    def is_clear(self, corner_m: np.ndarray) -> np.ndarray:
        corner_m = np.asarray(corner_m, np.float64)
        clear = np.zeros(len(corner_m), bool)
        outline = np.asarray(self.outline_m)
        # what does not come near is not asked
        reach = np.abs(self.reach_m).max() + np.linalg.norm(outline - self._middle_m, axis=1).max()
        near = np.flatnonzero(
            (corner_m.min(axis=1) <= self._middle_m + reach).all(axis=1)
            & (corner_m.max(axis=1) >= self._middle_m - reach).all(axis=1)
        )
        corner_m = corner_m[near]
        normal = np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0])
        along = np.abs(normal @ self._axes[2]) >= _MIN_FACING * np.linalg.norm(normal, axis=1)
        inside = self.holds(np.einsum("sk,tki->tsi", _middles(), corner_m))
        clear[near] = along & (inside.mean(axis=1) >= 0.5)
        return clear

    def opened(self, mesh: Mesh) -> Mesh:
        """A mesh without what of it is clear."""
        gone = self.is_clear(mesh.vertex_m[mesh.triangle])
        return replace(mesh, triangle=mesh.triangle[~gone]) if gone.any() else mesh

    def clear_area_m2(self, mesh: Mesh) -> float:
        """Area of what is clear of a mesh, across the normal [m^2]; both sides of a double pane count."""
        corner = mesh.vertex_m[mesh.triangle].astype(np.float64)
        corner = corner[self.is_clear(corner)]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        return 0.5 * float(np.abs(normal @ self._axes[2]).sum())

    def mirrored(self) -> Pane:
        """The pane on the other side of the plane y = 0, called ``<name>_mirrored``; itself if it lies across it."""
        x, y, z = self.normal
        outline = tuple((a, -b, c) for a, b, c in reversed(self.outline_m))
        away = np.linalg.norm(np.asarray(outline)[:, None] - np.asarray(self.outline_m)[None], axis=-1)
        if abs(y) < _SAME_M and away.min(axis=1).max() <= _SAME_M and away.min(axis=0).max() <= _SAME_M:
            return self
        name = self.name.removesuffix("_mirrored") if self.name.endswith("_mirrored") else f"{self.name}_mirrored"
        return replace(self, name=name, normal=(x, -y, z), outline_m=outline)


@cache
def _middles() -> np.ndarray:
    """Shares of the corners in the middles of the equal parts that a triangle is cut into, float64 [part, 3]."""
    i, j = np.divmod(np.arange(_STEPS**2), _STEPS)
    both = [np.stack([i, j], axis=1) + at for at in (1 / 3, 2 / 3)]
    share = np.concatenate(both) / _STEPS
    share = share[share.sum(axis=1) < 1.0]
    return np.c_[1.0 - share.sum(axis=1), share]


def _doubled_area(corner_m: np.ndarray) -> float:
    """Twice the signed area of a polygon, [corner, 2]."""
    x, y = corner_m.T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())
