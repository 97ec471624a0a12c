"""Plans of streets: where asphalt, blocks of houses, markings and spawn slots lie, and rectangles on the ground.

Town frame: x along the main street in the ego vehicle's driving direction, y left, metres; traffic keeps to the right
unless the plan is mirrored. Everything is made of axis-aligned rectangles.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

REACH_M = 64.0  # streets end here, in front of a house
SPAWN_REACH_M = 27.0  # vehicles stand no farther from the ego vehicle
_LINE_HALF_WIDTH_M = 0.06
_BLOCK_DEPTH_M = 20.0
_CROSSING_WIDTH_M = 2.6
_WHITE = 0.82
Rectangle = tuple[float, float, float, float]  # x low, y low, x high, y high [m]


@dataclass(frozen=True)
class Footprint:
    """A rectangle on the ground, in the town frame."""

    x_m: float  # its centre [m]
    y_m: float  # its centre [m]
    yaw_rad: float  # direction of its length
    length_m: float  # length [m]
    width_m: float  # width [m]

    @classmethod
    def at(cls, centre_m: np.ndarray, yaw_rad: float, size_m: Sequence[float] | np.ndarray) -> Footprint:
        """The rectangle of a length and a width around a point; its heading becomes -pi to pi."""
        yaw = np.arctan2(np.sin(yaw_rad), np.cos(yaw_rad))
        return cls(float(centre_m[0]), float(centre_m[1]), float(yaw), float(size_m[0]), float(size_m[1]))

    @property
    def centre_m(self) -> np.ndarray:
        return np.array([self.x_m, self.y_m])

    @property
    def radius_m(self) -> float:
        """Of the circle around it."""
        return 0.5 * float(np.hypot(self.length_m, self.width_m))

    def corners_m(self) -> np.ndarray:
        """Its corners in the town frame [m], float64 [4, 2]."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        half = 0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [self.length_m, self.width_m]
        return np.array([self.x_m, self.y_m]) + half @ np.array([[c, s], [-s, c]])

    def nearer(self, other: Footprint, gap_m: float) -> bool:
        """Whether two rectangles come nearer than a gap: no axis of either separates them by it."""
        sizes_m = self.length_m + self.width_m + other.length_m + other.width_m
        if abs(other.x_m - self.x_m) + abs(other.y_m - self.y_m) > sizes_m + 2.0 * gap_m:
            return False
        offset = other.centre_m - self.centre_m
        sides = [(axis, extent) for each in (self, other) for axis, extent in each._sides()]
        for axis, _ in sides:
            reach = sum(0.5 * abs(axis @ direction) * extent for direction, extent in sides)
            if abs(axis @ offset) > reach + gap_m:
                return False
        return True

    def _sides(self) -> tuple[tuple[np.ndarray, float], tuple[np.ndarray, float]]:
        """Directions of its sides and how long they are."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return (np.array([c, s]), self.length_m), (np.array([-s, c]), self.width_m)


class Occupied:
    """What is taken already: quickly asked whether a rectangle comes near any of it."""

    def __init__(self, footprints: Iterable[Footprint] = ()) -> None:
        self._footprints: list[Footprint] = []
        self._circle: list[tuple[float, float, float]] = []
        for each in footprints:
            self.add(each)

    def add(self, footprint: Footprint) -> None:
        self._footprints.append(footprint)
        self._circle.append((footprint.x_m, footprint.y_m, footprint.radius_m))

    def is_free(self, footprint: Footprint, gap_m: float) -> bool:
        """Whether nothing is nearer to it than a gap."""
        if not self._footprints:
            return True
        x, y, radius = np.array(self._circle).T
        reach = radius + footprint.radius_m + 1.5 * gap_m + 1e-6  # at corners
        near = np.flatnonzero(np.hypot(x - footprint.x_m, y - footprint.y_m) <= reach)
        return not any(footprint.nearer(self._footprints[k], gap_m) for k in near)


@dataclass(frozen=True)
class Marking:
    """A painted rectangle on the asphalt; ``brightness`` is its sRGB grey, 0..1."""

    rectangle_m: Rectangle
    brightness: float = _WHITE


@dataclass(frozen=True)
class Block:
    """A raised block: a kerb, a pavement, houses."""

    rectangle_m: Rectangle  # its kerb
    pavement_m: float  # width of the pavement in front of the houses [m]
    fronts: tuple[str, ...]  # the sides that houses face: any of ``south``, ``north``, ``west``, ``east``
    corner_m: float = 0.0  # radius of the kerb at its corners [m]


def sides_of(rectangle_m: Rectangle) -> dict[str, tuple[np.ndarray, np.ndarray, float]]:
    """Sides of a block, counter-clockwise: where each starts, its direction, and how long it is [m]."""
    x_low, y_low, x_high, y_high = rectangle_m
    return {
        "south": (np.array((x_low, y_low)), np.array((1.0, 0.0)), x_high - x_low),
        "north": (np.array((x_high, y_high)), np.array((-1.0, 0.0)), x_high - x_low),
        "east": (np.array((x_high, y_low)), np.array((0.0, 1.0)), y_high - y_low),
        "west": (np.array((x_low, y_high)), np.array((0.0, -1.0)), y_high - y_low),
    }


@dataclass(frozen=True)
class Slot:
    """A place where a vehicle may stand, in line with its lane or bay."""

    x_m: float  # centre of the vehicle [m]
    y_m: float  # centre of the vehicle [m]
    yaw_rad: float  # heading of the lane or bay
    room_m: float  # the longest vehicle that fits [m]
    parked: bool = False  # in a bay rather than in a lane


@dataclass(frozen=True)
class Lane:
    """A straight lane from where it starts to where it ends, as it is driven."""

    start_m: tuple[float, float]  # where its middle starts in the town frame, x and y [m]
    yaw_rad: float  # direction in which it is driven
    length_m: float  # its length [m]
    # Free traffic: smallest gap between two vehicles, and what is added to it on average [m].
    gap_m: tuple[float, float]
    kind_shares: dict[str, float]  # what drives in it; the shares add up to 1
    queue: float = 0.0  # how many wait at a line on average
    lines_m: tuple[float, ...] = ()  # where drivers wait now, such as at a red light, from its start [m]
    # Stretches in which nobody stands, such as a junction that others cross now, from its start [m].
    closed_m: tuple[tuple[float, float], ...] = ()

    def at(self, along_m: float, left_m: float = 0.0) -> np.ndarray:
        """A point so far along the lane and left of its middle, in the town frame [m], shape [2]."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.array(self.start_m) + along_m * np.array([c, s]) + left_m * np.array([-s, c])

    def lines(self, half_width_m: float = 1.3) -> Iterator[Footprint]:
        """The lines as thin rectangles across the lane: what slows drivers down."""
        for along_m in self.lines_m:
            x, y = self.at(along_m + 0.2)
            yield Footprint(float(x), float(y), self.yaw_rad, 0.4, 2.0 * half_width_m)


@dataclass(frozen=True)
class Layout:
    template: str  # name of the road template
    asphalt_m: tuple[Rectangle, ...]  # rectangles of road, not overlapping
    blocks: tuple[Block, ...]  # blocks of houses
    markings: tuple[Marking, ...]  # lines and crossings
    slots: tuple[Slot, ...]  # spawn slots around the ego vehicle
    ego: Slot  # where the centre of the ego vehicle is; it heads along +x
    crossings_m: tuple[Rectangle, ...] = ()  # where people cross the road: long side along the road that they cross
    open_crossings_m: tuple[Rectangle, ...] = ()  # those of a street that waits now
    lanes: tuple[Lane, ...] = ()  # where vehicles drive
    cycle_lanes: tuple[Lane, ...] = ()  # where cyclists do

    @property
    def ego_m(self) -> np.ndarray:
        """The centre of the ego vehicle [m], shape [2]."""
        return np.array([self.ego.x_m, self.ego.y_m])

    def mirrored(self) -> Layout:
        opposite = {"south": "north", "north": "south"}

        def flipped(rectangle: Rectangle) -> Rectangle:
            x_low, y_low, x_high, y_high = rectangle
            return x_low, -y_high, x_high, -y_low

        def lanes(each: Iterable[Lane]) -> tuple[Lane, ...]:
            return tuple(replace(one, start_m=(one.start_m[0], -one.start_m[1]), yaw_rad=-one.yaw_rad) for one in each)

        blocks = [
            replace(each, fronts=tuple(opposite.get(front, front) for front in each.fronts)) for each in self.blocks
        ]
        return Layout(
            self.template,
            tuple(map(flipped, self.asphalt_m)),
            tuple(replace(each, rectangle_m=flipped(each.rectangle_m)) for each in blocks),
            tuple(replace(each, rectangle_m=flipped(each.rectangle_m)) for each in self.markings),
            tuple(replace(slot, y_m=-slot.y_m, yaw_rad=-slot.yaw_rad) for slot in self.slots),
            replace(self.ego, y_m=-self.ego.y_m),
            tuple(map(flipped, self.crossings_m)),
            tuple(map(flipped, self.open_crossings_m)),
            lanes(self.lanes),
            lanes(self.cycle_lanes),
        )


def dashes(
    y: float, *, dash: float, gap: float, holes: Sequence[tuple[float, float]] = (), reach_m: float = REACH_M
) -> list[Marking]:
    """A broken line along x at ``y``, left out where it would enter a hole (x range)."""
    return [
        Marking((float(x), y - _LINE_HALF_WIDTH_M, float(x) + dash, y + _LINE_HALF_WIDTH_M))
        for x in np.arange(-reach_m + 2.0, reach_m - dash, dash + gap)
        if all(x + dash < low or x > high for low, high in holes)
    ]


def line(y: float, low: float = -REACH_M, high: float = REACH_M) -> Marking:
    return Marking((low, y - _LINE_HALF_WIDTH_M, high, y + _LINE_HALF_WIDTH_M))


def stripes(x: float, half: float, width: float) -> list[Marking]:
    """A pedestrian crossing over the main street, starting at x."""
    return [Marking((x, float(y), x + width, float(y) + 0.5)) for y in np.arange(-half + 0.5, half - 0.8, 1.0)]


def side_street_markings(
    centre: float, side: float, dash_m: tuple[float, float], stop_m: tuple[float, float], lane: float
) -> list[Marking]:
    """Broken and stop line of a side street, between distances from the middle of the main street."""
    found = []
    for y in np.arange(*dash_m, 6.0):
        low, high = sorted((side * y, side * (y + 3.0)))
        found.append(Marking((centre - _LINE_HALF_WIDTH_M, low, centre + _LINE_HALF_WIDTH_M, high)))
    west, east = sorted((centre, centre - side * lane))
    low, high = sorted((side * stop_m[0], side * stop_m[1]))
    return [*found, Marking((west + 0.1, low, east - 0.1, high))]


def _lane_slots(rng: np.random.Generator, y: float, yaw: float, *, spacing: float, clear: float = 0.0) -> list[Slot]:
    """Slots along a lane parallel to x, ``clear`` metres of it left free on either side of x = 0."""
    phase = rng.uniform(0.0, spacing)
    at = [
        float(x + rng.uniform(-0.12, 0.12) * spacing) for x in np.arange(-SPAWN_REACH_M + phase, SPAWN_REACH_M, spacing)
    ]
    return [Slot(x, y, yaw, 12.0) for x in at if abs(x) >= clear]


def _cross_slots(rng: np.random.Generator, x: float, yaw: float, low: float, high: float) -> list[Slot]:
    """Slots along a lane parallel to y between ``low`` and ``high``."""
    phase = rng.uniform(0.0, 3.0)
    return [Slot(x, float(y), yaw, 12.0) for y in np.arange(low + phase, high, rng.uniform(6.6, 8.5))]


def ends(half_width: float, reach_m: float = REACH_M) -> tuple[Block, Block]:
    """Houses that close the street at both ends."""
    half, far_m = half_width + 10.0, reach_m + _BLOCK_DEPTH_M
    return (
        Block((reach_m, -half, far_m, half), 2.5, ("west",)),
        Block((-far_m, -half, -reach_m, half), 2.5, ("east",)),
    )


def _street(
    name: str, half: float, pavement: float, markings: list[Marking], slots: list[Slot], ego_y: float
) -> Layout:
    """A straight street with houses on both sides and at its ends."""
    depth = half + _BLOCK_DEPTH_M
    blocks = (
        Block((-REACH_M, half, REACH_M, depth), pavement, ("south",)),
        Block((-REACH_M, -depth, REACH_M, -half), pavement, ("north",)),
        *ends(half),
    )
    road = ((-REACH_M, -half, REACH_M, half),)
    return Layout(name, road, blocks, tuple(markings), tuple(slots), Slot(0.0, ego_y, 0.0, 5.0))


def _parking_street(rng: np.random.Generator) -> Layout:
    """Two lanes with a row of parking bays along either kerb."""
    lane, bay, pavement = rng.uniform(3.1, 3.5), 2.3, rng.uniform(2.4, 3.6)
    half = lane + bay
    markings = dashes(0.0, dash=3.0, gap=3.0)
    slots: list[Slot] = []
    for side in (-1.0, 1.0):
        spacing = rng.uniform(5.7, 6.3)
        first = -SPAWN_REACH_M + rng.uniform(0.0, spacing)
        edge = side * lane
        markings += dashes(edge, dash=1.0, gap=1.0)
        for x in np.arange(first, SPAWN_REACH_M, spacing):
            low, high = sorted((edge, side * half))
            markings.append(Marking((x - spacing / 2 - 0.05, low, x - spacing / 2 + 0.05, high), 0.74))
            yaw = (0.0 if side < 0.0 else np.pi) + (np.pi if rng.random() < 0.08 else 0.0)
            slots.append(Slot(float(x), side * (half - 1.15), yaw, spacing - 0.7, parked=True))
    slots += _lane_slots(rng, -lane / 2, 0.0, spacing=rng.uniform(8.0, 11.0), clear=7.5)
    slots += _lane_slots(rng, lane / 2, np.pi, spacing=rng.uniform(8.0, 11.0))
    return _street("parking_street", half, pavement, markings, slots, -lane / 2)


def _avenue(rng: np.random.Generator) -> Layout:
    lane, pavement = rng.uniform(3.1, 3.5), rng.uniform(3.5, 5.5)
    half = 2.0 * lane + 0.4
    markings = [line(0.11), line(-0.11), line(half - 0.25), line(-half + 0.25)]
    markings += dashes(lane, dash=3.0, gap=4.5) + dashes(-lane, dash=3.0, gap=4.5)
    ego_lane = int(rng.integers(2))
    slots: list[Slot] = []
    for index in range(2):
        y = (index + 0.5) * lane + 0.1
        clear = 7.5 if index == ego_lane else 0.0
        slots += _lane_slots(rng, -y, 0.0, spacing=rng.uniform(7.0, 9.0), clear=clear)
        slots += _lane_slots(rng, y, np.pi, spacing=rng.uniform(7.0, 9.0))
    return _street("avenue", half, pavement, markings, slots, -(ego_lane + 0.5) * lane - 0.1)


def _junction(rng: np.random.Generator, arms: tuple[float, ...]) -> Layout:
    """A street of two lanes, and a side street of two lanes on the given sides (+1 left, -1 right)."""
    lane, side_lane = rng.uniform(3.2, 3.7), rng.uniform(3.1, 3.6)
    half, side_half, pavement = lane + 0.2, side_lane + 0.2, rng.uniform(2.6, 4.0)
    centre, corner = rng.uniform(1.0, 13.0), rng.uniform(1.6, 2.5)
    west, east = centre - side_half, centre + side_half
    markings = dashes(0.0, dash=3.0, gap=3.0, holes=[(west - 6.5, east + 6.5)])
    asphalt: list[Rectangle] = [(-REACH_M, -half, REACH_M, half)]
    blocks: list[Block] = list(ends(half))
    slots = _lane_slots(rng, -lane / 2, 0.0, spacing=rng.uniform(7.5, 10.0), clear=7.5)
    slots += _lane_slots(rng, lane / 2, np.pi, spacing=rng.uniform(7.5, 10.0))
    depth = REACH_M * 0.75
    for side in (-1.0, 1.0):
        low, high = sorted((side * half, side * depth))
        facing = "north" if side < 0.0 else "south"
        if side not in arms:
            low, high = sorted((side * half, side * (half + _BLOCK_DEPTH_M)))
            blocks.append(Block((-REACH_M, low, REACH_M, high), pavement, (facing,)))
            continue
        asphalt.append((west, low, east, high))
        blocks.append(Block((-REACH_M, low, west, high), pavement, (facing, "east"), corner))
        blocks.append(Block((east, low, REACH_M, high), pavement, (facing, "west"), corner))
        end_low, end_high = sorted((side * depth, side * (depth + _BLOCK_DEPTH_M)))
        blocks.append(Block((west - 10.0, end_low, east + 10.0, end_high), 2.5, (facing,)))
        markings += side_street_markings(
            centre, side, (half + 7.0, depth - 3.0), (half + 0.9, half + 1.3), side_half - 0.2
        )
        # Going to +y means keeping to the larger x.
        slot_low, slot_high = sorted((side * (half + 3.4), side * SPAWN_REACH_M))
        slots += _cross_slots(rng, centre + side_lane / 2, 0.5 * np.pi, slot_low, slot_high)
        slots += _cross_slots(rng, centre - side_lane / 2, -0.5 * np.pi, slot_low, slot_high)
    crossings: list[Rectangle] = []
    if len(arms) == 2 and rng.random() < 0.7:
        for x in (west - 3.6, east + 1.0):
            markings += stripes(x, half, _CROSSING_WIDTH_M)
            crossings.append((x, -half, x + _CROSSING_WIDTH_M, half))
    return Layout(
        "crossroads" if len(arms) == 2 else "t_junction",
        tuple(asphalt),
        tuple(blocks),
        tuple(markings),
        tuple(slots),
        Slot(0.0, -lane / 2, 0.0, 5.0),
        tuple(crossings),
    )


def _car_park(rng: np.random.Generator) -> Layout:
    """An open square with rows of perpendicular bays along three aisles."""
    aisle, depth, pitch = rng.uniform(6.4, 7.2), 5.2, rng.uniform(2.65, 2.85)
    length, row_end = 44.0, 26.0
    half = 1.5 * aisle + 2.0 * depth + rng.uniform(0.5, 6.0)
    markings: list[Marking] = []
    slots: list[Slot] = []
    first = -row_end + rng.uniform(0.0, pitch)
    edges = np.arange(first, row_end, pitch)
    for side in (-1.0, 1.0):
        for row in range(2):
            near = aisle / 2 + row * depth
            low, high = sorted((side * near, side * (near + depth)))
            markings += [Marking((float(x) - 0.05, low, float(x) + 0.05, high), 0.76) for x in edges]
            for x in edges[:-1] + pitch / 2:
                yaw = 0.5 * np.pi * (1.0 if rng.random() < 0.5 else -1.0)
                slots.append(Slot(float(x), side * (near + depth / 2), yaw, 4.85, parked=True))
        back = side * (aisle / 2 + depth)
        markings.append(Marking((float(edges[0]), back - 0.05, float(edges[-1]), back + 0.05), 0.76))
        outer = side * (1.0 * aisle + 2.0 * depth)
        slots += _lane_slots(rng, outer - 1.6, 0.0, spacing=11.0)
        slots += _lane_slots(rng, outer + 1.6, np.pi, spacing=11.0)
    slots += _lane_slots(rng, -1.65, 0.0, spacing=10.0, clear=7.5)
    slots += _lane_slots(rng, 1.65, np.pi, spacing=9.0)
    edge, end = half + _BLOCK_DEPTH_M, length + _BLOCK_DEPTH_M
    places = ((-length, half, length, edge), (-length, -edge, length, -half), (length, -half, end, half),
              (-end, -half, -length, half))  # fmt: skip
    fronts = ("south", "north", "west", "east")
    blocks = tuple(Block(place, 4.0, (front,)) for place, front in zip(places, fronts, strict=True))
    road = ((-length, -half, length, half),)
    return Layout("car_park", road, blocks, tuple(markings), tuple(slots), Slot(0.0, -1.65, 0.0, 5.0))


_TEMPLATES = (
    (_parking_street, 0.28),
    (_avenue, 0.22),
    (lambda rng: _junction(rng, (-1.0, 1.0)), 0.20),  # crossroads
    (lambda rng: _junction(rng, (1.0 if rng.random() < 0.5 else -1.0,)), 0.14),  # a street that ends in another one
    (_car_park, 0.16),
)


def town_layout(rng: np.random.Generator) -> Layout:
    make = _TEMPLATES[int(rng.choice(len(_TEMPLATES), p=[share for _, share in _TEMPLATES]))][0]
    layout = make(rng)
    return layout.mirrored() if rng.random() < 0.5 else layout
