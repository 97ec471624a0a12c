"""Test objects: what stands, or lies, on the ground of a requirement."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull

from warpav.raster.mesh import Mesh

SIZES_M = {
    "post": (0.3, 0.3, 1.1),
    "bollard": (0.12, 0.12, 0.9),
    "child": (0.2, 0.3, 1.1),
    "adult": (0.3, 0.5, 1.75),
    "lying": (1.75, 0.5, 0.25),
}
"""Length along x, width along y and height of the test objects that have a name [m]."""

_SIDES = 12
"""Of an upright test object: its outline touches the length and the width."""


@dataclass(frozen=True)
class TestObject:
    """A test object: an upright prism, for a lying person a box, or a mesh."""

    __test__ = False  # no test of pytest's

    kind: str
    size_m: tuple[float, float, float]
    yaw_rad: float = 0.0
    mesh: Mesh | None = field(default=None, compare=False)

    @cached_property
    def body(self) -> Mesh:
        """The object as it stands at the origin, turned."""
        mesh = _prism(self.size_m, is_box=self.kind == "lying") if self.mesh is None else self.mesh
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return mesh.transformed(np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))

    @cached_property
    def hull_m(self) -> np.ndarray:
        """Triangles of its convex hull [m], float64 [triangle, 3, 3]; their winding means nothing."""
        point_m = self.body.vertex_m.astype(np.float64)
        return point_m[ConvexHull(point_m).simplices]

    @cached_property
    def footprint_m(self) -> np.ndarray:
        """Corners of its outline from above, and what lies halfway between them [m], [point, 2]."""
        point_m = self.body.vertex_m[:, :2].astype(np.float64)
        corner_m = point_m[ConvexHull(point_m).vertices]
        return np.concatenate([corner_m, 0.5 * (corner_m + np.roll(corner_m, -1, axis=0))])


def _prism(size_m: tuple[float, float, float], *, is_box: bool) -> Mesh:
    length, width, height = size_m
    if is_box:
        ring = 0.5 * np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    else:
        turn = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
        ring = 0.5 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    ring = ring * (length, width)
    n = len(ring)
    vertex = np.concatenate([np.c_[ring, np.zeros(n)], np.c_[ring, np.full(n, height)]])
    i, j = np.arange(n), (np.arange(n) + 1) % n
    k = np.arange(1, n - 1)
    triangle = np.concatenate(
        [
            np.c_[i, j, n + j],
            np.c_[i, n + j, n + i],
            np.c_[np.zeros_like(k), k + 1, k],
            np.c_[np.full_like(k, n), n + k, n + k + 1],
        ]
    )
    return Mesh(vertex.astype(np.float32), triangle.astype(np.int32), np.full((2 * n, 3), 200, np.uint8))
