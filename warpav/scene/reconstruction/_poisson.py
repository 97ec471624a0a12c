"""Poisson surface reconstruction (Kazhdan et al., 2006; screened: 2013) on a grid, solved by multigrid in Warp.

The points' normals, splat onto the nodes of a grid, are the gradient of a blurred step from inside (-1/2) to outside
(+1/2). The field whose gradient comes nearest to them solves a Poisson equation; it is asked besides to be 0 at the
points (screening). Its zero level is the surface. Where points are sparse they are splat onto coarser grids.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import warp as wp

from warpav_kernels.reconstruction import poisson

_MAX_NODE_COUNT = 20_000_000  # of a grid; a node takes about 40 bytes
_SPARSE_LEVELS = 3  # grids on which points are splat: cells of 1, 2 and 4 times the length
_MIN_PER_FACE = 1.5  # points per face of a cell below which the next coarser grid is taken
_COARSEST_CELLS = 8  # along the shortest side
_COARSEST_STEPS = 20
_CYCLES = 2  # of every level
_COARSE_SCREEN = 0.7  # from level to level: a field that is 0 between two nodes is not 0 on them
_GPU_LANES = 32


def poisson_surface(
    point_m: np.ndarray,
    normal: np.ndarray,
    *,
    cell_m: float,
    screening: float = 4.0,
    margin_m: float | None = None,
    device: str = "cpu",
) -> tuple[np.ndarray, np.ndarray]:
    """Closed surface through oriented points, [point, 3], the same bits each time; guessed between: trim it."""
    point_m, normal = checked_points(point_m, normal)
    if not (np.isfinite(cell_m) and cell_m > 0.0):
        raise ValueError(f"cell_m must be positive, got {cell_m}")
    if not screening >= 0.0:
        raise ValueError(f"screening must be at least 0, got {screening}")
    margin_m = 6.0 * cell_m if margin_m is None else max(float(margin_m), 2.0 * cell_m)
    grids, lower_m = _grids_around(point_m, cell_m, margin_m, device)
    _state_equation(grids, (point_m - lower_m) / cell_m, normal, screening)
    _solve(grids)
    return _contour(grids[0].field.numpy(), lower_m, cell_m, device)


def checked_points(point_m: np.ndarray, normal: np.ndarray, name: str = "normal") -> tuple[np.ndarray, np.ndarray]:
    """Points and what belongs to each, [point, 3] both, as float64; ``name`` is what messages call the latter."""
    point_m, normal = np.asarray(point_m, np.float64), np.asarray(normal, np.float64)
    for what, array in (("point_m", point_m), (name, normal)):
        if array.ndim != 2 or array.shape[1] != 3 or len(array) < 4:
            raise ValueError(f"{what}: expected shape [4 or more, 3], got {list(array.shape)}")
        bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
        if len(bad):
            raise ValueError(f"{what}[{bad[0]}] is {array[bad[0]].tolist()}; {len(bad)} of {len(array)} not finite")
    if point_m.shape != normal.shape:
        raise ValueError(f"{name}: expected one for each of {len(point_m)} points, got {len(normal)}")
    return point_m, normal


class _OnDevice:
    device: str

    def launch(self, kernel: Callable, dim: int | tuple[int, ...], *, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device, record_tape=False)


class _Grid(_OnDevice):
    """One level of the equation ``screen x - laplacian x = source``, its arrays on a device."""

    def __init__(self, shape: tuple[int, int, int], cell: float, device: str) -> None:
        """A level of so many nodes along x, y, z; ``cell`` is the cell's length in cells of the finest level."""
        self.shape = shape
        self.cell = cell
        self.device = device
        self.field, self.source, self.screen, self.residual = (
            wp.zeros(shape, dtype=float, device=device) for _ in range(4)
        )
        self.lanes = _GPU_LANES if wp.get_device(device).is_cuda else 1
        self.columns = (*shape[:2], self.lanes)

    def relax(self, steps: int) -> None:
        for step in range(2 * steps):
            self.launch(
                poisson.relax_field_kernel,
                self.columns,
                inputs=[self.source, self.screen, self.cell, step % 2, self.lanes],
                outputs=[self.field],
            )

    def find_residual(self) -> None:
        self.launch(
            poisson.find_residual_kernel,
            self.columns,
            inputs=[self.source, self.screen, self.field, self.cell, self.lanes],
            outputs=[self.residual],
        )

    def restrict(self, fine: wp.array, coarse: wp.array, factor: float = 1.0) -> None:
        self.launch(poisson.restrict_field_kernel, self.columns, inputs=[fine, factor, self.lanes], outputs=[coarse])

    def add_prolonged(self, coarse: wp.array, fine: wp.array) -> None:
        self.launch(poisson.add_prolonged_kernel, self.columns, inputs=[coarse, self.lanes], outputs=[fine])


def _grids_around(point_m: np.ndarray, cell_m: float, margin_m: float, device: str) -> tuple[list[_Grid], np.ndarray]:
    """Grids from fine to coarse, and their common lowest corner [m]."""
    low_m, high_m = point_m.min(axis=0) - margin_m, point_m.max(axis=0) + margin_m
    cells = np.maximum(np.ceil((high_m - low_m) / cell_m), _COARSEST_CELLS)
    levels = max(int(np.log2(cells.min() / _COARSEST_CELLS)) + 1, _SPARSE_LEVELS)
    unit = 2.0 ** (levels - 1)
    cells = np.ceil(cells / unit) * unit
    node_count = float(np.prod(cells + 1.0))
    if node_count > _MAX_NODE_COUNT:
        fitting_m = 1.05 * cell_m * (node_count / _MAX_NODE_COUNT) ** (1 / 3)
        size = " x ".join(f"{length:.3g}" for length in high_m - low_m)
        raise ValueError(
            f"a grid of {size} m in cells of {cell_m} m has {node_count:.2g} nodes, more than {_MAX_NODE_COUNT:.0e};"
            f" use cell_m={fitting_m:.2g} or fewer far points"
        )
    lower_m = 0.5 * (low_m + high_m) - 0.5 * cells * cell_m
    counts = [(cells / 2**level).astype(int) + 1 for level in range(levels)]
    return [_Grid((int(n[0]), int(n[1]), int(n[2])), 2.0**level, device) for level, n in enumerate(counts)], lower_m


@dataclass
class _Splat(_OnDevice):
    """Points sorted into groups of one nearest node, and groups into 27 colours that can be written at once."""

    order: np.ndarray
    place: wp.array
    nearest_node: wp.array
    group_start: wp.array
    colour_start: np.ndarray
    device: str

    @classmethod
    def of(cls, place: np.ndarray, shape: tuple[int, int, int], device: str) -> _Splat:
        """For points at ``place`` [cells of the grid], shape [point, 3]."""
        node = np.rint(place).astype(np.int64)
        colour = (node % 3) @ [9, 3, 1]
        key = np.ravel_multi_index((colour, *node.T), (27, *shape))
        order = np.argsort(key, kind="stable")
        start = np.flatnonzero(np.r_[True, np.diff(key[order]) != 0])
        group_colour = colour[order[start]]
        return cls(
            order,
            wp.array(place[order].astype(np.float32), dtype=wp.vec3, device=device),
            wp.array(node[order].astype(np.int32), dtype=wp.vec3i, device=device),
            wp.array(np.r_[start, len(order)].astype(np.int32), dtype=int, device=device),
            np.searchsorted(group_colour, np.arange(28)),
            device,
        )

    def points_per_face(self, shape: tuple[int, int, int]) -> np.ndarray:
        """Points of the surface around every point, per area of a cell's face, in the order that was given."""
        density = wp.zeros(shape, dtype=float, device=self.device)
        for first, last in pairwise(self.colour_start):
            self.launch(
                poisson.splat_density_kernel,
                int(last - first),
                inputs=[self.place, self.nearest_node, self.group_start, int(first)],
                outputs=[density],
            )
        sorted_count = wp.zeros(len(self.order), dtype=float, device=self.device)
        self.launch(
            poisson.read_density_kernel,
            len(self.order),
            inputs=[self.place, self.nearest_node, density],
            outputs=[sorted_count],
        )
        count = np.empty(len(self.order))
        count[self.order] = sorted_count.numpy()
        return count

    def add_to_equation(self, grid: _Grid, area_normal: np.ndarray, screening: float) -> None:
        """Add what the points ask for, ``area_normal`` [faces of a cell, point, 3] in the order that was given."""
        flux = wp.zeros(grid.shape, dtype=wp.vec3, device=self.device)
        area, height = (wp.zeros(grid.shape, dtype=float, device=self.device) for _ in range(2))
        sorted_normal = wp.array(area_normal[self.order].astype(np.float32), dtype=wp.vec3, device=self.device)
        for first, last in pairwise(self.colour_start):
            self.launch(
                poisson.splat_normals_kernel,
                int(last - first),
                inputs=[self.place, self.nearest_node, sorted_normal, self.group_start, int(first)],
                outputs=[flux, area, height],
            )
        self.launch(
            poisson.state_equation_kernel,
            grid.columns,
            inputs=[flux, area, height, screening, grid.cell**-2, grid.lanes],
            outputs=[grid.source, grid.screen],
        )


def _state_equation(grids: list[_Grid], place: np.ndarray, normal: np.ndarray, screening: float) -> None:
    """Source and screen of the finest grid; points at ``place``, in its cells, go to the finest dense enough."""
    left, used = np.ones(len(place)), 0
    while used < _SPARSE_LEVELS and left.any():
        grid = grids[used]
        splat = _Splat.of(place / grid.cell, grid.shape, grid.device)
        count = splat.points_per_face(grid.shape)
        used += 1
        share = left * np.clip(2.0 * count / _MIN_PER_FACE - 1.0, 0.0, 1.0) if used < _SPARSE_LEVELS else left
        splat.add_to_equation(grid, normal * (share / count)[:, None], screening)
        left = left - share
    for fine, coarse in reversed(list(pairwise(grids[:used]))):
        fine.add_prolonged(coarse.source, fine.source)
        fine.add_prolonged(coarse.screen, fine.screen)


def _solve(grids: list[_Grid]) -> None:
    """Full multigrid: from the coarsest grid to the finest, each improved by W-cycles."""
    for fine, coarse in pairwise(grids):
        coarse.restrict(fine.source, coarse.source)
        coarse.restrict(fine.screen, coarse.screen, _COARSE_SCREEN)
    grids[-1].relax(_COARSEST_STEPS)
    for level in range(len(grids) - 2, -1, -1):
        grids[level].add_prolonged(grids[level + 1].field, grids[level].field)
        for _ in range(_CYCLES):
            _cycle(grids[level:])


def _cycle(grids: list[_Grid]) -> None:
    """One W-cycle; overwrites the source and the field of all but the first grid."""
    if len(grids) == 1:
        grids[0].relax(_COARSEST_STEPS)
        return
    fine, coarse = grids[:2]
    fine.relax(1)
    fine.find_residual()
    coarse.restrict(fine.residual, coarse.source)
    coarse.field.zero_()
    for _ in range(min(2, len(grids) - 1)):
        _cycle(grids[1:])
    fine.add_prolonged(coarse.field, fine.field)
    fine.relax(1)


def _contour(field: np.ndarray, lower_m: np.ndarray, cell_m: float, device: str) -> tuple[np.ndarray, np.ndarray]:
    """The zero level: vertices [m] and triangles."""
    import warp.geometry

    outside = field >= 0.0
    some, every = outside, outside
    for axis in range(3):
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        some = some[tuple(low)] | some[tuple(high)]
        every = every[tuple(low)] & every[tuple(high)]
    cell = np.argwhere(some & ~every).astype(np.int32)
    if len(cell) == 0:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
    corner = cell[:, None, :] + np.array(warp.geometry.IsoSurfaceMarchingCubes.CUBE_CORNER_OFFSETS)
    value = field[corner[..., 0], corner[..., 1], corner[..., 2]]
    vertex, index = warp.geometry.sparse_marching_cubes_from_cells(cell, value, threshold=0.0, device=device)
    vertex_m = (vertex.numpy() * cell_m + lower_m).astype(np.float32)
    return vertex_m, index.numpy().reshape(-1, 3)
