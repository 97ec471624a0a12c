"""Plans of streets: where asphalt, blocks of houses, markings and spawn slots lie.

Town frame: x along the main street in the ego vehicle's driving direction, y left, metres; traffic keeps to the right
unless the plan is mirrored. Everything is made of axis-aligned rectangles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

REACH_M = 64.0  # streets end here, in front of a house
SPAWN_REACH_M = 27.0  # vehicles stand no farther from the ego vehicle
LINE_HALF_WIDTH_M = 0.06
_BLOCK_DEPTH_M = 20.0
_CROSSING_WIDTH_M = 2.6
_WHITE = 0.82

Rectangle = tuple[float, float, float, float]  # x low, y low, x high, y high [m]


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


@dataclass(frozen=True)
class Slot:
    """A place where a vehicle may stand, in line with its lane or bay."""

    x_m: float  # centre of the vehicle [m]
    y_m: float  # centre of the vehicle [m]
    yaw_rad: float  # heading of the lane or bay
    room_m: float  # the longest vehicle that fits [m]
    parked: bool  # in a bay rather than in a lane


@dataclass(frozen=True)
class Layout:
    """One town plan."""

    template: str  # name of the road template
    asphalt_m: tuple[Rectangle, ...]  # rectangles of road, not overlapping
    blocks: tuple[Block, ...]  # blocks of houses
    markings: tuple[Marking, ...]  # lines and crossings
    slots: tuple[Slot, ...]  # spawn slots around the ego vehicle
    ego: Slot  # where the centre of the ego vehicle is; it heads along +x
    crossings_m: tuple[Rectangle, ...] = ()  # where people cross the road: long side along the road that they cross

    def mirrored(self) -> Layout:
        """The plan with left and right exchanged."""
        opposite = {"south": "north", "north": "south"}
        return Layout(
            self.template,
            tuple(_mirrored(rectangle) for rectangle in self.asphalt_m),
            tuple(
                replace(
                    block,
                    rectangle_m=_mirrored(block.rectangle_m),
                    fronts=tuple(opposite.get(front, front) for front in block.fronts),
                )
                for block in self.blocks
            ),
            tuple(replace(marking, rectangle_m=_mirrored(marking.rectangle_m)) for marking in self.markings),
            tuple(replace(slot, y_m=-slot.y_m, yaw_rad=-slot.yaw_rad) for slot in self.slots),
            replace(self.ego, y_m=-self.ego.y_m),
            tuple(_mirrored(rectangle) for rectangle in self.crossings_m),
        )


def _mirrored(rectangle: Rectangle) -> Rectangle:
    x_low, y_low, x_high, y_high = rectangle
    return (x_low, -y_high, x_high, -y_low)


def _dashes(y: float, *, dash: float, gap: float, holes: tuple[tuple[float, float], ...] = ()) -> list[Marking]:
    """A broken line along x at ``y``, left out where it would enter a hole (x range)."""
    start = np.arange(-REACH_M + 2.0, REACH_M - dash, dash + gap)
    return [
        Marking((float(x), y - LINE_HALF_WIDTH_M, float(x) + dash, y + LINE_HALF_WIDTH_M))
        for x in start
        if all(x + dash < low or x > high for low, high in holes)
    ]


def _line(y: float, pieces: tuple[tuple[float, float], ...] = ((-REACH_M, REACH_M),)) -> list[Marking]:
    return [Marking((low, y - LINE_HALF_WIDTH_M, high, y + LINE_HALF_WIDTH_M)) for low, high in pieces]


def _lane_slots(
    rng: np.random.Generator, y: float, yaw: float, *, spacing: float, room: float = 12.0, clear: float = 0.0
) -> list[Slot]:
    """Slots along a lane parallel to x, ``clear`` metres of it left free on either side of x = 0."""
    phase = rng.uniform(0.0, spacing)
    slots = []
    for x in np.arange(-SPAWN_REACH_M + phase, SPAWN_REACH_M, spacing):
        shifted = float(x + rng.uniform(-0.12, 0.12) * spacing)
        if abs(shifted) >= clear:
            slots.append(Slot(shifted, y, yaw, room, parked=False))
    return slots


def _cross_slots(rng: np.random.Generator, x: float, yaw: float, low: float, high: float) -> list[Slot]:
    """Slots along a lane parallel to y between ``low`` and ``high``."""
    phase = rng.uniform(0.0, 3.0)
    return [Slot(x, float(y), yaw, 12.0, parked=False) for y in np.arange(low + phase, high, rng.uniform(6.6, 8.5))]


def _ends(half_width: float) -> tuple[Block, Block]:
    """Houses that close the street at both ends."""
    half = half_width + 10.0
    return (
        Block((REACH_M, -half, REACH_M + _BLOCK_DEPTH_M, half), 2.5, ("west",)),
        Block((-REACH_M - _BLOCK_DEPTH_M, -half, -REACH_M, half), 2.5, ("east",)),
    )


def _side_blocks(half_width: float, pavement: float) -> tuple[Block, Block]:
    depth = half_width + _BLOCK_DEPTH_M
    return (
        Block((-REACH_M, half_width, REACH_M, depth), pavement, ("south",)),
        Block((-REACH_M, -depth, REACH_M, -half_width), pavement, ("north",)),
    )


def _parking_street(rng: np.random.Generator) -> Layout:
    """Two lanes with a row of parking bays along either kerb."""
    lane, bay, pavement = rng.uniform(3.1, 3.5), 2.3, rng.uniform(2.4, 3.6)
    half = lane + bay
    markings = _dashes(0.0, dash=3.0, gap=3.0)
    slots: list[Slot] = []
    for side in (-1.0, 1.0):
        spacing = rng.uniform(5.7, 6.3)
        first = -SPAWN_REACH_M + rng.uniform(0.0, spacing)
        edge = side * lane
        markings += _dashes(edge, dash=1.0, gap=1.0)
        for x in np.arange(first, SPAWN_REACH_M, spacing):
            across = sorted((edge, side * half))
            markings.append(Marking((x - spacing / 2 - 0.05, across[0], x - spacing / 2 + 0.05, across[1]), 0.74))
            yaw = (0.0 if side < 0.0 else np.pi) + (np.pi if rng.random() < 0.08 else 0.0)
            slots.append(Slot(float(x), side * (half - 1.15), yaw, spacing - 0.7, parked=True))
    slots += _lane_slots(rng, -lane / 2, 0.0, spacing=rng.uniform(8.0, 11.0), clear=7.5)
    slots += _lane_slots(rng, lane / 2, np.pi, spacing=rng.uniform(8.0, 11.0))
    return Layout(
        "parking_street",
        ((-REACH_M, -half, REACH_M, half),),
        _side_blocks(half, pavement) + _ends(half),
        tuple(markings),
        tuple(slots),
        Slot(0.0, -lane / 2, 0.0, 5.0, parked=False),
    )


def _avenue(rng: np.random.Generator) -> Layout:
    """Two lanes in either direction."""
    lane, pavement = rng.uniform(3.1, 3.5), rng.uniform(3.5, 5.5)
    half = 2.0 * lane + 0.4
    markings = _line(0.11) + _line(-0.11) + _line(half - 0.25) + _line(-half + 0.25)
    markings += _dashes(lane, dash=3.0, gap=4.5) + _dashes(-lane, dash=3.0, gap=4.5)
    ego_lane = int(rng.integers(2))
    slots: list[Slot] = []
    for index in range(2):
        y = (index + 0.5) * lane + 0.1
        clear = 7.5 if index == ego_lane else 0.0
        slots += _lane_slots(rng, -y, 0.0, spacing=rng.uniform(7.0, 9.0), clear=clear)
        slots += _lane_slots(rng, y, np.pi, spacing=rng.uniform(7.0, 9.0))
    return Layout(
        "avenue",
        ((-REACH_M, -half, REACH_M, half),),
        _side_blocks(half, pavement) + _ends(half),
        tuple(markings),
        tuple(slots),
        Slot(0.0, -(ego_lane + 0.5) * lane - 0.1, 0.0, 5.0, parked=False),
    )


def _crossing_stripes(x: float, half: float) -> list[Marking]:
    """A pedestrian crossing over the main street, starting at x."""
    return [
        Marking((x, float(y), x + _CROSSING_WIDTH_M, float(y) + 0.5)) for y in np.arange(-half + 0.5, half - 0.8, 1.0)
    ]


def _junction(rng: np.random.Generator, arms: tuple[float, ...]) -> Layout:
    """A street of two lanes, and a side street of two lanes on the given sides (+1 left, -1 right)."""
    lane, side_lane = rng.uniform(3.2, 3.7), rng.uniform(3.1, 3.6)
    half, side_half, pavement = lane + 0.2, side_lane + 0.2, rng.uniform(2.6, 4.0)
    centre, corner = rng.uniform(1.0, 13.0), rng.uniform(1.6, 2.5)
    west, east = centre - side_half, centre + side_half
    hole = ((west - 6.5, east + 6.5),)
    markings = _dashes(0.0, dash=3.0, gap=3.0, holes=hole)
    asphalt: list[Rectangle] = [(-REACH_M, -half, REACH_M, half)]
    blocks: list[Block] = list(_ends(half))
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
        for y in np.arange(half + 7.0, depth - 3.0, 6.0):
            dash_low, dash_high = sorted((side * y, side * (y + 3.0)))
            markings.append(Marking((centre - LINE_HALF_WIDTH_M, dash_low, centre + LINE_HALF_WIDTH_M, dash_high)))
        # Whoever comes towards the junction waits at a line on its own half of the street.
        stop = sorted((centre, centre - side * (side_half - 0.2)))
        line_low, line_high = sorted((side * (half + 0.9), side * (half + 1.3)))
        markings.append(Marking((stop[0] + 0.1, line_low, stop[1] - 0.1, line_high)))
        # Going to +y means keeping to the larger x.
        slot_low, slot_high = sorted((side * (half + 3.4), side * SPAWN_REACH_M))
        slots += _cross_slots(rng, centre + side_lane / 2, 0.5 * np.pi, slot_low, slot_high)
        slots += _cross_slots(rng, centre - side_lane / 2, -0.5 * np.pi, slot_low, slot_high)
    crossings: list[Rectangle] = []
    if len(arms) == 2 and rng.random() < 0.7:
        for x in (west - 3.6, east + 1.0):
            markings += _crossing_stripes(x, half)
            crossings.append((x, -half, x + _CROSSING_WIDTH_M, half))
    return Layout(
        "crossroads" if len(arms) == 2 else "t_junction",
        tuple(asphalt),
        tuple(blocks),
        tuple(markings),
        tuple(slots),
        Slot(0.0, -lane / 2, 0.0, 5.0, parked=False),
        tuple(crossings),
    )


def _crossroads(rng: np.random.Generator) -> Layout:
    """Two streets that cross."""
    return _junction(rng, (-1.0, 1.0))


def _t_junction(rng: np.random.Generator) -> Layout:
    """A street that ends in another one."""
    return _junction(rng, (1.0 if rng.random() < 0.5 else -1.0,))


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
    edge = half + _BLOCK_DEPTH_M
    return Layout(
        "car_park",
        ((-length, -half, length, half),),
        (
            Block((-length, half, length, edge), 4.0, ("south",)),
            Block((-length, -edge, length, -half), 4.0, ("north",)),
            Block((length, -half, length + _BLOCK_DEPTH_M, half), 4.0, ("west",)),
            Block((-length - _BLOCK_DEPTH_M, -half, -length, half), 4.0, ("east",)),
        ),
        tuple(markings),
        tuple(slots),
        Slot(0.0, -1.65, 0.0, 5.0, parked=False),
    )


_TEMPLATES: tuple[tuple[Callable[[np.random.Generator], Layout], float], ...] = (
    (_parking_street, 0.28),
    (_avenue, 0.22),
    (_crossroads, 0.20),
    (_t_junction, 0.14),
    (_car_park, 0.16),
)


def town_layout(rng: np.random.Generator) -> Layout:
    """A random plan, mirrored half of the time."""
    make = _TEMPLATES[int(rng.choice(len(_TEMPLATES), p=[share for _, share in _TEMPLATES]))][0]
    layout = make(rng)
    return layout.mirrored() if rng.random() < 0.5 else layout
