"""Builds closed, outward-facing surfaces from a few primitives, and gives them smooth vertex normals.

A surface is a union of shells: lofts, boxes, lathes, tubes and ellipsoids. Every shell is closed (each edge is used
once in either direction) and counter-clockwise seen from outside, so a ray from outside never meets the back of a
triangle. Shells may overlap: a lamp box sinks into the body, the glass house into the deck.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from warpav.scene._scene import yaw_rotation

_WELD_GRID_M = 1e-5  # vertices nearer than this are one vertex
_CREASE_COSINE = float(np.cos(np.radians(42.0)))  # flatter edges are shaded smoothly
Point = tuple[float, float, float]
NORMAL_STEPS = 64  # normals are compared on this grid when vertices are shared


@dataclass(frozen=True)
class Surface:
    """A finished surface: vertices are shared only where material and shading normal agree."""

    vertex_m: np.ndarray  # positions [m], float64, shape [vertex, 3]
    normal: np.ndarray  # unit shading normals, float64, shape [vertex, 3]
    material: np.ndarray  # material number per vertex, uint8, shape [vertex]
    triangle: np.ndarray  # vertex indices, int32, shape [triangle, 3], counter-clockwise seen from outside


class SurfaceBuilder:
    """Collects shells; `finish` welds them, drops degenerate triangles and computes normals."""

    def __init__(self) -> None:
        self._vertex: list[np.ndarray] = []
        self._triangle: list[np.ndarray] = []
        self._material: list[np.ndarray] = []
        self._vertex_count = 0

    def add_grid(self, point_m: np.ndarray, material: np.ndarray | int) -> None:
        """Add a sheet of quads, [a, b, 3]; its outside is where ``d/d(first index) x d/d(second index)`` points."""
        rows, columns = point_m.shape[:2]
        first = self._vertex_count + (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
        quad = np.stack([first, first + columns, first + columns + 1, first + 1], axis=1)
        quad_material = np.broadcast_to(np.asarray(material, np.uint8), (rows - 1, columns - 1)).ravel()
        self._vertex.append(point_m.reshape(-1, 3))
        self._triangle.append(np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]))
        self._material.append(np.concatenate([quad_material, quad_material]))
        self._vertex_count += rows * columns

    def add_mirrored_grid(self, point_m: np.ndarray, material: np.ndarray | int) -> None:
        """Add a sheet of quads as `add_grid` does, and its mirror image across the plane y = 0."""
        self.add_grid(point_m, material)
        material = np.broadcast_to(np.asarray(material), (point_m.shape[0] - 1, point_m.shape[1] - 1))
        self.add_grid(point_m[:, ::-1] * np.array([1.0, -1.0, 1.0]), material[:, ::-1])

    def add_loft(
        self, ring_m: np.ndarray, material: np.ndarray, *, crown_m: float, across: int, caps: tuple[int, int]
    ) -> None:
        """Add a closed body from stacked half outlines, [row, column, 3], mirrored across y = 0; caps: top, bottom."""
        self.add_mirrored_grid(ring_m.transpose(1, 0, 2), material.T)
        self.add_grid(_cap(ring_m[-1], crown_m, across)[::-1], caps[0])
        self.add_grid(_cap(ring_m[0], 0.0, 2), caps[1])

    def add_box(self, low_m: Point, high_m: Point, material: int) -> None:
        corner = np.array([[(low_m, high_m)[bit >> axis & 1][axis] for axis in range(3)] for bit in range(8)])
        for quad in ((0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6)):
            self.add_grid(corner[np.array(quad)[[[0, 3], [1, 2]]]], material)

    def add_box_pair(self, low_m: Point, high_m: Point, material: int) -> None:
        """Add a box and its mirror image across y = 0."""
        self.add_box(low_m, high_m, material)
        self.add_box((low_m[0], -high_m[1], low_m[2]), (high_m[0], -low_m[1], high_m[2]), material)

    def add_lathe_pair(self, center_m: Point, profile_m: np.ndarray, material: np.ndarray) -> None:
        """Add a solid of revolution about a y axis, of a profile [point, 2], and its mirror image across y = 0."""
        angle = np.linspace(0.0, 2.0 * np.pi, material.shape[1] + 1) - 0.5 * np.pi  # a vertex at the very bottom
        radius, offset = profile_m[:, :1], profile_m[:, 1:]
        point = np.stack(
            [
                center_m[0] + radius * np.cos(angle),
                center_m[1] + np.broadcast_to(offset, (len(profile_m), len(angle))),
                center_m[2] + radius * np.sin(angle),
            ],
            axis=-1,
        )
        self.add_mirrored_grid(point[:, ::-1], material[:, ::-1])

    def add_ellipsoid_pair(self, center_m: Point, radius_m: Point, material: int) -> None:
        """Add an ellipsoid with axes along x, y, z, and its mirror image across y = 0."""
        polar = np.linspace(0.0, np.pi, 6)[:, None]
        around = np.linspace(0.0, 2.0 * np.pi, 9)
        direction = np.stack(
            [np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar) + 0.0 * around], axis=-1
        )
        self.add_mirrored_grid(np.array(center_m) + direction * np.array(radius_m), material)

    def add_tube(
        self, centre_m: ArrayLike, radius_m: ArrayLike, material: np.ndarray | int, *, sides: int, cap: float = 0.45
    ) -> None:
        """Add a closed tube along a path; ``centre_m`` [ring, 3], ``radius_m`` [ring, 2], [ring] or one for all."""
        centre, radius = np.asarray(centre_m, np.float64), np.asarray(radius_m, np.float64)
        radius = np.broadcast_to(radius[:, None] if radius.ndim == 1 else radius, (len(centre), 2))
        step = np.diff(centre, axis=0)
        step /= np.linalg.norm(step, axis=1, keepdims=True)
        along = np.concatenate([step[:1], step[:-1] + step[1:], step[-1:]])
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        side = np.array([0.0, 1.0, 0.0]) if np.abs(along[:, 1]).max() < 0.8 else np.array([1.0, 0.0, 0.0])
        first = np.cross(side, along)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second = np.cross(along, first)
        angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)[:, None, None]
        angle[-1] = 0.0  # the seam closes exactly
        ring = centre + np.cos(angle) * radius[:, :1] * first + np.sin(angle) * radius[:, 1:] * second
        ends = [centre[0] - cap * radius[0].mean() * along[0], centre[-1] + cap * radius[-1].mean() * along[-1]]
        poles = [np.broadcast_to(end, (sides + 1, 1, 3)) for end in ends]
        cells = np.asarray(material)
        self.add_grid(np.concatenate([poles[0], ring, poles[1]], axis=1), cells[None] if cells.ndim else cells)

    def finish(self) -> Surface:
        """Weld all shells and compute shading normals."""
        vertex, triangle, material = (np.concatenate(parts) for parts in (self._vertex, self._triangle, self._material))
        key, weld = np.unique(_row_key(np.round(vertex / _WELD_GRID_M).astype(np.int64)), return_inverse=True)
        position = np.empty((len(key), 3))
        position[weld] = vertex
        corner = weld[triangle]
        distinct = (corner != np.roll(corner, 1, axis=1)).all(axis=1)
        corner, material = corner[distinct], material[distinct]
        normal = corner_normals(position, corner)

        normal_key = _row_key(np.round(normal.reshape(-1, 3) * NORMAL_STEPS).astype(np.int64))
        row = np.stack([corner.ravel(), np.repeat(material, 3).astype(np.int64), normal_key], axis=1)
        _, first, index = np.unique(_row_key(row), return_index=True, return_inverse=True)
        # Numbered by first use: neighbours in the list of triangles stay neighbours in memory.
        order = np.argsort(first, kind="stable")
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        first = first[order]
        return Surface(
            position[corner.ravel()[first]],
            normal.reshape(-1, 3)[first],
            np.repeat(material, 3)[first].astype(np.uint8),
            rank[index].reshape(-1, 3).astype(np.int32),
        )


def _cap(rim_m: np.ndarray, crown_m: float, lateral_count: int) -> np.ndarray:
    """Sheet that spans a half outline and its mirror image, shape [column, lateral_count + 1, 3]."""
    across = np.linspace(-1.0, 1.0, lateral_count + 1)
    rise = crown_m * (1.0 - across**2) * np.minimum(1.0, rim_m[:, 1:2] / (0.6 * rim_m[:, 1].max()))
    return np.stack([np.repeat(rim_m[:, :1], len(across), 1), rim_m[:, 1:2] * across, rim_m[:, 2:] + rise], axis=-1)


def _row_key(row: np.ndarray) -> np.ndarray:
    """One int64 per row of integers, equal exactly where the rows are equal."""
    key = np.zeros(len(row), np.int64)
    for column in row.T:
        value, index = np.unique(column, return_inverse=True)
        key = np.unique(key * len(value) + index, return_inverse=True)[1].astype(np.int64)
    return key


def corner_normals(position_m: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Unit normal of every triangle corner, averaged over the neighbours within the crease angle."""
    edge = position_m[triangle[:, 1:]] - position_m[triangle[:, :1]]
    area_normal = np.cross(edge[:, 0], edge[:, 1])
    unit = area_normal / (np.linalg.norm(area_normal, axis=1, keepdims=True) + 1e-15)

    order = np.argsort(triangle.ravel(), kind="stable")
    count = np.bincount(triangle.ravel())
    start = np.cumsum(count) - count
    # Every ordered pair of corners that meet in one vertex.
    valence = count[triangle.ravel()]
    left = np.repeat(np.arange(triangle.size), valence)
    within = np.arange(len(left)) - np.repeat(np.cumsum(valence) - valence, valence)
    right = order[np.repeat(start[triangle.ravel()], valence) + within]
    smooth = np.einsum("ij,ij->i", unit[left // 3], unit[right // 3]) > _CREASE_COSINE
    left, right = left[smooth], right[smooth]
    total = np.stack(
        [np.bincount(left, area_normal[right // 3, axis], minlength=triangle.size) for axis in range(3)], axis=1
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    total = np.where(length > 1e-12, total / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])
    return total.reshape(-1, 3, 3)


_KNOT_SPACING_M = 2.0  # planes lie between multiples of this x; whatever is split there lies on them exactly
_LEVEL_REACH_M = 4.5  # the ego vehicle stands on level ground
_CURVE_LENGTH_M = 20.0  # in which the road bends from level to its grade
_REACH_M = 96.0
_FLAT_M = 1e-9  # second differences of the height below this are rounding errors


class StreetGround:
    """Height of the ground as a function of x in the town frame; it does not depend on y."""

    def __init__(
        self,
        centre_x_m: float = 0.0,
        ahead: float = 0.0,
        behind: float = 0.0,
        *,
        curve_m: float = _CURVE_LENGTH_M,
        reach_m: float = _REACH_M,
        only_bends: bool = False,
    ) -> None:
        self.is_level = ahead == 0.0 and behind == 0.0
        self._knot = np.arange(-reach_m, reach_m + 0.5 * _KNOT_SPACING_M, _KNOT_SPACING_M)
        beyond = np.maximum(np.abs(self._knot - centre_x_m) - _LEVEL_REACH_M, 0.0)
        bent = np.minimum(beyond, curve_m)
        risen = bent**2 / (2.0 * curve_m) + beyond - bent
        self._height = np.where(self._knot > centre_x_m, ahead, -behind) * risen
        self._named = self._knot
        if only_bends:
            self._named = self._knot[1:-1][np.abs(np.diff(self._height, 2)) > _FLAT_M]

    def height_m(self, x_m: np.ndarray | float) -> np.ndarray:
        """Height [m] at x [m], any shape."""
        return np.asarray(np.interp(x_m, self._knot, self._height))

    def knots_m(self, low_m: float, high_m: float) -> np.ndarray:
        """Where the surface bends between two x [m]; none on level ground."""
        if self.is_level:
            return np.empty(0)
        return self._named[(self._named > low_m + 1e-6) & (self._named < high_m - 1e-6)]

    def bulge_m(self, low_m: float, high_m: float) -> float:
        """How far the ground rises above the straight line between two x [m]; at least 0."""
        x = np.linspace(low_m, high_m, 9)
        height = self.height_m(x)
        return float(max(0.0, np.max(height - np.interp(x, x[[0, -1]], height[[0, -1]]))))

    def stand(self, x_m: float, y_m: float, yaw_rad: float, size_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How a vehicle stands: the plane through the ground below its wheels; ``size_m`` [3], returns [3, 3]."""
        if self.is_level:
            return yaw_rotation(yaw_rad), np.array([x_m, y_m, 0.0])
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        wheel_x, wheel_y = 0.3 * size_m[0], 0.4 * size_m[1]
        front, rear = self.height_m(x_m + wheel_x * c), self.height_m(x_m - wheel_x * c)
        left, right = self.height_m(x_m - wheel_y * s), self.height_m(x_m + wheel_y * s)
        forward = np.array([c, s, (front - rear) / (2.0 * wheel_x)])
        forward /= np.linalg.norm(forward)
        up = np.cross(forward, np.array([-s, c, (left - right) / (2.0 * wheel_y)]))
        up /= np.linalg.norm(up)
        rotation = np.stack([forward, np.cross(up, forward), up], axis=1)
        return rotation, np.array([x_m, y_m, 0.25 * (front + rear + left + right)])
