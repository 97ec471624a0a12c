"""Plans of long streets with junctions, for the levels urban and dense: what drives and stands where, and who waits.

Town frame as in `town_layout`. A street has, from its middle: lanes, maybe a cycle lane, maybe parking bays, pavement,
houses. At every junction either the main street moves and the side street waits, or the other way round.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise

import numpy as np

from warpav.scene.town.houses import SceneryBuilder
from warpav.scene.town.lanes import Lane, lane_positions, lane_vehicles
from warpav.scene.town.level_world import LevelWorld
from warpav.scene.town.placed_vehicle import LONG_KINDS, PlacedVehicle, drawn_vehicle
from warpav.scene.town.street_life import Footprint, furnish, strips
from warpav.scene.town.surface_builder import StreetGround
from warpav.scene.town.town_layout import LINE_HALF_WIDTH_M, Block, Layout, Marking, Rectangle, Slot

STREET_REACH_M, SIDE_REACH_M = 95.0, 80.0
"""Where the main street ends, and the side streets, in front of houses."""
_BAY_M, _CYCLE_LANE_M, _CROSSING_M, _BLOCK_DEPTH_M = 2.3, 1.7, 2.8, 20.0
_JUNCTION_SPACING_M = 38.0  # between the middles of two side streets
_LINE_M, _KERB_RADIUS_M = 1.1, 2.4
_CYCLIST_M = 1.9


@dataclass(frozen=True)
class Traffic:
    """How much goes on in a street."""

    gap_m: tuple[float, float]  # in free traffic, smallest gap and what is added on average [m]
    queue: float  # how many wait at a red light in each lane, on average
    cyclist_gap_m: tuple[float, float]  # the same as ``gap_m`` between cyclists in a cycle lane [m]
    kind_shares: dict[str, float]  # what drives
    parked_share: float  # share of the bays that are taken
    pavement_m: float  # length of pavement for every person on it [m]
    crossing: float  # people on a crossing whose road waits, on average
    stepping_out: float  # share of the gaps between parked cars from which somebody steps
    beside: float  # chance of a cyclist on either side of the ego vehicle
    children: float  # children within a few metres of the ego vehicle, on average
    double_parked: float  # chance that a lorry, bus or van stands in a lane and hides what is behind it


@dataclass(frozen=True)
class _StreetPlan:
    """One plan."""

    layout: Layout  # asphalt, blocks, markings; its slots are parking bays, and places in lanes for road works
    lanes: tuple[Lane, ...]  # where vehicles drive
    cycle_lanes: tuple[Lane, ...]  # where cyclists do
    open_crossings: tuple[Rectangle, ...]  # where people cross the main street, which waits now
    half_m: float  # half the width of the main street between the kerbs [m]
    pavement_m: float  # width of its pavements [m]


@dataclass
class _Junction:
    centre_m: float
    half_m: float
    lane_m: float
    arms: tuple[float, ...]
    main_moves: bool
    has_crossings: bool

    @property
    def west_m(self) -> float:
        return self.centre_m - self.half_m

    @property
    def east_m(self) -> float:
        return self.centre_m + self.half_m

    @property
    def line_m(self) -> float:
        """How far before the side street drivers of the main street wait."""
        return _CROSSING_M + 2.4 if self.has_crossings else _LINE_M


@dataclass
class _Drawing:
    """A plan as it grows."""

    half_m: float
    pavement_m: float
    junctions: list[_Junction]
    traffic: Traffic
    markings: list[Marking] = field(default_factory=list)
    slots: list[Slot] = field(default_factory=list)
    lanes: list[Lane] = field(default_factory=list)
    cycle_lanes: list[Lane] = field(default_factory=list)
    asphalt: list[Rectangle] = field(default_factory=list)
    blocks: list[Block] = field(default_factory=list)
    crossings: list[Rectangle] = field(default_factory=list)
    open_crossings: list[Rectangle] = field(default_factory=list)

    def holes(self, margin_m: float) -> list[tuple[float, float]]:
        """Stretches of the main street in and around its junctions."""
        return [(each.west_m - margin_m, each.east_m + margin_m) for each in self.junctions]


def _street_plan(traffic: Traffic, rng: np.random.Generator) -> _StreetPlan:
    """A random plan, mirrored half of the time."""
    lane = float(rng.uniform(3.1, 3.5))
    count = 2 if rng.random() < 0.4 else 1
    cycle = _CYCLE_LANE_M if rng.random() < 0.5 else 0.0
    parks = rng.random() < (0.8 if count == 1 else 0.55)
    half = count * lane + cycle + (_BAY_M if parks else 0.25)
    drawing = _Drawing(half, float(rng.uniform(2.6, 4.4)), _junctions(rng), traffic)
    drawing.asphalt.append((-STREET_REACH_M, -half, STREET_REACH_M, half))

    _add_dashes(drawing, 0.0, 3.0, 3.0) if count == 1 else _add_lines(drawing, (-0.11, 0.11))
    for side in (-1.0, 1.0):
        for index in range(1, count):
            _add_dashes(drawing, side * index * lane, 3.0, 4.5)
        if cycle:
            _add_dashes(drawing, side * count * lane, 1.0, 0.5)
        if parks:
            _add_bays(drawing, side, count * lane + cycle, rng)
        for index in range(count):
            drawing.lanes.append(_main_lane(drawing, side, (index + 0.5) * lane))
        if cycle:
            drawing.cycle_lanes.append(_main_lane(drawing, side, count * lane + 0.5 * cycle, is_cycle_lane=True))
    for junction in drawing.junctions:
        _add_side_street(drawing, junction, rng)
    _add_blocks(drawing)
    own_lane = int(rng.integers(count))
    layout = Layout(
        "street" if count == 1 else "avenue",
        tuple(drawing.asphalt),
        tuple(drawing.blocks),
        tuple(drawing.markings),
        tuple(drawing.slots),
        Slot(0.0, -(own_lane + 0.5) * lane, 0.0, 5.0, parked=False),
        tuple(drawing.crossings),
    )
    lanes, cycle_lanes = tuple(drawing.lanes), tuple(drawing.cycle_lanes)
    plan = _StreetPlan(layout, lanes, cycle_lanes, tuple(drawing.open_crossings), half, drawing.pavement_m)
    return _mirrored(plan) if rng.random() < 0.5 else plan


def _mirrored(plan: _StreetPlan) -> _StreetPlan:
    def lane(one: Lane) -> Lane:
        x, y = one.start_m
        return Lane(**{**vars(one), "start_m": (x, -y), "yaw_rad": -one.yaw_rad})

    return _StreetPlan(
        plan.layout.mirrored(),
        tuple(map(lane, plan.lanes)),
        tuple(map(lane, plan.cycle_lanes)),
        tuple((r[0], -r[3], r[2], -r[1]) for r in plan.open_crossings),
        plan.half_m,
        plan.pavement_m,
    )


def _junctions(rng: np.random.Generator) -> list[_Junction]:
    """One to three side streets; the ego vehicle stands in none whose traffic moves."""
    centres: list[float] = []
    for centre in rng.uniform([-45.0, 8.0, -75.0], [45.0, 75.0, 75.0])[: int(rng.integers(1, 4))]:
        if all(abs(centre - other) >= _JUNCTION_SPACING_M for other in centres):
            centres.append(float(centre))
    found = []
    for centre in sorted(centres):
        lane = float(rng.uniform(3.0, 3.4))
        half = lane + (_BAY_M if rng.random() < 0.5 else 0.25)
        arms = ((-1.0, 1.0), (-1.0,), (1.0,))[int(rng.choice(3, p=[0.6, 0.2, 0.2]))]
        occupied = abs(centre) < half + 9.0
        main_moves = len(arms) == 1 or bool(occupied) or rng.random() < 0.45
        found.append(_Junction(centre, half, lane, arms, main_moves, len(arms) == 2 and rng.random() < 0.75))
    return found


def _add_lines(drawing: _Drawing, offsets_m: tuple[float, ...]) -> None:
    edges = [-STREET_REACH_M, *(x for hole in drawing.holes(1.0) for x in hole), STREET_REACH_M]
    for low, high in zip(edges[::2], edges[1::2], strict=True):
        for y in offsets_m:
            drawing.markings.append(Marking((low, y - LINE_HALF_WIDTH_M, high, y + LINE_HALF_WIDTH_M)))


def _add_dashes(drawing: _Drawing, y_m: float, dash_m: float, gap_m: float) -> None:
    for x in np.arange(-STREET_REACH_M + 2.0, STREET_REACH_M - dash_m, dash_m + gap_m):
        if all(x + dash_m < low or x > high for low, high in drawing.holes(6.5)):
            rectangle = (float(x), y_m - LINE_HALF_WIDTH_M, float(x) + dash_m, y_m + LINE_HALF_WIDTH_M)
            drawing.markings.append(Marking(rectangle))


def _add_bays(drawing: _Drawing, side: float, edge_m: float, rng: np.random.Generator) -> None:
    """Bays along a kerb, away from junctions; most cars stand as the lane beside them goes."""
    pitch = float(rng.uniform(5.6, 6.3))
    middle = edge_m + 0.5 * _BAY_M
    for x in np.arange(-STREET_REACH_M + 6.0 + rng.uniform(0.0, pitch), STREET_REACH_M - 6.0, pitch):
        if any(low < x + 0.5 * pitch and x - 0.5 * pitch < high for low, high in drawing.holes(9.0)):
            continue
        low, high = sorted((side * edge_m, side * (edge_m + _BAY_M)))
        drawing.markings.append(Marking((x - 0.5 * pitch - 0.05, low, x - 0.5 * pitch + 0.05, high), 0.74))
        yaw = (0.0 if side < 0.0 else np.pi) + (np.pi if rng.random() < 0.08 else 0.0)
        drawing.slots.append(Slot(float(x), side * middle, yaw, pitch - 0.6, parked=True))


def _main_lane(drawing: _Drawing, side: float, offset_m: float, *, is_cycle_lane: bool = False) -> Lane:
    """A lane of the main street: side -1 goes with the ego vehicle, +1 against it."""
    traffic = drawing.traffic
    forward = side < 0.0
    lines, closed = [], []
    for junction in drawing.junctions:
        before, after = (junction.west_m, junction.east_m) if forward else (-junction.east_m, -junction.west_m)
        if not junction.main_moves:
            line = before - junction.line_m
            lines.append(line + STREET_REACH_M)
            # the crossings before and behind the side street are for people now
            closed.append((line + 0.3 + STREET_REACH_M, after + junction.line_m + STREET_REACH_M))
    if not is_cycle_lane:
        for x in np.arange(-78.0, 79.0, 13.0):
            drawing.slots.append(Slot(float(x), side * offset_m, 0.0 if forward else np.pi, 12.0, parked=False))
    return Lane(
        (-STREET_REACH_M if forward else STREET_REACH_M, side * offset_m),
        0.0 if forward else np.pi,
        2.0 * STREET_REACH_M,
        traffic.cyclist_gap_m if is_cycle_lane else traffic.gap_m,
        traffic.kind_shares,
        traffic.queue,
        tuple(lines),
        tuple(closed),
    )


def _add_side_street(drawing: _Drawing, junction: _Junction, rng: np.random.Generator) -> None:
    half, traffic = drawing.half_m, drawing.traffic
    centre, lane = junction.centre_m, junction.lane_m
    for side in junction.arms:
        low, high = sorted((side * half, side * SIDE_REACH_M))
        drawing.asphalt.append((junction.west_m, low, junction.east_m, high))
        for y in np.arange(half + 8.0, SIDE_REACH_M - 3.0, 6.0):
            dash = sorted((side * y, side * (y + 3.0)))
            drawing.markings.append(Marking((centre - LINE_HALF_WIDTH_M, dash[0], centre + LINE_HALF_WIDTH_M, dash[1])))
        stop = sorted((centre, centre - side * lane))
        line = sorted((side * (half + _LINE_M), side * (half + _LINE_M + 0.4)))
        drawing.markings.append(Marking((stop[0] + 0.1, line[0], stop[1] - 0.1, line[1])))
        if junction.half_m > lane + 1.0:
            for y in np.arange(half + 13.0 + rng.uniform(0.0, 5.0), SIDE_REACH_M - 8.0, 6.0):
                for kerb in (-1.0, 1.0):
                    yaw = 0.5 * np.pi * kerb + (np.pi if rng.random() < 0.1 else 0.0)
                    x = centre + kerb * (lane + 0.5 * _BAY_M)
                    drawing.slots.append(Slot(x, side * float(y), yaw, 5.2, parked=True))
    up, down = 1.0 in junction.arms, -1.0 in junction.arms
    bottom, top = (-SIDE_REACH_M if down else half, SIDE_REACH_M if up else -half)
    for direction in (1.0, -1.0):
        start, end = (bottom, top) if direction > 0.0 else (top, bottom)
        enters = down if direction > 0.0 else up  # there is an arm that it comes from
        lines, closed = (), ()
        if enters and junction.main_moves:
            line = abs(start) - half - _LINE_M
            lines, closed = (line,), ((line + 0.3, abs(start) + half),)
        if abs(end - start) < 10.0:
            continue
        drawing.lanes.append(
            Lane(
                (centre + direction * 0.5 * lane, start),
                direction * 0.5 * np.pi,
                abs(end - start),
                traffic.gap_m,
                traffic.kind_shares,
                0.6 * traffic.queue,
                lines,
                closed,
            )
        )
    if junction.has_crossings:
        for x in (junction.west_m - _CROSSING_M - 1.0, junction.east_m + 1.0):
            for y in np.arange(-half + 0.5, half - 0.8, 1.0):
                drawing.markings.append(Marking((x, float(y), x + _CROSSING_M, float(y) + 0.5)))
            drawing.crossings.append((x, -half, x + _CROSSING_M, half))
    if not junction.main_moves:
        drawing.open_crossings += drawing.crossings[-2:] if junction.has_crossings else []


def _add_blocks(drawing: _Drawing) -> None:
    """Houses on both sides, open where side streets lead away, and at the end of every street."""
    half, pavement = drawing.half_m, drawing.pavement_m
    for side in (-1.0, 1.0):
        facing = "north" if side < 0.0 else "south"
        arms = [junction for junction in drawing.junctions if side in junction.arms]
        depth = SIDE_REACH_M if arms else half + _BLOCK_DEPTH_M
        low, high = sorted((side * half, side * depth))
        edges = [-STREET_REACH_M, *(x for arm in arms for x in (arm.west_m, arm.east_m)), STREET_REACH_M]
        for k, (west, east) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
            fronts = [facing, *(["west"] if k > 0 else []), *(["east"] if k < len(arms) else [])]
            corner = _KERB_RADIUS_M if arms else 0.0
            drawing.blocks.append(Block((west, low, east, high), pavement, tuple(fronts), corner))
        for arm in arms:
            low, high = sorted((side * depth, side * (depth + _BLOCK_DEPTH_M)))
            drawing.blocks.append(Block((arm.west_m - 10.0, low, arm.east_m + 10.0, high), 2.5, (facing,)))
    end = half + 10.0
    for sign, front in ((1.0, "west"), (-1.0, "east")):
        low, high = sorted((sign * STREET_REACH_M, sign * (STREET_REACH_M + _BLOCK_DEPTH_M)))
        drawing.blocks.append(Block((low, -end, high, end), 2.5, (front,)))


USERS_REACH_M = 80.0
"""Road users are no farther from the ego vehicle."""
_FURNITURE_REACH_M, _FRAMES_WITHIN_M = 90.0, 45.0
_CLEARANCE_M, _AHEAD_M = 0.30, 1.2
_STEP_OUT_GAP_M = 0.75  # between parked cars, for somebody to step out
_CHILD_M = (1.0, 1.2)
_TRIES = 10
_CORNER_M = 3.0
_KERB_CLEAR_M = 0.5  # people on the road step no nearer to the kerb
_GRADE_SHARE, _GRADE = 0.4, (0.02, 0.06)

_KINDS = {"hatchback": 0.25, "saloon": 0.18, "estate": 0.14, "suv": 0.18, "van": 0.12, "lorry": 0.07, "bus": 0.06}
_HIDING_KINDS = {"hatchback": 0.2, "saloon": 0.14, "estate": 0.1, "suv": 0.16, "van": 0.15, "lorry": 0.13, "bus": 0.12}
_TRAFFIC = {
    "urban": Traffic(
        gap_m=(4.0, 18.0),
        queue=2.5,
        cyclist_gap_m=(3.0, 32.0),
        kind_shares=_KINDS,
        parked_share=0.72,
        pavement_m=24.0,
        crossing=2.0,
        stepping_out=0.03,
        beside=0.12,
        children=0.3,
        double_parked=0.15,
    ),
    "dense": Traffic(
        gap_m=(2.5, 6.0),
        queue=7.0,
        cyclist_gap_m=(1.5, 10.0),
        kind_shares=_HIDING_KINDS,
        parked_share=0.94,
        pavement_m=8.0,
        crossing=6.0,
        stepping_out=0.16,
        beside=0.6,
        children=1.6,
        double_parked=0.5,
    ),
}


def street_world(level: str, rng: np.random.Generator, world: LevelWorld) -> None:
    """Build a street of a level and its traffic into a world."""
    traffic = _TRAFFIC[level]
    plan = _street_plan(traffic, rng)
    ahead, behind = rng.uniform(*_GRADE, 2) * rng.choice([-1.0, 1.0], 2)
    is_level = rng.random() >= _GRADE_SHARE
    ground = StreetGround() if is_level else StreetGround(0.0, ahead, behind, reach_m=130.0, only_bends=True)
    furnishing = furnish(plan.layout, rng, ground, reach_m=_FURNITURE_REACH_M)
    scenery = SceneryBuilder(rng, ground, detailed_within_m=_FRAMES_WITHIN_M)
    for rectangle in plan.layout.asphalt_m:
        scenery.add_asphalt(rectangle)
    for marking in (*plan.layout.markings, *furnishing.markings):
        scenery.add_marking(marking)
    for block in plan.layout.blocks:
        scenery.add_block(block)
    world.begin(scenery, ground, plan.layout.ego, furnishing.meshes, furnishing.footprints)
    life = _Life(plan, traffic, world, rng)
    life.park()
    life.go_beside()
    life.step_out()
    life.cross()
    life.drive()
    life.walk()
    world.set_lines([line for lane in (*plan.lanes, *plan.cycle_lanes) for line in lane.lines()])


class _Life:
    """Puts road users into a world, those first whom the others have to leave room for."""

    def __init__(self, plan: _StreetPlan, traffic: Traffic, world: LevelWorld, rng: np.random.Generator) -> None:
        self._plan, self._traffic, self._world, self._rng = plan, traffic, world, rng
        self._side = float(np.sign(plan.layout.ego.y_m))  # on which the ego vehicle drives
        self._bays: list[tuple[Slot, PlacedVehicle]] = []

    def park(self) -> None:
        """Fill bays; somebody with a lorry, bus or van stands in a lane."""
        rng = self._rng
        for slot in self._plan.layout.slots:
            if not slot.parked or rng.random() >= self._traffic.parked_share or not self._is_near(slot.x_m, slot.y_m):
                continue
            drawn = drawn_vehicle(self._traffic.kind_shares, rng)
            size = drawn.size_m
            if size[0] > slot.room_m or drawn.kind in LONG_KINDS:
                continue
            yaw = slot.yaw_rad + rng.uniform(-0.02, 0.02)
            shift = rng.uniform(-0.5, 0.5) * (slot.room_m - size[0])
            along, across = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
            x, y = np.array([slot.x_m, slot.y_m]) + shift * along + rng.uniform(-0.08, 0.08) * across
            footprint = Footprint(float(x), float(y), float(np.arctan2(along[1], along[0])), *map(float, size[:2]))
            vehicle = self._world.put_vehicle(drawn, footprint, None, gap_m=_CLEARANCE_M)
            if vehicle is not None:
                self._bays.append((slot, vehicle))
        if rng.random() < self._traffic.double_parked:
            self._double_park()

    def _double_park(self) -> None:
        rng = self._rng
        lanes = [lane for lane in self._plan.lanes if abs(np.sin(lane.yaw_rad)) < 0.5]
        for _ in range(_TRIES):
            lane = lanes[int(rng.integers(len(lanes)))]
            kind = ("lorry", "bus", "van")[int(rng.integers(3))]
            drawn = drawn_vehicle({kind: 1.0}, rng)
            x, y = lane.at(rng.uniform(40.0, 150.0), -0.35)
            in_junction = any(r[0] - 6.0 < x < r[2] + 6.0 for r in self._plan.layout.asphalt_m[1:])
            ego_y_m = self._plan.layout.ego.y_m
            if in_junction or (abs(y - ego_y_m) < 2.2 and abs(x) < 14.0):
                continue
            footprint = Footprint(float(x), float(y), lane.yaw_rad, *map(float, drawn.size_m[:2]))
            if self._world.put_vehicle(drawn, footprint, None, gap_m=0.1) is not None:
                return

    def go_beside(self) -> None:
        """Cyclists beside and behind the ego vehicle, children near it."""
        rng, ego = self._rng, self._plan.layout.ego
        for side in (-1.0, 1.0):
            if rng.random() < self._traffic.beside:
                for _ in range(_TRIES):
                    place = np.array([rng.uniform(-9.0, 3.5), ego.y_m + side * rng.uniform(1.45, 2.1)])
                    # between two lanes of one direction and at the kerb cyclists go with the ego vehicle
                    if place[1] * self._side > 0.1 and self._person("cyclist", place, rng.normal(0.0, 0.03)):
                        break
        for _ in range(int(rng.poisson(self._traffic.children))):
            for _ in range(_TRIES):
                angle, distance = rng.uniform(-np.pi, np.pi), rng.uniform(0.4, 2.6)
                edge = np.array([2.35, 1.05]) + distance
                place = np.array([edge[0] * np.cos(angle), ego.y_m + edge[1] * np.sin(angle)])
                if abs(place[1] - ego.y_m) > 1.5 and self._person("child", place, rng.uniform(-np.pi, np.pi)):
                    break

    def step_out(self) -> None:
        """People who come out between parked cars."""
        rng = self._rng
        for (slot, one), (other_slot, other) in pairwise(self._bays):
            a, b = one.footprint, other.footprint
            if slot.y_m != other_slot.y_m or abs(np.sin(slot.yaw_rad)) > 0.5:
                continue
            gap = abs(b.x_m - a.x_m) - 0.5 * (a.length_m + b.length_m)
            if not _STEP_OUT_GAP_M <= gap <= 4.0 or rng.random() >= self._traffic.stepping_out:
                continue
            inward = -float(np.sign(slot.y_m))
            x = 0.5 * (a.x_m + 0.5 * a.length_m + b.x_m - 0.5 * b.length_m)
            place = np.array([x, slot.y_m + inward * rng.uniform(0.2, 1.25)])
            heading = inward * 0.5 * np.pi + rng.normal(0.0, 0.2)
            self._person("pedestrian" if rng.random() < 0.75 else "child", place, heading)

    def cross(self) -> None:
        """People on the crossings of a street that waits, and some who cross anywhere."""
        rng = self._rng
        for low_x, low_y, high_x, high_y in self._plan.open_crossings:
            for _ in range(int(rng.poisson(self._traffic.crossing))):
                place = rng.uniform([low_x + 0.3, low_y - 0.5], [high_x - 0.3, high_y + 0.5])
                heading = 0.5 * np.pi * (1.0 if rng.random() < 0.5 else -1.0)
                self._person("pedestrian", place, heading + rng.normal(0.0, 0.1))

    def drive(self) -> None:
        """Everybody in lanes, and cyclists in cycle lanes and at the edges of others."""
        rng = self._rng
        for lane in self._plan.lanes:
            draw = partial(drawn_vehicle, lane.kind_shares, rng)
            for drawn, footprint in lane_vehicles(lane, draw, rng):
                if self._is_near(footprint.x_m, footprint.y_m) and self._leaves_room(footprint):
                    self._world.put_vehicle(drawn, footprint, lane.yaw_rad, gap_m=_CLEARANCE_M)
        for lane in self._plan.cycle_lanes:
            for middle_m, _ in lane_positions(lane, lambda: _CYCLIST_M, rng):
                self._person("cyclist", lane.at(middle_m, rng.uniform(-0.3, 0.3)), lane.yaw_rad + rng.normal(0.0, 0.03))
        if not self._plan.cycle_lanes:
            for lane in self._plan.lanes:
                for _ in range(int(rng.poisson(lane.length_m / (6.0 * sum(self._traffic.cyclist_gap_m))))):
                    place = lane.at(rng.uniform(0.0, lane.length_m), -rng.uniform(0.9, 1.3))
                    self._person("cyclist", place, lane.yaw_rad + rng.normal(0.0, 0.03))

    def walk(self) -> None:
        """People on pavements."""
        rng = self._rng
        for strip in strips(self._plan.layout):
            span = strip.span_m(np.zeros(2), USERS_REACH_M)
            if span is None:
                continue
            low, high = span
            for _ in range(int(rng.poisson((high - low) / self._traffic.pavement_m))):
                place = strip.at(rng.uniform(low, high), rng.uniform(0.4, strip.depth_m - 0.4))
                heading = strip.yaw_rad + (np.pi if rng.random() < 0.5 else 0.0) + rng.normal(0.0, 0.15)
                self._person("pedestrian", place, heading)

    def _person(self, category: str, place_m: np.ndarray, yaw_rad: float) -> bool:
        """Put somebody on the road or a pavement; False where there is no room."""
        if not self._is_near(*place_m):
            return False
        share = self._pavement_share(place_m)
        if share is None or (category == "cyclist" and share >= 0.0):
            return False
        height = float(self._rng.uniform(*_CHILD_M)) if category == "child" else None
        return self._world.put_person(
            "cyclist" if category == "cyclist" else "pedestrian", place_m, yaw_rad, share, height_m=height
        )

    def _pavement_share(self, place_m: np.ndarray) -> float | None:
        """How far from kerb to houses, 0..1; -1 on the road, None in a house or on a kerb."""
        for x_low, y_low, x_high, y_high in self._plan.layout.asphalt_m:
            inset_m = min(place_m[0] - x_low, x_high - place_m[0], place_m[1] - y_low, y_high - place_m[1])
            if inset_m >= _KERB_CLEAR_M:
                return -1.0
        for block in self._plan.layout.blocks:
            x_low, y_low, x_high, y_high = block.rectangle_m
            insets = (place_m[0] - x_low, x_high - place_m[0]), (place_m[1] - y_low, y_high - place_m[1])
            inset, other = sorted(map(min, insets))
            if inset >= 0.0:
                is_pavement = 0.35 <= inset <= block.pavement_m - 0.35 and other >= _CORNER_M  # kerbs are round there
                return inset / block.pavement_m if is_pavement else None
        return None

    def _is_near(self, x_m: float, y_m: float) -> bool:
        return bool(np.hypot(x_m, y_m - self._plan.layout.ego.y_m) <= USERS_REACH_M)

    def _leaves_room(self, footprint: Footprint) -> bool:
        """Whether a vehicle keeps its distance ahead of and behind the ego vehicle in its lane."""
        ego = self._plan.layout.ego
        beside = abs(footprint.y_m - ego.y_m) > 2.4 or abs(np.sin(footprint.yaw_rad)) > 0.5
        return beside or abs(footprint.x_m) - 0.5 * footprint.length_m > 2.35 + _AHEAD_M
