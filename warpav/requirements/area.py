"""Areas on the ground around a vehicle: bands around its body, strips beside it, polygons; grids of points in them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull

from warpav.raster.mesh import Mesh

SIDES = ("front", "rear", "left", "right")
"""Sides of the body that a strip lies beside."""

_EDGE_M = 1e-6  # points on a border belong to the area


@dataclass(frozen=True, eq=False)
class Body:
    """A vehicle's body from above, in the ego frame.

    Attributes:
        outline_m: Its convex hull, counter-clockwise, float64 [corner, 2].
    """

    outline_m: np.ndarray

    @classmethod
    def of(cls, ego: Mesh) -> Body:
        """The body of a vehicle's mesh; all of it counts, mirrors too."""
        point_m = ego.vertex_m[:, :2].astype(np.float64)
        return cls(point_m[ConvexHull(point_m).vertices])

    @cached_property
    def bounds_m(self) -> np.ndarray:
        """Lowest and highest corner [m], [2, 2]."""
        return np.stack([self.outline_m.min(axis=0), self.outline_m.max(axis=0)])

    @property
    def centre_m(self) -> np.ndarray:
        """Centre of the bounds [m], [2]."""
        return self.bounds_m.mean(axis=0)

    def distance_m(self, point_m: np.ndarray) -> np.ndarray:
        """Distance of points [..., 2] from the outline [m], 0 within it; [...]."""
        start = self.outline_m
        along = np.roll(start, -1, axis=0) - start
        offset = point_m[..., None, :] - start
        share = np.clip((offset * along).sum(axis=-1) / (along**2).sum(axis=-1), 0.0, 1.0)
        distance = np.linalg.norm(offset - share[..., None] * along, axis=-1).min(axis=-1)
        left = along[:, 0] * offset[..., 1] - along[:, 1] * offset[..., 0]
        return np.where((left >= 0.0).all(axis=-1), 0.0, distance)

    def grown_m(self, distance_m: float) -> np.ndarray:
        """What is within a distance of it, as a polygon [corner, 2] with round corners."""
        if distance_m <= 0.0:
            return self.outline_m
        turn = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
        circle = distance_m * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        point_m = (self.outline_m[:, None] + circle).reshape(-1, 2)
        return point_m[ConvexHull(point_m).vertices]


@dataclass(frozen=True)
class Band:
    """Ground at a distance from the body."""

    distance_m: tuple[float, float]

    def outlines_m(self, body: Body) -> list[np.ndarray]:
        """Its outer and inner border, [corner, 2] each."""
        return [body.grown_m(distance) for distance in self.distance_m[::-1]]

    def holds(self, point_m: np.ndarray, body: Body) -> np.ndarray:
        """Which points [..., 2] lie in it, bool [...]."""
        distance = body.distance_m(point_m)
        return (distance >= self.distance_m[0] - _EDGE_M) & (distance <= self.distance_m[1] + _EDGE_M)


@dataclass(frozen=True)
class Strip:
    """A rectangle straight out from one side of the body's bounds."""

    side: str
    distance_m: tuple[float, float]
    along_m: tuple[float, float] | None = None

    def outlines_m(self, body: Body) -> list[np.ndarray]:
        """Its border, [4, 2]."""
        across = 0 if self.side in ("front", "rear") else 1
        low, high = body.bounds_m
        along = 1 - across
        ends = (low[along], high[along]) if self.along_m is None else body.centre_m[along] + self.along_m
        near, far = self.distance_m
        reach = (
            (high[across] + near, high[across] + far)
            if self.side in ("front", "left")
            else (low[across] - far, low[across] - near)
        )
        (x0, x1), (y0, y1) = (reach, ends) if across == 0 else (ends, reach)
        return [np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], np.float64)]

    def holds(self, point_m: np.ndarray, body: Body) -> np.ndarray:
        """Which points [..., 2] lie in it, bool [...]."""
        return _is_inside(point_m, self.outlines_m(body)[0])


@dataclass(frozen=True)
class Polygon:
    """A polygon in the ego frame."""

    corner_m: tuple[tuple[float, float], ...]

    def outlines_m(self, body: Body) -> list[np.ndarray]:
        """Its border, [corner, 2]."""
        return [np.array(self.corner_m, np.float64)]

    def holds(self, point_m: np.ndarray, body: Body) -> np.ndarray:
        """Which points [..., 2] lie in it, bool [...]."""
        return _is_inside(point_m, self.outlines_m(body)[0])


Area = Band | Strip | Polygon


def grid_m(area: Area, body: Body, spacing_m: float) -> np.ndarray:
    """Points of an area on a grid in the middle of its bounds, [point, 2], x running slowest."""
    outline = area.outlines_m(body)[0]
    steps = []
    for low, high in zip(outline.min(axis=0), outline.max(axis=0), strict=True):
        count = int((high - low) / spacing_m + 1e-6) + 1
        steps.append(0.5 * (low + high) + spacing_m * (np.arange(count) - 0.5 * (count - 1)))
    point_m = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 2)
    return point_m[area.holds(point_m, body)]


def _is_inside(point_m: np.ndarray, corner_m: np.ndarray) -> np.ndarray:
    """Which points [..., 2] lie in a polygon [corner, 2] or on its border, bool [...]."""
    start, end = corner_m, np.roll(corner_m, -1, axis=0)
    offset, along = point_m[..., None, :] - start, end - start
    is_upwards = start[:, 1] <= point_m[..., 1, None]
    crosses = is_upwards != (end[:, 1] <= point_m[..., 1, None])
    side = along[:, 0] * offset[..., 1] - along[:, 1] * offset[..., 0]
    inside = (crosses & ((side > 0.0) == is_upwards)).sum(axis=-1) % 2 == 1
    share = np.clip((offset * along).sum(axis=-1) / np.maximum((along**2).sum(axis=-1), 1e-300), 0.0, 1.0)
    distance = np.linalg.norm(offset - share[..., None] * along, axis=-1).min(axis=-1)
    return inside | (distance <= _EDGE_M)
