"""Charts: the zones of a vehicle side by side in one mount surface, and the zones that a body suggests.

Between the zones are gaps, as between the parts of a texture: a place in the chart is a zone and a place of it. So a
camera anywhere on the body is still two numbers, and one raster is all that a kernel needs; see `MountSurface`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from warpav.core.errors import InputError
from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll
from warpav.raster.mesh import Mesh
from warpav.raster.pane import Pane
from warpav.rig._module import Housing, Module, Role
from warpav.rig._mount_surface import MountSurface, mount_surface_from_mesh
from warpav.rig._proposals import BodyParts, parts_of, simplified
from warpav.rig._zone import NORMALS, Zone

_GAP_M = 1.0
"""Between the rectangles of two zones in the chart: more than twice what any search moves a camera at once."""

_CENTRE_M = 0.1
"""Half the width of what of a centred zone is drawn: cameras stand in its middle."""

_PANE_MARGIN_M = 0.02
"""How far a pane reaches beyond the cells of its zone, along them and across [m]."""

_MIN_CLEAR = 0.5
"""Least share of a pane's area that has to be clear: less shows that its triangles are larger than the pane."""

_SKIRT_CELLS = 3
_SIMPLER_M = 0.003
_BIG_M = 1e6

_STEP_RAD = math.radians(5.0)
"""Between the directions in which a housing is tried; between them it reaches .1 % farther at most."""

_ROUNDING_M = 1e-3

_PITCH_RAD = (math.radians(-10.0), math.radians(30.0))
"""Of proposed zones."""

_CLEAR_M, _COARSE_M, _LEAST_M2 = 0.04, 0.04, 0.25
"""How far proposed zones keep from panes, the cells in which they are tried, and the least of one [m2]."""


def chart_of(
    zones: Sequence[Zone],
    mesh: Mesh,
    *,
    cell_m: float = 0.02,
    min_upward_normal: float = 0.8,
    min_zone_normal: float = 0.9,
    modules: Sequence[Module] = (),
    pair_spacing_m: float | None = None,
    pitch_rad: tuple[float, float] = (0.0, 0.0),
) -> MountSurface:
    """All zones of a vehicle in one chart, once for every module that they carry."""
    names = [zone.name for zone in zones]
    if not names or len(set(names)) != len(names):
        raise InputError(f"zones: expected at least one, and names that differ, got {names}")
    options = {"cell_m": cell_m, "min_upward_normal": min_upward_normal, "min_zone_normal": min_zone_normal}
    field_of, known = dict[str, MountSurface](), dict[tuple[object, ...], MountSurface]()
    for zone in zones:  # many share a part of the body
        part = *zone.normal, *zone.origin_m, id(zone.box_m), id(zone.keep_out_m), id(zone.outline_m)
        field_of[zone.name] = known[part] = known.get(part) or _zone_surface(zone, mesh, **options)
    pane_of = {zone.name: _pane_under(zone, field_of[zone.name], mesh) for zone in zones if zone.is_behind_glass}
    surface_of = {name: _with_skirt(surface) for name, surface in field_of.items()}
    names, module_of_zone, pairs, notes = [module.name for module in modules], np.zeros(0, np.int64), (), ()
    if pair_spacing_m is not None:
        surface_of = _left_halves(zones, surface_of, pair_spacing_m)
    if modules:
        there = [zone for zone in zones if zone.name in surface_of]
        sheets, names, module_of_zone, pairs, notes = _sheets(
            modules,
            there,
            surface_of,
            middle_x_m=float(mesh.bounds_m()[:, 0].mean()),
            is_symmetric=pair_spacing_m is not None,
            pitch_rad=pitch_rad,
        )
        zones, surfaces = [zone for zone, _ in sheets], [surface for _, surface in sheets]
    else:
        surfaces = [surface_of[zone.name] for zone in zones]
    firsts, size = _packed([each.height_m.shape for each in surfaces], math.ceil(_GAP_M / cell_m))
    # the first zone keeps its own coordinates
    origin_m = surfaces[0].origin_m - np.multiply(firsts[0], cell_m)
    height_m, zone_of = np.zeros(size, np.float32), np.full(size, -1, np.int32)
    is_mountable, plane_origin_m = np.zeros(size, bool), []
    for number, (zone, surface, (row, column)) in enumerate(zip(zones, surfaces, firsts, strict=True)):
        rows, columns = surface.height_m.shape
        part = np.s_[row : row + rows, column : column + columns]
        height_m[part], zone_of[part] = surface.height_m, number
        is_mountable[part] = surface.inside
        shift_m = origin_m + np.multiply((row, column), cell_m) - surface.origin_m
        plane_origin_m.append(np.asarray(zone.origin_m) - shift_m @ zone.axes[:2])
    return MountSurface(
        height_m,
        origin_m,
        cell_m,
        is_mountable,
        tuple(zones),
        _nearest_zone(zone_of),
        np.array(plane_origin_m),
        tuple(names),
        module_of_zone,
        pairs,
        tuple(pane_of.get(zone.name) for zone in zones) if pane_of else (),
        notes,
    )


def _pane_under(zone: Zone, surface: MountSurface, mesh: Mesh) -> Pane:
    """What of the body the cameras of a zone behind glass look through.

    Its outline is the zone's, or else the convex hull of the cells that carry a camera, `_PANE_MARGIN_M` wider; it
    reaches so much beyond the skin to either side, so a second sheet of glass is clear as well.
    """
    from scipy.spatial import ConvexHull

    place_m = surface.place_m[surface.inside]
    height_m = surface.height_m[surface.inside].astype(np.float64)
    middle_m = float(height_m.mean())
    if zone.outline_m is not None:
        corner_m = (np.asarray(zone.outline_m) - zone.origin_m) @ zone.axes[:2].T
    else:
        half_m = 0.5 * surface.cell_m
        around_m = half_m * np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
        corner_m = (place_m[:, None] + around_m).reshape(-1, 2)
    angle_rad = np.arange(0.0, 2.0 * math.pi, math.pi / 8.0)
    round_m = _PANE_MARGIN_M * np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=1)
    corner_m = (corner_m[:, None] + round_m).reshape(-1, 2)
    corner_m = simplified(corner_m[ConvexHull(corner_m).vertices], _SIMPLER_M)
    outline_m = np.c_[corner_m, np.full(len(corner_m), middle_m)] @ zone.axes + zone.origin_m
    pane = Pane(
        zone.name,
        tuple(np.round(zone.axes[2], 6).tolist()),
        tuple(tuple(corner) for corner in np.round(outline_m, 6).tolist()),
        (
            round(float(height_m.min()) - middle_m - _PANE_MARGIN_M, 6),
            round(float(height_m.max()) - middle_m + _PANE_MARGIN_M, 6),
        ),
    )
    clear_m2 = pane.clear_area_m2(mesh)
    zone_m2 = len(place_m) * surface.cell_m**2
    if clear_m2 < _MIN_CLEAR * zone_m2:
        raise InputError(
            f"zone {zone.name!r}: behind_glass: expected triangles that lie under the zone, got {clear_m2:.2f} of "
            f"{zone_m2:.2f} m² clear; the others reach beyond it: let box_m or outline_m cover the whole pane"
        )
    return pane


def _sheets(
    modules: Sequence[Module],
    zones: Sequence[Zone],
    surface_of: dict[str, MountSurface],
    *,
    middle_x_m: float,
    is_symmetric: bool,
    pitch_rad: tuple[float, float],
) -> tuple[list[tuple[Zone, MountSurface]], list[str], np.ndarray, tuple[bool, ...], tuple[str, ...]]:
    """The zones once for each module that they carry: they, names, which each carries, which are pairs; and notes."""
    sheets, names, carried, pairs, notes = [], [], [], [], []
    for module in modules:
        sides = (1.0,) if is_symmetric else (1.0, -1.0)
        there = [
            kept
            for zone in _fitting(module, zones)
            for kept in _of_role(module, zone, surface_of[zone.name], pitch_rad, middle_x_m, sides)
        ]
        if not there:
            names_there = ", ".join(zone.name for zone in _fitting(module, zones))
            raise InputError(
                f"module {module.name!r}: role: expected a zone that lets it stand and look as a {module.role} module "
                f"does, got {names_there}; give a zone other yaw_deg or pitch_deg, or the module role: any"
            )
        fitting, left_out = _roomy(module, there, pitch_rad)
        notes += left_out
        for is_pair in (True, False) if is_symmetric else (False,):
            own = [each for each in fitting if not is_symmetric or each[0].is_centred != is_pair]
            if own:
                sheets += own
                carried += [len(names)] * len(own)
                names.append(module.name)
                pairs.append(is_pair)
    return sheets, names, np.array(carried), tuple(pairs) if is_symmetric else (), tuple(notes)


_AHEAD_RAD, _ASIDE_RAD, _LEVEL_RAD = math.radians(20.0), math.radians(60.0), math.radians(10.0)
"""How far modules of a role look aside of ahead or back, or of straight to the side; and those two up or down [rad]."""


def _of_role(
    module: Module,
    zone: Zone,
    surface: MountSurface,
    pitch_rad: tuple[float, float],
    middle_x_m: float,
    sides: Sequence[float],
) -> list[tuple[Zone, MountSurface]]:
    """A zone and its surface as a role lets a module look and stand there, once for each side where it has one."""
    if module.role in (Role.ANY, Role.SURROUND):
        return [(zone, surface)]
    local_m = np.concatenate([surface.place_m, surface.height_m[..., None]], axis=-1)
    point_m = local_m @ zone.axes + zone.origin_m
    pitch = zone.pitch_rad or pitch_rad
    if module.role is Role.SIDE:
        wanted = [(side * math.pi / 2.0, _ASIDE_RAD, side * point_m[..., 1] >= 0.0) for side in sides]
    else:
        forward = 1.0 if module.role is Role.FRONT else -1.0
        pitch = max(pitch[0], -_LEVEL_RAD), min(pitch[1], _LEVEL_RAD)
        ahead = forward * (point_m[..., 0] - middle_x_m) >= 0.0
        wanted = [(0.0 if forward > 0.0 else math.pi, _AHEAD_RAD, ahead)]
    found = []
    for middle_rad, half_rad, is_there in wanted:
        yaw = _overlap(zone.yaw_range_rad, middle_rad - half_rad, middle_rad + half_rad)
        kept = surface.inside & is_there
        if yaw is None or pitch[0] > pitch[1] or not kept.any():
            continue
        narrowed = zone if zone.is_centred else replace(zone, yaw_rad=yaw)
        found.append((replace(narrowed, pitch_rad=pitch), replace(surface, is_mountable=kept)))
    return found


def _overlap(range_rad: tuple[float, float] | None, low_rad: float, high_rad: float) -> tuple[float, float] | None:
    """What a range of yaws, None: all, has in common with another; None: nothing."""
    if range_rad is None:
        return low_rad, high_rad
    for turn in (0.0, math.tau, -math.tau):
        low, high = max(range_rad[0] + turn, low_rad), min(range_rad[1] + turn, high_rad)
        if low <= high:
            return low, high
    return None


def _roomy(
    module: Module, zones: Sequence[tuple[Zone, MountSurface]], pitch_rad: tuple[float, float]
) -> tuple[list[tuple[Zone, MountSurface]], list[str]]:
    """Those of a module's zones in which its housing has room, as they are then, with their surfaces; and a note."""
    found = [(zone, _with_room(module, zone, surface, pitch_rad=pitch_rad)) for zone, surface in zones]
    roomy = [each for _, each in found if isinstance(each, tuple)]
    needed = [
        f"{zone.name} needs {1e3 * each:.0f} mm and allows {1e3 * zone.stand_off_m[1]:.0f}"
        for zone, each in found
        if not isinstance(each, tuple)
    ]
    fix = "raise the zone's stand_off_m or recess_m, or narrow its angles"
    if not roomy:
        raise InputError(
            f"module {module.name!r}: housing: expected room for it in a zone, got none: {', '.join(needed)}; {fix}"
        )
    return roomy, [
        f"module {module.name!r}: left out of zones without room for its housing: {', '.join(needed)}; {fix}"
    ] if needed else []


def _with_room(
    module: Module, zone: Zone, surface: MountSurface, *, pitch_rad: tuple[float, float]
) -> tuple[Zone, MountSurface] | float:
    """A zone and its surface as a module may stand there; or the stand-off that it would need, beyond the greatest [m].

    The least stand-off is raised until the housing has room in half of the zone, whichever way it points; where it has
    none then, as the body bulges, the zone carries no camera. A zone outside that sets no ``recess_m`` stays: its
    housings may be let in.
    """
    if not zone.is_behind_glass and zone.recess_m is None:
        return zone, surface
    outwards = 1.0 if zone.is_behind_glass else -1.0
    depth_m, reach_m = _housing_reach_m(module.housing, zone, outwards * zone.axes[2], pitch_rad=pitch_rad)
    # how far the skin comes nearer within reach of the housing
    height_m = -outwards * surface.height_m.astype(np.float64)
    needed_m = depth_m + _highest_within(height_m, reach_m / surface.cell_m) - height_m
    needed_m -= 0.0 if zone.is_behind_glass else zone.recess_m or 0.0
    low_m, high_m = zone.stand_off_m
    inside = surface.inside
    if not (needed_m[inside] <= high_m).any():
        return float(needed_m[inside].min())
    least_m = float(np.clip(np.median(needed_m[inside]), low_m, high_m))
    kept = inside & (needed_m <= least_m + _ROUNDING_M)
    return replace(zone, stand_off_m=(least_m, high_m)), replace(surface, is_mountable=kept)


def _housing_reach_m(
    housing: Housing, zone: Zone, direction: np.ndarray, *, pitch_rad: tuple[float, float]
) -> tuple[float, float]:
    """How far a housing reaches along a unit vector [3] and across it at most, however it points in a zone [m]."""
    half_m = 0.5 * np.asarray(housing.size_m)
    corner_m = np.array([np.multiply(signs, half_m) for signs in itertools.product((-1.0, 1.0), repeat=3)])
    corner_m = (corner_m + housing.offset_m) @ FLU_FROM_RDF.T
    yaws, pitches, rolls = (
        _steps(pair)
        for pair in (
            zone.yaw_range_rad or (-math.pi, math.pi),
            zone.pitch_rad or pitch_rad,
            zone.roll_rad or (0.0, 0.0),
        )
    )
    along, across = [], []
    for angles in itertools.product(yaws, pitches, rolls):
        turned_m = corner_m @ rotation_from_yaw_pitch_roll(*angles).T
        there = turned_m @ direction
        along.append(there.max())
        across.append(np.linalg.norm(turned_m - there[:, None] * direction, axis=1).max())
    return float(max(along)), float(max(across))


def _steps(pair: tuple[float, float]) -> np.ndarray:
    return np.linspace(*pair, 1 + math.ceil((pair[1] - pair[0]) / _STEP_RAD))


def _highest_within(height_m: np.ndarray, cells: float) -> np.ndarray:
    """The greatest height of the cells of which some part is within so many cells of each, [row, column]."""
    from scipy import ndimage

    cells += math.sqrt(0.5)
    reach = math.ceil(cells)
    i, j = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return ndimage.maximum_filter(height_m, footprint=np.hypot(i, j) <= cells + 1e-9, mode="nearest")


def _left_halves(
    zones: Sequence[Zone], surface_of: dict[str, MountSurface], pair_spacing_m: float
) -> dict[str, MountSurface]:
    """What of the zones carries the left cameras of pairs, and of centred ones what is near the plane of symmetry."""
    result = {}
    for zone in zones:
        surface = surface_of[zone.name]
        local_m = np.concatenate([surface.place_m, surface.height_m[..., None]], axis=-1)
        y_m = (local_m @ zone.axes)[..., 1] + zone.origin_m[1]
        is_kept = np.abs(y_m) <= _CENTRE_M if zone.is_centred else y_m >= 0.5 * pair_spacing_m
        if (surface.inside & is_kept).any():
            result[zone.name] = replace(surface, is_mountable=surface.inside & is_kept)
    if not result:
        raise InputError("zones: expected one on the left or in the middle for a symmetric rig, got none")
    return result


def _fitting(module: Module, zones: Sequence[Zone]) -> list[Zone]:
    found = [zone for zone in zones if any(map(module.fits, (zone.name, *zone.kinds)))]
    if not found:
        there = ", ".join(zone.name + (f" ({', '.join(zone.kinds)})" if zone.kinds else "") for zone in zones)
        raise InputError(
            f"module {module.name!r}: zones: expected one of the vehicle's, {there}, got {', '.join(module.zones)}; "
            "give a zone this kind, or let the module fit another"
        )
    return found


def _zone_surface(
    zone: Zone, mesh: Mesh, *, cell_m: float, min_upward_normal: float, min_zone_normal: float
) -> MountSurface:
    """The height field of a zone over its own plane; u and v take the places of x and y."""
    vertex_m = (mesh.vertex_m.astype(np.float64) - zone.origin_m) @ zone.axes.T
    turned = Mesh.create(vertex_m.astype(np.float32), mesh.triangle, [128, 128, 128])
    try:
        return mount_surface_from_mesh(
            turned,
            cell_m=cell_m,
            min_upward_normal=min_upward_normal,
            min_zone_normal=min_zone_normal,
            min_height_m=-_BIG_M,
            smoothing_tolerance_m=math.inf,
            keeps=zone.holds,
        )
    except InputError:
        low_m, high_m = (", ".join(f"{each:.2f}" for each in corner_m) for corner_m in mesh.bounds_m())
        raise InputError(
            f"zone {zone.name!r}: expected a part of the body that faces {_words(zone.axes[2])}"
            f"{'' if zone.box_m is None else ' inside box_m'}, got none among {len(mesh.triangle)} faces; the body "
            f"reaches from {low_m} to {high_m} m"
        ) from None


def _with_skirt(surface: MountSurface) -> MountSurface:
    """A surface that goes on at its height for some cells beyond its rectangle, where no camera may stand."""
    return MountSurface(
        np.pad(surface.height_m, _SKIRT_CELLS, mode="edge"),
        surface.origin_m - _SKIRT_CELLS * surface.cell_m,
        surface.cell_m,
        np.pad(surface.inside, _SKIRT_CELLS),
    )


def _packed(sizes: Sequence[tuple[int, ...]], gap: int) -> tuple[list[tuple[int, int]], tuple[int, int]]:
    """First row and column of rectangles side by side in shelves, the highest first, and rows and columns in all."""
    area = sum((rows + gap) * (columns + gap) for rows, columns in sizes)
    most = max(math.ceil(math.sqrt(area)), *(columns for _, columns in sizes))
    firsts, row, column, shelf, right = [(0, 0)] * len(sizes), 0, 0, 0, 0
    for number in sorted(range(len(sizes)), key=lambda k: -sizes[k][0]):
        rows, columns = sizes[number]
        if column and column + columns > most:
            row, column, shelf = row + shelf + gap, 0, 0
        firsts[number] = (row, column)
        shelf, right, column = max(shelf, rows), max(right, column + columns), column + columns + gap
    return firsts, (row + shelf, right)


def _nearest_zone(zone_of: np.ndarray) -> np.ndarray:
    """The zone of every cell, between zones that of the nearest cell that has one."""
    from scipy import ndimage

    nearest = np.zeros((2, *zone_of.shape), np.int32)
    ndimage.distance_transform_edt(zone_of < 0, return_distances=False, return_indices=True, indices=nearest)
    return np.ascontiguousarray(zone_of[tuple(nearest)])


def _words(normal: np.ndarray) -> str:
    for name, known in NORMALS.items():
        if np.allclose(normal, known, atol=1e-3):
            return {"up": "upwards", "front": "forwards", "rear": "backwards"}.get(name, f"to the {name}")
    return f"along {np.round(normal, 3).tolist()}"


@lru_cache(maxsize=4)
def propose_zones(mesh: Mesh, parts: BodyParts | None = None) -> tuple[Zone, ...]:
    """Zones of a vehicle (in the ego frame [m]) for a person to edit: roof, bonnet, sides, front and rear, panes.

    The roof is what faces upwards in the upper third behind the windscreen, the bonnet what does ahead of it. Sides
    keep out of the lowest third (wheels, sills), front and rear out of what bumpers touch, all out of panes and of
    what else carries no camera (``parts``; None: as far as the mesh tells), so no two share any skin. A zone of which
    the body has nothing is left out. `write_zones` writes them, for ``Placement(..., zones=file)``.
    """
    parts = parts_of(mesh) if parts is None else parts
    pane_m = {pane: cell_m for pane in parts.panes if len(cell_m := _cells_m(pane, mesh, cell_m=0.02))}
    boxes = [(side, box) for _, side, box in parts.keep_out]
    boxes += [("", np.round([m.min(axis=0) - _CLEAR_M, m.max(axis=0) + _CLEAR_M], 3)) for m in pane_m.values()]
    low_m, high_m = mesh.bounds_m().astype(np.float64)
    length_m, _, height_m = high_m - low_m
    lower_m, upper_m = low_m[2] + height_m / 3.0, low_m[2] + 2.0 / 3.0 * height_m
    begins_m, ends_m, top_m = low_m[0] + 0.6 * length_m, high_m[0], upper_m - _CLEAR_M  # of the bonnet, of the roof
    for pane, cell_m in pane_m.items():
        if pane.name == "windscreen":
            begins_m, _, middle_m = cell_m.mean(axis=0)
            ends_m, top_m, upper_m = begins_m, cell_m[:, 2].max(), max(upper_m, middle_m)

    def box(x_m: Sequence[float] = (-_BIG_M, _BIG_M), z_m: Sequence[float] = (-_BIG_M, _BIG_M)) -> np.ndarray:
        corner_m = np.array([[x_m[0], -_BIG_M, z_m[0]], [x_m[1], _BIG_M, z_m[1]]])
        return np.round(np.clip(corner_m, low_m - 0.1, high_m + 0.1), 3)

    above_ground_m, side = low_m[2] + 0.2 * height_m, ("b_pillar", "mirror", "fender")
    wanted = (
        Zone("roof", NORMALS["up"], box_m=box((-_BIG_M, ends_m), (upper_m, _BIG_M))),
        Zone("bonnet", NORMALS["up"], box_m=box((begins_m, _BIG_M), (lower_m, top_m))),
        Zone("left", NORMALS["left"], box_m=box(z_m=(lower_m, _BIG_M)), kinds=side),
        Zone("right", NORMALS["right"], box_m=box(z_m=(lower_m, _BIG_M)), kinds=side),
        Zone("front", NORMALS["front"], box_m=box(z_m=(above_ground_m, _BIG_M)), kinds=("bumper",)),
        Zone("rear", NORMALS["rear"], box_m=box(z_m=(above_ground_m, _BIG_M)), kinds=("bumper", "tailgate")),
    )
    found = []
    for zone in wanted:
        seen = [box for side, box in boxes if not side or NORMALS[side] == zone.normal]
        found.append(_clear_of(seen, replace(zone, pitch_rad=_PITCH_RAD), mesh))
    return (*(zone for zone in found if zone is not None), *pane_m)


def _clear_of(boxes: Sequence[np.ndarray], zone: Zone, mesh: Mesh) -> Zone | None:
    """A zone with those boxes kept out that reach into it; None where nothing of it is there, or left."""
    point_m = _cells_m(zone, mesh)
    inside = [box for box in boxes if ((point_m >= box[0]) & (point_m <= box[1])).all(axis=1).any()]
    clear = replace(zone, keep_out_m=tuple(inside))
    cell_count = len(point_m) if not inside else len(_cells_m(clear, mesh))
    return clear if cell_count * _COARSE_M**2 > _LEAST_M2 else None


def _cells_m(zone: Zone, mesh: Mesh, *, cell_m: float = _COARSE_M) -> np.ndarray:
    """Middles of the cells of a zone in the ego frame [m], float64 [cell, 3]; none where the body has nothing of it."""
    try:
        chart = chart_of([zone], mesh, cell_m=cell_m)
    except InputError:
        return np.zeros((0, 3))
    place_m = chart.place_m[chart.inside]
    return chart.point_m(place_m, chart.height_at_m(place_m))


def with_middles(zones: Sequence[Zone], *, upwards: bool = False) -> tuple[Zone, ...]:
    """Zones, and of each that lies across the middle and looks forwards or back a centred one, for single cameras.

    ``upwards``: of those that look upwards too, for LiDARs that see all round.
    """
    across = [
        zone
        for zone in zones
        if not zone.is_centred
        and (abs(zone.axes[2, 0]) > 0.5 or (upwards and zone.axes[2, 2] > 0.5))
        and abs(zone.axes[2, 1]) < 1e-6
        and not zone.origin_m[1]
    ]
    middles = (
        replace(zone, name=f"{zone.name}_middle", kinds=(*zone.kinds, zone.name), is_centred=True) for zone in across
    )
    return (*zones, *middles)
