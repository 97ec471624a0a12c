"""Where furniture, road works and people go in a town plan; nothing stands in anything else."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.scene._scene import Box, yaw_rotation
from warpav.scene.town._furniture import FOOTPRINT_M, furniture_mesh
from warpav.scene.town._houses import KERB_HEIGHT_M
from warpav.scene.town._people import person_mesh
from warpav.scene.town._surface_builder import StreetGround
from warpav.scene.town._town_layout import Footprint, Layout, Marking, Occupied, sides_of

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


@dataclass(frozen=True, eq=False, kw_only=True)
class RoadUser:
    """Somebody who may move."""

    category: str  # as `warpav.scene._scene.Vehicle` has it
    footprint: Footprint  # where, in the town frame
    heading_rad: float | None  # direction of the lane, or of somebody on foot; None: parked
    # Lowest and highest speed where nothing is in the way [m/s]; None: that of the category and the street.
    free_m_s: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Person(RoadUser):
    """A pedestrian or cyclist in the town frame."""

    mesh: Mesh  # town frame
    pavement_share: float  # how far from the kerb to the houses, 0..1; below 0 on the road

    def standing(self, _: StreetGround) -> Mesh:
        """The person's mesh in the town frame, which knows the ground already."""
        return self.mesh


def upright_box(mesh: Mesh, yaw_rad: float) -> Box:
    """The smallest upright box of a heading that contains a mesh."""
    turn = yaw_rotation(-yaw_rad)
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
    return [
        Strip(*sides_of(block.rectangle_m)[front], block.pavement_m)
        for block in layout.blocks
        for front in block.fronts
    ]


class _Furnishing:
    """What was set up in a town: pieces that do not stand in each other."""

    def __init__(self, rng: np.random.Generator, ground: StreetGround) -> None:
        self.meshes: list[Mesh] = []  # in the town frame
        self.footprints: list[Footprint] = []  # where they stand; of road works the whole closed area
        self.markings: list[Marking] = []  # dug-up ground
        self._rng = rng
        self._ground = ground

    def put(self, kind: str, place: np.ndarray, yaw_rad: float, height_m: float, *, alone: bool = True) -> None:
        """Add a piece; where something stands already, nothing happens unless it need not stand alone."""
        footprint = Footprint(float(place[0]), float(place[1]), yaw_rad, *FOOTPRINT_M[kind])
        mesh = furniture_mesh(kind, self._rng)
        if alone:
            if any(footprint.nearer(other, 0.3) for other in self.footprints):
                return
            self.footprints.append(footprint)
        z = height_m + float(self._ground.height_m(place[0]))
        self.meshes.append(mesh.transformed(yaw_rotation(yaw_rad), np.array([place[0], place[1], z])))


def furnish(
    layout: Layout, rng: np.random.Generator, ground: StreetGround, *, reach_m: float = _REACH_M
) -> _Furnishing:
    """Random furniture on the pavements near the ego vehicle, and in some scenes road works in a lane."""
    found = _Furnishing(rng, ground)
    if rng.random() < _WORKS_SHARE:
        _put_works(found, layout, rng)
    junctions_m = np.array([0.5 * (r[0] + r[2]) for r in layout.asphalt_m[1:]])
    for x_low, y_low, x_high, y_high in layout.crossings_m:
        nearest_m = junctions_m[np.abs(junctions_m - x_low).argmin()]
        x = x_high + 0.7 if x_low > nearest_m else x_low - 0.7
        for y, yaw in ((y_low - 0.6, np.pi), (y_high + 0.6, 0.0)):
            found.put("traffic_light", np.array([x, y]), yaw, KERB_HEIGHT_M)
    for strip in strips(layout):
        span = strip.span_m(layout.ego_m, reach_m)
        if span is None or strip.depth_m < 2.0:
            continue

        def put(kind: str, along: float, inset: float, strip: Strip = strip) -> None:
            found.put(kind, strip.at(along, inset), strip.yaw_rad, KERB_HEIGHT_M)

        low, high = span
        for along in np.arange(low + rng.uniform(0.0, _LAMP_SPACING_M), high, _LAMP_SPACING_M):
            put("lamp_post", along, _KERB_CLEAR_M)
        large = rng.random()
        along = rng.uniform(low, high)
        if large < 0.28 and strip.depth_m > 2.5:
            put("bus_shelter", along, _KERB_CLEAR_M + 0.9)
            put("sign", along + 2.6, _KERB_CLEAR_M)
        elif large < 0.5 and strip.depth_m > 3.3:
            put("kiosk", along, strip.depth_m - 1.4)
        for kind, mean, inset in (("bench", 1.2, strip.depth_m - 0.6), ("bin", 1.5, _KERB_CLEAR_M),
                                  ("sign", 1.5, _KERB_CLEAR_M)):  # fmt: skip
            for along in rng.uniform(low, high, rng.poisson(mean)):
                put(kind, along, inset)
        if rng.random() < 0.3:
            first = rng.uniform(low, high)
            for along in np.arange(first, min(first + 12.0, high), 1.7):
                put("bollard", along, _KERB_CLEAR_M - 0.1)
    return found


def _put_works(found: _Furnishing, layout: Layout, rng: np.random.Generator) -> None:
    """Close part of a lane off: barriers at both ends, cones along the side, a patch without asphalt inside."""
    lanes = [slot for slot in layout.slots if not slot.parked and abs(np.sin(slot.yaw_rad)) < 0.1
             and _WORKS_CLEAR_M < np.hypot(slot.x_m - layout.ego.x_m, slot.y_m - layout.ego.y_m) < 24.0]  # fmt: skip
    if not lanes:
        return
    slot = lanes[int(rng.integers(len(lanes)))]
    half_length, half_width = rng.uniform(2.4, 3.6), 1.15
    area = Footprint(slot.x_m, slot.y_m, 0.0, 2.0 * half_length + 1.2, 2.0 * half_width + 0.3)
    crossing = any(
        area.nearer(Footprint(0.5 * (r[0] + r[2]), 0.5 * (r[1] + r[3]), 0.0, r[2] - r[0], r[3] - r[1]), 0.5)
        for r in layout.crossings_m
    )
    # in front of a side street
    west, east = area.x_m - 0.5 * area.length_m, area.x_m + 0.5 * area.length_m
    sides = [r for r in layout.asphalt_m[1:] if abs(r[2] - r[0]) < abs(r[3] - r[1])]
    if crossing or any(east > r[0] - 1.0 and west < r[2] + 1.0 for r in sides):
        return

    def put(kind: str, x: float, y: float, yaw: float) -> None:
        found.put(kind, np.array([slot.x_m + x, slot.y_m + y]), yaw, 0.0, alone=False)

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
    found.footprints.append(area)
    patch = (slot.x_m - inner, slot.y_m - 0.75, slot.x_m + inner, slot.y_m + 0.75)
    found.markings.append(Marking(patch, _PATCH_BRIGHTNESS))


def _pavement_places(layout: Layout, rng: np.random.Generator) -> Iterator[tuple[np.ndarray, float, float]]:
    """Place, heading and share of the pavement of somebody who walks along it; without end."""
    near = [(strip, span) for strip in strips(layout) if (span := strip.span_m(layout.ego_m, _PEOPLE_REACH_M))]
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
    ego = layout.ego_m
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
        self.persons: list[Person] = []
        self._ground, self._taken, self._ego_m, self._clear_m = ground, taken, ego_m, clear_m

    def add(self, category: str, mesh: Mesh, place_m: np.ndarray, yaw_rad: float, pavement_share: float) -> bool:
        """Put somebody at a place, below 0 of the pavement on the road; False where there is no room."""
        low, high = mesh.bounds_m().astype(np.float64)
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        x, y = 0.5 * (low + high)[:2]
        centre = (place_m[0] + c * x - s * y, place_m[1] + s * x + c * y)
        footprint = Footprint.at(np.array(centre), yaw_rad, high - low)
        near = np.hypot(*(place_m - self._ego_m)) < self._clear_m
        if near or not self._taken.is_free(footprint, _GAP_M):
            return False
        self._taken.add(footprint)
        if category == "cyclist":
            turn, foot = self._ground.stand(float(place_m[0]), float(place_m[1]), yaw_rad, high - low)
        else:
            kerb = KERB_HEIGHT_M if pavement_share >= 0.0 else 0.0
            turn = yaw_rotation(yaw_rad)
            foot = np.array([place_m[0], place_m[1], kerb + float(self._ground.height_m(place_m[0]))])
        self.persons.append(
            Person(
                category=category,
                footprint=footprint,
                heading_rad=footprint.yaw_rad,
                mesh=mesh.transformed(turn, foot),
                pavement_share=pavement_share,
            )
        )
        return True


def people(layout: Layout, rng: np.random.Generator, ground: StreetGround, taken: Sequence[Footprint]) -> list[Person]:
    """A handful of people near the ego vehicle: on pavements and crossings, and on bicycles in lanes."""
    crowd = Crowd(ground, Occupied(taken), layout.ego_m, clear_m=_PEOPLE_CLEAR_M)
    for places, count in (
        (_pavement_places(layout, rng), int(rng.integers(2, 7))),
        (_road_places(layout, rng), int(rng.integers(0, 4))),
    ):
        left = count
        for _, (place, yaw, share) in zip(range(_TRIES), places, strict=False):
            if left > 0 and crowd.add("pedestrian", person_mesh("pedestrian", rng), place, yaw, share):
                left -= 1
    side = 1.0 if layout.ego.y_m > 0.0 else -1.0  # traffic keeps to the right, or to the left
    lanes = [slot for slot in layout.slots if not slot.parked]
    wanted = int(rng.choice(_CYCLIST_COUNTS, p=_CYCLIST_SHARES))
    for index in rng.permutation(len(lanes))[:_TRIES]:
        slot = lanes[index]
        shift = side * rng.uniform(0.6, 1.0)
        place = np.array([slot.x_m - np.sin(slot.yaw_rad) * shift, slot.y_m + np.cos(slot.yaw_rad) * shift])
        yaw = slot.yaw_rad + rng.normal(0.0, 0.03)
        if wanted > 0 and crowd.add("cyclist", person_mesh("cyclist", rng), place, yaw, -1.0):
            wanted -= 1
    return crowd.persons
