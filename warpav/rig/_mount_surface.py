"""Where cameras may stand: height and borders of the vehicle's upward-facing surface, as rasters over the ground."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from warpav.core.errors import InputError
from warpav.raster.mesh import Mesh
from warpav.raster.pane import Pane
from warpav.rig._zone import Zone

if TYPE_CHECKING:
    from scipy.spatial import KDTree

    from warpav.rig._rig import RigCamera

_SAMPLES_PER_CELL = 2
"""Surface points per cell and axis."""

_MIN_UPWARD_NORMAL = 0.9

_MIN_PATCH_FRACTION = 0.1
"""A patch of fewer cells than this share of the largest one's is a mirror, a sill or a handle, not roof or bonnet."""

_LEDGE_STEP_M = 0.3
"""A cell beside one that is higher by this is the foot of a wall; a sill below a roof's edge is nothing else [m]."""

_MAX_EXTENT_M = 40.0
"""A vehicle longer or wider than this was not given in metres."""


@dataclass(frozen=True)
class MountSurface:
    """A height map over the ego frame's ground plane, or over a chart of several zones.

    A zone has a plane of its own: the place (x, y) of the chart is the point ``plane + x * U + y * V + height * N`` of
    the ego frame. Without zones that is (x, y, height) itself.
    """

    # Height of the surface above the ground, or above the plane of its zone [m], float32, shape [row, column], at
    # least 2 x 2; rows run along x (forward), columns along y (left)
    height_m: np.ndarray
    origin_m: np.ndarray  # x and y of the centre of cell (0, 0) [m], float64, shape [2]
    cell_m: float
    # Cells that can carry a camera, bool [row, column]; None: all of them. The others bridge holes
    is_mountable: np.ndarray | None = None
    zones: tuple[Zone, ...] = ()
    # Number of the zone of every cell, int32 [row, column]; empty without zones
    zone_of_cell: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.int32))
    # Where the chart's (0, 0) would be in the plane of every zone [m], float64 [zone, 3]
    plane_m: np.ndarray = field(default_factory=lambda: np.zeros((1, 3)))
    modules: tuple[str, ...] = ()
    module_of_zone: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    pairs: tuple[bool, ...] = ()
    panes: tuple[Pane | None, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def inside(self) -> np.ndarray:
        """Cells that can carry a camera, bool [row, column]."""
        return np.ones(self.height_m.shape, bool) if self.is_mountable is None else self.is_mountable

    @property
    def place_m(self) -> np.ndarray:
        """Centres of the cells in the chart [m], float64 [row, column, 2]."""
        return self.origin_m + self.cell_m * np.moveaxis(np.indices(self.height_m.shape), 0, -1)

    @cached_property
    def axes(self) -> np.ndarray:
        """U, V and N of every zone, rows, float64 [zone, 3, 3]; the ego frame's without zones."""
        return np.stack([zone.axes for zone in self.zones]) if self.zones else np.eye(3)[None]

    def zone_at(self, position_m: np.ndarray) -> np.ndarray:
        """Number of the zone at places [..., 2] of the chart, between zones that of the nearest; int [...]."""
        position_m = np.asarray(position_m, np.float64)
        if not self.zones:
            return np.zeros(position_m.shape[:-1], int)
        cell = np.rint((position_m - self.origin_m) / self.cell_m)
        row, column = np.moveaxis(np.clip(cell, 0, np.array(self.height_m.shape) - 1).astype(int), -1, 0)
        return self.zone_of_cell[row, column].astype(int)

    def module_at(self, position_m: np.ndarray) -> np.ndarray:
        """Number of the module that a camera at places [..., 2] of the chart is, 0 without modules; int [...]."""
        zone = self.zone_at(position_m)
        return self.module_of_zone[zone] if self.modules else np.zeros_like(zone)

    def panes_at(self, position_m: np.ndarray) -> list[Pane | None]:
        """What cameras at places [camera, 2] of the chart look through; None outside of the body."""
        if not self.panes:
            return [None] * len(position_m)
        return [self.panes[zone] for zone in self.zone_at(position_m)]

    def carriers_of(self, cameras: Sequence[RigCamera]) -> np.ndarray | None:
        """Modules whose zones a rig's cameras may stand in (all, where none is theirs), bool [camera, module]."""
        if not self.modules:
            return None
        same = np.array([[camera.module == name for name in self.modules] for camera in cameras])
        same[~same.any(axis=1)] = True
        return same

    def left_of(self, point_m: np.ndarray) -> np.ndarray:
        """Points [..., 3] of the ego frame, those on the right mirrored to the left where rigs are symmetric."""
        point_m = np.array(point_m, np.float64)
        if any(self.pairs):
            point_m[..., 1] = np.abs(point_m[..., 1])
        return point_m

    def point_m(self, position_m: np.ndarray, height_m: np.ndarray | float) -> np.ndarray:
        """Points of the ego frame [..., 3] [m] at places of the chart [..., 2] and heights over its planes [...]."""
        position_m = np.asarray(position_m, np.float64)
        height_m = np.broadcast_to(height_m, position_m.shape[:-1])
        local_m = np.concatenate([position_m, height_m[..., None]], axis=-1)
        if not self.zones:
            return local_m
        zone = self.zone_at(position_m)
        return self.plane_m[zone] + np.einsum("...i,...ij->...j", local_m, self.axes[zone])

    def place_of(self, point_m: np.ndarray, carriers: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Place in the chart [m], [..., 2], and height over the surface [m], [...], of a camera at a point.

        Of zones the one whose surface and stand-off are nearest, of several the one in which the place lies deepest;
        above none of them the nearest cell's.
        """
        point_m = np.asarray(point_m, np.float64)
        if not self.zones:
            place_m = point_m[..., :2]
            return place_m, point_m[..., 2] - self.height_at_m(place_m)
        best_m, deepest_m = np.full((2, *point_m.shape[:-1]), np.inf)
        module = np.full(point_m.shape[:-1], -1)
        place_m, rise_m = np.zeros((*point_m.shape[:-1], 2)), np.zeros(point_m.shape[:-1])
        for number, zone in enumerate(self.zones):
            local_m = (point_m - self.plane_m[number]) @ self.axes[number].T
            here_m = local_m[..., :2]
            above_m = local_m[..., 2] - self.height_at_m(here_m)
            low_m, high_m = zone.rise_m
            inside_m = self.zone_distance_m(here_m)
            away_m = np.maximum(-inside_m, 0.0) + np.abs(above_m - np.clip(above_m, low_m, high_m))
            away_m = np.round(away_m, 6)  # of zones of a module that are as near, that in which the place lies deepest
            away_m = np.where(self.zone_at(here_m) == number, away_m, np.inf)
            if carriers is not None:
                away_m = np.where(carriers[..., self.module_of_zone[number]], away_m, np.inf)
            carried = self.module_of_zone[number] if self.modules else 0
            is_deeper = (away_m == best_m) & (module == carried) & (inside_m > deepest_m)
            is_nearer = (away_m < best_m) | is_deeper
            deepest_m = np.where(is_nearer, inside_m, deepest_m)
            module = np.where(is_nearer, carried, module)
            best_m = np.where(is_nearer, away_m, best_m)
            place_m = np.where(is_nearer[..., None], here_m, place_m)
            rise_m = np.where(is_nearer, above_m, rise_m)
        is_lost = np.isinf(best_m)
        if is_lost.any():
            self._to_nearest_cell(point_m, is_lost, carriers, place_m, rise_m)
        return place_m, rise_m

    def _to_nearest_cell(
        self,
        point_m: np.ndarray,
        is_lost: np.ndarray,
        carriers: np.ndarray | None,
        place_m: np.ndarray,
        rise_m: np.ndarray,
    ) -> None:
        """Write place and height over the nearest cell that carries a camera, for points [..., 3] above no zone."""
        lost = np.flatnonzero(is_lost)
        flat_m, flat_place_m, flat_rise_m = point_m.reshape(-1, 3)[lost], place_m.reshape(-1, 2), rise_m.reshape(-1)
        best_m = np.full(len(lost), np.inf)
        for number in [-1] if carriers is None else range(len(self.modules)):
            cell_place_m, cell_point_m, tree = self._cells_of(number)
            away_m, cell = map(np.asarray, tree.query(flat_m))
            if carriers is not None:
                away_m = np.where(carriers.reshape(-1, len(self.modules))[lost, number], away_m, np.inf)
            nearer = away_m < best_m
            normal = self.axes[self.zone_at(cell_place_m[cell]), 2]
            above_m = np.einsum("ki,ki->k", flat_m - cell_point_m[cell], normal)
            best_m[nearer] = away_m[nearer]
            flat_place_m[lost[nearer]], flat_rise_m[lost[nearer]] = cell_place_m[cell[nearer]], above_m[nearer]

    def _cells_of(self, module: int) -> tuple[np.ndarray, np.ndarray, KDTree]:
        """Places and points [m] of the cells that carry a module, -1: any, [cell, 2] and [cell, 3], and their tree."""
        from scipy.spatial import KDTree

        kept: dict[int, tuple[np.ndarray, np.ndarray, KDTree]] = self.__dict__.setdefault("_kept_cells", {})
        if module not in kept:
            place_m = self.place_m[self.inside]
            place_m = place_m if module < 0 else place_m[self.module_at(place_m) == module]
            point_m = self.point_m(place_m, self.height_at_m(place_m))
            kept[module] = place_m, point_m, KDTree(point_m)
        return kept[module]

    @cached_property
    def over_ground(self) -> MountSurface:
        """The same seen from above, over the ground plane: NaN where there is nothing of it. Itself without zones."""
        if not self.zones:
            return self
        point_m = self.point_m(self.place_m[self.inside], self.height_m[self.inside])
        first = np.floor(point_m[:, :2].min(axis=0) / self.cell_m) - 1
        cell = np.rint(point_m[:, :2] / self.cell_m - first).astype(int)
        size = cell.max(axis=0) + 2
        top_m = np.full(size, -np.inf)
        np.maximum.at(top_m, (cell[:, 0], cell[:, 1]), point_m[:, 2])
        seen = np.isfinite(top_m)
        return MountSurface(np.where(seen, top_m, np.nan).astype(np.float32), first * self.cell_m, self.cell_m, seen)

    def bounds_of(self, module: int) -> np.ndarray:
        """Centres of the extreme cells that carry a module, as `bounds_m` [m]."""
        if not self.modules:
            return self.bounds_m
        place_m, *_ = self._cells_of(module)
        return np.stack([place_m.min(axis=0), place_m.max(axis=0)])

    @property
    def bounds_m(self) -> np.ndarray:
        """Centres of the extreme cells: [[x_min, y_min], [x_max, y_max]] [m]; cameras stay within."""
        last = np.array(self.height_m.shape) - 1
        return np.stack([self.origin_m, self.origin_m + last * self.cell_m])

    def height_at_m(self, position_m: np.ndarray) -> np.ndarray:
        """Height of the surface at x and y [..., 2] [m], bilinear, outside that of the nearest border point."""
        return self._bilinear(self.height_m, position_m)

    @cached_property
    def border_distance_m(self) -> np.ndarray:
        """Distance from every cell's centre to the border of the mountable zone [m], positive inside, [row, column].

        Borders run along the edges between cells that can and cells that cannot carry a camera, and along `bounds_m`.
        """
        to_edge = _cells_to_edge(self.inside)
        rows, columns = (np.minimum(np.arange(n), np.arange(n)[::-1]) for n in self.height_m.shape)
        to_rectangle = np.minimum(rows[:, None], columns[None, :])
        return np.ascontiguousarray(self.cell_m * np.minimum(to_edge, to_rectangle), np.float32)

    def zone_distance_m(self, position_m: np.ndarray) -> np.ndarray:
        """Distance of x and y [..., 2] to the border of the mountable zone [m], positive inside; float64 [...]."""
        low_m, high_m = self.bounds_m
        position_m = np.asarray(position_m, np.float64)
        beyond_m = np.linalg.norm(position_m - np.clip(position_m, low_m, high_m), axis=-1)
        return self._bilinear(self.border_distance_m, position_m) - beyond_m

    def _bilinear(self, raster: np.ndarray, position_m: np.ndarray) -> np.ndarray:
        """Value of a raster between its cell centres, that of the nearest border point outside; float64 [...]."""
        size = np.array(raster.shape)
        cell = np.clip((np.asarray(position_m, np.float64) - self.origin_m) / self.cell_m, 0.0, size - 1.0)
        low = np.minimum(cell.astype(np.int64), size - 2)
        row, column = low[..., 0], low[..., 1]
        u, v = np.moveaxis(cell - low, -1, 0)
        near = raster[row, column] * (1.0 - v) + raster[row, column + 1] * v
        far = raster[row + 1, column] * (1.0 - v) + raster[row + 1, column + 1] * v
        return near * (1.0 - u) + far * u

    def highest_point_m(self, module: int = -1) -> np.ndarray:
        """The highest cell, on a flat top (within 1 mm) the one nearest its middle: x, y, height [m], [3]."""
        height_m = self.height_m
        if self.zones:
            place_m, inside = self.place_m, self.inside
            if module >= 0:
                inside = inside & (self.module_at(place_m) == module)
            height_m = np.where(inside, self.point_m(place_m, height_m)[..., 2], -np.inf)
        cell = np.argwhere(height_m >= height_m.max() - 1e-3)
        row, column = cell[np.linalg.norm(cell - cell.mean(axis=0), axis=1).argmin()]
        x, y = self.origin_m + np.array([row, column]) * self.cell_m
        return np.array([x, y, self.height_m[row, column]], dtype=np.float64)


def mount_surface_from_mesh(
    mesh: Mesh,
    *,
    cell_m: float = 0.02,
    min_upward_normal: float = _MIN_UPWARD_NORMAL,
    min_zone_normal: float = 0.9,
    min_height_m: float = 0.0,
    smoothing_tolerance_m: float = 1e-4,
    keeps: Callable[[np.ndarray], np.ndarray] | None = None,
) -> MountSurface:
    """What faces upwards and is seen from straight above: roof and bonnet (thesis, 3D Surface Positioning).

    Points are the first hits of vertical rays, where the face points upwards; a cell takes the highest. Cells without
    points, as over glass, are filled from those around and smoothed until none moves by more than the tolerance. Those
    with points carry a camera if their faces point upwards by ``min_zone_normal``; gaps of up to two cells are no
    border, but at a wall.
    """
    from scipy import ndimage

    measured_m, upward, origin_m = _measured(mesh, cell_m, min_upward_normal, min_height_m, keeps)
    is_measured = np.isfinite(measured_m)
    filled_m = _filled(np.where(is_measured, measured_m, 0.0), is_measured, smoothing_tolerance_m)
    is_upward = np.pad(_without_small_patches(is_measured & (upward >= min_zone_normal)), 2)
    is_mountable = ndimage.binary_closing(is_upward, structure=np.ones((3, 3)))[2:-2, 2:-2]  # gaps of up to two cells
    top_m, foot_m = (each(filled_m, 3, mode="nearest") for each in (ndimage.maximum_filter, ndimage.minimum_filter))
    is_mountable = np.asarray(is_mountable, bool) & (is_upward[2:-2, 2:-2] | (top_m - foot_m <= _LEDGE_STEP_M))
    if not is_mountable.any():
        raise InputError(
            f"ego mesh: expected faces that can carry a camera (normal z of at least {min_zone_normal}), got none with "
            f"more than {upward[is_measured].max():.3f}"
        )
    return MountSurface(np.ascontiguousarray(filled_m, np.float32), origin_m, float(cell_m), is_mountable)


def measured_surface(mesh: Mesh, *, cell_m: float) -> MountSurface:
    """As `mount_surface_from_mesh` before holes are filled: NaN where nothing was measured."""
    measured_m, _, origin_m = _measured(mesh, cell_m, _MIN_UPWARD_NORMAL, 0.0)
    return MountSurface(np.ascontiguousarray(measured_m, np.float32), origin_m, float(cell_m))


def _measured(
    mesh: Mesh,
    cell_m: float,
    min_upward_normal: float,
    min_height_m: float,
    keeps: Callable[[np.ndarray], np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heights [m] (NaN: none) and z of the flattest face's normal, [row, column]; centre of cell (0, 0) [m]."""
    from scipy import ndimage

    low_m, high_m = mesh.bounds_m().astype(np.float64)[:, :2]
    extent_m = high_m - low_m
    if extent_m.max() > _MAX_EXTENT_M:
        raise InputError(
            f"ego mesh: expected a vehicle in metres, got {extent_m[0]:.6g} x {extent_m[1]:.6g}; scale it to metres"
        )
    # The raster lies symmetrically about the centre of the mesh, so a symmetric vehicle keeps its symmetry.
    size = np.maximum(2, np.ceil(extent_m / cell_m - 1e-3).astype(int))
    origin_m = 0.5 * (low_m + high_m) - 0.5 * (size - 1) * cell_m

    sample_m, sample_upward = _first_upward_height(
        mesh, origin_m - 0.5 * cell_m, size * _SAMPLES_PER_CELL, cell_m / _SAMPLES_PER_CELL, min_upward_normal
    )
    sample_m[sample_m < min_height_m] = -np.inf
    if keeps is not None:
        at = np.moveaxis(np.indices(sample_m.shape), 0, -1)
        plane_m = origin_m - 0.5 * cell_m + (at + 0.5) * (cell_m / _SAMPLES_PER_CELL)
        point_m = np.concatenate([plane_m, np.where(np.isfinite(sample_m), sample_m, 0.0)[..., None]], axis=-1)
        sample_m[~keeps(point_m)] = -np.inf
    sample_upward[sample_m == -np.inf] = -np.inf
    in_cells = (size[0], _SAMPLES_PER_CELL, size[1], _SAMPLES_PER_CELL)
    height_m = sample_m.reshape(in_cells).max(axis=(1, 3))
    upward = sample_upward.reshape(in_cells).max(axis=(1, 3))
    is_foot_of_wall = ndimage.maximum_filter(height_m, size=3, mode="nearest") > height_m + _LEDGE_STEP_M
    is_measured = _without_small_patches(np.isfinite(height_m) & ~is_foot_of_wall)
    if not is_measured.any():
        raise InputError(
            f"ego mesh: expected faces that point upwards (normal z of at least {min_upward_normal}, "
            f"height of at least {min_height_m} m), got none among {len(mesh.triangle)}; check that z points up"
        )
    kept = (_used_range(is_measured, 0), _used_range(is_measured, 1))
    first = np.array([kept[0].start, kept[1].start])
    upward = np.where(is_measured, upward, -np.inf)
    return np.where(is_measured, height_m, np.nan)[kept], upward[kept], origin_m + first * cell_m


def _used_range(is_measured: np.ndarray, axis: int) -> slice:
    first, last = np.flatnonzero(is_measured.any(axis=1 - axis))[[0, -1]]
    if first == last:
        first, last = (first, last + 1) if last + 1 < is_measured.shape[axis] else (first - 1, last)
    return slice(int(first), int(last) + 1)


def _first_upward_height(
    mesh: Mesh, corner_m: np.ndarray, size: np.ndarray, step_m: float, min_upward_normal: float
) -> tuple[np.ndarray, np.ndarray]:
    """Height of the first hits of vertical rays and absolute z of the normal there, -inf where none faces up.

    A ray runs through the centre of each square of side ``step_m``; ``corner_m`` is the low corner of the first.
    """
    corner = mesh.vertex_m.astype(np.float64)[mesh.triangle]  # [triangle, corner, xyz]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    doubled_area = np.linalg.norm(normal, axis=1)
    # A face on edge has no extent from above; a line meets its neighbours.
    seen = np.flatnonzero(np.abs(normal[:, 2]) > 1e-9 * np.maximum(doubled_area, 1e-12))
    corner, normal, doubled_area = corner[seen], normal[seen], doubled_area[seen]
    plane = (corner[:, :, :2] - corner_m) / step_m - 0.5  # in units of samples: line k lies at k
    low = np.maximum(np.ceil(plane.min(axis=1) - 1e-9), 0).astype(np.int64)
    high = np.minimum(np.floor(plane.max(axis=1) + 1e-9), size - 1).astype(np.int64)
    span = np.maximum(high - low + 1, 0)

    # Every line in every face's bounding rectangle, as one flat list: its rows, then of each its columns.
    face, row = _counted(np.where(span[:, 1] > 0, span[:, 0], 0), low[:, 0])
    of_row, column = _counted(span[face, 1], low[face, 1])
    face, row = face[of_row], row[of_row]

    turn = np.sign(normal[:, 2])
    for i in range(3):
        (x, y), (along, aside) = plane[:, i].T, np.ascontiguousarray((plane[:, (i + 1) % 3] - plane[:, i]).T * turn)
        side = along[face] * column - aside[face] * row + (aside * x - along * y)[face]
        is_inside = side >= -1e-9  # a ray through a shared edge hits at least one of its faces
        face, row, column = face[is_inside], row[is_inside], column[is_inside]
    slope = -normal[:, :2] / normal[:, 2:] * step_m  # height change per sample
    (x, y), (by_row, by_column) = np.ascontiguousarray(plane[:, 0].T), np.ascontiguousarray(slope.T)
    height_m = corner[:, 0, 2][face] + (by_row[face] * (row - x[face]) + by_column[face] * (column - y[face]))

    line = row * size[1] + column
    top_m = np.full(size[0] * size[1], -np.inf)
    np.maximum.at(top_m, line, height_m)
    is_upward = (np.abs(normal[:, 2]) >= min_upward_normal * doubled_area)[face]
    is_top = is_upward & (height_m >= top_m[line] - 1e-6)
    upward = np.full(len(top_m), -np.inf)
    np.maximum.at(upward, line[is_top], (np.abs(normal[:, 2]) / doubled_area)[face[is_top]])
    return np.where(upward > -np.inf, top_m, -np.inf).reshape(size), upward.reshape(size)


def _counted(count: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """So many whole numbers from a first one on, of each: whose they are, and they, int64 [number]."""
    of = np.repeat(np.arange(len(count)), count)
    return of, np.arange(len(of)) + np.repeat(first - (np.cumsum(count) - count), count)


def _without_small_patches(is_measured: np.ndarray) -> np.ndarray:
    """The mask without slivers thinner than three cells and without small patches; the largest patch always stays."""
    from scipy import ndimage

    opened = ndimage.binary_opening(is_measured, structure=np.ones((3, 3)))
    is_measured = opened if opened.any() else is_measured
    label = np.zeros(is_measured.shape, dtype=np.int32)
    ndimage.label(is_measured, structure=np.ones((3, 3)), output=label)
    area = np.bincount(label.ravel())
    area[0] = 0
    return is_measured & (area >= _MIN_PATCH_FRACTION * area.max())[label]


def _cells_to_edge(is_inside: np.ndarray) -> np.ndarray:
    """Distance from every cell's centre to the nearest edge between inside and outside, in cells, positive inside.

    The nearest point of an edge is its middle or one of its ends. Beyond the raster is outside.
    """
    from scipy import ndimage

    # the raster at twice the resolution: centres at odd places, edges and corners at even ones
    touched, filled = is_inside, is_inside
    for axis in (0, 1):
        touched = _between(touched, np.logical_or, axis)
        filled = _between(filled, np.logical_and, axis)
    distance = np.zeros(touched.shape)
    ndimage.distance_transform_edt(~(touched & ~filled), distances=distance)
    return 0.5 * np.where(is_inside, 1.0, -1.0) * distance[1::2, 1::2]


def _between(is_inside: np.ndarray, of_both: np.ufunc, axis: int) -> np.ndarray:
    """A mask with what lies between its elements put in between them, and before the first and after the last."""
    is_inside = np.moveaxis(is_inside, axis, 0)
    result = np.zeros((2 * len(is_inside) + 1, *is_inside.shape[1:]), bool)
    outside = np.zeros((1, *is_inside.shape[1:]), bool)
    result[0::2] = of_both(np.concatenate([outside, is_inside]), np.concatenate([is_inside, outside]))
    result[1::2] = is_inside
    return np.moveaxis(result, 0, axis)


def _filled(height_m: np.ndarray, is_known: np.ndarray, tolerance_m: float) -> np.ndarray:
    """The raster with unknown cells smoothed, by over-relaxation, until none moves by more than a tolerance."""
    from scipy import ndimage

    distance = np.zeros(is_known.shape)
    nearest = np.zeros((2, *is_known.shape), dtype=np.int32)
    ndimage.distance_transform_edt(~is_known, return_indices=True, distances=distance, indices=nearest)
    filled_m = height_m[tuple(nearest)]
    # The best over-relaxation for a hole of this width between known cells, or half of it against the border.
    relaxation = 2.0 / (1.0 + math.sin(math.pi / (2.0 * max(1.0, float(distance.max())) + 1.0)))
    row, column = np.nonzero(~is_known)
    last_row, last_column = np.array(filled_m.shape) - 1
    neighbour = np.stack(
        [
            np.ravel_multi_index((np.clip(row + i, 0, last_row), np.clip(column + j, 0, last_column)), filled_m.shape)
            for i, j in ((-1, 0), (1, 0), (0, -1), (0, 1))
        ]
    )
    cell = np.ravel_multi_index((row, column), filled_m.shape)
    # Like a chessboard: the four neighbours of one colour have the other, so each half updates at once.
    halves = [(cell[half], neighbour[:, half]) for half in ((row + column) % 2 == 0, (row + column) % 2 == 1)]
    flat_m = filled_m.ravel()
    change_m = math.inf
    while change_m > tolerance_m:
        change_m = 0.0
        for own, around in halves:
            step_m = flat_m[around].mean(axis=0) - flat_m[own]
            flat_m[own] += relaxation * step_m
            change_m = max(change_m, float(np.abs(step_m).max(initial=0.0)))
    return np.clip(flat_m, height_m[is_known].min(), height_m[is_known].max()).reshape(filled_m.shape)
