"""Vehicles of the town before they are meshes: drawn at random, then placed; and which the roof can see."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from warpav.raster.mesh import Mesh, merge
from warpav.scene.town.paint import drawn_paint
from warpav.scene.town.street_life import RoadUser
from warpav.scene.town.surface_builder import StreetGround
from warpav.scene.town.vehicle_shapes import VARIANT_COUNT, body_width_m, vehicle_mesh, vehicle_size_m

LONG_KINDS = ("lorry", "bus")
_SCALE_SPREAD = 0.03
Exchange = Callable[[int, str, Mesh, np.ndarray], Mesh]
"""What may put another mesh in the place of a vehicle's own.

It takes the number of the vehicle in its scene, from 1, its kind, its own mesh in the vehicle frame, and its length,
width without mirrors and height [m], [3]; it returns a mesh in the vehicle frame of this size, or the own one.
"""


@dataclass(frozen=True, eq=False)
class DrawnVehicle:
    """A random vehicle, nowhere yet."""

    kind: str  # as `vehicle_mesh` takes it
    variant: int  # as `vehicle_mesh` takes it
    paint: np.ndarray  # linear albedo, shape [3]
    scale: np.ndarray  # factors along x, y, z, shape [3]

    @property
    def size_m(self) -> np.ndarray:
        """Length, width with mirrors, height [m], shape [3]."""
        return vehicle_size_m(self.kind, self.variant) * self.scale

    def mesh(self, *, coarse: bool = False) -> Mesh:
        """Its mesh in the vehicle frame."""
        return vehicle_mesh(self.kind, self.paint, variant=self.variant, scale=self.scale, coarse=coarse)


def drawn_vehicle(kind_shares: Mapping[str, float], rng: np.random.Generator) -> DrawnVehicle:
    """A vehicle of one of these kinds, by their shares, which add up to 1."""
    kind = list(kind_shares)[int(rng.choice(len(kind_shares), p=list(kind_shares.values())))]
    paint = drawn_paint(kind, rng)
    scale = 1.0 + rng.uniform(-_SCALE_SPREAD, _SCALE_SPREAD, 3)
    return DrawnVehicle(kind, int(rng.integers(VARIANT_COUNT)), paint, scale)


@dataclass(frozen=True, eq=False, kw_only=True)
class PlacedVehicle(RoadUser):
    """A vehicle in the town frame: its mesh in the vehicle frame, and where it stands."""

    variant: int  # as `vehicle_mesh` takes it
    mesh: Mesh  # in the vehicle frame
    size_m: np.ndarray  # length, width with mirrors, height [m], shape [3]

    def exchanged(self, exchange: Exchange | None, number: int) -> PlacedVehicle:
        """The vehicle with the mesh that an exchange gives it, as the vehicle of this number; None: its own."""
        if exchange is None:
            return self
        kind, variant = self.category, self.variant
        width_m = self.size_m[1] * body_width_m(kind, variant) / vehicle_size_m(kind, variant)[1]
        low_m, high_m = self.mesh.bounds_m().astype(np.float64)  # a coarse mesh is a little shorter
        found = exchange(number, kind, self.mesh, np.array([high_m[0] - low_m[0], width_m, high_m[2]]))
        if found is self.mesh:
            return self
        middle_m = np.array([0.5 * (low_m[0] + high_m[0]), 0.0, 0.0])
        return replace(self, mesh=found.transformed(np.eye(3), middle_m))

    def standing(self, ground: StreetGround) -> Mesh:
        """The vehicle's mesh in the town frame."""
        place = self.footprint
        return self.mesh.transformed(*ground.stand(place.x_m, place.y_m, place.yaw_rad, self.size_m))


_SAMPLES = 200  # rays to a mesh


class Sight:
    """Everything that can hide something, ready for rays."""

    def __init__(self, blockers: Sequence[Mesh], targets: Sequence[Mesh], samples: int = _SAMPLES) -> None:
        """Everything, in one frame; so many rays go to each target."""
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        meshes = [*blockers, *targets]
        whole = merge(meshes)
        self._owner = np.repeat(np.arange(len(meshes)), [len(mesh.triangle) for mesh in meshes])
        self._first = len(blockers)
        # Centres of triangles: a ray to a vertex may miss the surface by a rounding error.
        self._point_m = [
            mesh.vertex_m[mesh.triangle[:: max(1, len(mesh.triangle) // samples)]].mean(axis=1) for mesh in targets
        ]
        self._caster = EmbreeScene()
        TriangleMesh(self._caster, whole.vertex_m, whole.triangle)

    def shares(self, eye_m: np.ndarray, some: np.ndarray | None = None) -> np.ndarray:
        """Share of triangles whose middle can be seen from a point, [3], of each target or of some by number."""
        some = np.arange(len(self._point_m)) if some is None else some
        if not len(some):
            return np.zeros(0)
        point = [self._point_m[k] for k in some]
        count = np.array([len(each) for each in point])
        direction = np.ascontiguousarray((np.concatenate(point) - eye_m).astype(np.float32))
        origin = np.ascontiguousarray(np.broadcast_to(eye_m.astype(np.float32), direction.shape))
        hit = self._caster.run(origin, direction, query="INTERSECT")
        row = np.repeat(np.arange(len(count)), count)
        is_seen = (hit >= 0) & (self._owner[np.maximum(hit, 0)] == self._first + some[row])
        return np.bincount(row, is_seen, minlength=len(count)) / count
