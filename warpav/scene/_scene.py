"""What a traffic scene is: the environment, the ego vehicle, and separate road users, all in the ego frame."""

from __future__ import annotations

import html
import math
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.raster.mesh import Mesh, merge

if TYPE_CHECKING:
    from pathlib import Path

    from embreex.rtcore_scene import EmbreeScene

    MultiBlock = Any

ROAD_USERS = ("vehicle", "pedestrian", "cyclist")
"""The kinds of road users that a rig can be asked to see. A detection only ever matches an object of its own kind."""

_ROAD_USER_OF_CATEGORY = {
    "pedestrian": "pedestrian",
    "person": "pedestrian",
    "cyclist": "cyclist",
    "bicyclist": "cyclist",
}


def road_user_of(category: str) -> str:
    """The kind of a category out of `ROAD_USERS`: anything else than a person or cyclist counts as a vehicle."""
    return _ROAD_USER_OF_CATEGORY.get(category.lower(), "vehicle")


def triangle_caster(corner_m: np.ndarray) -> EmbreeScene:
    """Triangles [triangle, 3, 3], to cast rays at."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    caster = EmbreeScene()
    TriangleMesh(caster, np.asarray(corner_m, np.float32))
    return caster


def yaw_rotation(yaw_rad: float) -> np.ndarray:
    """Rotation about z, shape [3, 3]."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rectangle_m(low_m: np.ndarray, high_m: np.ndarray) -> np.ndarray:
    """Corners of the rectangle between two points, round it [m], shape [4, 2]."""
    return np.array([[low_m[0], low_m[1]], [low_m[0], high_m[1]], [high_m[0], high_m[1]], [high_m[0], low_m[1]]])


def outline_gap_m(one_m: np.ndarray, other_m: np.ndarray) -> float:
    """By how much an edge of either of two rectangles, [4, 2] each, parts them [m]; negative: how deep they overlap."""
    edge = np.concatenate([one_m[1:3] - one_m[:2], other_m[1:3] - other_m[:2]])
    axis = edge / np.hypot(*edge.T)[:, None]
    one, other = one_m @ axis.T, other_m @ axis.T
    return float(np.maximum(other.min(axis=0) - one.max(axis=0), one.min(axis=0) - other.max(axis=0)).max())


@dataclass(frozen=True)
class Box:
    """An upright 3D bounding box in the ego frame.

    It has a heading but neither pitch nor roll: around a vehicle on a grade it is as large as the tilted vehicle needs,
    a few centimetres more than on level ground.

    Attributes:
        center_m: Centre [m], shape [3].
        size_m: Length, width, height [m], shape [3].
    """

    center_m: np.ndarray
    size_m: np.ndarray
    yaw_rad: float

    @property
    def ego_from_box(self) -> np.ndarray:
        """Rotation from the box's axes (along its length, to its left, up) to the ego frame, shape [3, 3]."""
        return yaw_rotation(self.yaw_rad)

    def mirrored(self) -> Box:
        """The box with left and right exchanged."""
        return Box(np.asarray(self.center_m) * [1.0, -1.0, 1.0], self.size_m, -self.yaw_rad)

    def corners_m(self) -> np.ndarray:
        """The eight corners in the ego frame [m], shape [8, 3]."""
        side = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        return self.center_m + side * self.size_m @ self.ego_from_box.T

    @property
    def outline_m(self) -> np.ndarray:
        """Its corners seen from above, round it [m], shape [4, 2]."""
        return self.corners_m()[[0, 2, 6, 4], :2]

    def time_to_meet_s(self, low_m: np.ndarray, high_m: np.ndarray, velocity_m_s: np.ndarray) -> float:
        """Time until its outline on the ground meets a rectangle that stands still, as it moves without turning.

        Two convex outlines meet while their shadows on the normals of all edges overlap (separating axes); on each the
        overlap is an interval of time, and they meet in the intersection of all.

        Shapes: ``low_m`` [2], ``high_m`` [2], ``velocity_m_s`` [2].
        """
        axis = np.concatenate([np.eye(2), self.ego_from_box[:2, :2].T])
        corner, rectangle = self.outline_m @ axis.T, rectangle_m(low_m, high_m) @ axis.T
        way_m = np.stack([rectangle.min(axis=0) - corner.max(axis=0), rectangle.max(axis=0) - corner.min(axis=0)])
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # still along an axis: at once, or never
            first_s, last_s = np.sort(way_m / (axis @ velocity_m_s), axis=0)
        begin_s, end_s = max(float(first_s.max()), 0.0), float(last_s.min())
        return begin_s if begin_s < end_s else math.inf

    def local_m(self, point_m: np.ndarray) -> np.ndarray:
        """Points of the ego frame in the box's axes from its centre [m], shape [point, 3]."""
        return (point_m - self.center_m) @ self.ego_from_box

    def contains(self, point_m: np.ndarray, *, margin_m: float = 0.0) -> np.ndarray:
        """Whether points of the ego frame [m], [point, 3], lie inside the box grown by a margin, bool [point]."""
        half_m = 0.5 * np.asarray(self.size_m) + margin_m
        reach_m = np.hypot(*half_m[:2])
        inside = (np.abs(point_m[:, 0] - self.center_m[0]) <= reach_m) & (
            np.abs(point_m[:, 1] - self.center_m[1]) <= reach_m
        )
        near = np.flatnonzero(inside)  # most points are far away
        inside[near] = (np.abs(self.local_m(point_m[near])) <= half_m).all(axis=1)
        return inside


@dataclass(frozen=True, repr=False)
class Vehicle:
    """A road user other than the ego vehicle; mostly a vehicle, hence the name.

    Attributes:
        velocity_ego_m_s: How it moves in the ego frame, forward and left [m/s], shape [2]: relative to the ego vehicle,
            which moves itself, so that what stands on the road comes nearer. None: unknown.
    """

    instance_id: int
    category: str
    mesh: Mesh
    box: Box
    velocity_ego_m_s: np.ndarray | None = None

    def __repr__(self) -> str:
        """Category and position; the mesh has thousands of numbers."""
        x, y = self.box.center_m[:2]
        return f"<Vehicle {self.instance_id}: {self.category} at x {x:.1f}, y {y:.1f} m>"

    @property
    def road_user(self) -> str:
        """Its kind out of `ROAD_USERS`: anything else than a person or cyclist counts as a vehicle."""
        return road_user_of(self.category)

    def mirrored(self) -> Vehicle:
        """The same with left and right exchanged."""
        velocity = None if self.velocity_ego_m_s is None else self.velocity_ego_m_s * [1.0, -1.0]
        return replace(self, mesh=self.mesh.mirrored(), box=self.box.mirrored(), velocity_ego_m_s=velocity)


@dataclass(frozen=True)
class Sky:
    """What a ray that hits nothing sees: a vertical gradient of two sRGB colours, 0..255, shape [3] each."""

    horizon_rgb: np.ndarray
    zenith_rgb: np.ndarray

    @staticmethod
    def zenith_share(elevation_sine: np.ndarray) -> np.ndarray:
        """Share of the zenith's colour at the sine of an elevation, 0..1: 0 at the horizon and below, 1 overhead."""
        return 1.0 - (1.0 - np.clip(elevation_sine, 0.0, 1.0)) ** 2


BLACK_SKY = Sky(np.zeros(3, np.uint8), np.zeros(3, np.uint8))


@dataclass(frozen=True, repr=False)
class Scene:
    """One traffic situation, in the ego frame.

    Ego frame: ISO 8855, x forward, y left, z up; origin on the ground below the centre of the rear axle.

    Attributes:
        name: Short name, such as ``town_0007``.
        environment: Road, kerbs, pavements, buildings.
        ego: The vehicle that carries the cameras.
        vehicles: The road users that rigs are to see, in order of instance id: the vehicles, unless `targeting` chose
            otherwise.
        sky: The background.
        source: Where it came from, such as ``town seed 7``.
        others: The other road users, in order of instance id. They are rendered and occlude the vehicles like the
            environment does, but no loss and no metric asks for them.
    """

    name: str
    environment: Mesh
    ego: Mesh
    vehicles: tuple[Vehicle, ...]
    sky: Sky = BLACK_SKY
    source: str = ""
    others: tuple[Vehicle, ...] = ()

    @property
    def road_users(self) -> tuple[Vehicle, ...]:
        """Everybody but the ego vehicle, in order of instance id."""
        return tuple(sorted((*self.vehicles, *self.others), key=lambda user: user.instance_id))

    def targeting(self, road_users: Collection[str]) -> Scene:
        """The scene whose `vehicles` are the road users of these kinds, and whose `others` are all the rest."""
        unknown = sorted(set(road_users) - set(ROAD_USERS))
        if unknown:
            raise ValueError(f"road users must be out of {', '.join(ROAD_USERS)}, got {unknown[0]!r}")
        return replace(
            self,
            vehicles=tuple(user for user in self.road_users if user.road_user in road_users),
            others=tuple(user for user in self.road_users if user.road_user not in road_users),
        )

    def around(self, ego: Mesh) -> Scene:
        """The scene with another ego vehicle; road users that overlap with it are removed."""
        place_m = rectangle_m(*ego.bounds_m()[:, :2].astype(np.float64))
        vehicles, others = (
            tuple(user for user in users if outline_gap_m(user.box.outline_m, place_m) >= 0.0)
            for users in (self.vehicles, self.others)
        )
        return replace(self, ego=ego, vehicles=vehicles, others=others)

    def surroundings(self) -> Mesh:
        """The environment, followed by the road users in `others`, as one mesh."""
        return merge([self.environment, *(other.mesh for other in self.others)]) if self.others else self.environment

    def mirrored(self) -> Scene:
        """The scene with left and right exchanged, where traffic keeps to the other side; the ego vehicle stays."""
        return replace(
            self,
            name=f"{self.name}_mirrored",
            environment=self.environment.mirrored(),
            vehicles=tuple(vehicle.mirrored() for vehicle in self.vehicles),
            others=tuple(other.mirrored() for other in self.others),
        )

    def __repr__(self) -> str:
        """Name and counts; the meshes have thousands of numbers."""
        counts = self._counts()
        others = f", {len(self.others)} not targeted" if self.others else ""
        return f"<Scene {self.name}: {len(self.vehicles)} targets{others} ({counts or 'no road user'})>"

    def _repr_html_(self) -> str:
        """What Jupyter shows: road users by category, the nearest and the farthest of them, triangles, source."""
        users = sorted(self.road_users, key=_distance_m)
        rows = {"road users": self._counts() or "none"}
        if self.others:
            rows["not targeted"] = str(len(self.others))
        for name, user in zip(("nearest", "farthest"), users[:1] + users[-1:], strict=False):
            x, y = user.box.center_m[:2]
            bearing_deg = np.degrees(np.arctan2(y, x))
            rows[name] = f"{user.category} {user.instance_id}, {_distance_m(user):.1f} m away at {bearing_deg:+.0f}°"
        meshes = (self.environment, self.ego, *(user.mesh for user in users))
        rows["triangles"] = str(sum(len(mesh.triangle) for mesh in meshes))
        rows |= {"source": self.source} if self.source else {}
        cell = "style='text-align:left'"
        body = "".join(
            f"<tr><th {cell}>{html.escape(name)}</th><td {cell}>{html.escape(text)}</td></tr>"
            for name, text in rows.items()
        )
        return f"<table><caption>Scene {html.escape(self.name)}</caption><tbody>{body}</tbody></table>"

    def _counts(self) -> str:
        """Number of road users by category, the most frequent first."""
        counts = Counter(user.category for user in self.road_users).most_common()
        return ", ".join(f"{count} {category}" for category, count in counts)

    def plot(self, out: str | Path | None = None, **options: Any) -> Any:  # noqa: ANN401
        """Show the scene in a window or a notebook, or write its image to a file; see `warpav.view.plot`."""
        from warpav.view import plot

        return plot(self, out=out, **options)

    def to_pyvista(self) -> MultiBlock:
        """The scene as ``pyvista.MultiBlock``, see `warpav.view._blocks.scene_to_pyvista`."""
        from warpav.view import scene_to_pyvista

        return scene_to_pyvista(self)


def _distance_m(user: Vehicle) -> float:
    """Distance of a road user from the origin of the ego frame, seen from above [m]."""
    return float(np.hypot(*user.box.center_m[:2]))
