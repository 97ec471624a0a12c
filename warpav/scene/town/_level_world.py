"""A scene of a level as it grows: scenery, an ego vehicle, and road users who overlap with nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpav.raster.mesh import Mesh, merge
from warpav.scene._scene import Scene, Vehicle
from warpav.scene.town._houses import SHADOW_SEGMENTS, SceneryBuilder
from warpav.scene.town._people import person_mesh
from warpav.scene.town._placed_vehicle import LONG_KINDS, DrawnVehicle, Exchange, PlacedVehicle, Sight, velocities_m_s
from warpav.scene.town._street_life import Crowd, Person, RoadUser, upright_box
from warpav.scene.town._surface_builder import StreetGround
from warpav.scene.town._town import drawn_sky, ego_vehicle
from warpav.scene.town._town_layout import Footprint, Occupied, Slot

# Road users farther from the ego vehicle have coarse meshes, the second those of lorries and buses.
_COARSE_FROM_M, _LONG_COARSE_FROM_M = 28.0, 60.0
_PERSON_M = 0.45  # room that is looked for before a person is drawn
_SHADOW_LAYERS = 10
_FAR_SHADOW_SEGMENTS = 10
_SAMPLES = 40  # rays to each road user from each point of the body


class LevelWorld:
    """Collects what is in a scene; `finish` makes the scene of it."""

    def __init__(
        self,
        scenery: SceneryBuilder,
        ground: StreetGround,
        ego: Slot,
        pieces: Sequence[Mesh],
        taken: Sequence[Footprint],
        rng: np.random.Generator,
        free_m_s: tuple[float, float] | None = None,
    ) -> None:
        self._rng = rng
        self._ego = ego_vehicle()
        self._vehicles: list[PlacedVehicle] = []
        self.lines: list[Footprint] = []  # where drivers wait now
        low, high = self._ego.bounds_m().astype(np.float64)
        self._scenery, self._ground, self._pieces, self._obstacles = scenery, ground, list(pieces), list(taken)
        self._origin_m = np.array([ego.x_m - 0.5 * (low[0] + high[0]), ego.y_m, 0.0])
        place = Footprint.at(np.array([ego.x_m, ego.y_m]), 0.0, high - low)
        self._own = RoadUser(category="ego", footprint=place, heading_rad=0.0, free_m_s=free_m_s)
        self._occupied = Occupied((place, *taken))
        self._crowd = Crowd(ground, self._occupied, place.centre_m, clear_m=0.0)

    def put_vehicle(
        self,
        drawn: DrawnVehicle,
        footprint: Footprint,
        lane_yaw_rad: float | None,
        *,
        gap_m: float,
        free_m_s: tuple[float, float] | None = None,
    ) -> PlacedVehicle | None:
        """Put a vehicle at a place; None, and nothing, if anything is nearer than a gap."""
        if not self._occupied.is_free(footprint, gap_m):
            return None
        self._occupied.add(footprint)
        coarse_from_m = _LONG_COARSE_FROM_M if drawn.kind in LONG_KINDS else _COARSE_FROM_M
        vehicle = PlacedVehicle(
            category=drawn.kind,
            footprint=footprint,
            heading_rad=lane_yaw_rad,
            free_m_s=free_m_s,
            variant=drawn.variant,
            mesh=drawn.mesh(coarse=self._is_far(footprint, coarse_from_m)),
            size_m=drawn.size_m,
        )
        self._vehicles.append(vehicle)
        return vehicle

    def put_person(
        self, category: str, place_m: np.ndarray, yaw_rad: float, pavement_share: float, *, height_m: float | None
    ) -> bool:
        """Put a pedestrian or cyclist at a place; False where there is no room. See `Crowd.add`."""
        room = Footprint(float(place_m[0]), float(place_m[1]), yaw_rad, _PERSON_M, _PERSON_M)
        if not self._occupied.is_free(room, 0.1):
            return False
        mesh = person_mesh(category, self._rng, height_m=height_m, coarse=self._is_far(room))
        return self._crowd.add(category, mesh, place_m, yaw_rad, pavement_share)

    def finish(self, name: str, source: str, exchange: Exchange | None = None) -> Scene:
        """The scene in the ego frame, without those whom nobody on the ego vehicle could see."""
        to_ego = -self._origin_m
        users = [*self._vehicles, *self._crowd.persons]
        meshes = [one.standing(self._ground) for one in users]
        velocity = velocities_m_s([self._own, *users], [*self._obstacles, *self.lines], self._rng)
        pieces = merge([self._scenery.finish(), *self._pieces])
        seen = self._seen([pieces, self._ego.transformed(np.eye(3), self._origin_m)], meshes)
        found: list[Vehicle] = []
        for k in seen:
            one = users[k]
            if exchange is not None and isinstance(one, PlacedVehicle):
                meshes[k] = one.exchanged(exchange, len(found) + 1).standing(self._ground)
            mesh = meshes[k].transformed(np.eye(3), to_ego)
            box = upright_box(mesh, one.footprint.yaw_rad)
            found.append(Vehicle(len(found) + 1, one.category, mesh, box, velocity[1 + k] - velocity[0]))
        for index, one in enumerate((self._own, *(users[k] for k in seen))):
            segments = _FAR_SHADOW_SEGMENTS if self._is_far(one.footprint) else SHADOW_SEGMENTS
            share = one.pavement_share if isinstance(one, Person) else None
            self._scenery.add_shadow(one.footprint, index % _SHADOW_LAYERS, share, segments=segments)
        environment = merge([self._scenery.finish(), *self._pieces]).transformed(np.eye(3), to_ego)
        scene = Scene(name, environment, self._ego, tuple(found), drawn_sky(self._rng), source)
        return scene.targeting(("vehicle",))

    def _seen(self, blockers: Sequence[Mesh], users: Sequence[Mesh]) -> list[int]:
        """Who can be seen from anywhere around the body."""
        sight = Sight(blockers, users, _SAMPLES)
        low, high = self._ego.bounds_m().astype(np.float64) + self._origin_m
        low, high = low - 0.1, high + 0.1
        middle = 0.5 * (low + high)
        eyes = [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (0.6, 1.2)]
        eyes += [(middle[0], y, 1.2) for y in (low[1], high[1])]
        eyes += [(x, middle[1], 1.8) for x in (low[0], middle[0], high[0])]
        is_seen = np.zeros(len(users), bool)
        for eye in np.array(eyes):
            waiting = np.flatnonzero(~is_seen)
            is_seen[waiting] = sight.shares(eye, waiting) > 0.0
        return np.flatnonzero(is_seen).tolist()

    def _is_far(self, footprint: Footprint, from_m: float = _COARSE_FROM_M) -> bool:
        return bool(np.hypot(*(footprint.centre_m - self._own.footprint.centre_m)) > from_m)
