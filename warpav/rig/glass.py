"""Windscreen and rear window of a body, found by shape, by colour, or by what a file calls glass."""

from __future__ import annotations

import math

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.rig.zone import BEHIND_GLASS_M, Zone

LEAST_RISE, GREATEST_RISE = math.radians(15.0), math.radians(87.0)
"""Steeper than a roof, and no wall: how far from level a pane is that is found by shape alone [rad]."""

FLAT_COSINE = math.cos(math.radians(8.0))
"""Triangles whose normals are so near to a pane's belong to it: a windscreen bends less, a roof turns away."""

MIN_AREA_M2 = 0.25
"""A smaller pane carries no camera."""

DARK_LUMA = 50.0
"""Glass is drawn darker than this, 0..255, where there are lighter parts beside it."""

_FLOOR_SHARE = 0.55  # bonnets, grilles and bumpers are lower
_WIDTH_SHARE = 0.5  # a windscreen is at least so wide, as a share of the vehicle
_CELL_M = 0.03


def propose_panes(mesh: Mesh, is_glass: np.ndarray | None = None) -> tuple[Zone, ...]:
    """Windscreen and rear window of a vehicle as zones behind glass, as far as they are found.

    The windscreen is the widest flat part of the front half, above the middle of its height, that faces forwards
    and upwards more steeply than roof and bonnet; where parts are dark beside lighter ones, of the dark parts. The
    rear window is found likewise, but by its colour or name alone: many a rear is a plain wall.

    Args:
        mesh: The vehicle in the ego frame [m].
    """
    corner_m = mesh.vertex_m[mesh.triangle].astype(np.float64)
    doubled = np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0])
    area_m2 = 0.5 * np.linalg.norm(doubled, axis=1)
    normal = doubled / np.maximum(2.0 * area_m2, 1e-12)[:, None]
    luma = mesh.vertex_rgb[mesh.triangle].mean(axis=1) @ [0.299, 0.587, 0.114]
    low_m, high_m = mesh.bounds_m().astype(np.float64)
    centre_m = corner_m.mean(axis=1)
    floor_m = low_m[2] + _FLOOR_SHARE * (high_m[2] - low_m[2])
    found = []
    for name, forward in (("windscreen", 1.0), ("rear_window", -1.0)):
        ahead = forward * (centre_m[:, 0] - 0.5 * (low_m[0] + high_m[0])) > 0.0
        rise = np.arccos(np.clip(normal[:, 2], -1.0, 1.0))
        may_be = ahead & (centre_m[:, 2] > floor_m) & (forward * normal[:, 0] > 0.2) & (normal[:, 2] > -0.1)
        if is_glass is not None:
            may_be &= is_glass
        elif _has_dark(may_be, luma, area_m2):
            may_be &= luma < DARK_LUMA
        elif forward > 0.0:
            may_be &= (rise > LEAST_RISE) & (rise < GREATEST_RISE)
        else:
            continue
        part = _flattest(normal, area_m2, may_be)
        zone = _zone_over(name, corner_m[part], normal[part], area_m2[part], high_m[1] - low_m[1])
        if zone is not None:
            found.append(zone)
    return tuple(found)


def _has_dark(may_be: np.ndarray, luma: np.ndarray, area_m2: np.ndarray) -> bool:
    """Whether glass is told by its colour: a large dark part beside lighter ones."""
    dark_m2 = area_m2[may_be & (luma < DARK_LUMA)].sum()
    return bool(MIN_AREA_M2 < dark_m2 < 0.9 * area_m2[may_be].sum())


def _flattest(normal: np.ndarray, area_m2: np.ndarray, may_be: np.ndarray) -> np.ndarray:
    """Those of some triangles that face one way with the largest area together, bool [triangle]."""
    if not may_be.any():
        return may_be
    candidates = np.flatnonzero(may_be)
    # normals that are level across the vehicle: a pane lies across it
    some = candidates[np.argsort(-area_m2[candidates])[:400]]
    level = normal[some] * [1.0, 0.0, 1.0]
    level /= np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-9)
    together = ((level @ normal[candidates].T) >= FLAT_COSINE) @ area_m2[candidates]
    axis = level[int(together.argmax())]
    for _ in range(5):
        near = may_be & (normal @ axis >= FLAT_COSINE)
        mean = (area_m2[near, None] * normal[near]).sum(axis=0) * [1.0, 0.0, 1.0]
        if not np.linalg.norm(mean) > 0.0:
            break
        axis = mean / np.linalg.norm(mean)
    return may_be & (normal @ axis >= FLAT_COSINE)


def _zone_over(name: str, corner_m: np.ndarray, normal: np.ndarray, area_m2: np.ndarray, width_m: float) -> Zone | None:
    """The zone of a pane of some triangles [triangle, corner, 3]: their largest patch; None if that is small."""
    import cv2
    from scipy import ndimage
    from scipy.spatial import ConvexHull

    if area_m2.sum() < MIN_AREA_M2:
        return None
    mean = (area_m2[:, None] * normal).sum(axis=0) * [1.0, 0.0, 1.0]
    x, _, z = mean / np.linalg.norm(mean)
    plane = Zone(name, (float(x), 0.0, float(z)))
    place = corner_m @ plane.axes[:2].T
    # a patch is what hangs together in a raster of the plane, so seams of the mesh do not matter
    first = place.reshape(-1, 2).min(axis=0) - 2 * _CELL_M
    size = np.ceil((place.reshape(-1, 2).max(axis=0) - first) / _CELL_M).astype(int) + 3
    mask = np.zeros(size[::-1], np.uint8)
    for corners in np.rint((place - first) / _CELL_M).astype(np.int32):
        cv2.fillConvexPoly(mask, corners, 1)
    mask = mask.T > 0
    label = np.zeros(mask.shape, np.int32)
    ndimage.label(ndimage.binary_closing(mask, iterations=2), structure=np.ones((3, 3)), output=label)
    sizes = np.bincount(label[mask].ravel(), minlength=2)
    sizes[0] = 0
    best = int(sizes.argmax())
    at = np.rint((place.mean(axis=1) - first) / _CELL_M).astype(int)
    inside = label[at[:, 0], at[:, 1]] == best
    if area_m2[inside].sum() < MIN_AREA_M2:
        return None
    corner, height_m = place[inside].reshape(-1, 2), (corner_m[inside] @ plane.axes[2]).mean()
    if np.ptp(corner[:, 0]) < _WIDTH_SHARE * width_m:
        return None
    hull = simplified(corner[ConvexHull(corner).vertices], _CELL_M)
    outline_m = np.c_[hull, np.full(len(hull), height_m)] @ plane.axes
    return Zone(
        name,
        plane.normal,
        outline_m=np.round(outline_m, 3),
        is_behind_glass=True,
        stand_off_m=BEHIND_GLASS_M,
        pitch_rad=(math.radians(-10.0), math.radians(30.0)),
        kinds=(name,),
    )


def simplified(corner_m: np.ndarray, tolerance_m: float) -> np.ndarray:
    """A convex polygon [corner, 2] without corners that are so near to the line between their neighbours."""
    while len(corner_m) > 4:
        before, after = np.roll(corner_m, 1, axis=0), np.roll(corner_m, -1, axis=0)
        side, to = after - before, corner_m - before
        away_m = np.abs(side[:, 0] * to[:, 1] - side[:, 1] * to[:, 0]) / np.maximum(np.linalg.norm(side, axis=1), 1e-9)
        if away_m.min() > tolerance_m:
            break
        corner_m = np.delete(corner_m, int(away_m.argmin()), axis=0)
    return corner_m
