"""Requirements: an area on the ground, what stands there, and how well how many cameras have to see it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np

from warpav.core.errors import InputError
from warpav.raster.mesh import Mesh

# ------------------------------------------------------------------------------------------- areas on the ground

SECTORS = ("front", "front left", "left", "rear left", "rear", "rear right", "right", "front right")
"""Sectors of 45 degrees around the middle of the vehicle, the first one centred straight ahead; the centre of an
object's box decides, and a sector includes its right edge."""

_EDGE_M = 1e-6  # points on a border belong to the area


@dataclass(frozen=True, eq=False)
class Body:
    """A vehicle's body from above, in the ego frame."""

    outline_m: np.ndarray  # its convex hull, counter-clockwise, float64 [corner, 2]

    @classmethod
    @lru_cache(maxsize=8)
    def of(cls, ego: Mesh) -> Body:
        """The body of a vehicle's mesh; all of it counts, mirrors too."""
        from scipy.spatial import ConvexHull

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
        return np.where(self.contains(point_m), 0.0, distance)

    def contains(self, point_m: np.ndarray) -> np.ndarray:
        """Whether points [..., 2] are within it or on its border, bool [...]."""
        along_x, along_y = (np.roll(self.outline_m, -1, axis=0) - self.outline_m).T  # it runs to the left
        return (
            along_x * (point_m[..., 1:] - self.outline_m[:, 1]) >= along_y * (point_m[..., :1] - self.outline_m[:, 0])
        ).all(axis=-1)

    def border_m(self, azimuth_rad: np.ndarray) -> np.ndarray:
        """Points of the border by azimuth from the centre [m], float64 [direction, 2]."""
        across = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=-1)
        side = np.roll(self.outline_m, -1, axis=0) - self.outline_m
        normal = np.stack([side[:, 1], -side[:, 0]], axis=-1) / np.linalg.norm(side, axis=1, keepdims=True)
        inside = ((self.outline_m - self.centre_m) * normal).sum(axis=1)
        along = across @ normal.T
        distance_m = np.where(along > 1e-12, inside / np.maximum(along, 1e-12), np.inf).min(axis=1)
        return self.centre_m + distance_m[:, None] * across

    def ring_m(self, distance_m: float, *, direction_count: int = 720) -> np.ndarray:
        """The closed line at a distance from the border, by its normal from ahead to the left [m], [direction, 2]."""
        turn_rad = np.arange(direction_count) * 2.0 * math.pi / direction_count
        normal = np.stack([np.cos(turn_rad), np.sin(turn_rad)], axis=-1)
        return self.outline_m[(normal @ self.outline_m.T).argmax(axis=1)] + distance_m * normal


@dataclass(frozen=True)
class Band:
    """Ground at a distance from the body."""

    distance_m: tuple[float, float]

    def outlines_m(self, body: Body) -> list[np.ndarray]:
        """Its outer and inner border, [corner, 2] each."""
        return [body.ring_m(each) if each > 0.0 else body.outline_m for each in self.distance_m[::-1]]

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


def sectors_of(from_ego_m: np.ndarray) -> np.ndarray:
    """Index in `SECTORS` of positions relative to the ego vehicle's centre: forward and left [m], [..., 2]."""
    turn = np.arctan2(from_ego_m[..., 1], from_ego_m[..., 0]) * (len(SECTORS) / (2.0 * math.pi))
    return (np.floor(turn + 0.5) % len(SECTORS)).astype(int)


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


# ------------------------------------------------------------------------------------------------ test objects

SIZES_M = {
    "post": (0.3, 0.3, 1.1),
    "bollard": (0.12, 0.12, 0.9),
    "child": (0.2, 0.3, 1.1),
    "adult": (0.3, 0.5, 1.75),
    "lying": (1.75, 0.5, 0.25),
}
"""Length along x, width along y and height of the test objects that have a name [m]."""

_SIDES = 12  # of an upright test object: its outline touches the length and the width


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
        from scipy.spatial import ConvexHull

        point_m = self.body.vertex_m.astype(np.float64)
        return point_m[ConvexHull(point_m).simplices]

    @cached_property
    def footprint_m(self) -> np.ndarray:
        """Corners of its outline from above, and what lies halfway between them [m], [point, 2]."""
        from scipy.spatial import ConvexHull

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


# ------------------------------------------------------------------------------------------------ requirements

MAX_GHOSTS = 100_000  # points of all requirements together


@dataclass(frozen=True)
class Requirement:
    """What has to be seen on a part of the ground."""

    name: str
    area: Area
    grid_m: float
    test_object: TestObject
    visible_share: float = 0.5
    pixels: float = 0.0  # area that is seen of it in the image at least [px^2]
    cameras: int = 1
    sector_rad: tuple[float, float] | None = None
    weight: float | None = None
    share: float | None = 1.0

    @property
    def is_hard(self) -> bool:
        """Whether every point has to be met."""
        return self.weight is None

    def need(self) -> str:
        """What is needed, in words."""
        seen = f"{100.0 * self.visible_share:g} %"
        if self.pixels > 0.0:
            seen += f" and {self.pixels:g} px"
        kind = self.test_object.kind
        article = "an" if kind[:1].lower() in set("aeiou") else "a"
        text = f"{seen} of {article} {kind} by {self.cameras} camera{'s' if self.cameras > 1 else ''}"
        return text if self.share in (None, 1.0) else f"{text}, at {100.0 * self.share:g} % of the points"

    def points_m(self, body: Body) -> np.ndarray:
        """Where the test object is put [m], [point, 2]: only where it does not reach under the body."""
        point_m = grid_m(self.area, body, self.grid_m)
        inside = "the area"
        if self.sector_rad is not None:
            start, end = self.sector_rad
            turn = np.arctan2(*(point_m - body.centre_m).T[::-1])
            point_m = point_m[(turn - start + 1e-9) % (2.0 * math.pi) <= (end - start) % (2.0 * math.pi) + 2e-9]
            inside = "the area's part in the sector"
        if len(point_m):
            point_m = point_m[(body.distance_m(point_m[:, None] + self.test_object.footprint_m) > 0.0).all(axis=1)]
        if not len(point_m):
            raise InputError(
                f"requirement {self.name}: expected at least one point of {inside} outside of the body, got none with "
                f"a grid of {self.grid_m:g} m; enlarge the area or refine the grid"
            )
        return point_m


@dataclass(frozen=True, eq=False)
class Ghosts:
    """The test objects of some requirements, each at one point."""

    requirements: tuple[Requirement, ...]
    position_m: np.ndarray  # where each stands, float64 [ghost, 2]
    requirement: np.ndarray

    @classmethod
    def of(cls, requirements: Sequence[Requirement], ego: Mesh) -> Ghosts:
        """The test objects around a vehicle."""
        if not requirements:
            raise InputError("requirements: expected at least one, got none")
        body = Body.of(ego)
        points = [each.points_m(body) for each in requirements]
        count = sum(map(len, points))
        if count > MAX_GHOSTS:
            raise InputError(
                f"requirements: expected at most {MAX_GHOSTS} points together, got {count}; choose wider grids"
            )
        which = np.repeat(np.arange(len(points)), [len(each) for each in points])
        return cls(tuple(requirements), np.concatenate(points), which)

    def __len__(self) -> int:
        return len(self.position_m)

    def of_each(self, name: str) -> np.ndarray:
        """A number of every ghost's requirement, such as ``visible_share``, [ghost]."""
        return np.array([getattr(each, name) for each in self.requirements])[self.requirement]

    @cached_property
    def is_hard(self) -> np.ndarray:
        """Whether its requirement is hard, bool [ghost]."""
        return self.of_each("is_hard")

    def at(self, which: np.ndarray) -> Ghosts:
        """Some of them, int [ghost]."""
        return Ghosts(self.requirements, self.position_m[which], self.requirement[which])

    def mesh(self, ghost: int) -> Mesh:
        """The test object where it stands, in the ego frame."""
        body = self.requirements[self.requirement[ghost]].test_object.body
        return body.transformed(np.eye(3), np.append(self.position_m[ghost], 0.0))
