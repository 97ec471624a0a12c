"""Vehicles of the town before they are meshes: drawn at random, then placed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.scene.town.ground import StreetGround
from warpav.scene.town.paint import drawn_paint
from warpav.scene.town.street_life import Footprint
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


@dataclass(frozen=True, eq=False)
class PlacedVehicle:
    """A vehicle in the town frame: its mesh in the vehicle frame, and where it stands."""

    kind: str  # as `vehicle_mesh` takes it
    variant: int  # as `vehicle_mesh` takes it
    mesh: Mesh  # in the vehicle frame
    size_m: np.ndarray  # length, width with mirrors, height [m], shape [3]
    footprint: Footprint  # where
    lane_yaw_rad: float | None  # direction of its lane; None: parked
    # Lowest and highest speed where nothing is in the way [m/s]; None: that of the street.
    free_m_s: tuple[float, float] | None = None

    def exchanged(self, exchange: Exchange | None, number: int) -> PlacedVehicle:
        """The vehicle with the mesh that an exchange gives it, as the vehicle of this number; None: its own."""
        if exchange is None:
            return self
        width_m = self.size_m[1] * body_width_m(self.kind, self.variant) / vehicle_size_m(self.kind, self.variant)[1]
        low_m, high_m = self.mesh.bounds_m().astype(np.float64)  # a coarse mesh is a little shorter
        found = exchange(number, self.kind, self.mesh, np.array([high_m[0] - low_m[0], width_m, high_m[2]]))
        if found is self.mesh:
            return self
        middle_m = np.array([0.5 * (low_m[0] + high_m[0]), 0.0, 0.0])
        return replace(self, mesh=found.transformed(np.eye(3), middle_m))

    def standing(self, ground: StreetGround) -> Mesh:
        """The vehicle's mesh in the town frame."""
        place = self.footprint
        return self.mesh.transformed(*ground.stand(place.x_m, place.y_m, place.yaw_rad, self.size_m))
