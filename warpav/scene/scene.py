"""What a traffic scene is: the environment, the ego vehicle, and separate other vehicles, all in the ego frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpav.geometry.mesh import Mesh


@dataclass(frozen=True)
class Box:
    """An upright 3D bounding box in the ego frame.

    Attributes:
        center_m: Centre [m], shape [3].
        size_m: Length, width, height [m], shape [3].
        yaw_rad: Heading about z, left positive [rad].
    """

    center_m: np.ndarray
    size_m: np.ndarray
    yaw_rad: float


@dataclass(frozen=True)
class Vehicle:
    """A vehicle other than the ego vehicle.

    Attributes:
        instance_id: Number of the instance within its scene, from 1.
        category: What it is: ``hatchback``, ``saloon``, ``estate``, ``suv``, ``van``, ``lorry`` or ``bus``.
        mesh: Its surface in the ego frame.
        box: Its bounding box in the ego frame.
    """

    instance_id: int
    category: str
    mesh: Mesh
    box: Box


@dataclass(frozen=True)
class Sky:
    """What a ray that hits nothing sees: a vertical gradient of two sRGB colours, 0..255, shape [3] each."""

    horizon_rgb: np.ndarray
    zenith_rgb: np.ndarray


BLACK_SKY = Sky(np.zeros(3, np.uint8), np.zeros(3, np.uint8))


@dataclass(frozen=True)
class Scene:
    """One traffic situation, in the ego frame.

    Ego frame: ISO 8855, x forward, y left, z up; origin on the ground below the middle of the rear axle.

    Attributes:
        name: Short name, such as ``town_0007``.
        environment: Road, kerbs, pavements, buildings.
        ego: The vehicle that carries the cameras.
        vehicles: The others, in order of instance id.
        sky: The background.
        source: Where it came from, such as ``town seed 7``.
    """

    name: str
    environment: Mesh
    ego: Mesh
    vehicles: tuple[Vehicle, ...]
    sky: Sky = BLACK_SKY
    source: str = ""
