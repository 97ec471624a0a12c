"""What a lorry carries behind its cab: chassis, cargo box with rear doors, axles, lamps, under-run bar, mud flaps."""

from __future__ import annotations

from warpav.scene.paint import Material
from warpav.scene.surface_builder import SurfaceBuilder
from warpav.scene.vehicle_specs import CARGO, VehicleSpec
from warpav.scene.wheels import add_wheel_pair

_BAR_RADIUS_M = 0.022
_DOOR_PROUD_M = 0.025


def add_lorry_body(builder: SurfaceBuilder, spec: VehicleSpec) -> None:
    """Add everything behind the cab of ``spec``; all parts are closed boxes that overlap or touch nothing flush."""
    front = -0.5 * spec.length_m - CARGO.gap_m
    rear = front - CARGO.length_m
    half, floor, roof = CARGO.half_width_m, CARGO.floor_m, CARGO.roof_m
    frame = CARGO.frame_half_width_m
    builder.add_box((rear, -half, floor), (front, half, roof), Material.CARGO)
    builder.add_box((rear + 0.12, -frame, 0.55), (front + 0.55, frame, floor + 0.03), Material.UNDERBODY)
    for x in CARGO.rear_axles_m:
        axle = -0.5 * spec.length_m - x
        add_wheel_pair(builder, axle, half - 0.03, spec.wheel_radius_m, twin=True)
        builder.add_box((axle - 0.09, -half + 0.3, 0.36), (axle + 0.09, half - 0.3, 0.54), Material.UNDERBODY)
        flap = axle - spec.wheel_radius_m - 0.16
        builder.add_box_pair((flap - 0.02, half - 0.64, 0.18), (flap + 0.02, half - 0.04, floor + 0.02),
                             Material.BLACK_PLASTIC)  # fmt: skip
    _add_side(builder, front, -0.5 * spec.length_m - CARGO.rear_axles_m[0] + spec.wheel_radius_m + 0.2)
    _add_edges(builder, front, rear)
    _add_rear(builder, rear)


def _add_side(builder: SurfaceBuilder, front: float, guard_end: float) -> None:
    """Side guards, fuel tank, a livery stripe and board, a reflective line, marker lamps."""
    half, floor, roof = CARGO.half_width_m, CARGO.floor_m, CARGO.roof_m
    rear = front - CARGO.length_m
    proud = half + 0.008
    builder.add_box_pair((rear + 0.05, half - 0.02, floor + 0.28), (front - 0.05, proud, floor + 0.62), Material.PAINT)
    builder.add_box_pair(
        (front - 0.72 * CARGO.length_m, half - 0.02, roof - 1.15),
        (front - 0.20 * CARGO.length_m, proud, roof - 0.45),
        Material.PAINT,
    )
    for index in range(5):
        lamp = front - CARGO.length_m * (0.1 + 0.2 * index)
        builder.add_box_pair((lamp - 0.06, half - 0.02, floor + 0.02), (lamp + 0.06, half + 0.02, floor + 0.07),
                             Material.INDICATOR)  # fmt: skip
    for low in (0.42, 0.66):
        builder.add_box_pair(
            (guard_end, half - 0.09, low), (front - 0.15, half - 0.03, low + 0.13), Material.CARGO_FRAME
        )
    builder.add_box_pair((guard_end + 0.4, half - 0.62, 0.42), (front - 0.5, half - 0.12, floor + 0.02),
                         Material.UNDERBODY)  # fmt: skip


def _add_edges(builder: SurfaceBuilder, front: float, rear: float) -> None:
    """Metal profiles along the edges of the cargo box."""
    half, floor, roof = CARGO.half_width_m, CARGO.floor_m, CARGO.roof_m
    for low, high in ((floor - 0.02, floor + 0.10), (roof - 0.08, roof + 0.015)):
        builder.add_box_pair((rear - 0.01, half - 0.06, low), (front + 0.012, half + 0.012, high), Material.CARGO_FRAME)
    for x in (rear, front):
        builder.add_box_pair((x - 0.012, half - 0.06, floor + 0.02), (x + 0.012, half + 0.014, roof),
                             Material.CARGO_FRAME)  # fmt: skip


def _add_rear(builder: SurfaceBuilder, rear: float) -> None:
    """Two doors with lock bars and hinges, lamp clusters, plate, marker boards, under-run bar."""
    half, floor, roof = CARGO.half_width_m, CARGO.floor_m, CARGO.roof_m

    def plate(proud: float, y: tuple[float, float], z: tuple[float, float], material: Material) -> None:
        builder.add_box((rear - proud, y[0], z[0]), (rear + 0.01, y[1], z[1]), material)

    def pair(proud: float, y: tuple[float, float], z: tuple[float, float], material: Material) -> None:
        builder.add_box_pair((rear - proud, y[0], z[0]), (rear + 0.01, y[1], z[1]), material)

    # Door frame, then two door leaves with a dark gap between them.
    plate(0.020, (-half + 0.05, half - 0.05), (roof - 0.10, roof - 0.005), Material.CARGO_FRAME)
    plate(0.020, (-half + 0.05, half - 0.05), (floor - 0.01, floor + 0.12), Material.CARGO_FRAME)
    pair(0.018, (half - 0.09, half - 0.005), (floor + 0.01, roof - 0.01), Material.CARGO_FRAME)
    plate(0.008, (-half + 0.09, half - 0.09), (floor + 0.12, roof - 0.10), Material.SEAM)
    pair(_DOOR_PROUD_M, (0.010, half - 0.10), (floor + 0.13, roof - 0.11), Material.CARGO)
    for y in (0.22, 0.80):
        pair(_DOOR_PROUD_M + 2.0 * _BAR_RADIUS_M, (y - _BAR_RADIUS_M, y + _BAR_RADIUS_M), (floor + 0.05, roof - 0.06),
             Material.CARGO_FRAME)  # fmt: skip
        pair(_DOOR_PROUD_M + 0.055, (y - 0.05, y + 0.05), (floor + 0.40, floor + 0.46), Material.SEAM)
        pair(_DOOR_PROUD_M + 0.070, (y - 0.14 if y > 0.5 else y, y if y > 0.5 else y + 0.14),
             (floor + 0.50, floor + 0.535), Material.SEAM)  # fmt: skip
    for z in (floor + 0.30, 0.5 * (floor + roof), roof - 0.32):
        pair(_DOOR_PROUD_M + 0.02, (half - 0.20, half - 0.03), (z - 0.03, z + 0.03), Material.CARGO_FRAME)

    # Lamps and plate hang on a dark cross-member below the floor.
    cross = (0.70, floor - 0.02)
    builder.add_box(
        (rear - 0.015, -half + 0.04, cross[0]), (rear + 0.14, half - 0.04, cross[1]), Material.BLACK_PLASTIC
    )
    for low, high, material in (
        (half - 0.22, half - 0.06, Material.TAIL_LAMP),
        (half - 0.36, half - 0.22, Material.INDICATOR),
        (half - 0.48, half - 0.36, Material.TAIL_LAMP),
        (half - 0.57, half - 0.48, Material.PLATE),
    ):
        pair(0.045, (low, high), (cross[0] + 0.06, cross[1] - 0.06), material)
    plate(0.035, (-0.26, 0.26), (cross[0] + 0.07, cross[0] + 0.19), Material.REAR_PLATE)
    pair(0.030, (half - 0.20, half - 0.06), (roof - 0.075, roof - 0.035), Material.TAIL_LAMP)
    # Under-run bar on two brackets, with yellow marker boards.
    builder.add_box((rear + 0.02, -half + 0.06, 0.40), (rear + 0.12, half - 0.06, 0.54), Material.CARGO_FRAME)
    builder.add_box_pair((rear + 0.04, 0.40, 0.45), (rear + 0.14, 0.50, cross[1]), Material.UNDERBODY)
    builder.add_box_pair((rear + 0.005, half - 0.62, 0.42), (rear + 0.03, half - 0.08, 0.52), Material.MARKER_YELLOW)
