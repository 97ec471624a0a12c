"""What is proposed for a body and left for a person to edit: its panes, and boxes of parts that carry no camera."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.rig.zone import BEHIND_GLASS_M, Zone

# -------------------------------------------------- windscreen and rear window, by shape, colour or a file's names

_LEAST_RISE, _GREATEST_RISE = math.radians(15.0), math.radians(87.0)
"""Steeper than a roof, and no wall: how far from level a pane is that is found by shape alone [rad]."""

_FLAT_COSINE = math.cos(math.radians(8.0))
"""Triangles whose normals are so near to a pane's belong to it: a windscreen bends less, a roof turns away."""

_MIN_AREA_M2 = 0.25
"""A smaller pane carries no camera."""

_DARK_LUMA = 50.0
"""Glass is drawn darker than this, 0..255, where there are lighter parts beside it."""

_FLOOR_SHARE = 0.55  # bonnets, grilles and bumpers are lower
_WIDTH_SHARE = 0.5  # a windscreen is at least so wide, as a share of the vehicle
_CELL_M = 0.03


def propose_panes(mesh: Mesh, is_glass: np.ndarray | None = None) -> tuple[Zone, ...]:
    """Windscreen and rear window of a vehicle as zones behind glass, as far as they are found.

    The windscreen is the widest flat part of the front half, above the middle of its height, that faces forwards and
    upwards more steeply than roof and bonnet; of the dark parts, where there are lighter ones beside them. The rear
    window is found by colour or name alone: many a rear is a plain wall.
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
        dark_m2 = area_m2[may_be & (luma < _DARK_LUMA)].sum()
        if is_glass is not None:
            may_be &= is_glass
        elif _MIN_AREA_M2 < dark_m2 < 0.9 * area_m2[may_be].sum():  # a large dark part beside lighter ones
            may_be &= luma < _DARK_LUMA
        elif forward > 0.0:
            may_be &= (rise > _LEAST_RISE) & (rise < _GREATEST_RISE)
        else:
            continue
        part = _flattest(normal, area_m2, may_be)
        zone = _zone_over(name, corner_m[part], normal[part], area_m2[part], high_m[1] - low_m[1])
        if zone is not None:
            found.append(zone)
    return tuple(found)


def _flattest(normal: np.ndarray, area_m2: np.ndarray, may_be: np.ndarray) -> np.ndarray:
    """Those of some triangles that face one way with the largest area together, bool [triangle]."""
    if not may_be.any():
        return may_be
    candidates = np.flatnonzero(may_be)
    # normals that are level across the vehicle: a pane lies across it
    some = candidates[np.argsort(-area_m2[candidates])[:400]]
    level = normal[some] * [1.0, 0.0, 1.0]
    level /= np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-9)
    together = ((level @ normal[candidates].T) >= _FLAT_COSINE) @ area_m2[candidates]
    axis = level[int(together.argmax())]
    for _ in range(5):
        near = may_be & (normal @ axis >= _FLAT_COSINE)
        mean = (area_m2[near, None] * normal[near]).sum(axis=0) * [1.0, 0.0, 1.0]
        if not np.linalg.norm(mean) > 0.0:
            break
        axis = mean / np.linalg.norm(mean)
    return may_be & (normal @ axis >= _FLAT_COSINE)


def _zone_over(name: str, corner_m: np.ndarray, normal: np.ndarray, area_m2: np.ndarray, width_m: float) -> Zone | None:
    """The zone of a pane of some triangles [triangle, corner, 3]: their largest patch; None if that is small."""
    import cv2
    from scipy import ndimage
    from scipy.spatial import ConvexHull

    if area_m2.sum() < _MIN_AREA_M2:
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
    if area_m2[inside].sum() < _MIN_AREA_M2:
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


# ------------------------------------------------------------------ glass, lamps, plates and wheels, as boxes

WORDS = {
    "glass": ("glass", "window", "windscreen", "windshield"),
    "lamp": ("light", "lamp", "indicator", "reflector"),
    "plate": ("plate", "licence", "license"),
    "wheel": ("wheel", "tyre", "tire", "rim"),
}
"""How files name such parts; a word that ends so counts, such as ``headlights``."""

MARGIN_M = {"glass": 0.02, "lamp": 0.02, "plate": 0.02, "wheel": 0.08, "other colour": 0.02}
"""How far a box reaches beyond its part [m]; around wheels their arches."""

_OTHER_COLOUR = 45.0
"""Distance of a colour, 0..255, from all shades of the paint, from which on it is no paint."""

_SHADES = (0.45, 1.35)  # of the paint, in light and shadow
_WHEEL_HEIGHT_M, _WHEEL_RATIO = (0.4, 1.4), (0.8, 1.25)
_PATCH_M2 = (0.002, 6.0)
_NEAR_M = 0.03


def kinds_of_names(names: Sequence[str]) -> np.ndarray:
    """What parts of some names are, out of `WORDS`, empty where the name says nothing; str [name]."""
    return np.array([_kind_of(name) for name in names], dtype=object)


def _kind_of(name: str) -> str:
    words = re.findall(r"[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower())
    for kind, ends in WORDS.items():
        if any(word.removesuffix("s").endswith(ends) or word.endswith(ends) for word in words):
            return kind
    return ""


def propose_keep_out(mesh: Mesh, kind: np.ndarray | None = None) -> list[tuple[str, np.ndarray]]:
    """Boxes of what carries no camera, each with its kind, out of `MARGIN_M`; in the ego frame [m], float64 [2, 3].

    Wheels are round parts of their own on the ground. What a file names is taken from there; without names whatever has
    another colour than the paint, which is the most frequent one.
    """
    corner_m = mesh.vertex_m[mesh.triangle].astype(np.float64)
    kind = np.full(len(corner_m), "", object) if kind is None else kind.copy()
    has_names = bool((kind != "").any())
    ground_m = corner_m[..., 2].min()
    for patch in _patches(mesh, np.ones(len(corner_m), bool)):
        low_m, high_m = corner_m[patch].min(axis=(0, 1)), corner_m[patch].max(axis=(0, 1))
        length_m, _, height_m = high_m - low_m
        is_round = _WHEEL_RATIO[0] < length_m / max(height_m, 1e-6) < _WHEEL_RATIO[1]
        if low_m[2] < ground_m + 0.1 and _WHEEL_HEIGHT_M[0] < height_m < _WHEEL_HEIGHT_M[1] and is_round:
            kind[patch] = "wheel"
    if not has_names:
        kind[(kind == "") & _has_other_colour(mesh, corner_m)] = "other colour"
    doubled = np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0])
    area_m2 = 0.5 * np.linalg.norm(doubled, axis=1)
    found: list[tuple[str, np.ndarray]] = []
    for name, margin_m in MARGIN_M.items():
        boxes = []
        for patch in _patches(mesh, kind == name):
            if _PATCH_M2[0] < area_m2[patch].sum() < _PATCH_M2[1]:
                boxes.append(np.stack([corner_m[patch].min(axis=(0, 1)), corner_m[patch].max(axis=(0, 1))]))
        if name == "wheel":  # one that hangs together with the body has its like on the other side
            boxes += [box * [1.0, 0.0, 1.0] - box[::-1] * [0.0, 1.0, 0.0] for box in boxes]
        found += [(name, np.round(box + np.array([[-margin_m], [margin_m]]), 3)) for box in _merged(boxes)]
    return found


def _patches(mesh: Mesh, wanted: np.ndarray) -> list[np.ndarray]:
    """Triangles that hang together among some, bool [triangle]: the numbers of each group. Near vertices are one."""
    from scipy import sparse
    from scipy.sparse import csgraph

    if not wanted.any():
        return []
    _, place = np.unique(np.round(mesh.vertex_m, 4), axis=0, return_inverse=True)
    triangle = place.reshape(-1)[mesh.triangle[wanted]]
    count = int(place.max()) + 1
    start, end = triangle[:, [0, 1]].ravel(), triangle[:, [1, 2]].ravel()
    links = sparse.coo_array((np.ones(len(start), bool), (start, end)), shape=(count, count))
    _, label = csgraph.connected_components(links, directed=False)
    of_triangle = label[triangle[:, 0]]
    order = np.argsort(of_triangle, kind="stable")
    return np.split(np.flatnonzero(wanted)[order], np.flatnonzero(np.diff(of_triangle[order])) + 1)


def _has_other_colour(mesh: Mesh, corner_m: np.ndarray) -> np.ndarray:
    """Which triangles have a colour that is no shade of the paint, bool [triangle]."""
    rgb = mesh.vertex_rgb[mesh.triangle].mean(axis=1).astype(np.float64)
    doubled = np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0])
    _, group = np.unique((rgb // 32).astype(int), axis=0, return_inverse=True)
    area_m2 = np.bincount(group.reshape(-1), weights=np.linalg.norm(doubled, axis=1))
    paint = rgb[group.reshape(-1) == area_m2.argmax()].mean(axis=0)
    shade = np.clip(rgb @ paint / max(paint @ paint, 1.0), *_SHADES)
    return np.linalg.norm(rgb - shade[:, None] * paint, axis=1) > _OTHER_COLOUR


def _merged(boxes: list[np.ndarray]) -> list[np.ndarray]:
    """Boxes [2, 3] of which none comes near another: those that do become one."""
    boxes = list(boxes)
    k = 0
    while k < len(boxes):
        one = boxes[k]
        near = [
            j
            for j, other in enumerate(boxes)
            if j != k and (one[0] <= other[1] + _NEAR_M).all() and (other[0] <= one[1] + _NEAR_M).all()
        ]
        if near:
            group = np.stack([one, *(boxes[j] for j in near)])
            boxes = [box for j, box in enumerate(boxes) if j != k and j not in near]
            boxes.append(np.stack([group[:, 0].min(axis=0), group[:, 1].max(axis=0)]))
            k = 0
        else:
            k += 1
    return boxes
