"""Plans of long streets with junctions, for the levels urban and dense: what drives and stands where, and who waits.

Town frame as in `town_layout`. A street has, from its middle: lanes, maybe a cycle lane, maybe parking bays, pavement,
houses. At every junction either the main street moves and the side street waits, or the other way round.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from warpav.scene.town._houses import SceneryBuilder
from warpav.scene.town._level_world import LevelWorld
from warpav.scene.town._placed_vehicle import LONG_KINDS, PlacedVehicle, drawn_vehicle, lane_positions, lane_vehicles
from warpav.scene.town._street_life import furnish, strips
from warpav.scene.town._surface_builder import StreetGround
from warpav.scene.town._town_layout import (
    Block,
    Footprint,
    Lane,
    Layout,
    Marking,
    Rectangle,
    Slot,
    dashes,
    ends,
    line,
    side_street_markings,
    stripes,
)

_REACH_M, _SIDE_REACH_M = 95.0, 80.0  # where the main street ends, and the side streets, in front of houses
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


class _Plan:
    """A plan as it grows."""

    def __init__(self, traffic: Traffic, rng: np.random.Generator) -> None:
        self._traffic, self._rng = traffic, rng
        self._markings: list[Marking] = []
        self._slots: list[Slot] = []  # parking bays, and places in lanes for road works
        self._lanes: list[Lane] = []
        self._blocks: list[Block] = []
        self._crossings: list[Rectangle] = []
        self._open_crossings: list[Rectangle] = []
        lane = float(rng.uniform(3.1, 3.5))
        count = 2 if rng.random() < 0.4 else 1
        cycle = _CYCLE_LANE_M if rng.random() < 0.5 else 0.0
        parks = rng.random() < (0.8 if count == 1 else 0.55)
        self._half_m = half = count * lane + cycle + (_BAY_M if parks else 0.25)
        self._pavement_m = float(rng.uniform(2.6, 4.4))
        self._junctions = self._drawn_junctions()
        self._asphalt: list[Rectangle] = [(-_REACH_M, -half, _REACH_M, half)]
        cycle_lanes: list[Lane] = []

        if count == 1:
            self._add_dashes(0.0, 3.0, 3.0)
        else:
            edges = [-_REACH_M, *(x for hole in self._holes(1.0) for x in hole), _REACH_M]
            pieces = zip(edges[::2], edges[1::2], strict=True)
            self._markings += [line(y, low, high) for low, high in pieces for y in (-0.11, 0.11)]
        for side in (-1.0, 1.0):
            for index in range(1, count):
                self._add_dashes(side * index * lane, 3.0, 4.5)
            if cycle:
                self._add_dashes(side * count * lane, 1.0, 0.5)
            if parks:
                self._add_bays(side, count * lane + cycle)
            for index in range(count):
                offset_m = (index + 0.5) * lane
                self._lanes.append(self._main_lane(side, offset_m, traffic.gap_m))
                yaw = 0.0 if side < 0.0 else np.pi
                self._slots += [Slot(float(x), side * offset_m, yaw, 12.0) for x in np.arange(-78.0, 79.0, 13.0)]
            if cycle:
                cycle_lanes.append(self._main_lane(side, count * lane + 0.5 * cycle, traffic.cyclist_gap_m))
        for junction in self._junctions:
            self._add_side_street(junction)
        self._add_blocks()
        layout = Layout(
            "street" if count == 1 else "avenue",
            tuple(self._asphalt),
            tuple(self._blocks),
            tuple(self._markings),
            tuple(self._slots),
            Slot(0.0, -(int(rng.integers(count)) + 0.5) * lane, 0.0, 5.0),
            tuple(self._crossings),
            tuple(self._open_crossings),
            tuple(self._lanes),
            tuple(cycle_lanes),
        )
        self.layout = layout.mirrored() if rng.random() < 0.5 else layout

    def _holes(self, margin_m: float) -> list[tuple[float, float]]:
        """Stretches of the main street in and around its junctions."""
        return [(each.west_m - margin_m, each.east_m + margin_m) for each in self._junctions]

    def _drawn_junctions(self) -> list[_Junction]:
        """One to three side streets; the ego vehicle stands in none whose traffic moves."""
        rng = self._rng
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

    def _add_dashes(self, y_m: float, dash_m: float, gap_m: float) -> None:
        self._markings += dashes(y_m, dash=dash_m, gap=gap_m, holes=self._holes(6.5), reach_m=_REACH_M)

    def _add_bays(self, side: float, edge_m: float) -> None:
        """Bays along a kerb, away from junctions; most cars stand as the lane beside them goes."""
        rng = self._rng
        pitch = float(rng.uniform(5.6, 6.3))
        for x in np.arange(-_REACH_M + 6.0 + rng.uniform(0.0, pitch), _REACH_M - 6.0, pitch):
            if any(low < x + 0.5 * pitch and x - 0.5 * pitch < high for low, high in self._holes(9.0)):
                continue
            low, high = sorted((side * edge_m, side * (edge_m + _BAY_M)))
            self._markings.append(Marking((x - 0.5 * pitch - 0.05, low, x - 0.5 * pitch + 0.05, high), 0.74))
            yaw = (0.0 if side < 0.0 else np.pi) + (np.pi if rng.random() < 0.08 else 0.0)
            self._slots.append(Slot(float(x), side * (edge_m + 0.5 * _BAY_M), yaw, pitch - 0.6, parked=True))

    def _main_lane(self, side: float, offset_m: float, gap_m: tuple[float, float]) -> Lane:
        """A lane of the main street: side -1 goes with the ego vehicle, +1 against it."""
        forward = side < 0.0
        lines, closed = [], []
        for junction in self._junctions:
            before, after = (junction.west_m, junction.east_m) if forward else (-junction.east_m, -junction.west_m)
            if not junction.main_moves:
                stop = before - junction.line_m
                lines.append(stop + _REACH_M)
                # the crossings before and behind the side street are for people now
                closed.append((stop + 0.3 + _REACH_M, after + junction.line_m + _REACH_M))
        return Lane(
            (-_REACH_M if forward else _REACH_M, side * offset_m),
            0.0 if forward else np.pi,
            2.0 * _REACH_M,
            gap_m,
            self._traffic.kind_shares,
            self._traffic.queue,
            tuple(lines),
            tuple(closed),
        )

    def _add_side_street(self, junction: _Junction) -> None:
        half, rng, traffic = self._half_m, self._rng, self._traffic
        centre, lane = junction.centre_m, junction.lane_m
        for side in junction.arms:
            low, high = sorted((side * half, side * _SIDE_REACH_M))
            self._asphalt.append((junction.west_m, low, junction.east_m, high))
            stop_m = (half + _LINE_M, half + _LINE_M + 0.4)
            self._markings += side_street_markings(centre, side, (half + 8.0, _SIDE_REACH_M - 3.0), stop_m, lane)
            if junction.half_m > lane + 1.0:
                for y in np.arange(half + 13.0 + rng.uniform(0.0, 5.0), _SIDE_REACH_M - 8.0, 6.0):
                    for kerb in (-1.0, 1.0):
                        yaw = 0.5 * np.pi * kerb + (np.pi if rng.random() < 0.1 else 0.0)
                        x = centre + kerb * (lane + 0.5 * _BAY_M)
                        self._slots.append(Slot(x, side * float(y), yaw, 5.2, parked=True))
        up, down = 1.0 in junction.arms, -1.0 in junction.arms
        bottom, top = (-_SIDE_REACH_M if down else half, _SIDE_REACH_M if up else -half)
        for direction, start, end, enters in ((1.0, bottom, top, down), (-1.0, top, bottom, up)):
            lines, closed = (), ()
            if enters and junction.main_moves:  # there is an arm that it comes from
                stop = abs(start) - half - _LINE_M
                lines, closed = (stop,), ((stop + 0.3, abs(start) + half),)
            if abs(end - start) < 10.0:
                continue
            place, yaw = (centre + direction * 0.5 * lane, start), direction * 0.5 * np.pi
            length, queue = abs(end - start), 0.6 * traffic.queue
            self._lanes.append(Lane(place, yaw, length, traffic.gap_m, traffic.kind_shares, queue, lines, closed))
        if junction.has_crossings:
            for x in (junction.west_m - _CROSSING_M - 1.0, junction.east_m + 1.0):
                self._markings += stripes(x, half, _CROSSING_M)
                self._crossings.append((x, -half, x + _CROSSING_M, half))
            if not junction.main_moves:
                self._open_crossings += self._crossings[-2:]

    def _add_blocks(self) -> None:
        """Houses on both sides, open where side streets lead away, and at the end of every street."""
        half, pavement = self._half_m, self._pavement_m
        for side in (-1.0, 1.0):
            facing = "north" if side < 0.0 else "south"
            arms = [junction for junction in self._junctions if side in junction.arms]
            depth = _SIDE_REACH_M if arms else half + _BLOCK_DEPTH_M
            low, high = sorted((side * half, side * depth))
            edges = [-_REACH_M, *(x for arm in arms for x in (arm.west_m, arm.east_m)), _REACH_M]
            for k, (west, east) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
                fronts = [facing, *(["west"] if k > 0 else []), *(["east"] if k < len(arms) else [])]
                corner = _KERB_RADIUS_M if arms else 0.0
                self._blocks.append(Block((west, low, east, high), pavement, tuple(fronts), corner))
            for arm in arms:
                low, high = sorted((side * depth, side * (depth + _BLOCK_DEPTH_M)))
                self._blocks.append(Block((arm.west_m - 10.0, low, arm.east_m + 10.0, high), 2.5, (facing,)))
        self._blocks += ends(half, _REACH_M)


_USERS_REACH_M = 80.0  # road users are no farther from the ego vehicle
_FURNITURE_REACH_M = 90.0
FRAMES_WITHIN_M = 45.0  # of the ego vehicle, windows have frames
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


def street_world(level: str, rng: np.random.Generator, users_rng: np.random.Generator) -> LevelWorld:
    traffic = _TRAFFIC[level]
    plan = _Plan(traffic, rng).layout
    ahead, behind = rng.uniform(*_GRADE, 2) * rng.choice([-1.0, 1.0], 2)
    is_level = rng.random() >= _GRADE_SHARE
    ground = StreetGround() if is_level else StreetGround(0.0, ahead, behind, reach_m=130.0, only_bends=True)
    furnishing = furnish(plan, rng, ground, reach_m=_FURNITURE_REACH_M)
    scenery = SceneryBuilder(rng, ground, detailed_within_m=FRAMES_WITHIN_M)
    scenery.add_plan(plan, furnishing.markings)
    world = LevelWorld(scenery, ground, plan.ego, furnishing.meshes, furnishing.footprints, users_rng)
    life = _Life(plan, traffic, world, rng)
    life.park()
    life.go_beside()
    life.step_out()
    life.cross()
    life.drive()
    life.walk()
    world.lines = [each for lane in (*plan.lanes, *plan.cycle_lanes) for each in lane.lines()]
    return world


class _Life:
    """Puts road users into a world, those first whom the others have to leave room for."""

    def __init__(self, plan: Layout, traffic: Traffic, world: LevelWorld, rng: np.random.Generator) -> None:
        self._plan, self._traffic, self._world, self._rng = plan, traffic, world, rng
        self._side = float(np.sign(plan.ego.y_m))  # on which the ego vehicle drives
        self._bays: list[tuple[Slot, PlacedVehicle]] = []

    def park(self) -> None:
        """Fill bays; somebody with a lorry, bus or van stands in a lane."""
        rng = self._rng
        for slot in self._plan.slots:
            if not slot.parked or rng.random() >= self._traffic.parked_share or not self._is_near(slot.x_m, slot.y_m):
                continue
            drawn = drawn_vehicle(self._traffic.kind_shares, rng)
            size = drawn.size_m
            if size[0] > slot.room_m or drawn.kind in LONG_KINDS:
                continue
            yaw = slot.yaw_rad + rng.uniform(-0.02, 0.02)
            shift = rng.uniform(-0.5, 0.5) * (slot.room_m - size[0])
            along, across = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
            place = np.array([slot.x_m, slot.y_m]) + shift * along + rng.uniform(-0.08, 0.08) * across
            footprint = Footprint.at(place, yaw, size)
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
            in_junction = any(r[0] - 6.0 < x < r[2] + 6.0 for r in self._plan.asphalt_m[1:])
            ego_y_m = self._plan.ego.y_m
            if in_junction or (abs(y - ego_y_m) < 2.2 and abs(x) < 14.0):
                continue
            footprint = Footprint(float(x), float(y), lane.yaw_rad, *map(float, drawn.size_m[:2]))
            if self._world.put_vehicle(drawn, footprint, None, gap_m=0.1) is not None:
                return

    def go_beside(self) -> None:
        """Cyclists beside and behind the ego vehicle, children near it."""
        rng, ego = self._rng, self._plan.ego
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
        for low_x, low_y, high_x, high_y in self._plan.open_crossings_m:
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
                # nobody comes too near ahead of and behind the ego vehicle in its lane
                beside = abs(footprint.y_m - self._plan.ego.y_m) > 2.4 or abs(np.sin(footprint.yaw_rad)) > 0.5
                leaves_room = beside or abs(footprint.x_m) - 0.5 * footprint.length_m > 2.35 + _AHEAD_M
                if self._is_near(footprint.x_m, footprint.y_m) and leaves_room:
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
        rng = self._rng
        for strip in strips(self._plan):
            span = strip.span_m(np.zeros(2), _USERS_REACH_M)
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
        for x_low, y_low, x_high, y_high in self._plan.asphalt_m:
            inset_m = min(place_m[0] - x_low, x_high - place_m[0], place_m[1] - y_low, y_high - place_m[1])
            if inset_m >= _KERB_CLEAR_M:
                return -1.0
        for block in self._plan.blocks:
            x_low, y_low, x_high, y_high = block.rectangle_m
            insets = (place_m[0] - x_low, x_high - place_m[0]), (place_m[1] - y_low, y_high - place_m[1])
            inset, other = sorted(map(min, insets))
            if inset >= 0.0:
                is_pavement = 0.35 <= inset <= block.pavement_m - 0.35 and other >= _CORNER_M  # kerbs are round there
                return inset / block.pavement_m if is_pavement else None
        return None

    def _is_near(self, x_m: float, y_m: float) -> bool:
        return bool(np.hypot(x_m, y_m - self._plan.ego.y_m) <= _USERS_REACH_M)
