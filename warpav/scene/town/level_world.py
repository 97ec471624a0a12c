"""A scene of a level as it grows: scenery, an ego vehicle, and road users who overlap with nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpav.raster.mesh import Mesh, merge
from warpav.scene.scene import Scene, Vehicle
from warpav.scene.town.houses import SceneryBuilder
from warpav.scene.town.lanes import RoadUser, velocities_m_s
from warpav.scene.town.people import person_mesh
from warpav.scene.town.placed_vehicle import LONG_KINDS, DrawnVehicle, Exchange, PlacedVehicle, Sight
from warpav.scene.town.street_life import Crowd, Footprint, Occupied, Person, upright_box
from warpav.scene.town.surface_builder import StreetGround
from warpav.scene.town.town import drawn_sky, ego_vehicle
from warpav.scene.town.town_layout import Layout, Slot

COARSE_FROM_M, LONG_COARSE_FROM_M = 28.0, 60.0
"""Road users farther from the ego vehicle have coarse meshes, the second those of lorries and buses [m]."""
_PERSON_M = 0.45  # room that is looked for before a person is drawn
_SHADOW_LAYERS = 10
_FAR_SHADOW_SEGMENTS = 10
_SAMPLES = 40  # rays to each road user from each point of the body


class LevelWorld:
    """Collects what is in a scene; `finish` makes the scene of it."""

    def __init__(self, rng: np.random.Generator) -> None:
        """Nothing yet."""
        self._rng = rng
        self._ego = ego_vehicle()
        self._vehicles: list[PlacedVehicle] = []
        self._lines: list[Footprint] = []

    def begin(
        self,
        scenery: SceneryBuilder,
        ground: StreetGround,
        ego: Slot,
        pieces: Sequence[Mesh],
        taken: Sequence[Footprint],
        free_m_s: tuple[float, float] | None = None,
    ) -> None:
        """Set everything up that stands."""
        low, high = self._ego.bounds_m().astype(np.float64)
        self._scenery, self._ground, self._pieces, self._ego_free_m_s = scenery, ground, list(pieces), free_m_s
        self._origin_m = np.array([ego.x_m - 0.5 * (low[0] + high[0]), ego.y_m, 0.0])
        self._centre_m = np.array([ego.x_m, ego.y_m])
        self._ego_footprint = Footprint(
            ego.x_m, ego.y_m, 0.0, float(high[0] - low[0]), float(high[1] - low[1])
        )  # fmt: skip
        self._obstacles = list(taken)
        self._occupied = Occupied((self._ego_footprint, *taken))
        self._crowd = Crowd(ground, self._occupied, self._centre_m, clear_m=0.0)

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
        coarse_from_m = LONG_COARSE_FROM_M if drawn.kind in LONG_KINDS else COARSE_FROM_M
        mesh = drawn.mesh(coarse=self._is_far(footprint, coarse_from_m))
        vehicle = PlacedVehicle(
            drawn.kind, drawn.variant, mesh, drawn.size_m, footprint, lane_yaw_rad, free_m_s
        )  # fmt: skip
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

    def set_lines(self, lines: Sequence[Footprint]) -> None:
        """Where drivers wait now."""
        self._lines = list(lines)

    def finish(self, name: str, source: str, exchange: Exchange | None = None) -> Scene:
        """The scene in the ego frame, without those whom nobody on the ego vehicle could see."""
        to_ego = -self._origin_m
        persons = self._crowd.persons
        meshes = [*(one.standing(self._ground) for one in self._vehicles), *(one.mesh for one in persons)]
        velocity = self._velocities_m_s()
        pieces = merge([self._scenery.finish(), *self._pieces])
        seen = self._seen([pieces, self._ego.transformed(np.eye(3), self._origin_m)], meshes)
        users, categories = [*self._vehicles, *persons], self._categories()
        found: list[Vehicle] = []
        for k in np.flatnonzero(seen):
            if exchange is not None and k < len(self._vehicles):
                meshes[k] = self._vehicles[k].exchanged(exchange, len(found) + 1).standing(self._ground)
            mesh = meshes[k].transformed(np.eye(3), to_ego)
            box = upright_box(mesh, users[k].footprint.yaw_rad)
            found.append(Vehicle(len(found) + 1, categories[k], mesh, box, velocity[1 + k] - velocity[0]))
        self._add_shadows([one for one, is_seen in zip(users, seen, strict=True) if is_seen])
        environment = merge([self._scenery.finish(), *self._pieces]).transformed(np.eye(3), to_ego)
        scene = Scene(name, environment, self._ego, tuple(found), drawn_sky(self._rng), source)
        return scene.targeting(("vehicle",))

    def _categories(self) -> list[str]:
        return [*(one.kind for one in self._vehicles), *(one.category for one in self._crowd.persons)]

    def _velocities_m_s(self) -> np.ndarray:
        """Over ground in the town frame, the ego vehicle's first [m/s], shape [1 + road user, 2]."""
        persons = (RoadUser(one.category, one.footprint, one.footprint.yaw_rad) for one in self._crowd.persons)
        moving = [
            RoadUser("ego", self._ego_footprint, 0.0, self._ego_free_m_s),
            *(RoadUser(one.kind, one.footprint, one.lane_yaw_rad, one.free_m_s) for one in self._vehicles),
            *persons,
        ]
        street = Layout("street", ((0.0, 0.0, 0.0, 0.0),), (), (), (), Slot(0.0, 0.0, 0.0, 0.0, parked=False))
        return velocities_m_s(moving, [*self._obstacles, *self._lines], street, self._rng)

    def _seen(self, blockers: Sequence[Mesh], users: Sequence[Mesh]) -> np.ndarray:
        """Who can be seen from anywhere around the body, bool [road user]."""
        sight = Sight(blockers, users)
        low, high = self._ego.bounds_m().astype(np.float64) + self._origin_m
        low, high = low - 0.1, high + 0.1
        middle = 0.5 * (low + high)
        eyes = [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (0.6, 1.2)]
        eyes += [(middle[0], y, 1.2) for y in (low[1], high[1])]
        eyes += [(x, middle[1], 1.8) for x in (low[0], middle[0], high[0])]
        return sight.seen_from_any(np.array(eyes), _SAMPLES)

    def _add_shadows(self, users: Sequence[PlacedVehicle | Person]) -> None:
        for index, one in enumerate((self._ego_footprint, *users)):
            place = one if isinstance(one, Footprint) else one.footprint
            layer = index % _SHADOW_LAYERS
            centre = np.array([place.x_m, place.y_m])
            segments = {"segments": _FAR_SHADOW_SEGMENTS} if self._is_far(place) else {}
            if isinstance(one, Person):
                size = (place.length_m, place.width_m)
                self._scenery.add_foot_shadow(centre, place.yaw_rad, size, layer, one.pavement_share, **segments)
            else:
                width = place.width_m - 0.25  # without mirrors
                self._scenery.add_contact_shadow(centre, place.yaw_rad, place.length_m, width, layer, **segments)

    def _is_far(self, footprint: Footprint, from_m: float = COARSE_FROM_M) -> bool:
        return bool(np.hypot(footprint.x_m - self._centre_m[0], footprint.y_m - self._centre_m[1]) > from_m)
