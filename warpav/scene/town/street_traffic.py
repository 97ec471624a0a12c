"""Who is in a long street, for the levels urban and dense: parked, queueing, crossing, stepping out, beside the ego."""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import numpy as np

from warpav.scene.town.ground import StreetGround
from warpav.scene.town.houses import SceneryBuilder
from warpav.scene.town.lanes import lane_positions, lane_vehicles
from warpav.scene.town.level_world import LevelWorld
from warpav.scene.town.placed_vehicle import LONG_KINDS, PlacedVehicle, drawn_vehicle
from warpav.scene.town.street_life import Footprint, furnish, strips
from warpav.scene.town.street_plan import StreetPlan, Traffic, street_plan
from warpav.scene.town.town_layout import Slot

USERS_REACH_M = 80.0
"""Road users are no farther from the ego vehicle."""
_FURNITURE_REACH_M, _FRAMES_WITHIN_M = 90.0, 45.0
_CLEARANCE_M, _AHEAD_M = 0.30, 1.2
_CYCLIST_M = 1.9
_STEP_OUT_GAP_M = 0.75  # between parked cars, for somebody to step out
_CHILD_M = (1.0, 1.2)
_TRIES = 10
_CORNER_M = 3.0
_KERB_CLEAR_M = 0.5  # people on the road step no nearer to the kerb
_GRADE_SHARE, _GRADE = 0.4, (0.02, 0.06)

_KINDS = {"hatchback": 0.25, "saloon": 0.18, "estate": 0.14, "suv": 0.18, "van": 0.12, "lorry": 0.07, "bus": 0.06}
_HIDING_KINDS = {"hatchback": 0.2, "saloon": 0.14, "estate": 0.1, "suv": 0.16, "van": 0.15, "lorry": 0.13, "bus": 0.12}
TRAFFIC = {
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
    traffic = TRAFFIC[level]
    plan = street_plan(traffic, rng)
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

    def __init__(self, plan: StreetPlan, traffic: Traffic, world: LevelWorld, rng: np.random.Generator) -> None:
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
