"""What a lorry carries behind its cab: chassis, cargo box, axles, lamps, under-run bar, mud flaps.

The box is white and closed by two doors, or painted and closed by a roller shutter above a folded tail lift.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from warpav.scene.town._paint import Material
from warpav.scene.town._surface_builder import SurfaceBuilder
from warpav.scene.town._vehicle_specs import CARGO, VehicleSpec

_BAR_RADIUS_M = 0.022
_DOOR_PROUD_M = 0.025
_SLAT_COUNT = 11
_BOARD_FIELDS = 4


def add_lorry_body(builder: SurfaceBuilder, spec: VehicleSpec, *, shutter: bool, coarse: bool = False) -> None:
    """Add everything behind the cab; all parts are closed boxes that overlap or touch nothing flush."""
    front = -0.5 * spec.length_m - CARGO.gap_m
    rear = front - CARGO.length_m
    half, floor, roof = CARGO.half_width_m, CARGO.floor_m, CARGO.roof_m
    frame = CARGO.frame_half_width_m
    wall, livery = (Material.PAINT, Material.CARGO) if shutter else (Material.CARGO, Material.PAINT)
    builder.add_box((rear, -half, floor), (front, half, roof), wall)
    builder.add_box((rear + 0.12, -frame, 0.55), (front + 0.55, frame, floor + 0.03), Material.UNDERBODY)
    for x in CARGO.rear_axles_m:
        axle = -0.5 * spec.length_m - x
        add_wheel_pair(builder, axle, half - 0.03, spec.wheel_radius_m, twin=True, coarse=coarse)
        builder.add_box((axle - 0.09, -half + 0.3, 0.36), (axle + 0.09, half - 0.3, 0.54), Material.UNDERBODY)
        flap = axle - spec.wheel_radius_m - 0.16
        high = (flap + 0.02, half - 0.04, floor + 0.02)
        builder.add_box_pair((flap - 0.02, half - 0.64, 0.18), high, Material.BLACK_PLASTIC)
    _add_side(builder, front, -0.5 * spec.length_m - CARGO.rear_axles_m[0] + spec.wheel_radius_m + 0.2, livery)
    if not coarse:  # metal profiles along the edges of the cargo box
        for low, high in ((floor - 0.02, floor + 0.10), (roof - 0.08, roof + 0.015)):
            builder.add_box_pair(
                (rear - 0.01, half - 0.06, low), (front + 0.012, half + 0.012, high), Material.CARGO_FRAME
            )
        for x in (rear, front):
            corner = (x + 0.012, half + 0.014, roof)
            builder.add_box_pair((x - 0.012, half - 0.06, floor + 0.02), corner, Material.CARGO_FRAME)
    for proud, low, high, z_low, z_high, material in _coarse_rear() if coarse else _rear(shutter=shutter):
        corner = (rear + (0.14 if material == Material.BLACK_PLASTIC else 0.01), high, z_high)
        if low is None:
            builder.add_box((rear - proud, -high, z_low), corner, material)
        else:
            builder.add_box_pair((rear - proud, low, z_low), corner, material)
    if not coarse:
        _add_bumper(builder, rear)


def _add_side(builder: SurfaceBuilder, front: float, guard_end: float, livery: Material) -> None:
    """Side guards, fuel tank, a livery stripe and board, a reflective line, marker lamps."""
    half, floor, roof, length = CARGO.half_width_m, CARGO.floor_m, CARGO.roof_m, CARGO.length_m
    rear = front - length
    proud = half + 0.008
    builder.add_box_pair((rear + 0.05, half - 0.02, floor + 0.28), (front - 0.05, proud, floor + 0.62), livery)
    board = (front - 0.20 * length, proud, roof - 0.45)
    builder.add_box_pair((front - 0.72 * length, half - 0.02, roof - 1.15), board, livery)
    for index in range(5):
        lamp = front - length * (0.1 + 0.2 * index)
        high = (lamp + 0.06, half + 0.02, floor + 0.07)
        builder.add_box_pair((lamp - 0.06, half - 0.02, floor + 0.02), high, Material.INDICATOR)
    for low in (0.42, 0.66):
        high = (front - 0.15, half - 0.03, low + 0.13)
        builder.add_box_pair((guard_end, half - 0.09, low), high, Material.CARGO_FRAME)
    tank = (front - 0.5, half - 0.12, floor + 0.02)
    builder.add_box_pair((guard_end + 0.4, half - 0.62, 0.42), tank, Material.UNDERBODY)


_Plate = tuple[float, float | None, float, float, float, Material]
"""A box on the rear wall: how far it stands proud, y from and to, z from and to, material; with None the box is one
across the middle, else it has a mirror image."""


def _coarse_rear() -> list[_Plate]:
    """A frame, the gap of the doors, a cross-member below the floor, lamps."""
    half, floor, roof = CARGO.half_width_m, CARGO.floor_m, CARGO.roof_m
    return [
        (0.018, half - 0.12, half - 0.005, floor + 0.01, roof - 0.01, Material.CARGO_FRAME),
        (0.012, None, 0.03, floor + 0.12, roof - 0.10, Material.SEAM),
        (0.015, None, half - 0.04, 0.50, floor - 0.02, Material.BLACK_PLASTIC),
        (0.045, half - 0.48, half - 0.06, 0.73, floor - 0.09, Material.TAIL_LAMP),
    ]


def _rear(*, shutter: bool) -> Iterator[_Plate]:
    """The frame round the opening with marker lamps and a reflecting outline, and what closes it."""
    half, floor, roof = CARGO.half_width_m, CARGO.floor_m, CARGO.roof_m
    low, high = floor + 0.12, roof - 0.10
    yield 0.020, None, half - 0.05, roof - 0.10, roof - 0.005, Material.CARGO_FRAME
    yield 0.020, None, half - 0.05, floor - 0.01, floor + 0.12, Material.CARGO_FRAME
    yield 0.018, half - 0.09, half - 0.005, floor + 0.01, roof - 0.01, Material.CARGO_FRAME
    for z in (roof - 0.03, 0.5 * (floor + roof), floor + 0.16):
        yield 0.030, half - 0.075, half - 0.025, z - 0.45, z - 0.05, Material.REFLECTOR
    yield 0.034, half - 0.20, half - 0.06, roof - 0.075, roof - 0.035, Material.TAIL_LAMP
    if shutter:  # slats with a handle, above the platform of a tail lift that stands folded up
        yield 0.006, None, half - 0.09, low, high, Material.SEAM
        edges = [low + 0.01 + (high - low - 0.02) * index / _SLAT_COUNT for index in range(_SLAT_COUNT + 1)]
        for bottom, top in pairwise(edges):
            yield 0.016, None, half - 0.10, bottom + 0.008, top - 0.008, Material.CARGO
        lift = (floor - 0.05, floor + 0.72)
        yield 0.075, None, half - 0.13, *lift, Material.LIFT
        yield 0.085, 0.10, half - 0.25, lift[0] + 0.10, lift[1] - 0.10, Material.CARGO_FRAME
        yield 0.095, half - 0.22, half - 0.15, lift[0] + 0.02, lift[1] - 0.04, Material.SEAM
        yield 0.055, None, 0.12, lift[1] + 0.16, lift[1] + 0.21, Material.SEAM
        return
    # two door leaves with a dark gap between them, lock bars with handles, hinges
    yield 0.008, None, half - 0.09, low, high, Material.SEAM
    yield _DOOR_PROUD_M, 0.010, half - 0.10, floor + 0.13, roof - 0.11, Material.CARGO
    for y in (0.22, 0.80):
        proud = _DOOR_PROUD_M + 2.0 * _BAR_RADIUS_M
        yield proud, y - _BAR_RADIUS_M, y + _BAR_RADIUS_M, floor + 0.05, roof - 0.06, Material.CARGO_FRAME
        for z in (floor + 0.08, floor + 0.40, roof - 0.16):
            yield _DOOR_PROUD_M + 0.055, y - 0.05, y + 0.05, z, z + 0.06, Material.SEAM
        handle = (y - 0.16, y) if y > 0.5 else (y, y + 0.16)
        yield _DOOR_PROUD_M + 0.070, *handle, floor + 0.50, floor + 0.54, Material.SEAM
    for z in (floor + 0.30, floor + 0.85, roof - 0.85, roof - 0.32):
        yield _DOOR_PROUD_M + 0.02, half - 0.22, half - 0.03, z - 0.03, z + 0.03, Material.CARGO_FRAME


def _add_bumper(builder: SurfaceBuilder, rear: float) -> None:
    """Lamp clusters and plate on a dark cross-member below the floor; under-run bar with marker boards."""
    half, low, high = CARGO.half_width_m, 0.66, CARGO.floor_m - 0.02
    builder.add_box((rear - 0.015, -half + 0.04, low), (rear + 0.14, half - 0.04, high), Material.BLACK_PLASTIC)
    lamps = (
        (0.22, 0.06, Material.TAIL_LAMP),
        (0.36, 0.22, Material.INDICATOR),
        (0.48, 0.36, Material.TAIL_LAMP),
        (0.57, 0.48, Material.PLATE),
    )
    for inner, outer, material in lamps:
        corner = (rear + 0.01, half - outer, high - 0.07)
        builder.add_box_pair((rear - 0.045, half - inner, low + 0.07), corner, material)
    builder.add_box((rear - 0.035, -0.26, low + 0.08), (rear + 0.01, 0.26, low + 0.20), Material.REAR_PLATE)
    builder.add_box((rear + 0.02, -half + 0.06, 0.42), (rear + 0.12, half - 0.06, 0.56), Material.CARGO_FRAME)
    builder.add_box_pair((rear + 0.04, 0.40, 0.47), (rear + 0.14, 0.50, high), Material.UNDERBODY)
    # Boards of red and yellow: the mark of long and heavy vehicles.
    for index in range(_BOARD_FIELDS):
        inner = half - 0.64 + 0.56 * index / _BOARD_FIELDS
        material = Material.MARKER_YELLOW if index % 2 == 0 else Material.REFLECTOR
        builder.add_box_pair((rear + 0.005, inner, 0.435), (rear + 0.03, inner + 0.56 / _BOARD_FIELDS, 0.545), material)


_SEGMENTS = 15
_SPOKES = 5
# (radius over tyre radius, y offset [m] from the tyre's outer face), from the hub outwards and round to the inside.
_PROFILE = ((0.0, -0.022), (0.20, -0.022), (0.62, -0.040), (0.70, -0.010), (0.92, 0.0), (1.0, -0.030), (1.0, -1.0),
            (0.0, -1.0))  # fmt: skip
_COARSE_PROFILE, _COARSE_SEGMENTS = ((0.0, -0.022), (0.68, -0.015), (1.0, -0.010), (1.0, -1.0), (0.0, -1.0)), 8
_WIDTH_SHARE = 0.66  # tyre width over tyre radius


def add_wheel_pair(
    builder: SurfaceBuilder, x_m: float, outer_face_m: float, radius_m: float, *, twin: bool, coarse: bool = False
) -> None:
    width = _WIDTH_SHARE * radius_m * (2.0 if twin else 1.0)
    profile = np.array(_COARSE_PROFILE if coarse else _PROFILE)
    profile[:, 0] *= radius_m
    profile[-2:, 1] = -width
    if coarse:
        rows = np.array([Material.RIM, Material.TYRE, Material.TYRE, Material.TYRE])
        builder.add_lathe_pair((x_m, outer_face_m, radius_m), profile, np.tile(rows[:, None], _COARSE_SEGMENTS))
        return
    segment = np.arange(_SEGMENTS)
    per_spoke = _SEGMENTS // _SPOKES
    spoke = np.where(segment % per_spoke < per_spoke - 1, Material.RIM, Material.DARK)
    rim = np.full(_SEGMENTS, Material.RIM)
    tyre = np.full(_SEGMENTS, Material.TYRE)
    builder.add_lathe_pair((x_m, outer_face_m, radius_m), profile, np.stack([rim, spoke, rim, tyre, tyre, tyre, tyre]))
