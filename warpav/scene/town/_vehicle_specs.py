"""Measures of the kinds of vehicles: what distinguishes a hatchback from a bus."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any


@dataclass(frozen=True)
class VehicleSpec:
    """Measures of one kind of vehicle; fractions of the length count from the nose, heights from the ground."""

    length_m: float  # length of the lofted body (a lorry's cab without its cargo box) [m]
    width_m: float  # width without mirrors [m]
    height_m: float  # height of the roof [m]
    sill_m: float  # height of the lower edge [m]
    # Side view of bonnet, belt and boot: (fraction of the length, height [m]) pairs.
    deck: tuple[tuple[float, float], ...]
    windscreen: tuple[float, float]  # fractions of the length where its lower and upper edge stand
    rear_window: tuple[float, float]  # the same for the rear window
    roof_width: float  # width of the roof over the width of the vehicle
    wheel_radius_m: float  # radius of a tyre [m]
    axles: tuple[float, ...]  # fractions of the length where the axles stand
    # (start, end) along the side glass, 0 front to 1 rear, that is black instead of glass.
    pillars: tuple[tuple[float, float], ...]
    painted_pillars: bool  # pillars in the colour of the vehicle
    # (start, end) as fractions of the length of doors that are of glass down to the step.
    glass_doors: tuple[tuple[float, float], ...]
    side_glass: tuple[float, float]  # (start, end) of the side glass along the house
    seams: tuple[float, ...]  # fractions of the length of the door seams
    # (low, high) of the headlamps as fractions of the height from sill to deck.
    front_lamp: tuple[float, float]
    rear_lamp: tuple[float, float]  # the same for the tail lamps
    rear_lamp_inner: float  # how far the tail lamps reach inwards, 4.0 (corner) to 5.0 (centre)
    corner_front_m: tuple[float, float]  # corner radii in plan, along x and y [m]
    corner_rear_m: tuple[float, float]  # the same at the rear
    bow_m: float  # how far the nose bows forwards in the centre [m]
    nose_inset_m: float  # how far the upper edge of the nose lies behind its most forward point [m]
    shoulder_inset_m: float  # how far the upper edge of the sides lies inside the widest point [m]
    taper_m: float  # how much narrower each side is at the very ends [m]
    house_corner_m: float  # plan radius of the glass house's corners [m]
    roof_round: float  # share of the glass house's height that rounds into the roof
    glass_top: float  # share of the glass house's height where the glass ends
    rear_glass: bool  # false for a blind rear
    rear_doors: bool  # two doors with hinges and a handle at the rear, and a bumper to step on
    dark_bumpers: bool  # bumpers of bare plastic


_KINDS = ("hatchback", "saloon", "estate", "suv", "van", "lorry", "bus")
_FIELDS: dict[str, tuple[Any, ...]] = {
    "length_m": (4.05, 4.65, 4.70, 4.50, 5.10, 2.15, 10.8),
    "width_m": (1.76, 1.82, 1.82, 1.86, 1.95, 2.30, 2.50),
    "height_m": (1.48, 1.45, 1.48, 1.68, 1.98, 2.60, 3.00),
    "sill_m": (0.20, 0.20, 0.20, 0.27, 0.24, 0.42, 0.32),
    "deck": (
        ((0.0, 0.70), (0.06, 0.80), (0.15, 0.89), (0.27, 0.97), (0.60, 1.00), (0.90, 1.04), (1.0, 1.00)),
        ((0.0, 0.68), (0.05, 0.77), (0.15, 0.86), (0.28, 0.95), (0.60, 0.98), (0.80, 1.02), (0.95, 1.02), (1.0, 0.95)),
        ((0.0, 0.68), (0.05, 0.77), (0.15, 0.86), (0.28, 0.95), (0.60, 0.98), (0.92, 1.02), (1.0, 0.98)),
        ((0.0, 0.85), (0.05, 0.96), (0.15, 1.03), (0.26, 1.08), (0.60, 1.12), (0.90, 1.15), (1.0, 1.10)),
        ((0.0, 0.88), (0.04, 0.98), (0.10, 1.07), (0.17, 1.14), (0.60, 1.18), (1.0, 1.18)),
        ((0.0, 1.22), (0.05, 1.30), (1.0, 1.32)),
        ((0.0, 1.05), (0.02, 1.12), (1.0, 1.15)),
    ),
    "windscreen": (
        (0.225, 0.43), (0.255, 0.43), (0.255, 0.43), (0.23, 0.395), (0.145, 0.295), (0.02, 0.13), (0.008, 0.02)
    ),
    "rear_window": (
        (0.975, 0.875), (0.865, 0.70), (0.975, 0.89), (0.98, 0.90), (0.992, 0.972), (0.98, 0.97), (0.998, 0.992)
    ),
    "roof_width": (0.72, 0.70, 0.70, 0.75, 0.84, 0.88, 0.95),
    "wheel_radius_m": (0.315, 0.325, 0.325, 0.365, 0.345, 0.46, 0.48),
    "axles": ((0.195, 0.815), (0.19, 0.79), (0.19, 0.79), (0.19, 0.81), (0.17, 0.78), (0.52,), (0.24, 0.72)),
    "pillars": (
        ((0.40, 0.45), (0.78, 0.85)),
        ((0.42, 0.47), (0.80, 0.87)),
        ((0.32, 0.36), (0.61, 0.65), (0.92, 0.96)),
        ((0.31, 0.36), (0.64, 0.70)),
        ((0.10, 0.12),),
        ((0.58, 1.0),),
        ((0.10, 0.116), (0.235, 0.247), (0.365, 0.377), (0.495, 0.507), (0.625, 0.637), (0.755, 0.767), (0.88, 0.90)),
    ),
    "painted_pillars": (False, False, False, False, False, False, True),
    "glass_doors": ((), (), (), (), (), (), ((0.052, 0.148), (0.46, 0.555))),
    "side_glass": ((0.03, 0.96), (0.03, 0.96), (0.03, 0.96), (0.03, 0.96), (0.02, 0.27), (0.05, 0.60), (0.01, 0.985)),
    "seams": (
        (0.335, 0.575, 0.76),
        (0.335, 0.545, 0.74),
        (0.335, 0.545, 0.74),
        (0.335, 0.55, 0.745),
        (0.215, 0.40, 0.655),
        (0.30, 0.80),
        (0.30, 0.82),
    ),
    "front_lamp": ((0.64, 0.86), (0.64, 0.86), (0.64, 0.86), (0.64, 0.86), (0.64, 0.86), (0.22, 0.44), (0.30, 0.52)),
    "rear_lamp": ((0.60, 0.91), (0.60, 0.91), (0.60, 0.91), (0.60, 0.91), (0.52, 0.96), (0.30, 0.40), (0.42, 0.80)),
    "rear_lamp_inner": (4.40, 4.40, 4.40, 4.40, 4.12, 4.40, 4.20),
    "corner_front_m": ((0.4, 0.34), (0.4, 0.34), (0.4, 0.34), (0.4, 0.34), (0.4, 0.34), (0.26, 0.26), (0.28, 0.28)),
    "corner_rear_m": ((0.30, 0.26), (0.30, 0.26), (0.30, 0.26), (0.30, 0.26), (0.16, 0.16), (0.12, 0.12), (0.18, 0.18)),
    "bow_m": (0.10, 0.10, 0.10, 0.10, 0.10, 0.10, 0.10),
    "nose_inset_m": (0.18, 0.18, 0.18, 0.18, 0.18, 0.06, 0.04),
    "shoulder_inset_m": (0.09, 0.09, 0.09, 0.09, 0.03, 0.04, 0.02),
    "taper_m": (0.05, 0.05, 0.05, 0.05, 0.03, 0.01, 0.01),
    "house_corner_m": (0.20, 0.20, 0.20, 0.20, 0.14, 0.14, 0.24),
    "roof_round": (0.15, 0.15, 0.15, 0.15, 0.15, 0.15, 0.12),
    "glass_top": (0.84, 0.84, 0.84, 0.84, 0.84, 0.84, 0.80),
    "rear_glass": (True, True, True, True, True, False, True),
    "rear_doors": (False, False, False, False, True, False, False),
    "dark_bumpers": (False, False, False, True, True, True, False),
}  # fmt: skip
VEHICLE_SPECS = {
    kind: VehicleSpec(**{name: values[number] for name, values in _FIELDS.items()})
    for number, kind in enumerate(_KINDS)
}


# A van for goods: a high roof, and no windows behind the driver's.
HIGH_VAN = replace(
    VEHICLE_SPECS["van"],
    length_m=5.40,
    height_m=2.36,
    wheel_radius_m=0.355,
    glass_top=0.62,
    roof_round=0.12,
    rear_glass=False,
    rear_lamp=(0.42, 0.98),
    seams=(0.205, 0.385, 0.62),
)


class CARGO:
    """Measures of the box behind a lorry's cab [m]; x counts backwards from the cab's rear wall."""

    length_m = 4.6  # length of the cargo box
    half_width_m = 1.20  # half its width
    floor_m = 1.00  # height of its floor
    roof_m = 3.15  # height of its roof
    gap_m = 0.10  # gap between cab and box
    frame_half_width_m = 0.42  # half the width of the chassis frame
    rear_axles_m = (3.35,)  # how far behind the cab's rear wall the rear axles stand


# The ego vehicle: a tall estate whose upper surfaces are smooth and free of rails and aerials.
EGO_SPEC = replace(
    VEHICLE_SPECS["estate"],
    length_m=4.70,
    width_m=1.85,
    height_m=1.55,
    sill_m=0.22,
    deck=((0.0, 0.74), (0.05, 0.84), (0.15, 0.93), (0.28, 1.01), (0.60, 1.04), (0.92, 1.07), (1.0, 1.03)),
    wheel_radius_m=0.335,
)
