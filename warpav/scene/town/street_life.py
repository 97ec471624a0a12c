"""Where furniture, road works and people go in a town plan; nothing stands in anything else."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.scene.scene import Box, Vehicle
from warpav.scene.town.furniture import FOOTPRINT_M, furniture_mesh
from warpav.scene.town.houses import KERB_HEIGHT_M
from warpav.scene.town.people import person_mesh
from warpav.scene.town.surface_builder import StreetGround
from warpav.scene.town.town_layout import Layout, Marking, Slot

_REACH_M = 40.0  # furniture stands no farther from the ego vehicle
_CORNER_CLEAR_M = 3.2  # of a pavement's ends, in which nobody stands
_KERB_CLEAR_M = 0.45  # between the kerb and what stands along it
_LAMP_SPACING_M = 19.0
_WORKS_SHARE = 0.32  # of the scenes with lanes
_WORKS_CLEAR_M = 8.5  # between road works and the ego vehicle's centre
_PATCH_BRIGHTNESS = 0.22
_PEOPLE_REACH_M, _PEOPLE_CLEAR_M = 24.0, 3.6
_GAP_M = 0.25  # between people, and between them and anything else
_CYCLIST_COUNTS, _CYCLIST_SHARES = (0, 1, 2), (0.45, 0.38, 0.17)
_TRIES = 12


@dataclass(frozen=True)
class Footprint:
    """A rectangle on the ground, in the town frame."""

    x_m: float  # its centre [m]
    y_m: float  # its centre [m]
    yaw_rad: float  # direction of its length
    length_m: float  # length [m]
    width_m: float  # width [m]

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
        offset = np.array([other.x_m - self.x_m, other.y_m - self.y_m])
        for yaw in (self.yaw_rad, other.yaw_rad):
            for axis in (np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])):
                reach = sum(
                    0.5 * abs(axis @ direction) * extent
                    for rectangle in (self, other)
                    for direction, extent in (
                        (np.array([np.cos(rectangle.yaw_rad), np.sin(rectangle.yaw_rad)]), rectangle.length_m),
                        (np.array([-np.sin(rectangle.yaw_rad), np.cos(rectangle.yaw_rad)]), rectangle.width_m),
                    )
                )
                if abs(axis @ offset) > reach + gap_m:
                    return False
        return True


class Occupied:
    """What is taken already: quickly asked whether a rectangle comes near any of it."""

    def __init__(self, footprints: Iterable[Footprint] = ()) -> None:
        """These are taken."""
        self._footprints = list(footprints)
        self._circle = [_circle_of(each) for each in self._footprints]

    def add(self, footprint: Footprint) -> None:
        """Take a rectangle."""
        self._footprints.append(footprint)
        self._circle.append(_circle_of(footprint))

    def is_free(self, footprint: Footprint, gap_m: float) -> bool:
        """Whether nothing is nearer to it than a gap."""
        if not self._footprints:
            return True
        x, y, radius = _circle_of(footprint)
        centre_x, centre_y, reach = np.array(self._circle).T
        near = np.flatnonzero(np.hypot(centre_x - x, centre_y - y) <= reach + radius + 1.5 * gap_m)  # at corners
        return not any(footprint.nearer(self._footprints[k], gap_m) for k in near)


def _circle_of(footprint: Footprint) -> tuple[float, float, float]:
    """Centre and radius of a circle around a rectangle [m]."""
    return footprint.x_m, footprint.y_m, 0.5 * float(np.hypot(footprint.length_m, footprint.width_m)) + 1e-6


@dataclass(frozen=True)
class _Furnishing:
    """What was set up in a town."""

    meshes: tuple[Mesh, ...]  # the pieces, in the town frame
    footprints: tuple[Footprint, ...]  # where they stand; of road works the whole closed area
    markings: tuple[Marking, ...]  # dug-up ground


@dataclass(frozen=True)
class Person:
    """A person in the town frame."""

    category: str  # ``pedestrian`` or ``cyclist``
    mesh: Mesh  # town frame
    footprint: Footprint  # where the person is
    pavement_share: float  # how far from the kerb to the houses, 0..1; below 0 on the road

    def road_user(self, instance_id: int, origin_m: np.ndarray) -> Vehicle:
        """The person in the ego frame, whose origin in the town frame [m] is given, shape [3]."""
        mesh = self.mesh.transformed(np.eye(3), -origin_m)
        return Vehicle(instance_id, self.category, mesh, upright_box(mesh, self.footprint.yaw_rad))


def upright_box(mesh: Mesh, yaw_rad: float) -> Box:
    """The smallest upright box of a heading that contains a mesh."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    local = mesh.vertex_m.astype(np.float64) @ turn.T
    low, high = local.min(axis=0), local.max(axis=0)
    return Box(turn.T @ (0.5 * (low + high)), high - low, yaw_rad)


@dataclass(frozen=True)
class Strip:
    """A pavement between kerb and houses: a point of the kerb, unit vectors along it and towards the houses."""

    start: np.ndarray
    along: np.ndarray
    length_m: float
    depth_m: float

    @property
    def inward(self) -> np.ndarray:
        """Unit vector towards the houses, shape [2]."""
        return np.array([-self.along[1], self.along[0]])

    @property
    def yaw_rad(self) -> float:
        """Direction of the kerb."""
        return float(np.arctan2(self.along[1], self.along[0]))

    def at(self, along_m: float, inward_m: float) -> np.ndarray:
        """A point so far along the kerb and towards the houses, in the town frame [m], shape [2]."""
        return self.start + along_m * self.along + inward_m * self.inward

    def span_m(self, centre: np.ndarray, reach_m: float) -> tuple[float, float] | None:
        """The part within reach of a point, away from the corners; None if there is none."""
        offset = centre - self.start
        across, foot = abs(float(self.inward @ offset)), float(self.along @ offset)
        if across >= reach_m:
            return None
        half = np.sqrt(reach_m**2 - across**2)
        low = max(foot - half, _CORNER_CLEAR_M)
        high = min(foot + half, self.length_m - _CORNER_CLEAR_M)
        return (low, high) if high > low else None


def strips(layout: Layout) -> list[Strip]:
    """The pavements of a plan that lie in front of houses."""
    found = []
    for block in layout.blocks:
        x_low, y_low, x_high, y_high = block.rectangle_m
        sides = {
            "south": ((x_low, y_low), (1.0, 0.0), x_high - x_low),
            "north": ((x_high, y_high), (-1.0, 0.0), x_high - x_low),
            "east": ((x_high, y_low), (0.0, 1.0), y_high - y_low),
            "west": ((x_low, y_high), (0.0, -1.0), y_high - y_low),
        }
        for front in block.fronts:
            start, along, length = sides[front]
            found.append(Strip(np.array(start), np.array(along), length, block.pavement_m))
    return found


def _turned(mesh: Mesh, yaw_rad: float, place_m: np.ndarray) -> Mesh:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return mesh.transformed(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), place_m)


class _Furnisher:
    """Collects pieces that do not stand in each other."""

    def __init__(self, rng: np.random.Generator, ground: StreetGround) -> None:
        self.meshes: list[Mesh] = []
        self.footprints: list[Footprint] = []
        self._rng = rng
        self._ground = ground

    def put(self, kind: str, place: np.ndarray, yaw_rad: float, height_m: float, *, alone: bool = True) -> None:
        """Add a piece; where something stands already, nothing happens unless it need not stand alone."""
        length, width = FOOTPRINT_M[kind]
        footprint = Footprint(float(place[0]), float(place[1]), yaw_rad, length, width)
        mesh = furniture_mesh(kind, self._rng)
        if alone:
            if any(footprint.nearer(other, 0.3) for other in self.footprints):
                return
            self.footprints.append(footprint)
        z = height_m + float(self._ground.height_m(place[0]))
        self.meshes.append(_turned(mesh, yaw_rad, np.array([place[0], place[1], z])))


def furnish(
    layout: Layout, rng: np.random.Generator, ground: StreetGround, *, reach_m: float = _REACH_M
) -> _Furnishing:
    """Random furniture on the pavements near the ego vehicle, and in some scenes road works in a lane."""
    furnisher = _Furnisher(rng, ground)
    markings: list[Marking] = []
    ego = np.array([layout.ego.x_m, layout.ego.y_m])
    if rng.random() < _WORKS_SHARE:
        markings += _put_works(furnisher, layout, rng)
    junctions_m = np.array([0.5 * (r[0] + r[2]) for r in layout.asphalt_m[1:]])
    for x_low, y_low, x_high, y_high in layout.crossings_m:
        nearest_m = junctions_m[np.abs(junctions_m - x_low).argmin()]
        x = x_high + 0.7 if x_low > nearest_m else x_low - 0.7
        for y, yaw in ((y_low - 0.6, np.pi), (y_high + 0.6, 0.0)):
            furnisher.put("traffic_light", np.array([x, y]), yaw, KERB_HEIGHT_M)
    for strip in strips(layout):
        span = strip.span_m(ego, reach_m)
        if span is None or strip.depth_m < 2.0:
            continue
        low, high = span
        for along in np.arange(low + rng.uniform(0.0, _LAMP_SPACING_M), high, _LAMP_SPACING_M):
            furnisher.put("lamp_post", strip.at(along, _KERB_CLEAR_M), strip.yaw_rad, KERB_HEIGHT_M)
        large = rng.random()
        along = rng.uniform(low, high)
        if large < 0.28 and strip.depth_m > 2.5:
            furnisher.put("bus_shelter", strip.at(along, _KERB_CLEAR_M + 0.9), strip.yaw_rad, KERB_HEIGHT_M)
            furnisher.put("sign", strip.at(along + 2.6, _KERB_CLEAR_M), strip.yaw_rad, KERB_HEIGHT_M)
        elif large < 0.5 and strip.depth_m > 3.3:
            furnisher.put("kiosk", strip.at(along, strip.depth_m - 1.4), strip.yaw_rad, KERB_HEIGHT_M)
        for kind, mean, inset in (
            ("bench", 1.2, strip.depth_m - 0.6),
            ("bin", 1.5, _KERB_CLEAR_M),
            ("sign", 1.5, _KERB_CLEAR_M),
        ):
            for along in rng.uniform(low, high, rng.poisson(mean)):
                furnisher.put(kind, strip.at(along, inset), strip.yaw_rad, KERB_HEIGHT_M)
        if rng.random() < 0.3:
            first = rng.uniform(low, high)
            for along in np.arange(first, min(first + 12.0, high), 1.7):
                furnisher.put("bollard", strip.at(along, _KERB_CLEAR_M - 0.1), strip.yaw_rad, KERB_HEIGHT_M)
    return _Furnishing(tuple(furnisher.meshes), tuple(furnisher.footprints), tuple(markings))


def _put_works(furnisher: _Furnisher, layout: Layout, rng: np.random.Generator) -> list[Marking]:
    """Close part of a lane off: barriers at both ends, cones along the side, a patch without asphalt inside."""
    ego = np.array([layout.ego.x_m, layout.ego.y_m])
    lanes = [
        slot
        for slot in layout.slots
        if not slot.parked and abs(np.sin(slot.yaw_rad)) < 0.1
        and _WORKS_CLEAR_M < np.hypot(slot.x_m - ego[0], slot.y_m - ego[1]) < 24.0
    ]  # fmt: skip
    if not lanes:
        return []
    slot = lanes[int(rng.integers(len(lanes)))]
    half_length, half_width = rng.uniform(2.4, 3.6), 1.15
    area = Footprint(slot.x_m, slot.y_m, 0.0, 2.0 * half_length + 1.2, 2.0 * half_width + 0.3)
    crossing = any(
        area.nearer(Footprint(0.5 * (r[0] + r[2]), 0.5 * (r[1] + r[3]), 0.0, r[2] - r[0], r[3] - r[1]), 0.5)
        for r in layout.crossings_m
    )
    if crossing or _in_junction(layout, area):
        return []

    def put(kind: str, x: float, y: float, yaw: float) -> None:
        furnisher.put(kind, np.array([slot.x_m + x, slot.y_m + y]), yaw, 0.0, alone=False)

    for end in (-1.0, 1.0):
        put("barrier", end * half_length, 0.0, 0.5 * np.pi * end)
    side = 1.0 if slot.y_m < 0.0 else -1.0  # the centre of the road
    for x in np.linspace(-half_length + 0.7, half_length - 0.7, 5):
        put("cone", float(x), side * half_width, 0.0)
    put("works_sign", -half_length - 0.1 if np.cos(slot.yaw_rad) > 0 else half_length + 0.1, -side * 0.75,
        slot.yaw_rad - 0.5 * np.pi)  # fmt: skip
    inner = half_length - 1.1
    if rng.random() < 0.6:
        put("sand_heap", inner - 0.4, -side * 0.1, rng.uniform(0.0, np.pi))
    if rng.random() < 0.6:
        put("pallet", -inner + 0.2, -side * 0.3, rng.uniform(-0.2, 0.2))
    furnisher.footprints.append(area)
    patch = (slot.x_m - inner, slot.y_m - 0.75, slot.x_m + inner, slot.y_m + 0.75)
    return [Marking(patch, _PATCH_BRIGHTNESS)]


def _in_junction(layout: Layout, area: Footprint) -> bool:
    """Whether an area of the main street lies in front of a side street."""
    side_streets = [r for r in layout.asphalt_m[1:] if abs(r[2] - r[0]) < abs(r[3] - r[1])]
    return any(area.x_m + 0.5 * area.length_m > r[0] - 1.0 and area.x_m - 0.5 * area.length_m < r[2] + 1.0
               for r in side_streets)  # fmt: skip


def _pavement_places(layout: Layout, rng: np.random.Generator) -> Iterator[tuple[np.ndarray, float, float]]:
    """Place, heading and share of the pavement of somebody who walks along it; without end."""
    ego = np.array([layout.ego.x_m, layout.ego.y_m])
    near = [(strip, span) for strip in strips(layout) if (span := strip.span_m(ego, _PEOPLE_REACH_M))]
    if not near:
        return
    weight = np.array([high - low for _, (low, high) in near])
    while True:
        strip, (low, high) = near[int(rng.choice(len(near), p=weight / weight.sum()))]
        inset = rng.uniform(0.55, strip.depth_m - 0.45)
        heading = strip.yaw_rad + (np.pi if rng.random() < 0.5 else 0.0) + rng.normal(0.0, 0.15)
        yield strip.at(rng.uniform(low, high), inset), heading, inset / strip.depth_m


def _road_places(layout: Layout, rng: np.random.Generator) -> Iterator[tuple[np.ndarray, float, float]]:
    """The same of somebody who crosses the road: on a crossing, or anywhere in a car park; ends where nobody does."""
    ego = np.array([layout.ego.x_m, layout.ego.y_m])
    near = [r for r in layout.crossings_m if abs(0.5 * (r[0] + r[2]) - ego[0]) < _PEOPLE_REACH_M]
    while near:
        x_low, y_low, x_high, y_high = near[int(rng.integers(len(near)))]
        place = np.array([rng.uniform(x_low + 0.3, x_high - 0.3), rng.uniform(y_low + 0.5, y_high - 0.5)])
        yield place, 0.5 * np.pi * (1.0 if rng.random() < 0.5 else -1.0) + rng.normal(0.0, 0.1), -1.0
    while layout.template == "car_park":
        slot = layout.slots[int(rng.integers(len(layout.slots)))]
        if not slot.parked and np.hypot(slot.x_m - ego[0], slot.y_m - ego[1]) < _PEOPLE_REACH_M:
            side = 1.0 if rng.random() < 0.5 else -1.0
            yield np.array([slot.x_m, slot.y_m + 1.2 * side]), slot.yaw_rad + rng.normal(0.0, 0.3), -1.0


class Crowd:
    """Collects people who stand on the ground and in nothing else."""

    def __init__(self, ground: StreetGround, taken: Occupied, ego_m: np.ndarray, *, clear_m: float) -> None:
        """Nobody yet; ``ego_m`` [2]."""
        self.persons: list[Person] = []
        self._ground, self._taken, self._ego_m, self._clear_m = ground, taken, ego_m, clear_m

    def add(self, category: str, mesh: Mesh, place_m: np.ndarray, yaw_rad: float, pavement_share: float) -> bool:
        """Put somebody at a place, below 0 of the pavement on the road; False where there is no room."""
        low, high = mesh.bounds_m().astype(np.float64)
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        centre = 0.5 * (low + high)
        footprint = Footprint(
            float(place_m[0] + c * centre[0] - s * centre[1]),
            float(place_m[1] + s * centre[0] + c * centre[1]),
            float(np.arctan2(s, c)),
            float(high[0] - low[0]),
            float(high[1] - low[1]),
        )
        near = np.hypot(*(place_m - self._ego_m)) < self._clear_m
        if near or not self._taken.is_free(footprint, _GAP_M):
            return False
        self._taken.add(footprint)
        kerb = KERB_HEIGHT_M if pavement_share >= 0.0 else 0.0
        if category == "cyclist":
            rotation, foot = self._ground.stand(float(place_m[0]), float(place_m[1]), yaw_rad, high - low)
            standing = mesh.transformed(rotation, foot)
        else:
            z = kerb + float(self._ground.height_m(place_m[0]))
            standing = _turned(mesh, yaw_rad, np.array([place_m[0], place_m[1], z]))
        self.persons.append(Person(category, standing, footprint, pavement_share))
        return True


def people(
    layout: Layout,
    rng: np.random.Generator,
    ground: StreetGround,
    taken: Sequence[Footprint],
    free_slots: Sequence[Slot],
) -> list[Person]:
    """A handful of people near the ego vehicle: on pavements and crossings, and on bicycles in lanes."""
    crowd = Crowd(ground, Occupied(taken), np.array([layout.ego.x_m, layout.ego.y_m]), clear_m=_PEOPLE_CLEAR_M)
    for places, count in (
        (_pavement_places(layout, rng), int(rng.integers(2, 7))),
        (_road_places(layout, rng), int(rng.integers(0, 4))),
    ):
        left = count
        for _, (place, yaw, share) in zip(range(_TRIES), places, strict=False):
            if left > 0 and crowd.add("pedestrian", person_mesh("pedestrian", rng), place, yaw, share):
                left -= 1
    side = 1.0 if layout.ego.y_m > 0.0 else -1.0  # traffic keeps to the right, or to the left
    lanes = [slot for slot in free_slots if not slot.parked]
    wanted = int(rng.choice(_CYCLIST_COUNTS, p=_CYCLIST_SHARES))
    for index in rng.permutation(len(lanes))[:_TRIES]:
        slot = lanes[index]
        shift = side * rng.uniform(0.6, 1.0)
        place = np.array([slot.x_m - np.sin(slot.yaw_rad) * shift, slot.y_m + np.cos(slot.yaw_rad) * shift])
        yaw = slot.yaw_rad + rng.normal(0.0, 0.03)
        if wanted > 0 and crowd.add("cyclist", person_mesh("cyclist", rng), place, yaw, -1.0):
            wanted -= 1
    return crowd.persons
