"""Measures of the kinds of vehicles: what distinguishes a hatchback from a bus."""

from __future__ import annotations

from dataclasses import dataclass, field, replace


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
    painted_pillars: bool = False  # pillars in the colour of the vehicle
    # (start, end) as fractions of the length of doors that are of glass down to the step.
    glass_doors: tuple[tuple[float, float], ...] = ()
    side_glass: tuple[float, float] = (0.03, 0.96)  # (start, end) of the side glass along the house
    seams: tuple[float, ...] = ()  # fractions of the length of the door seams
    # (low, high) of the headlamps as fractions of the height from sill to deck.
    front_lamp: tuple[float, float] = (0.64, 0.86)
    rear_lamp: tuple[float, float] = (0.60, 0.91)  # the same for the tail lamps
    rear_lamp_inner: float = 4.40  # how far the tail lamps reach inwards, 4.0 (corner) to 5.0 (centre)
    corner_front_m: tuple[float, float] = (0.40, 0.34)  # corner radii in plan, along x and y [m]
    corner_rear_m: tuple[float, float] = (0.30, 0.26)  # the same at the rear
    bow_m: float = 0.10  # how far the nose bows forwards in the centre [m]
    nose_inset_m: float = 0.18  # how far the upper edge of the nose lies behind its most forward point [m]
    shoulder_inset_m: float = 0.09  # how far the upper edge of the sides lies inside the widest point [m]
    taper_m: float = 0.05  # how much narrower each side is at the very ends [m]
    house_corner_m: float = 0.20  # plan radius of the glass house's corners [m]
    roof_round: float = 0.15  # share of the glass house's height that rounds into the roof
    glass_top: float = 0.84  # share of the glass house's height where the glass ends
    rear_glass: bool = True  # false for a blind rear
    rear_doors: bool = False  # two doors with hinges and a handle at the rear, and a bumper to step on
    dark_bumpers: bool = False  # bumpers of bare plastic


_HATCHBACK = VehicleSpec(
    length_m=4.05,
    width_m=1.76,
    height_m=1.48,
    sill_m=0.20,
    deck=((0.0, 0.70), (0.06, 0.80), (0.15, 0.89), (0.27, 0.97), (0.60, 1.00), (0.90, 1.04), (1.0, 1.00)),
    windscreen=(0.225, 0.43),
    rear_window=(0.975, 0.875),
    roof_width=0.72,
    wheel_radius_m=0.315,
    axles=(0.195, 0.815),
    pillars=((0.40, 0.45), (0.78, 0.85)),
    seams=(0.335, 0.575, 0.76),
)
_SALOON = VehicleSpec(
    length_m=4.65,
    width_m=1.82,
    height_m=1.45,
    sill_m=0.20,
    deck=((0.0, 0.68), (0.05, 0.77), (0.15, 0.86), (0.28, 0.95), (0.60, 0.98), (0.80, 1.02), (0.95, 1.02), (1.0, 0.95)),
    windscreen=(0.255, 0.43),
    rear_window=(0.865, 0.70),
    roof_width=0.70,
    wheel_radius_m=0.325,
    axles=(0.19, 0.79),
    pillars=((0.42, 0.47), (0.80, 0.87)),
    seams=(0.335, 0.545, 0.74),
)
_ESTATE = replace(
    _SALOON,
    length_m=4.70,
    height_m=1.48,
    deck=((0.0, 0.68), (0.05, 0.77), (0.15, 0.86), (0.28, 0.95), (0.60, 0.98), (0.92, 1.02), (1.0, 0.98)),
    rear_window=(0.975, 0.89),
    pillars=((0.32, 0.36), (0.61, 0.65), (0.92, 0.96)),
)
_SUV = VehicleSpec(
    dark_bumpers=True,
    length_m=4.50,
    width_m=1.86,
    height_m=1.68,
    sill_m=0.27,
    deck=((0.0, 0.85), (0.05, 0.96), (0.15, 1.03), (0.26, 1.08), (0.60, 1.12), (0.90, 1.15), (1.0, 1.10)),
    windscreen=(0.23, 0.395),
    rear_window=(0.98, 0.90),
    roof_width=0.75,
    wheel_radius_m=0.365,
    axles=(0.19, 0.81),
    pillars=((0.31, 0.36), (0.64, 0.70)),
    seams=(0.335, 0.55, 0.745),
)
_VAN = VehicleSpec(
    dark_bumpers=True,
    rear_doors=True,
    length_m=5.10,
    width_m=1.95,
    height_m=1.98,
    sill_m=0.24,
    deck=((0.0, 0.88), (0.04, 0.98), (0.10, 1.07), (0.17, 1.14), (0.60, 1.18), (1.0, 1.18)),
    windscreen=(0.145, 0.295),
    rear_window=(0.992, 0.972),
    roof_width=0.84,
    wheel_radius_m=0.345,
    axles=(0.17, 0.78),
    pillars=((0.10, 0.12),),
    side_glass=(0.02, 0.27),
    seams=(0.215, 0.40, 0.655),
    rear_lamp=(0.52, 0.96),
    rear_lamp_inner=4.12,
    corner_rear_m=(0.16, 0.16),
    taper_m=0.03,
    house_corner_m=0.14,
    shoulder_inset_m=0.03,
)
_BUS = VehicleSpec(
    length_m=10.8,
    width_m=2.50,
    height_m=3.00,
    sill_m=0.32,
    deck=((0.0, 1.05), (0.02, 1.12), (1.0, 1.15)),
    windscreen=(0.008, 0.020),
    rear_window=(0.998, 0.992),
    roof_width=0.95,
    wheel_radius_m=0.48,
    axles=(0.24, 0.72),
    pillars=(
        (0.10, 0.116),
        (0.235, 0.247),
        (0.365, 0.377),
        (0.495, 0.507),
        (0.625, 0.637),
        (0.755, 0.767),
        (0.88, 0.90),
    ),
    painted_pillars=True,
    glass_doors=((0.052, 0.148), (0.46, 0.555)),
    side_glass=(0.01, 0.985),
    seams=(0.30, 0.82),
    front_lamp=(0.30, 0.52),
    rear_lamp=(0.42, 0.80),
    rear_lamp_inner=4.20,
    corner_front_m=(0.28, 0.28),
    corner_rear_m=(0.18, 0.18),
    nose_inset_m=0.04,
    shoulder_inset_m=0.02,
    taper_m=0.01,
    house_corner_m=0.24,
    roof_round=0.12,
    glass_top=0.80,
)
_LORRY = VehicleSpec(
    dark_bumpers=True,
    length_m=2.15,
    width_m=2.30,
    height_m=2.60,
    sill_m=0.42,
    deck=((0.0, 1.22), (0.05, 1.30), (1.0, 1.32)),
    windscreen=(0.02, 0.13),
    rear_window=(0.98, 0.97),
    roof_width=0.88,
    wheel_radius_m=0.46,
    axles=(0.52,),
    pillars=((0.58, 1.0),),
    side_glass=(0.05, 0.60),
    seams=(0.30, 0.80),
    front_lamp=(0.22, 0.44),
    rear_lamp=(0.30, 0.40),
    corner_front_m=(0.26, 0.26),
    corner_rear_m=(0.12, 0.12),
    nose_inset_m=0.06,
    shoulder_inset_m=0.04,
    taper_m=0.01,
    house_corner_m=0.14,
    rear_glass=False,
)

VEHICLE_SPECS = {
    "hatchback": _HATCHBACK,
    "saloon": _SALOON,
    "estate": _ESTATE,
    "suv": _SUV,
    "van": _VAN,
    "lorry": _LORRY,
    "bus": _BUS,
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


@dataclass(frozen=True)
class _CargoSpec:
    """Measures of the box behind a lorry's cab [m]; x counts backwards from the cab's rear wall."""

    length_m: float = 4.6  # length of the cargo box
    half_width_m: float = 1.20  # half its width
    floor_m: float = 1.00  # height of its floor
    roof_m: float = 3.15  # height of its roof
    gap_m: float = 0.10  # gap between cab and box
    frame_half_width_m: float = 0.42  # half the width of the chassis frame
    rear_axles_m: tuple[float, ...] = field(default=(3.35,))  # how far behind the cab's rear wall the rear axles stand


CARGO = _CargoSpec()
# The ego vehicle: a tall estate whose upper surfaces are smooth and free of rails and aerials.
EGO_SPEC = replace(
    _ESTATE,
    length_m=4.70,
    width_m=1.85,
    height_m=1.55,
    sill_m=0.22,
    deck=((0.0, 0.74), (0.05, 0.84), (0.15, 0.93), (0.28, 1.01), (0.60, 1.04), (0.92, 1.07), (1.0, 1.03)),
    wheel_radius_m=0.335,
)
