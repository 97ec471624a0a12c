"""The level motorway: two carriageways, what stands beside and over them, and fast traffic far ahead and behind.

Town frame as in `town_layout`: x along the carriageway of the ego vehicle, y left; in half of the scenes everything is
mirrored, and traffic keeps to the left.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.scene._scene import yaw_rotation
from warpav.scene.town._furniture import furniture_mesh
from warpav.scene.town._houses import SceneryBuilder, cells_of
from warpav.scene.town._level_world import LevelWorld
from warpav.scene.town._placed_vehicle import LONG_KINDS, drawn_vehicle, lane_vehicles
from warpav.scene.town._surface_builder import StreetGround
from warpav.scene.town._town_layout import Footprint, Lane, Marking, Slot

_MOTORWAY_REACH_M = 232.0
_USERS_REACH_M = 200.0  # road users are no farther from the ego vehicle
_FIELD_M = 130.0  # from the middle to the edge of the ground
_INNER_SHOULDER_M, _VERGE_M = 0.8, 7.0
_CURVE_M = 90.0  # in which the road bends from level to its grade
_GRADE_SHARE, _GRADE = 0.5, (0.01, 0.04)
_ROAD_CELL_M, _GRASS_CELL_M = 14.0, 22.0
_LINE_HALF_M = 0.08
_BRIDGE_CLEARANCE_M = 5.0
_CLEARANCE_M, _EGO_LENGTH_M = 0.3, 4.7
_STANDING_SHARE = 0.12  # of the scenes have somebody on the hard shoulder
_GRASS, _LEAVES = np.array([0.36, 0.43, 0.24]), np.array([0.24, 0.33, 0.19])
_BARK = np.array([0.25, 0.2, 0.15])
_STEEL, _CONCRETE, _SIGN_BLUE = np.array([0.62, 0.64, 0.66]), np.array([0.66, 0.65, 0.62]), np.array([0.08, 0.22, 0.55])
_WALLS = np.array([(0.45, 0.52, 0.42), (0.60, 0.60, 0.57), (0.55, 0.45, 0.36), (0.42, 0.50, 0.55)])

# From the middle of the road outwards: lowest and highest speed [m/s], and what drives there.
_FAST = ((32.0, 40.0), {"hatchback": 0.18, "saloon": 0.34, "estate": 0.26, "suv": 0.22})
_MIDDLE = ((27.0, 34.0), {"hatchback": 0.26, "saloon": 0.2, "estate": 0.2, "suv": 0.2, "van": 0.14})
_SLOW = (
    (23.0, 27.0),
    {"hatchback": 0.19, "saloon": 0.10, "estate": 0.10, "suv": 0.10, "van": 0.16, "lorry": 0.30, "bus": 0.05},
)
_HEADWAY_S = 1.4  # the smallest gap is what the slowest of a lane drives in this time
_ADDED_GAP_M = (12.0, 45.0)  # of a busy and of a free motorway, on average


@dataclass(frozen=True)
class _Section:
    """A cross-section; y of the ego vehicle's side is ``side`` times these [m]."""

    median_m: float  # half the width of the median, to the inner edge of the asphalt
    lane_m: float  # width of a lane
    lanes: int  # lanes of a carriageway
    shoulder_m: float  # width of the hard shoulder

    @property
    def first_m(self) -> float:
        """Inner edge of the innermost lane."""
        return self.median_m + _INNER_SHOULDER_M

    @property
    def last_m(self) -> float:
        """Outer edge of the outermost lane."""
        return self.first_m + self.lanes * self.lane_m

    @property
    def edge_m(self) -> float:
        """Outer edge of the asphalt."""
        return self.last_m + self.shoulder_m

    def lane_y_m(self, index: int) -> float:
        """Middle of a lane, 0 the innermost."""
        return self.first_m + (index + 0.5) * self.lane_m


def motorway_world(rng: np.random.Generator, users_rng: np.random.Generator) -> LevelWorld:
    section = _Section(rng.uniform(1.2, 2.2), rng.uniform(3.5, 3.75), int(rng.integers(2, 5)), rng.uniform(2.4, 3.2))
    side = 1.0 if rng.random() < 0.5 else -1.0  # of the carriageway of the ego vehicle
    ahead, behind = rng.uniform(*_GRADE, 2) * rng.choice([-1.0, 1.0], 2)
    is_level = rng.random() >= _GRADE_SHARE
    ahead, behind = (0.0, 0.0) if is_level else (ahead, behind)
    ground = StreetGround(0.0, ahead, behind, curve_m=_CURVE_M, reach_m=300.0, only_bends=True)
    scenery = SceneryBuilder(rng, ground)
    _Builder(section, side, scenery, ground, rng).build()
    own = int(rng.choice(section.lanes))
    (slow, fast), _ = _lane_kind(own, section.lanes)
    # round signs on posts, back to back at both edges
    pieces: list[Mesh] = []
    taken: list[Footprint] = []
    for x in rng.uniform(-180.0, 180.0, int(rng.integers(2, 6))):
        y = side * (section.edge_m + 1.6) * (1.0 if rng.random() < 0.7 else -1.0)
        yaw = -0.5 * np.pi if y * side > 0.0 else 0.5 * np.pi  # a sign faces -y of its own frame
        place = np.array([x, y, float(ground.height_m(x))])
        pieces.append(furniture_mesh("sign", rng).transformed(yaw_rotation(yaw), place))
        taken.append(Footprint(float(x), y, yaw, 0.7, 0.3))
    ego = Slot(0.0, side * section.lane_y_m(own), 0.0, 5.0)
    world = LevelWorld(scenery, ground, ego, pieces, taken, users_rng, (slow, fast))
    _drive(section, side, ego, world, rng)
    return world


def _lane_kind(index: int, count: int) -> tuple[tuple[float, float], dict[str, float]]:
    """Speeds and kinds of a lane, 0 the innermost."""
    return _SLOW if index == count - 1 else _FAST if index == 0 else _MIDDLE


def _drive(section: _Section, side: float, ego: Slot, world: LevelWorld, rng: np.random.Generator) -> None:
    added_m = float(rng.uniform(*_ADDED_GAP_M))
    for direction in (1.0, -1.0):
        for index in range(section.lanes):
            free_m_s, kind_shares = _lane_kind(index, section.lanes)
            y = direction * side * section.lane_y_m(index)
            yaw = 0.0 if direction > 0.0 else np.pi
            draw = partial(drawn_vehicle, kind_shares, rng)
            start_m, spacing_m = (-direction * _USERS_REACH_M, y), (_HEADWAY_S * free_m_s[0], added_m)
            lane = Lane(start_m, yaw, 2.0 * _USERS_REACH_M, spacing_m, kind_shares)
            for drawn, footprint in lane_vehicles(lane, draw, rng):
                limits = (free_m_s[0], min(free_m_s[1], free_m_s[0] + 2.5)) if drawn.kind in LONG_KINDS else free_m_s
                gap_m = abs(footprint.x_m) - 0.5 * (drawn.size_m[0] + _EGO_LENGTH_M)
                own_lane = abs(y - ego.y_m) < 1.0 and gap_m < _HEADWAY_S * free_m_s[0]
                in_reach = np.hypot(footprint.x_m, footprint.y_m - ego.y_m) <= _USERS_REACH_M
                if in_reach and not own_lane:
                    world.put_vehicle(drawn, footprint, yaw, gap_m=_CLEARANCE_M, free_m_s=limits)
    if rng.random() < _STANDING_SHARE:
        drawn = drawn_vehicle(_MIDDLE[1], rng)
        y = side * (section.last_m + 0.5 * section.shoulder_m)
        x = float(rng.uniform(15.0, 120.0) * rng.choice([-1.0, 1.0]))
        footprint = Footprint.at(np.array([x, y]), 0.0, drawn.size_m)
        world.put_vehicle(drawn, footprint, None, gap_m=_CLEARANCE_M)


class _Builder:
    """Builds everything that stands, from the middle of the road to the horizon."""

    def __init__(
        self, section: _Section, side: float, scenery: SceneryBuilder, ground: StreetGround, rng: np.random.Generator
    ) -> None:
        self._section, self._side, self._scenery, self._ground, self._rng = section, side, scenery, ground, rng

    def build(self) -> None:
        section, scenery, reach = self._section, self._scenery, _MOTORWAY_REACH_M
        scenery.add_ground((-reach, -section.median_m, reach, section.median_m), 0.0, _GRASS * 0.95, 0.02, _ROAD_CELL_M)
        for sign in (-1.0, 1.0):
            low, high = sorted((sign * section.median_m, sign * section.edge_m))
            scenery.add_asphalt((-reach, low, reach, high), _ROAD_CELL_M)
            low, high = sorted((sign * section.edge_m, sign * _FIELD_M))
            scenery.add_ground((-reach, low, reach, high), 0.0, _GRASS, 0.022, _GRASS_CELL_M)
            self._add_lines(sign)
            # delineators every 50 m
            y = sign * (self._section.edge_m + 0.4)
            for x in np.arange(-200.0 + self._rng.uniform(0.0, 50.0), 200.0, 50.0):
                self._scenery.add_box((x, y - 0.06, 0.0), (x + 0.1, y + 0.06, 1.0), np.full(3, 0.9))
                self._scenery.add_box((x - 0.005, y - 0.065, 0.68), (x + 0.105, y + 0.065, 0.88), np.full(3, 0.12))
            self._add_rail(sign * (section.edge_m + 0.9), sign)
            if self._rng.random() < 0.45:
                self._add_noise_barrier(sign)
            for _ in range(int(self._rng.integers(12, 45))):  # bushes and trees of a few triangles in the fields
                x = float(self._rng.uniform(-reach + 5.0, reach - 5.0))
                y = sign * (section.edge_m + _VERGE_M + 3.0 + float(self._rng.exponential(22.0)))
                if abs(y) < _FIELD_M - 6.0:
                    self._add_tree(x, y, float(self._rng.uniform(2.5, 11.0)))
        if section.median_m > 1.6:
            for sign in (-1.0, 1.0):
                self._add_rail(sign * 0.7, -sign)
        else:  # a concrete wall
            self._scenery.add_box((-reach, -0.15, 0.0), (reach, 0.15, 0.9), _CONCRETE * 0.95, steps=20)
            self._scenery.add_box((-reach, -0.35, 0.0), (reach, 0.35, 0.22), _CONCRETE * 0.9, steps=20)
        for sign in (-1.0, 1.0):
            if self._rng.random() < 0.4:
                self._add_bridge(sign * self._rng.uniform(35.0, 170.0))
            if self._rng.random() < 0.5:
                self._add_gantry(sign * self._rng.uniform(25.0, 190.0), sign)
            self._add_wood(sign * _MOTORWAY_REACH_M)

    def _add_lines(self, sign: float) -> None:
        section, add = self._section, self._scenery.add_marking
        for y in (section.first_m - 0.15, section.last_m + 0.1):
            low, high = sorted((sign * (y - 1.5 * _LINE_HALF_M), sign * (y + 1.5 * _LINE_HALF_M)))
            add(Marking((-_MOTORWAY_REACH_M, low, _MOTORWAY_REACH_M, high)))
        phase = self._rng.uniform(0.0, 18.0)
        for index in range(1, section.lanes):
            y = sign * (section.first_m + index * section.lane_m)
            for x in np.arange(-_MOTORWAY_REACH_M + phase, _MOTORWAY_REACH_M - 6.0, 18.0):
                add(Marking((float(x), y - _LINE_HALF_M, float(x) + 6.0, y + _LINE_HALF_M)))

    def _add_rail(self, y_m: float, faces: float) -> None:
        """A steel beam on posts along the whole road; the posts stand on the side away from the traffic."""
        reach = _MOTORWAY_REACH_M
        self._scenery.add_box((-reach, y_m - 0.06, 0.46), (reach, y_m + 0.06, 0.60), _STEEL * 0.92, steps=20)
        self._scenery.add_box((-reach, y_m - 0.06, 0.63), (reach, y_m + 0.06, 0.77), _STEEL, steps=20)
        for low, high, spacing in ((-reach, -72.0, 12.0), (-72.0, 72.0, 4.0), (72.0, reach, 12.0)):
            for x in np.arange(low, high, spacing):
                y_low, y_high = sorted((y_m + 0.05 * faces, y_m + 0.17 * faces))
                self._scenery.add_box((x, y_low, 0.0), (x + 0.1, y_high, 0.72), _STEEL * 0.7)

    def _add_noise_barrier(self, sign: float) -> None:
        rng = self._rng
        y = sign * (self._section.edge_m + rng.uniform(2.5, 5.0))
        height, panel = float(rng.uniform(2.5, 4.5)), 6.0
        colour = _WALLS[int(rng.integers(len(_WALLS)))]
        start, end = np.sort(rng.uniform(-_MOTORWAY_REACH_M, _MOTORWAY_REACH_M, 2))
        if end - start < 120.0:
            start, end = -_MOTORWAY_REACH_M, _MOTORWAY_REACH_M
        for x in np.arange(start, end - panel, panel):
            shade = colour * rng.uniform(0.95, 1.03)
            self._scenery.add_box((x, y - 0.08, 0.0), (x + panel - 0.25, y + 0.08, 0.5), _CONCRETE * 0.85)
            self._scenery.add_box((x, y - 0.06, 0.5), (x + panel - 0.25, y + 0.06, height), shade)
            self._scenery.add_box((x + panel - 0.25, y - 0.12, 0.0), (x + panel, y + 0.12, height + 0.1), _STEEL * 0.6)

    def _add_bridge(self, x_m: float) -> None:
        """A road over the motorway: a slab with parapets on a pier in the median and walls outside."""
        rng, half = self._rng, 0.5 * self._rng.uniform(7.0, 12.0)
        outer = self._section.edge_m + 3.0
        height = _BRIDGE_CLEARANCE_M + float(rng.uniform(0.0, 0.8))
        add, colour = self._scenery.add_level_box, _CONCRETE * rng.uniform(0.9, 1.05)
        add((x_m - half, -outer - 6.0, height), (x_m + half, outer + 6.0, height + 1.1), colour)
        for end in (-1.0, 1.0):
            low, high = sorted((x_m + end * half, x_m + end * (half - 0.3)))
            add((low, -outer - 6.0, height + 1.1), (high, outer + 6.0, height + 2.1), colour * 0.95)
            low, high = sorted((end * outer, end * (outer + 6.0)))
            add((x_m - half + 0.5, low, -2.0), (x_m + half - 0.5, high, height), colour * 0.85)
        for x in (x_m - 0.5 * half, x_m + 0.5 * half):
            add((x - 0.4, -0.4, -1.0), (x + 0.4, 0.4, height), colour * 0.9)

    def _add_gantry(self, x_m: float, faces: float) -> None:
        """Blue signs over a carriageway, for those who come towards them, on a beam with two legs."""
        section, add, rng = self._section, self._scenery.add_level_box, self._rng
        sign = self._side * faces  # ahead of the ego vehicle over its own carriageway, behind it over the other one
        inner, outer = sign * 0.5, sign * (section.edge_m + 2.0)
        for y in (inner, outer):
            add((x_m - 0.15, y - 0.15, -1.0), (x_m + 0.15, y + 0.15, 6.6), _STEEL * 0.75)
        low, high = sorted((inner, outer))
        add((x_m - 0.2, low, 6.2), (x_m + 0.2, high, 6.6), _STEEL * 0.8)
        front = x_m - faces * 0.3
        x_low, x_high = sorted((front, front + faces * 0.1))
        for index in range(0, section.lanes, 2):
            y = sign * (section.lane_y_m(index) + 0.5 * section.lane_m * (index + 1 < section.lanes))
            half, top = float(rng.uniform(2.0, 3.0)), 8.0
            add((x_low, y - half, 5.4), (x_high, y + half, top), _SIGN_BLUE)
            for z in (6.1, 6.7, 7.3):
                length = half * float(rng.uniform(0.5, 0.85))
                text_low, text_high = sorted((front - faces * 0.02, front))
                add((text_low, y - length, z), (text_high, y + length * 0.6, z + 0.3), np.full(3, 0.9))

    def _add_tree(self, x_m: float, y_m: float, height_m: float) -> None:
        angle = np.linspace(0.0, 2.0 * np.pi, 8)
        rows = np.array([(0.0, 0.05), (0.25, 0.05), (0.25, 0.28), (0.5, 0.36), (0.8, 0.26), (1.0, 0.0)]) * height_m
        leaves = _LEAVES * self._rng.uniform(0.8, 1.25)
        colour = np.where(np.arange(len(rows))[:, None] < 2, _BARK, leaves) * np.linspace(0.7, 1.15, len(rows))[:, None]
        wobble = 1.0 + 0.18 * self._rng.standard_normal((len(rows), len(angle)))
        wobble[:, -1] = wobble[:, 0]
        x = x_m + rows[:, 1:] * np.cos(angle) * wobble
        y = y_m + rows[:, 1:] * np.sin(angle) * wobble
        rise_m = float(self._ground.height_m(x_m)) - self._ground.height_m(x)  # a tree stands on one height
        point = np.stack([x, y, rows[:, :1] - 0.1 + rise_m], axis=-1)[:, ::-1]
        rgb = np.broadcast_to(colour[:, None], point.shape)
        self._scenery.add_quads(*(cells_of(each) for each in (point, rgb)))

    def _add_wood(self, x_m: float) -> None:
        """The edge of a wood where the ground ends, into which the road leads."""
        rng = self._rng
        y = np.linspace(-_FIELD_M, _FIELD_M, 45)
        top = 5.0 + 6.0 * rng.random(len(y))
        top[np.abs(y) < self._section.edge_m] *= 0.6
        base = np.stack([np.full_like(y, x_m), y, np.full_like(y, -3.0)], axis=-1)
        point = np.stack([base, base + (top + 3.0)[:, None] * [0.0, 0.0, 1.0]], axis=1)
        if x_m > 0.0:
            point = point[::-1]
        colour = _LEAVES * np.array([0.85, 0.95, 1.1]) * rng.uniform(0.85, 1.1, (len(y), 2, 1))
        self._scenery.add_quads(*(cells_of(each) for each in (point, colour)))
