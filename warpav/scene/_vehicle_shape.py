"""What the shape of a vehicle tells, by points spread evenly over it: its axes, its front, its wheels, its width.

Vehicles are symmetric, longer than they are high, and have wheels below.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warpav.core.errors import InputError
from warpav.raster.mesh import Mesh

_SAMPLE_COUNT, _SYMMETRY_COUNT = 200_000, 20_000
# Mean distances between shape and mirror image over the length: at most of symmetric sides, and at least between front
# and rear that differ: a box has .0002 by chance, a bus .0016, a car .008.
ALIKE, _UNLIKE = 0.004, 0.001
_CABIN_BEHIND = 0.04  # least offset of the upper quarter behind the centre, over the length; buses have none
# Mirrors are the widest parts above the wheels: their share of the surface (.0006 to .002), how far they spread along
# the vehicle at most (.00 to .01 of the length), and how far they are from its centre at least (cars .12, buses .49).
_MIRROR_SHARE, _MIRROR_SPREAD, _MIRROR_AHEAD = (0.0002, 0.006), 0.05, 0.08


@dataclass(frozen=True)
class Wheels:
    """Where a vehicle touches the ground."""

    axle_m: tuple[float, ...]  # x of every axle, from the rear [m]
    centre_y_m: float  # y halfway between left and right [m]


@dataclass(frozen=True)
class Shape:
    """Axes inferred from the shape of a mesh; None where the shape is ambiguous."""

    up: str | None  # the axis that points up, out of `AXES`; positive if the sign is unknown
    forward: str | None  # the axis that points to the front, likewise
    is_up_sure: bool = False  # whether wheels distinguish up from down
    # Whether front and rear can be told apart: mirrors are ahead of the centre, and without mirrors the cabin is
    # usually nearer to the rear.
    is_forward_sure: bool = False
    asymmetry: float = math.nan  # mean distance between the shape and its lateral mirror image, relative to the length
    has_mirrors: bool = False  # whether mirrors were recognised


def shape_of(point_m: np.ndarray) -> Shape:
    """Infer the axes of a vehicle from points spread evenly over it, [point, 3]."""
    from scipy.spatial import KDTree

    low, high = point_m.min(axis=0), point_m.max(axis=0)
    centre, size = 0.5 * (low + high), high - low
    count = min(_SYMMETRY_COUNT, len(point_m) // 2)
    tree, others = KDTree(point_m[:count]), point_m[count : count + count // 5]
    spacing = float(tree.query(others)[0].mean())
    distance = np.zeros(3)
    for axis in range(3):
        mirrored = others.copy()
        mirrored[:, axis] = 2.0 * centre[axis] - mirrored[:, axis]
        distance[axis] = max(float(tree.query(mirrored)[0].mean()) - spacing, 0.0) / size.max()
    ordered = np.argsort(distance)
    left = int(ordered[0])
    if distance[left] > ALIKE or distance[ordered[1]] < max(2.5 * distance[left], _UNLIKE):
        return Shape(None, None, asymmetry=float(distance[left]))
    forward, up = sorted((axis for axis in range(3) if axis != left), key=lambda axis: -size[axis])
    if size[forward] < 1.15 * size[up]:
        return Shape(None, None, asymmetry=float(distance[left]))
    stands = [wheels_of(_turned(point_m, forward, left, up, sign)) is not None for sign in (1.0, -1.0)]
    is_up_sure = stands[0] != stands[1]
    is_down = is_up_sure and stands[1]
    height = (point_m[:, up] - low[up]) / max(size[up], 1e-12)
    cabin = point_m[(height < 0.25) if is_down else (height > 0.75)]
    behind = float(centre[forward] - cabin[:, forward].mean()) / size[forward] if len(cabin) else 0.0
    is_forward_sure = is_up_sure and abs(behind) > _CABIN_BEHIND
    ahead = _mirrors_ahead(_turned(point_m, forward, left, up, -1.0 if is_down else 1.0)) if is_up_sure else None
    if ahead is not None:  # mirrors tell more than the cabin: those of pickups and buses are ahead as well
        behind, is_forward_sure = ahead, True
    return Shape(
        ("-" if is_down else "") + "xyz"[up],
        ("-" if is_forward_sure and behind < 0.0 else "") + "xyz"[forward],
        is_up_sure,
        is_forward_sure,
        float(distance[left]),
        ahead is not None,
    )


def _mirrors_ahead(point_m: np.ndarray) -> float | None:
    """How far mirrors, the widest parts above the wheels, are ahead of the centre, over the length; None without."""
    low, high = point_m.min(axis=0), point_m.max(axis=0)
    size = np.maximum(high - low, 1e-12)
    share = (point_m - 0.5 * (low + high)) / size
    upper = share[share[:, 2] > -0.15]
    if not len(upper):
        return None
    aside = np.abs(upper[:, 1])
    widest = upper[aside > max(np.percentile(aside, 97) + 0.015, 0.93 * aside.max())]
    if not _MIRROR_SHARE[0] <= len(widest) / len(point_m) <= _MIRROR_SHARE[1]:
        return None
    ahead = float(widest[:, 0].mean())
    is_both_sides = 0.2 < float(np.mean(widest[:, 1] > 0.0)) < 0.8
    is_mirror = is_both_sides and float(widest[:, 0].std()) < _MIRROR_SPREAD and abs(ahead) > _MIRROR_AHEAD
    return ahead if is_mirror else None


def body_width_m(point_m: np.ndarray) -> float:
    """Width of a vehicle without its mirrors, where it has any [m]; ``point_m`` [point, 3]."""
    low, high = point_m.min(axis=0), point_m.max(axis=0)
    ahead = _mirrors_ahead(point_m)
    if ahead is None:
        return float(high[1] - low[1])
    length_m = float(high[0] - low[0])
    beside = np.abs(point_m[:, 0] - 0.5 * (low[0] + high[0]) - ahead * length_m) < 2.0 * _MIRROR_SPREAD * length_m
    return float(np.ptp(point_m[~beside, 1]))


def wheels_of(point_m: np.ndarray) -> Wheels | None:
    """Where a vehicle in the ego frame's axes touches the ground, by points on it [point, 3]; None if nowhere."""
    low, high = point_m.min(axis=0), point_m.max(axis=0)
    size = high - low
    touching = point_m[point_m[:, 2] < low[2] + 0.02 * size[2]]
    across = (touching[:, 1] - 0.5 * (low[1] + high[1])) / max(size[1], 1e-12)
    if len(touching) < 8 or np.mean(np.abs(across) < 0.15) > 0.02 or across.min() > -0.15 or across.max() < 0.15:
        return None
    x = np.sort(touching[:, 0])
    axles = np.split(x, np.flatnonzero(np.diff(x) > 0.08 * size[0]) + 1)
    axle_m = tuple(0.5 * float(each[0] + each[-1]) for each in axles)
    if len(axle_m) < 2 or not 0.3 < (axle_m[-1] - axle_m[0]) / size[0] < 0.95:
        return None
    return Wheels(axle_m, 0.5 * float(touching[:, 1].min() + touching[:, 1].max()))


def points_on(mesh: Mesh) -> np.ndarray:
    """Points spread evenly over a mesh, the same for the same mesh, float64 [point, 3]."""
    rng = np.random.default_rng(0)
    corner = mesh.vertex_m.astype(np.float64)[mesh.triangle]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    total = float(area.sum())
    if not total > 0.0:
        raise InputError("vehicle: expected triangles with an area, got none")
    triangle = np.searchsorted(np.cumsum(area) / total, rng.random(_SAMPLE_COUNT), side="right").clip(max=len(area) - 1)
    share = rng.random((_SAMPLE_COUNT, 2))
    beyond = share.sum(axis=1) > 1.0
    share[beyond] = 1.0 - share[beyond]
    start = corner[triangle, 0]
    return start + share[:, :1] * (corner[triangle, 1] - start) + share[:, 1:] * (corner[triangle, 2] - start)


def _turned(point: np.ndarray, forward: int, left: int, up: int, sign: float) -> np.ndarray:
    return np.stack([point[:, forward], point[:, left], sign * point[:, up]], axis=1)
