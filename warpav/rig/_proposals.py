"""What of a body is no plain sheet metal: its panes, and boxes of parts that carry no camera; for a person to edit.

A body is looked at along the normals of zones, in rasters of what is seen first. Glass is what a file names so, else
what is dark beside the paint, else what shape alone tells: a windscreen leans between roof and bonnet, side windows end
at a kink or a frame.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.rig._on_body import ray_caster
from warpav.rig._zone import BEHIND_GLASS_M, NORMALS, Zone

if TYPE_CHECKING:
    from embreex.rtcore_scene import EmbreeScene

_CELL_M = 0.025

_FLOOR_SHARE = 0.45
"""Of the height: bonnets, grilles and bumpers are lower, glass is above."""

_RISE_RAD = {"front": (math.radians(15.0), math.radians(87.0)), "rear": (math.radians(15.0), math.radians(78.0))}
"""How far from level a pane is that shape alone tells: steeper than a roof, and no wall; many a rear is one."""

_PANES = {"front": "windscreen", "rear": "rear_window"}

_FACING = 0.7
"""Sine of how far a pane turns to the side at most, and cosine of how far a side window turns away."""

_EDGE_COSINE, _EDGE_M = math.cos(math.radians(5.0)), 0.01
"""Where the skin turns more from a cell to the next one, or has a higher step, there is an edge."""

_MIN_AREA_M2, _MIN_HEIGHT_M, _WIDTH_SHARE = 0.25, 0.2, 0.5
"""Smaller or lower panes carry no camera, and narrower ones, as a share of the vehicle's width, are no windscreens."""

_BELT_M = 0.15  # how much lower than the windscreen side windows begin at most
_FULL_SHARE = 0.75  # of its convex hull that a pane fills at least
_DARK_SHARE, _DARK = 0.4, 95.0  # glass is darker than this share of the paint and than this, 0..255
_PAINT_SHARE = 0.05  # of the most frequent colour: what has as much may be the paint
_UNLIKE_SHARE = 0.2  # of the cells of both: parts of two sides that differ by less are alike

_OTHER_COLOUR = 45.0
"""Distance of a colour, 0..255, from all shades of the paint, from which on it is no paint."""

_SHADES = (0.45, 1.35)  # of the paint, in light and shadow
_WINDOW_M2, _SUNROOF_M2, _LAMP_M2 = (0.04, math.inf), (0.15, math.inf), (0.006, 0.15)
"""Least and greatest area; larger patches of another colour than lamps, plates and handles are livery: sheet metal."""

_FILLED_SHARE = 0.35  # patches that fill less of their boxes are lines and rings
_THIN_M, _THIN_RISE_M, _THIN_DROP_M = 0.2, 0.08, 0.4
"""What is narrower, and rises so much from what is around it, is a rail, a ladder or an aerial; and how deep it is."""

_WHEEL_HEIGHT_M, _WHEEL_RATIO, _ARCH_M = (0.4, 1.4), (0.8, 1.25), 0.08
_MARGIN_M, _TRIM, _PILLAR = 0.02, 4, 5
"""How far boxes reach beyond their parts; cells across of dark trim beside glass, and of pillars of a windscreen."""

_WORDS = {
    "glass": ("glass", "window", "windscreen", "windshield"),
    "lamp": ("light", "lamp", "indicator", "reflector"),
    "plate": ("plate", "licence", "license"),
    "wheel": ("wheel", "tyre", "tire", "rim"),
}
"""How files name such parts; a word that ends so counts, such as ``headlights``."""


@dataclass(frozen=True, eq=False)
class BodyParts:
    """What of a body is told from sheet metal."""

    panes: tuple[Zone, ...]  # windscreen and rear window, as zones behind glass
    # What carries no camera: what it is, the zones that keep out of it, by their normal (empty: all), and its box in
    # the ego frame [m], float64 [2, 3]
    keep_out: tuple[tuple[str, str, np.ndarray], ...]
    untold: str  # what could not be told, in words; empty where all was


def kinds_of_names(names: Sequence[str]) -> np.ndarray:
    """What parts of some names are, out of `_WORDS`, empty where the name says nothing; str [name]."""
    return np.array([_kind_of(name) for name in names], dtype=object)


def _kind_of(name: str) -> str:
    words = re.findall(r"[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower())
    for kind, ends in _WORDS.items():
        if any(word.removesuffix("s").endswith(ends) or word.endswith(ends) for word in words):
            return kind
    return ""


def parts_of(mesh: Mesh, kind: np.ndarray | None = None) -> BodyParts:
    """The parts of a body in the ego frame; ``kind`` says what its file names every triangle, see `kinds_of_names`.

    Wheels are round parts of their own on the ground. What a file names is taken from there; without names lamps and
    plates are small patches that have another colour than the paint, which is the most frequent one.
    """
    is_named = kind is not None and bool((kind != "").any())
    caster = ray_caster(mesh)
    views = {side: _View.of(mesh, caster, side) for side in NORMALS}
    kind = kind if kind is not None and is_named else _kinds_by_colour(mesh, list(views.values()))
    glass = _alike({side: view.is_upper & (kind[view.triangle] == "glass") for side, view in views.items()})
    pane, by_shape, missing = _panes(views, glass)
    zones = tuple(_zone_over(name, views[side], pane[side]) for side, name in _PANES.items() if side in pane)
    is_told = "front" in pane and "windscreen" not in by_shape  # as one pane is, all are
    if "front" in pane:  # side windows are as high as the windscreen
        floor_m = views["front"].point_m[pane["front"]][:, 2].min() - _BELT_M
        views |= {side: views[side].above(floor_m) for side in ("left", "right")}
    framed = _alike({side: _framed(views[side]) for side in ("left", "right")})
    is_by_colour = not is_told and np.count_nonzero(framed["left"]) * _CELL_M**2 <= _MIN_AREA_M2
    if is_by_colour:  # pale glass has at least another colour than the paint
        is_other = kind == "other colour"
        upper = {side: views[side].is_upper & is_other[views[side].triangle] for side in framed}
        framed = _alike({side: mask | upper[side] for side, mask in framed.items()})
    elif not is_told:
        by_shape.append("side windows")
    glass |= {} if is_told else {side: glass[side] | mask for side, mask in framed.items()}
    glass = {side: mask & views[side].is_upper & ~pane.get(side, np.zeros((), bool)) for side, mask in glass.items()}
    keep_out = (*_wheels(mesh, kind), *_boxed(views, glass, kind, is_named=is_named))
    if is_by_colour and not any(name == "window" and side in ("left", "right") for name, side, _ in keep_out):
        is_by_colour, missing = False, [*missing, "side windows"]
    said = [] if is_told else ["the windscreen has no name, and is not dark beside the paint"]
    said += [f"{', '.join(by_shape)} by shape alone, with the pillars in between"] if by_shape else []
    said += ["side windows by colour alone"] if is_by_colour else []
    said += [f"no {', no '.join(missing)} found"] if missing else []
    return BodyParts(zones, keep_out, "; ".join(said))


def _boxed(
    views: Mapping[str, _View], glass: Mapping[str, np.ndarray], kind: np.ndarray, *, is_named: bool
) -> Iterator[tuple[str, str, np.ndarray]]:
    """Boxes of side windows, thin parts, lamps and plates, as `BodyParts.keep_out`; ``glass`` without panes."""
    for side, view in views.items():
        area_m2 = _SUNROOF_M2 if side == "up" else _WINDOW_M2
        yield from (("window", side, box) for box in _boxes(view, glass[side], area_m2, across=_TRIM))
        yield from (("thin part", side, box) for box in _thin_parts(view))
    for word in ("lamp", "plate") if is_named else ("other colour",):
        is_it = kind == word if is_named else kind != ""
        masks = {side: is_it[view.triangle] & view.is_seen & ~glass[side] for side, view in views.items()}
        sides = [side for side in masks if is_named or side != "up"]  # small patches on a roof are logos and trim
        yield from ((word, side, box) for side in sides for box in _boxes(views[side], _alike(masks)[side], _LAMP_M2))


@dataclass(frozen=True, eq=False)
class _View:
    """What is seen first against a zone's normal, in cells [row, column] along its V and U from the low ends."""

    name: str  # out of `NORMALS`
    axes: np.ndarray  # U, V and N of the zone, float64 [3, 3]
    triangle: np.ndarray  # int [row, column], 0 where nothing is
    point_m: np.ndarray  # in the ego frame, float64 [row, column, 3]
    normal: np.ndarray  # towards the viewer, unit length, float64 [row, column, 3]
    is_seen: np.ndarray  # bool [row, column]
    is_upper: np.ndarray  # those above a floor, at first `_FLOOR_SHARE`, bool [row, column]

    @classmethod
    def of(cls, mesh: Mesh, caster: EmbreeScene, name: str) -> _View:
        """A body from one side."""
        axes = Zone(name, NORMALS[name]).axes
        local_m = mesh.vertex_m.astype(np.float64) @ axes.T
        low_m, high_m = local_m.min(axis=0), local_m.max(axis=0)
        size = np.maximum(np.ceil((high_m - low_m)[:2] / _CELL_M), 1).astype(int)
        place = np.moveaxis(np.indices(size[::-1])[::-1], 0, -1) - 0.5 * (size - 1)
        place_m = 0.5 * (low_m + high_m)[:2] + _CELL_M * place
        start_m = np.concatenate([place_m, np.full((*place.shape[:2], 1), high_m[2] + 1.0)], axis=-1) @ axes
        ray = np.tile(-axes[2].astype(np.float32), (start_m.size // 3, 1))
        hit = caster.run(start_m.reshape(-1, 3).astype(np.float32), ray, output=1)
        is_seen = (hit["primID"] >= 0).reshape(place.shape[:2])
        far_m = np.where(is_seen, hit["tfar"].reshape(place.shape[:2]), high_m[2] - low_m[2] + 2.0)
        point_m = start_m - far_m[..., None] * axes[2]
        normal = hit["Ng"].reshape(point_m.shape).astype(np.float64)
        normal *= np.where(normal @ axes[2] < 0.0, -1.0, 1.0)[..., None]
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
        ground_m, top_m = mesh.bounds_m()[:, 2]
        triangle = np.where(is_seen, hit["primID"].reshape(is_seen.shape), 0)
        view = cls(name, axes, triangle, point_m, normal, is_seen, is_seen)
        return view.above(ground_m + _FLOOR_SHARE * (top_m - ground_m))

    def above(self, floor_m: float) -> _View:
        """The same with another floor [m]."""
        return replace(self, is_upper=self.is_seen & (self.point_m[..., 2] > floor_m))

    @property
    def lean(self) -> np.ndarray:
        """Normals seen from the side, which bends of glass across the view do not change; float64 [row, column, 3]."""
        lean = self.normal - (self.normal @ self.axes[0])[..., None] * self.axes[0]
        return lean / np.maximum(np.linalg.norm(lean, axis=-1, keepdims=True), 1e-9)

    @property
    def faces(self) -> np.ndarray:
        """What of the body faces the viewer, not the side, bool [row, column]."""
        return self.is_seen & (np.abs(self.normal @ self.axes[0]) < _FACING)

    @property
    def area_m2(self) -> np.ndarray:
        """Area of the skin in every cell, float64 [row, column]."""
        return _CELL_M**2 / np.maximum(self.normal @ self.axes[2], 0.05)


def _alike(masks: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Masks of views, bool [row, column]; those of sides that are almost mirror images are made so."""
    result, other_side = {}, {"left": "right", "right": "left"}
    for side, mask in masks.items():
        mirrored = masks[other_side.get(side, side)]
        mirrored = mirrored[::-1] if side == "up" else mirrored[:, ::-1]
        is_same = np.count_nonzero(mask != mirrored) < _UNLIKE_SHARE * np.count_nonzero(mask | mirrored)
        result[side] = mask | mirrored if is_same else mask
    return result


# ---------------------------------------------------------------------------------------------------------- panes


def _panes(
    views: Mapping[str, _View], glass: Mapping[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], list[str], list[str]]:
    """Cells of windscreen and rear window by their sides, bool [row, column]; which are by shape, and which missing."""
    pane: dict[str, np.ndarray] = {}
    by_shape, missing = [], []
    for side, name in _PANES.items():
        cells = _across(views[side], glass[side])
        if cells is None and (by_shape or not pane):  # a dark windscreen has no paint-coloured rear window
            cells = _across(views[side], _leaning(views[side]))
            (missing if cells is None else by_shape).append(name.replace("_", " "))
        if cells is not None:
            pane[side] = cells
    return pane, by_shape, missing


def _across(view: _View, mask: np.ndarray) -> np.ndarray | None:
    """The largest patch of some cells, as glass across the vehicle, bool [row, column]; None if small or narrow."""
    from scipy import ndimage
    from scipy.spatial import ConvexHull

    mask = ndimage.binary_opening(mask & view.faces, structure=np.ones((_TRIM, _TRIM)))
    closed = ndimage.binary_closing(np.pad(mask, _PILLAR), structure=np.ones((1, _PILLAR)))
    closed = closed[_PILLAR:-_PILLAR, _PILLAR:-_PILLAR]
    label = np.zeros(mask.shape, np.int32)
    ndimage.label(closed & view.is_seen, output=label)
    size_m2 = np.bincount(label[mask], view.area_m2[mask], minlength=2)
    cells = mask & (label == 1 + int(size_m2[1:].argmax()))
    if size_m2[1:].max() < _MIN_AREA_M2:
        return None
    _, width_m, height_m = np.ptp(view.point_m[cells], axis=0)
    is_across = width_m > _WIDTH_SHARE * np.ptp(view.point_m[view.is_seen][:, 1])
    is_full = cells.sum() * _CELL_M**2 > _FULL_SHARE * ConvexHull(view.point_m[cells] @ view.axes[:2].T).volume
    return cells if is_across and height_m > _MIN_HEIGHT_M and is_full else None


def _leaning(view: _View) -> np.ndarray:
    """Cells of the largest flat piece in the upper half that is steeper than a roof and no wall, bool [row, column]."""
    rise_rad = np.arccos(np.clip(view.lean[..., 2], -1.0, 1.0))
    low_rad, high_rad = _RISE_RAD[view.name]
    may_be = view.is_upper & view.faces & (rise_rad > low_rad) & (rise_rad < high_rad)
    is_half = np.arange(may_be.shape[1]) >= may_be.shape[1] // 2
    piece = _pieces(view, may_be & is_half)  # of one half of the view, as a windscreen may have two panes
    height_m = view.point_m[..., 2] - view.point_m[view.is_seen][:, 2].min()  # of two that are as large the upper one
    weight = np.bincount(piece.ravel(), (view.area_m2 * height_m).ravel(), minlength=2)
    best = piece == 1 + int(weight[1:].argmax())
    return best | (best[:, ::-1] & may_be)


def _pieces(view: _View, mask: np.ndarray) -> np.ndarray:
    """Some cells numbered from 1 on by the smooth piece of skin that they belong to, 0 elsewhere, int [row, column]."""
    from trimesh.graph import connected_component_labels

    lean, cell, links = view.lean, np.arange(mask.size).reshape(mask.shape), []
    for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        is_smooth = (lean[one] * lean[other]).sum(axis=-1) > _EDGE_COSINE
        step_m = np.abs(((view.point_m[other] - view.point_m[one]) * view.normal[one]).sum(axis=-1))
        is_joined = mask[one] & mask[other] & is_smooth & (step_m < _EDGE_M)
        links.append(np.stack([cell[one][is_joined], cell[other][is_joined]], axis=1))
    label = connected_component_labels(np.concatenate(links), node_count=mask.size)
    return np.where(mask, label.reshape(mask.shape) + 1, 0)


def _framed(view: _View) -> np.ndarray:
    """Cells of a side whose smooth piece of skin ends above the floor, at a frame or the kink of a belt line."""
    faces = view.faces & (view.normal @ view.axes[2] > _FACING)
    piece = _pieces(view, faces)
    is_body = np.bincount(piece.ravel(), (faces & ~view.is_upper).ravel()) > 0
    size_m2 = np.bincount(piece.ravel(), view.area_m2.ravel())
    return faces & ~is_body[piece] & (size_m2[piece] > _WINDOW_M2[0])


def _zone_over(name: str, view: _View, cells: np.ndarray) -> Zone:
    """The zone of a pane of some cells, bool [row, column]."""
    from scipy.spatial import ConvexHull

    point_m = view.point_m[cells]
    x, _, z = (view.area_m2[cells, None] * view.normal[cells]).sum(axis=0)
    plane = Zone(name, (float(x / math.hypot(x, z)), 0.0, float(z / math.hypot(x, z))))
    corner = point_m @ plane.axes[:2].T
    hull = simplified(corner[ConvexHull(corner).vertices], _CELL_M)
    outline_m = np.c_[hull, np.full(len(hull), (point_m @ plane.axes[2]).mean())] @ plane.axes
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


# ---------------------------------------------------------------------------------------------------------- boxes


def _kinds_by_colour(mesh: Mesh, views: Sequence[_View]) -> np.ndarray:
    """What triangles are by colour: ``glass`` (dark), ``other colour``, or paint, which is empty; object [triangle].

    The paint is the colour of which most is seen, in light and shadow.
    """
    rgb = mesh.vertex_rgb[mesh.triangle].mean(axis=1).astype(np.float64)
    each_m2 = [np.bincount(v.triangle[v.is_seen], v.area_m2[v.is_seen], minlength=len(rgb)) for v in views]
    seen_m2 = np.sum(each_m2, axis=0)
    _, group = np.unique((rgb // 32).astype(int), axis=0, return_inverse=True)
    group_m2 = np.bincount(group.reshape(-1), seen_m2)
    most = (group.reshape(-1) == number for number in np.flatnonzero(group_m2 > _PAINT_SHARE * group_m2.max()))
    paints = [np.average(rgb[some], axis=0, weights=seen_m2[some] + 1e-12) for some in most]
    paint = max(paints, key=lambda paint: seen_m2[~_is_other(rgb, paint)].sum())
    is_dark = rgb.max(axis=1) < min(_DARK_SHARE * paint.max(), _DARK)
    return np.select([is_dark, _is_other(rgb, paint)], ["glass", "other colour"], "").astype(object)


def _is_other(rgb: np.ndarray, paint: np.ndarray) -> np.ndarray:
    """Which colours [colour, 3] are no shades of a paint, bool [colour]."""
    shade = np.clip(rgb @ paint / max(paint @ paint, 1.0), *_SHADES)
    return np.linalg.norm(rgb - shade[:, None] * paint, axis=1) > _OTHER_COLOUR


def _boxes(
    view: _View, mask: np.ndarray, area_m2: tuple[float, float], *, across: int = 2, filled: float = _FILLED_SHARE
) -> list[np.ndarray]:
    """Boxes around patches of cells, as many ``across``, that are neither smaller nor larger than ``area_m2`` [m]."""
    from scipy import ndimage

    label, boxes = np.zeros(mask.shape, np.int32), []
    mask = ndimage.binary_opening(mask, structure=np.ones((across, across)))
    ndimage.label(mask, np.ones((3, 3)), output=label)
    for number, place in enumerate(ndimage.find_objects(label), start=1):
        inside = label[place] == number
        if area_m2[0] < view.area_m2[place][inside].sum() < area_m2[1] and inside.mean() > filled:
            boxes.append(_around(view.point_m[place][inside], _MARGIN_M))
    return boxes


def _around(point_m: np.ndarray, margin_m: float) -> np.ndarray:
    return np.round([point_m.min(axis=0) - margin_m, point_m.max(axis=0) + margin_m], 3)


def _thin_parts(view: _View) -> list[np.ndarray]:
    """Boxes around rails, ladders, aerials; of a side of what stands against the sky alone: bumpers carry cameras."""
    from scipy import ndimage

    height_m = view.point_m @ view.axes[2]
    around_m = ndimage.grey_opening(height_m, size=round(_THIN_M / _CELL_M))
    drop_m = np.minimum(height_m - around_m, _THIN_DROP_M)
    is_thin = view.is_upper & (drop_m > _THIN_RISE_M)
    if view.name != "up":
        is_thin &= around_m < height_m[view.is_seen].min()
    foot = replace(view, point_m=view.point_m - drop_m[..., None] * view.axes[2])
    both = zip(*(_boxes(each, is_thin, _WINDOW_M2, across=1, filled=0.0) for each in (view, foot)), strict=True)
    return [_around(np.concatenate(pair), 0.0) for pair in both]


def _wheels(mesh: Mesh, kind: np.ndarray) -> list[tuple[str, str, np.ndarray]]:
    """Wheels with their arches, as `BodyParts.keep_out`: what is named so, and round parts of their own on the ground.

    One that hangs together with the body has its like on the other side.
    """
    corner_m, is_wheel = mesh.vertex_m[mesh.triangle].astype(np.float64), kind == "wheel"
    for patch in _patches(mesh, np.ones(len(kind), bool)):
        length_m, _, height_m = np.ptp(corner_m[patch], axis=(0, 1))
        is_round = _WHEEL_RATIO[0] < length_m / max(height_m, 1e-6) < _WHEEL_RATIO[1]
        stands = corner_m[patch][..., 2].min() < corner_m[..., 2].min() + 0.1
        is_wheel[patch] |= stands and is_round and _WHEEL_HEIGHT_M[0] < height_m < _WHEEL_HEIGHT_M[1]
    boxes = [_around(corner_m[patch].reshape(-1, 3), _ARCH_M) for patch in _patches(mesh, is_wheel)]
    boxes += [np.sort(box * [1.0, -1.0, 1.0], axis=0) for box in boxes]
    kept: list[np.ndarray] = []
    for box in sorted(boxes, key=lambda box: -np.prod(np.ptp(box, axis=0))):  # rims lie in tyres
        middle_m = box.mean(axis=0)
        if not any((other[0] <= middle_m).all() and (middle_m <= other[1]).all() for other in kept):
            kept.append(box)
    return [("wheel", "", box) for box in kept]


def _patches(mesh: Mesh, wanted: np.ndarray) -> list[np.ndarray]:
    """Triangles that hang together among some, bool [triangle]: the numbers of each group. Near vertices are one."""
    from trimesh.graph import connected_component_labels

    _, place = np.unique(np.round(mesh.vertex_m, 4), axis=0, return_inverse=True)
    triangle = place.reshape(-1)[mesh.triangle[wanted]]
    links = triangle[:, [0, 1, 1, 2]].reshape(-1, 2)
    of_triangle = connected_component_labels(links, node_count=int(place.max()) + 1)[triangle[:, 0]]
    order = np.argsort(of_triangle, kind="stable")
    groups = np.split(np.flatnonzero(wanted)[order], np.flatnonzero(np.diff(of_triangle[order])) + 1)
    return groups if wanted.any() else []
