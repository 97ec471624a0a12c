"""Bodies of recorded road users: those of the town, drawn by seed and fitted to the recorded sizes.

Frame: x forward, y left, z up, metres; the origin lies on the ground below the centre of the recorded box. Length, and
height where one was recorded, become those of the box exactly; the width is that of the body without mirrors, which
boxes leave out and which stand out here. People have the sizes of people: recorded ones are nominal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.scene.town._paint import drawn_paint
from warpav.scene.town._people import person_mesh
from warpav.scene.town._vehicle_shapes import VARIANT_COUNT, body_width_m, vehicle_mesh
from warpav.scene.town._vehicle_specs import CARGO, VEHICLE_SPECS

_LORRY_FROM_M = 6.3  # a recorded car that is longer is a lorry, as in data sets that know cars alone
_MOTORCYCLE_TO_M = 1.3  # a recorded car that is narrower is a motorcycle, likewise
_CAR_SHARES = {"hatchback": 0.29, "saloon": 0.22, "estate": 0.16, "suv": 0.20, "van": 0.13}
_USUAL_STRETCH = 0.10  # of a kind's own length, within which it is drawn
_HEIGHT_SPREAD = 0.03
_RIDER_SCALE = (0.85, 1.15)
_SOFT_MAX = 8.0  # of what is neither wheel nor cab: a lorry of 30 m
_TYRE_FOOT_M = 1e-3  # tyres touch the ground there
_ARCH_M = 0.07  # of the wheel arches around a tyre


def drawn_kind(category: str, size_m: tuple[float, float, float], rng: np.random.Generator) -> str:
    """What a recorded road user is drawn as: a category of `warpav.scene._scene.Vehicle`."""
    length, width, height = size_m
    if category != "car":
        return {"truck": "lorry", "bicycle": "cyclist"}.get(category, category)
    if width < _MOTORCYCLE_TO_M:
        return "motorcycle"
    if length > _LORRY_FROM_M:
        return "lorry"
    own = {kind: VEHICLE_SPECS[kind] for kind in _CAR_SHARES}
    misfit = {kind: abs(math.log(length / spec.length_m)) for kind, spec in own.items()}
    if not math.isnan(height):
        misfit = {kind: value + 2.0 * abs(math.log(height / own[kind].height_m)) for kind, value in misfit.items()}
    usual = [kind for kind, value in misfit.items() if value <= _USUAL_STRETCH] or [min(misfit, key=misfit.__getitem__)]
    share = np.array([_CAR_SHARES[kind] for kind in usual])
    return usual[int(rng.choice(len(usual), p=share / share.sum()))]


def body_mesh(kind: str, size_m: tuple[float, float, float], rng: np.random.Generator) -> Mesh:
    """The body of a road user, with its light baked in."""
    if kind in ("pedestrian", "cyclist", "motorcycle"):
        return _person("motorcyclist" if kind == "motorcycle" else kind, rng, size_m)
    variant = int(rng.integers(VARIANT_COUNT))
    paint = drawn_paint(kind, rng)
    spread = 1.0 + rng.uniform(-_HEIGHT_SPREAD, _HEIGHT_SPREAD)
    mesh = vehicle_mesh(kind, paint, variant=variant)
    high = mesh.bounds_m()[1].astype(np.float64)
    height = high[2] * spread if math.isnan(size_m[2]) else size_m[2]
    vertex_m = mesh.vertex_m * np.array([1.0, size_m[1] / body_width_m(kind, variant), height / high[2]])
    vertex_m[:, 0] = stretched(vertex_m[:, 0], _rigid_m(mesh, kind), size_m[0], float(height / high[2]))
    return Mesh(vertex_m.astype(np.float32), mesh.triangle, mesh.vertex_rgb)


def _person(category: str, rng: np.random.Generator, size_m: tuple[float, float, float]) -> Mesh:
    """As tall as recorded; riders as long as the box: larger or smaller within limits, and beyond them stretched."""
    mesh = person_mesh(category, rng)
    (low_x, _, _), (high_x, _, high_z) = mesh.bounds_m().astype(np.float64)
    if category == "pedestrian":
        low_x, high_x = 0.0, 0.0
        factor = np.full(3, 1.0 if math.isnan(size_m[2]) else size_m[2] / high_z)
    else:
        ratio = size_m[0] / (high_x - low_x)
        scale = float(np.clip(ratio, *_RIDER_SCALE))
        factor = np.array([ratio, scale, scale if math.isnan(size_m[2]) else size_m[2] / high_z])
    vertex_m = (mesh.vertex_m - [0.5 * (low_x + high_x), 0.0, 0.0]) * factor
    return Mesh(vertex_m.astype(np.float32), mesh.triangle, mesh.vertex_rgb)


def _rigid_m(mesh: Mesh, kind: str) -> list[tuple[float, float]]:
    """Stretches of x that keep their proportions, ascending: those of the wheels, and a lorry's cab."""
    spec = VEHICLE_SPECS[kind]
    foot = np.unique(np.round(mesh.vertex_m[mesh.vertex_m[:, 2] < _TYRE_FOOT_M, 0].astype(np.float64), 2))
    axles = [group.mean() for group in np.split(foot, np.flatnonzero(np.diff(foot) > spec.wheel_radius_m) + 1)]
    reach = 1.04 * spec.wheel_radius_m + _ARCH_M
    spans = [(float(axle) - reach, float(axle) + reach) for axle in axles]
    if kind == "lorry":
        front = float(mesh.vertex_m[:, 0].max())
        spans[-1] = (min(spans[-1][0], front - spec.length_m - CARGO.gap_m), front)
    return spans


def stretched(x_m: np.ndarray, rigid_m: Sequence[tuple[float, float]], length_m: float, rate: float) -> np.ndarray:
    """X of a body of another length: rigid stretches grow by a rate, others by what is left, or all alike."""
    low, high = float(x_m.min()), float(x_m.max())
    knot = np.array([low, *(end for span in rigid_m for end in span), high])
    knot = np.maximum.accumulate(np.clip(knot, low, high))
    gap = np.diff(knot)
    is_rigid = np.arange(len(gap)) % 2 == 1
    left_m = length_m - rate * gap[is_rigid].sum()
    soft = left_m / max(float(gap[~is_rigid].sum()), 1e-6)
    grown = gap * np.where(is_rigid, rate, soft) if 0.4 <= soft <= _SOFT_MAX else gap * length_m / (high - low)
    place = np.concatenate([[0.0], np.cumsum(grown)]) - 0.5 * length_m
    return np.interp(x_m, knot, place)
