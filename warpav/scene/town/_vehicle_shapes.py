"""Recognisable road vehicles as closed lofted meshes: body, glass house, wheels, lamps, plates, mirrors.

Vehicle frame: x forward, y left, z up, metres; the origin lies on the ground below the centre of the body.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from warpav.raster.mesh import Mesh
from warpav.scene.town._lorry_body import add_lorry_body, add_wheel_pair
from warpav.scene.town._paint import Material, painted_mesh, sky_share
from warpav.scene.town._surface_builder import Surface, SurfaceBuilder
from warpav.scene.town._vehicle_specs import CARGO, EGO_SPEC, HIGH_VAN, VEHICLE_SPECS, VehicleSpec

VARIANT_COUNT = 2  # shapes per kind; instances differ further by paint and scale

# Outline parameter: 0..1 front edge, 1..2 front corner, 2..3 side, 3..4 rear corner, 4..5 rear edge.
_SIDE_START, _SIDE_END, _OUTLINE_END = 2.0, 3.0, 5.0
# Cross-section of the body: share of the height from sill to deck; inset of side, nose and tail as multiples of
# the spec's shoulder inset, nose inset, and of 0.12 m.
_SECTION_HEIGHT = [0.0, 0.12, 0.30, 0.62, 0.82, 0.93, 1.0]
_SECTION_SIDE = [0.70, 0.34, 0.13, 0.0, 0.20, 0.50, 1.10]
_SECTION_NOSE = [0.50, 0.12, 0.0, 0.10, 0.33, 0.60, 1.10]
_SECTION_TAIL = [0.90, 0.25, 0.0, 0.12, 0.35, 0.55, 0.95]
_TAIL_INSET_M = 0.11
_ARCH_GAP_M = 0.055
_ARCH_SEGMENTS = 8
_SEAM_WIDTH_M = 0.016
_LINE_GAP_M = 0.0035  # nearer grid lines fall together
_BODY_SPACING = (0.3, 0.25, 0.11, 0.34, 0.34)  # widest columns of each part of the outline
_HOUSE_SPACING = (0.5, 0.34, 0.16, 0.5, 0.5)
_HOUSE_SINK_M = 0.05
# A coarse vehicle keeps what tells it from others far away: outline, glass, lamps, bumpers, wheels.
_COARSE_BODY_SPACING, _COARSE_HOUSE_SPACING = (1.0, 0.5, 0.5, 1.0, 1.0), (1.0, 0.5, 0.5, 1.0, 1.0)
_COARSE_ARCH_SEGMENTS = 4
_EGO_PAINT = np.array([0.060, 0.085, 0.125])
_EGO_CELL_M = 0.075  # longest grid spacing of the ego vehicle's bonnet and roof
_BELT_SHARE = 0.06  # the lowest share of the glass house is body
# Rear doors as parts of the outline: the gap between them, the inner and the outer edge of their windows.
_DOOR_GAP, _DOOR_GLASS_INNER, _DOOR_GLASS_OUTER = 4.985, 4.88, 4.10


class _Body:
    """The lower body of one vehicle: its outline at every height."""

    def __init__(self, spec: VehicleSpec) -> None:
        self.spec = spec
        self.front_m = 0.5 * spec.length_m
        self.half_width_m = 0.5 * spec.width_m
        # The sides begin and end at the same x at every height, so that their grid columns stand upright.
        self.side_front_m = self.front_m - spec.bow_m - spec.corner_front_m[0]
        self.side_rear_m = -self.front_m + 0.5 * spec.bow_m + spec.corner_rear_m[0]

    def x_at(self, fraction: float) -> float:
        """X [m] at a fraction of the length from the nose."""
        return self.front_m - self.spec.length_m * fraction

    def side_parameter(self, x_m: float) -> float:
        """Outline parameter of the side at x [m]."""
        return _SIDE_START + (self.side_front_m - x_m) / (self.side_front_m - self.side_rear_m)

    def deck_m(self, x_m: np.ndarray) -> np.ndarray:
        """Height of the upper edge [m] at x [m], a little rounded where the profile bends."""
        fraction, height = np.array(self.spec.deck).T
        where = np.clip((self.front_m - np.asarray(x_m)) / self.spec.length_m, 0.0, 1.0)
        shifted = (np.interp(np.clip(where + shift, 0.0, 1.0), fraction, height) for shift in (-0.02, 0.0, 0.02))
        return np.einsum("i,i...->...", np.array([0.25, 0.5, 0.25]), np.stack(list(shifted)))

    def arch_m(self, x_m: np.ndarray) -> np.ndarray:
        """Height of the wheel arches' edge [m] at x [m]; 0 away from them."""
        radius = self.spec.wheel_radius_m + _ARCH_GAP_M
        height = np.zeros_like(np.asarray(x_m, dtype=np.float64))
        for axle in self.spec.axles:
            square = radius**2 - (x_m - self.x_at(axle)) ** 2
            inside = square >= -1e-9
            height = np.where(inside, self.spec.wheel_radius_m + np.sqrt(np.maximum(square, 0.0)), height)
        return height

    def ring_m(self, parameter: np.ndarray, height_nose: np.ndarray, height_tail: np.ndarray) -> np.ndarray:
        """Points of the left half [m], shape [row, column, 3]; ``parameter`` [column], ``height_nose`` [row]."""
        spec = self.spec
        blend = np.clip((parameter - 1.0) / 3.0, 0.0, 1.0)
        share = height_nose[:, None] * (1.0 - blend) + height_tail[:, None] * blend
        x, y = self._plan(parameter, share)
        deck = self.deck_m(x)
        height = np.maximum(spec.sill_m + share * (deck - spec.sill_m), self.arch_m(x))
        # The arch lifts points: they slide along the cross-section.
        _, y_lifted = self._plan(parameter, (height - spec.sill_m) / (deck - spec.sill_m))
        on_side = (parameter >= _SIDE_START) & (parameter <= _SIDE_END)
        y = np.where(on_side, y_lifted, y)
        y = y * (1.0 - spec.taper_m / self.half_width_m * np.minimum(np.abs(x) / self.front_m, 1.0) ** 3)
        return np.stack([x, y, height], axis=-1)

    def _plan(self, parameter: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        spec = self.spec
        front = self.front_m - spec.nose_inset_m * np.interp(share, _SECTION_HEIGHT, _SECTION_NOSE)
        rear = -self.front_m + _TAIL_INSET_M * np.interp(share, _SECTION_HEIGHT, _SECTION_TAIL)
        half_width = self.half_width_m - spec.shoulder_inset_m * np.interp(share, _SECTION_HEIGHT, _SECTION_SIDE)
        return _half_outline(
            parameter,
            (front, spec.bow_m, front - spec.bow_m - self.side_front_m, spec.corner_front_m[1]),
            (rear, 0.5 * spec.bow_m, self.side_rear_m - rear - 0.5 * spec.bow_m, spec.corner_rear_m[1]),
            half_width,
        )


def _half_outline(parameter, front, rear, half_width):  # noqa: ANN001, ANN202
    """Left half of a plan outline, x and y; ends are x of the centre, bow, corner radii along x and y."""
    part = np.minimum(parameter.astype(int), 4)
    along = parameter - part
    angle = 0.5 * np.pi * along
    (front_x, front_bow, front_rx, front_ry), (rear_x, rear_bow, rear_rx, rear_ry) = front, rear
    side_front, side_rear = front_x - front_bow - front_rx, rear_x + rear_bow + rear_rx
    x = np.select(
        [part == 0, part == 1, part == 2, part == 3],
        [
            front_x - front_bow * along**2,
            side_front + front_rx * np.cos(angle),
            side_front + along * (side_rear - side_front),
            side_rear - rear_rx * np.sin(angle),
        ],
        rear_x + rear_bow * (1.0 - along) ** 2,
    )
    y = np.select(
        [part == 0, part == 1, part == 2, part == 3],
        [
            (half_width - front_ry) * along,
            half_width - front_ry + front_ry * np.sin(angle),
            half_width + 0.0 * along,
            half_width - rear_ry + rear_ry * np.cos(angle),
        ],
        (half_width - rear_ry) * (1.0 - along),
    )
    return x, y


def _merged_lines(lines: Sequence[float], gap: float) -> np.ndarray:
    """Sorted grid lines; of two that are nearer than ``gap`` the first given survives."""
    kept: list[float] = []
    for line in lines:
        if all(abs(line - other) > gap for other in kept):
            kept.append(float(line))
    return np.array(sorted(kept))


def _subdivided(lines: np.ndarray, spacing: Callable[[float], float]) -> np.ndarray:
    """Grid lines no farther apart than the spacing at the middle between two of them."""
    found = list(lines)
    for low, high in pairwise(lines):
        pieces = int(np.ceil((high - low) / spacing(0.5 * (low + high)) - 1e-6))
        found += list(np.linspace(low, high, pieces + 1)[1:-1])
    return np.array(sorted(found))


def _midpoints(lines: np.ndarray) -> np.ndarray:
    return 0.5 * (lines[1:] + lines[:-1])


_Row = enum.IntEnum(
    "_Row",
    "BOTTOM TRIM INTAKE_LOW INTAKE_HIGH WAIST_LOW WAIST_HIGH LAMP_LOW LAMP_MIDDLE LAMP_HIGH SHOULDER DECK",
    start=0,
)
"""Horizontal grid lines of the body, upwards."""


def _body_rows(spec: VehicleSpec) -> tuple[np.ndarray, np.ndarray]:
    """Share of the height from sill to deck of each row, at the nose and at the tail."""

    def rows(lamp: tuple[float, float]) -> np.ndarray:
        low, high = lamp
        waist = min(0.47, 0.8 * low)
        midpoint = 0.45 * low + 0.55 * high
        upper = 0.45 * high + 0.55
        return np.array(
            [0.0, 0.09, 0.3 * waist + 0.05, 0.8 * waist, waist, waist + 0.02, low, midpoint, high, upper, 1.0]
        )

    return rows(spec.front_lamp), rows(spec.rear_lamp)


_COARSE_ROWS = (_Row.BOTTOM, _Row.TRIM, _Row.WAIST_LOW, _Row.LAMP_LOW, _Row.LAMP_HIGH, _Row.DECK)


def _body_panels(body: _Body, *, coarse: bool) -> list[tuple[_Row, _Row, float, float, Material]]:
    """What is not in the colour of the paint: (lower row, upper row, outline from, to, material), later ones on top."""
    spec = body.spec
    half_seam = 0.5 * _SEAM_WIDTH_M / (body.side_front_m - body.side_rear_m)
    seams = [body.side_parameter(body.x_at(fraction)) for fraction in spec.seams]
    inner = spec.rear_lamp_inner
    black, seam = Material.BLACK_PLASTIC, Material.SEAM
    bumper = black if spec.dark_bumpers else Material.PAINT
    if coarse:
        return [
            (_Row.BOTTOM, _Row.WAIST_LOW, 0.0, _SIDE_START, bumper),
            (_Row.BOTTOM, _Row.WAIST_LOW, _SIDE_END, _OUTLINE_END, bumper),
            (_Row.BOTTOM, _Row.TRIM, 0.0, _OUTLINE_END, black),
            *((_Row.TRIM, _Row.DECK, *panel[2:4], Material.GLASS) for panel in _glass_doors(body)[1::2]),
            (_Row.LAMP_LOW, _Row.LAMP_HIGH, 0.0, 0.72, black),
            (_Row.LAMP_LOW, _Row.LAMP_HIGH, 0.72, 1.62, Material.HEADLAMP),
            (_Row.LAMP_LOW, _Row.LAMP_HIGH, 3.36, inner, Material.TAIL_LAMP),
        ]
    return [
        (_Row.BOTTOM, _Row.WAIST_LOW, 0.0, 1.9, bumper),
        (_Row.BOTTOM, _Row.WAIST_LOW, 3.1, _OUTLINE_END, bumper),
        (_Row.BOTTOM, _Row.TRIM, 0.0, _OUTLINE_END, black),
        *((_Row.TRIM, _Row.DECK, at - half_seam, at + half_seam, seam) for at in seams),
        *_glass_doors(body),
        (_Row.WAIST_LOW, _Row.WAIST_HIGH, 0.0, 1.9, seam),
        (_Row.WAIST_LOW, _Row.WAIST_HIGH, 3.1, _OUTLINE_END, seam),
        (_Row.INTAKE_LOW, _Row.INTAKE_HIGH, 0.0, 0.74, black),
        (_Row.INTAKE_LOW, _Row.INTAKE_HIGH, 1.22, 1.58, black),
        (_Row.LAMP_LOW, _Row.LAMP_HIGH, 0.0, 0.62, black),
        (_Row.LAMP_LOW, _Row.LAMP_HIGH, 0.72, 1.62, Material.HEADLAMP),
        (_Row.LAMP_MIDDLE, _Row.LAMP_HIGH, 0.92, 1.06, Material.DARK),
        (_Row.LAMP_LOW, _Row.LAMP_MIDDLE, 1.40, 1.62, Material.INDICATOR),
        (_Row.BOTTOM, _Row.INTAKE_LOW, 3.0, _OUTLINE_END, black),
        (_Row.LAMP_LOW, _Row.LAMP_HIGH, 3.36, inner, Material.TAIL_LAMP),
        (_Row.LAMP_LOW, _Row.LAMP_MIDDLE, inner - 0.26, inner - 0.10, Material.HEADLAMP),
        (_Row.LAMP_LOW, _Row.LAMP_MIDDLE, 3.36, 3.60, Material.INDICATOR),
        *([(_Row.WAIST_LOW, _Row.DECK, _DOOR_GAP, _OUTLINE_END, seam)] if spec.rear_doors else []),
    ]


def _glass_doors(body: _Body) -> list[tuple[_Row, _Row, float, float, Material]]:
    """Panes in black frames, from the step to the windows."""
    panels = []
    for start, end in body.spec.glass_doors:
        low, high = (body.side_parameter(body.x_at(fraction)) for fraction in (start, end))
        edge = 0.07 * (high - low)
        panels.append((_Row.TRIM, _Row.DECK, low, high, Material.BLACK_PLASTIC))
        panels.append((_Row.INTAKE_LOW, _Row.DECK, low + edge, high - edge, Material.GLASS))
    return panels


def _add_body(builder: SurfaceBuilder, body: _Body, fine_m: float | None, *, coarse: bool) -> None:
    spec = body.spec
    panels = _body_panels(body, coarse=coarse)
    lines = [0.0, 1.0, _SIDE_START, _SIDE_END, 4.0, _OUTLINE_END]
    lines += [edge for panel in panels for edge in panel[2:4]]
    radius = spec.wheel_radius_m + _ARCH_GAP_M
    angle = np.linspace(0.0, np.pi, (_COARSE_ARCH_SEGMENTS if coarse else _ARCH_SEGMENTS) + 1)
    for axle in spec.axles:
        lines += [body.side_parameter(body.x_at(axle) + radius * c) for c in np.cos(angle)]
        lines += [body.side_parameter(body.x_at(axle) + side * (radius + 0.006)) for side in (-1.0, 1.0)]
    lines = _merged_lines(lines, _LINE_GAP_M / (body.side_front_m - body.side_rear_m))
    bonnet_end = body.side_parameter(body.x_at(spec.windscreen[0]) - 0.1)

    def spacing(middle: float) -> float:
        if fine_m is not None and middle < bonnet_end:
            return fine_m / (body.side_front_m - body.side_rear_m if middle > _SIDE_START else 0.55)
        return (_COARSE_BODY_SPACING if coarse else _BODY_SPACING)[min(int(middle), 4)]

    column = _subdivided(lines, spacing)

    kept = np.array(_COARSE_ROWS if coarse else tuple(_Row))
    nose, tail = _body_rows(spec)
    ring = body.ring_m(column, nose[kept], tail[kept])
    midpoint = _midpoints(column)
    row = kept[:-1]
    material = np.full((len(row), len(midpoint)), Material.PAINT)
    for row_low, row_high, low, high, what in panels:
        material[np.ix_((row >= row_low) & (row < row_high), (midpoint > low) & (midpoint < high))] = what
    across = 2 if coarse else 4 if fine_m is None else int(np.ceil(0.8 * spec.width_m / fine_m))
    builder.add_loft(ring, material, crown_m=0.045, across=across, caps=(Material.PAINT, Material.UNDERBODY))


def _add_house(builder: SurfaceBuilder, body: _Body, fine_m: float | None, *, coarse: bool) -> None:
    spec = body.spec
    base_front, roof_front = (body.x_at(fraction) for fraction in spec.windscreen)
    base_rear, roof_rear = (body.x_at(fraction) for fraction in spec.rear_window)
    base_half, roof_half = body.half_width_m - 0.95 * spec.shoulder_inset_m, body.half_width_m * spec.roof_width
    # Straight up to the bend, then a quarter ellipse into the roof: (share of the height, share of the bend).
    straight = np.array([0.0, _BELT_SHARE, *(() if coarse else (0.3, 0.6)), spec.glass_top])
    quarter = (0.0, 0.25, 0.5, 0.75, 0.94) if fine_m else (0.7,) if coarse else (0.2, 0.55, 0.9)
    bend = 0.5 * np.pi * np.array(quarter)
    bend_start = max(1.0 - spec.roof_round, spec.glass_top)
    height_share = np.r_[straight, bend_start + (1.0 - bend_start) * np.sin(bend)][:, None]
    inset = np.r_[0.0 * straight, 1.0 - np.cos(bend)][:, None]

    low, high = spec.side_glass
    side_lines = [0.0, 1.0, low, high, *(edge for pillar in spec.pillars for edge in pillar)]
    lines = [0.0, 1.0, 1.45, 2.0, *(2.0 + line for line in side_lines if line <= 1.0)]
    lines += [3.0, 3.5, 4.0, _OUTLINE_END]
    lines += [] if coarse else [0.5, 4.5]
    if spec.rear_doors:
        lines += [_DOOR_GLASS_OUTER, _DOOR_GLASS_INNER, _DOOR_GAP]

    def spacing(middle: float) -> float:
        part = min(int(middle), 4)
        if fine_m is not None:
            return fine_m / (roof_front - roof_rear) if part == 2 else 0.25
        return (_COARSE_HOUSE_SPACING if coarse else _HOUSE_SPACING)[part]

    column = _subdivided(_merged_lines(lines, 0.004), spacing)

    bend_m = 0.10 if spec.height_m < 2.5 else 0.08
    front = base_front + (roof_front - base_front) * height_share - 1.8 * bend_m * inset
    rear = base_rear + (roof_rear - base_rear) * height_share + 1.4 * bend_m * inset
    half_width = base_half + (roof_half - base_half) * height_share - bend_m * inset
    radius = spec.house_corner_m
    x, y = _half_outline(
        column, (front, 0.8 * spec.bow_m, radius, radius), (rear, 0.4 * spec.bow_m, radius, radius), half_width
    )
    floor = body.deck_m(x[0]) - _HOUSE_SINK_M
    z = floor + (spec.height_m - 0.04 - floor) * height_share
    ring = np.stack([x, y, z], axis=-1)

    midpoint, level = _midpoints(column), _midpoints(height_share[:, 0])
    material = np.full((len(level), len(midpoint)), Material.PAINT)
    glass = (level > _BELT_SHARE) & (level < spec.glass_top)
    along = midpoint - _SIDE_START
    side = (along > low) & (along < high)
    material[np.ix_((level > 0.0) & (level < spec.glass_top), midpoint < 1.45)] = Material.GLASS
    material[np.ix_(glass, side)] = Material.GLASS
    pillar = Material.PAINT if spec.painted_pillars else Material.BLACK_PLASTIC
    for start, end in spec.pillars:
        material[np.ix_(glass, (along > start) & (along < end) & side)] = pillar
    if spec.rear_glass:
        pane = (midpoint > _DOOR_GLASS_OUTER) & (midpoint < _DOOR_GLASS_INNER) if spec.rear_doors else midpoint > 3.5
        material[np.ix_(glass, pane)] = Material.GLASS
    if spec.rear_doors:
        material[np.ix_(level < bend_start, midpoint > _DOOR_GAP)] = Material.SEAM
    across = 2 if coarse else 4 if fine_m is None else int(np.ceil(2.0 * roof_half / fine_m))
    builder.add_loft(ring, material, crown_m=0.04, across=across, caps=(Material.PAINT, Material.UNDERBODY))


def _add_fittings(builder: SurfaceBuilder, kind: str, body: _Body, *, coarse: bool) -> None:
    """Wheels, plates, mirrors, handles: closed solids that sink into the body."""
    spec, half = body.spec, body.half_width_m
    tall = kind in ("bus", "lorry")
    for axle in spec.axles:
        x = body.x_at(axle)
        add_wheel_pair(builder, x, half - 0.015, spec.wheel_radius_m, twin=False, coarse=coarse)
        reach = spec.wheel_radius_m + _ARCH_GAP_M
        inner = half - (0.50 if tall else 0.32)
        high = (x + reach, inner, 2.0 * spec.wheel_radius_m + 0.1)
        builder.add_box((x - reach, -inner, 0.7 * spec.sill_m), high, Material.UNDERBODY)
    nose, tail = _body_rows(spec)
    plates = [(0.0, 0.5 * (nose[_Row.WAIST_LOW] + nose[_Row.LAMP_LOW]), Material.PLATE, 1.0)]
    if kind != "lorry":
        rear_row = 0.5 * (tail[_Row.LAMP_LOW] + tail[_Row.LAMP_HIGH]) if kind == "suv" else tail[_Row.LAMP_LOW] - 0.04
        plates.append((_OUTLINE_END, rear_row, Material.REAR_PLATE, -1.0))
    for parameter, share, material, sign in plates:
        point = body.ring_m(np.array([parameter]), np.array([share]), np.array([share]))[0, 0]
        x = point[0] + 0.012 * sign
        low, high = sorted((x, x - 0.07 * sign))
        builder.add_box((low, -0.26, point[2] - 0.057), (high, 0.26, point[2] + 0.057), material)

    if spec.rear_doors and not coarse:
        _add_rear_doors(builder, body)
    if kind == "bus" and not coarse:
        _add_bus_fittings(builder, spec)
    if tall:
        x, z = body.front_m - 0.10, 0.72 * spec.height_m
        builder.add_ellipsoid_pair((x, half + 0.10, z), (0.07, 0.12, 0.22), Material.BLACK_PLASTIC)
        arm = (x + 0.02, half + 0.08, z + 0.16)
        builder.add_box_pair((x - 0.02, half - 0.25, z + 0.12), arm, Material.BLACK_PLASTIC)
        return
    x = body.x_at(spec.windscreen[0]) - 0.42
    z = float(body.deck_m(np.array(x))) + 0.07
    if coarse:
        builder.add_box_pair((x - 0.06, half - 0.04, z - 0.07), (x + 0.06, half + 0.17, z + 0.07), Material.PAINT)
        return
    builder.add_ellipsoid_pair((x, half + 0.06, z), (0.08, 0.13, 0.08), Material.PAINT)
    for seam in spec.seams[1:]:
        x = body.x_at(seam) + 0.16
        share = np.array([0.84])
        point = body.ring_m(np.array([body.side_parameter(x)]), share, share)[0, 0]
        corner = (x + 0.09, point[1] + 0.018, point[2] + 0.014)
        builder.add_box_pair((x - 0.09, point[1] - 0.03, point[2] - 0.014), corner, Material.SEAM)


def _add_bus_fittings(builder: SurfaceBuilder, spec: VehicleSpec) -> None:
    """A destination board, air conditioning on the roof, a grille and high lamps at the rear."""
    front, half, roof = 0.5 * spec.length_m, 0.5 * spec.width_m, spec.height_m
    builder.add_box((-0.30 * front, -0.72, roof - 0.10), (0.22 * front, 0.72, roof + 0.18), Material.CARGO)
    board = (roof - 0.62, roof - 0.40)
    builder.add_box((front - 0.5, -0.70, board[0]), (front - 0.135, 0.70, board[1]), Material.DARK)
    for index in range(4):
        y = -0.60 + 0.32 * index
        builder.add_box((front - 0.2, y, board[0] + 0.05), (front - 0.125, y + 0.24, board[1] - 0.05),
                        Material.INDICATOR)  # fmt: skip
    rear = -front
    builder.add_box((rear - 0.01, -0.70, 0.80), (rear + 0.15, 0.70, 1.06), Material.BLACK_PLASTIC)
    for index in range(3):
        z = 0.83 + 0.08 * index
        builder.add_box((rear - 0.018, -0.66, z), (rear + 0.1, 0.66, z + 0.035), Material.CARGO_FRAME)
    builder.add_box_pair((rear + 0.04, 0.58 * half, roof - 0.46), (rear + 0.25, 0.76 * half, roof - 0.38),
                         Material.TAIL_LAMP)  # fmt: skip


def _add_rear_doors(builder: SurfaceBuilder, body: _Body) -> None:
    """Hinges, a handle and a high brake lamp on a van's rear doors; a bumper with a step below them."""
    spec = body.spec
    deck = float(body.deck_m(np.array(-body.front_m)))
    roof = spec.height_m - 0.04

    def skin_m(z: float) -> float:
        """X of the doors in the centre of the vehicle at a height [m]."""
        if z < deck:
            share = np.array([(z - spec.sill_m) / (deck - spec.sill_m)])
            return float(body.ring_m(np.array([_OUTLINE_END]), share, share)[0, 0, 0])
        base, top = (body.x_at(fraction) for fraction in spec.rear_window)
        return base + (top - base) * (z - deck) / (roof - deck)

    def fitting(y: tuple[float, float], z: tuple[float, float], proud: float, material: Material, *, paired: bool):  # noqa: ANN202
        x = skin_m(0.5 * (z[0] + z[1]))
        add = builder.add_box_pair if paired else builder.add_box
        add((x - proud, y[0], z[0]), (x + 0.09, y[1], z[1]), material)

    edge = body.half_width_m * spec.roof_width
    top = deck + 0.8 * (roof - deck)
    for z in (deck - 0.22, deck + 0.10, top):
        fitting((edge - 0.17, edge - 0.05), (z - 0.03, z + 0.03), 0.022, Material.BLACK_PLASTIC, paired=True)
    fitting((-0.22, -0.05), (deck - 0.11, deck - 0.06), 0.035, Material.BLACK_PLASTIC, paired=False)
    lamp = roof - (0.13 if spec.rear_glass else 0.24)  # between two rows of the grid, or its shadow smears
    fitting((-0.17, 0.17), (lamp, lamp + 0.04), 0.028, Material.TAIL_LAMP, paired=False)
    x = -body.front_m + 0.04
    step = (0.40, 0.52)
    builder.add_box((x - 0.12, -0.92 * body.half_width_m, step[0]), (x + 0.3, 0.92 * body.half_width_m, step[1]),
                    Material.BLACK_PLASTIC)  # fmt: skip
    builder.add_box((x - 0.10, -0.45, step[1] - 0.02), (x + 0.2, 0.45, step[1] + 0.012), Material.TYRE)
    builder.add_box_pair((x - 0.13, 0.60 * body.half_width_m, step[0] + 0.035),
                         (x + 0.1, 0.80 * body.half_width_m, step[1] - 0.035), Material.REFLECTOR)  # fmt: skip


def _varied(kind: str, variant: int) -> VehicleSpec:
    """The kind's spec itself, or a relative with other proportions of glass, roof and lamps."""
    spec = VEHICLE_SPECS[kind]
    if variant % 2 == 0:
        return spec
    if kind == "van":
        return HIGH_VAN
    front_low, front_high = spec.front_lamp
    rear_low, rear_high = spec.rear_lamp
    return replace(
        spec,
        length_m=1.03 * spec.length_m,
        height_m=spec.height_m + 0.02,
        roof_width=spec.roof_width - 0.015,
        front_lamp=(front_low + 0.05, front_high + 0.02),
        rear_lamp=(rear_low + 0.06, rear_high + 0.01),
        rear_lamp_inner=spec.rear_lamp_inner - 0.14,
        wheel_radius_m=spec.wheel_radius_m + 0.012,
        bow_m=1.15 * spec.bow_m,
    )


def _build(
    kind: str, spec: VehicleSpec, *, fine_m: float | None = None, shutter: bool = False, coarse: bool = False
) -> Surface:
    body = _Body(spec)
    builder = SurfaceBuilder()
    _add_body(builder, body, fine_m, coarse=coarse)
    _add_house(builder, body, fine_m, coarse=coarse)
    _add_fittings(builder, kind, body, coarse=coarse)
    if kind == "lorry":
        add_lorry_body(builder, spec, shutter=shutter, coarse=coarse)
    return builder.finish()


@cache
def _baked(kind: str, variant: int, coarse: bool) -> tuple[Surface, np.ndarray]:
    surface = _build(kind, _varied(kind, variant), shutter=variant % 2 == 1, coarse=coarse)
    centre_x_m = 0.5 * (surface.vertex_m[:, 0].min() + surface.vertex_m[:, 0].max())
    surface = replace(surface, vertex_m=surface.vertex_m - [centre_x_m, 0.0, 0.0])
    return surface, sky_share(surface)


def vehicle_mesh(
    kind: str, paint: np.ndarray, *, variant: int = 0, scale: ArrayLike = (1.0, 1.0, 1.0), coarse: bool = False
) -> Mesh:
    """One vehicle with its light baked in; shapes are computed once and kept, paint, [3], and scale are cheap."""
    if kind not in VEHICLE_SPECS or not 0 <= variant < VARIANT_COUNT:
        raise ValueError(f"no vehicle {kind!r} variant {variant}; kinds: {', '.join(VEHICLE_SPECS)}; variants 0..1")
    surface, sky = _baked(kind, variant, coarse)
    mesh = painted_mesh(surface, sky, {Material.PAINT: paint})
    return Mesh((mesh.vertex_m * np.asarray(scale, np.float32)).astype(np.float32), mesh.triangle, mesh.vertex_rgb)


def vehicle_glass(kind: str, variant: int = 0) -> np.ndarray:
    """Which triangles of `vehicle_mesh` are window panes, bool [triangle]."""
    return _glass(_baked(kind, variant, False)[0])


@cache
def vehicle_size_m(kind: str, variant: int) -> np.ndarray:
    """Length, width with mirrors and height of a shape before it is scaled [m], shape [3]."""
    return np.ptp(_baked(kind, variant, False)[0].vertex_m, axis=0)


def body_width_m(kind: str, variant: int) -> float:
    """Width without mirrors of a shape before it is scaled [m]."""
    if kind == "lorry":
        return 2.0 * CARGO.half_width_m
    return (HIGH_VAN if kind == "van" and variant % 2 else VEHICLE_SPECS[kind]).width_m


def body_size_m(kind: str, variant: int) -> np.ndarray:
    """Length, width without mirrors and height of a shape before it is scaled [m], shape [3]."""
    length_m, _, height_m = vehicle_size_m(kind, variant)
    return np.array([length_m, body_width_m(kind, variant), height_m])


@cache
def ego_mesh() -> Mesh:
    """The vehicle that carries the cameras, in the ego frame (origin on the ground below its rear axle).

    Its bonnet and roof are meshed in cells of about 5 cm, smooth and without rails, so that a mount surface can be
    computed from them.
    """
    surface = _ego_surface()
    rear_axle_m = EGO_SPEC.length_m * (0.5 - EGO_SPEC.axles[-1])
    mesh = painted_mesh(surface, sky_share(surface), {Material.PAINT: _EGO_PAINT})
    return mesh.transformed(np.eye(3), np.array([-rear_axle_m, 0.0, 0.0]))


def ego_glass() -> np.ndarray:
    """Which triangles of `ego_mesh` are window panes, bool [triangle]."""
    return _glass(_ego_surface())


@cache
def _ego_surface() -> Surface:
    return _build("estate", EGO_SPEC, fine_m=_EGO_CELL_M)


def _glass(surface: Surface) -> np.ndarray:
    return surface.material[surface.triangle[:, 0]] == Material.GLASS
