"""Small worlds whose best rig is known, because all rigs were tried: how surely it detects the vehicles.

The regret of a rig is how far the share that it is expected to miss lies above the optimum's, as a share of the
world's spread: the worst rig finds nothing.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh

from tests.driving_scene import SilentDetector
from tests.optimisation.objectives import rig_objective
from warpav.detection import DetectionProbability
from warpav.optimisation import (
    X_M,
    Y_M,
    YAW_RAD,
    AssignedScene,
    BudgetedValue,
    CameraMount,
    LossSettings,
    SearchSpace,
    ZoneAndSpacing,
)
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.mesh import Mesh, merge
from warpav.rig import MountSurface
from warpav.scene import Box, DeviceScene, Scene, Sky, Vehicle

PAINT = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0]], np.uint8)
GREY = (120, 120, 120)
MODEL = CameraModel(64, 64, math.pi / 2)
HEIGHT_OFFSET_M = 0.25


def large_and_whole():
    """A detector that is the surer the larger, the more visible and the more inside the image a vehicle is."""
    start = np.array([1.0, 0.0, 0.0, -1.5, 1.2, 0.0, -1.0, -1.0])
    step = np.array([2.0, 0.25, 0.25, 0.75, 0.9, 0.15, 0.5, 0.5])
    rise = np.array([2.0, 6.0, 4.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    return DetectionProbability(start, step, rise[:, None] * np.linspace(-0.5, 0.5, 5), -4.0)


@dataclass(frozen=True, eq=False)
class World:
    """A scene, where the cameras may stand, and how rigs are judged.

    ``surest`` is the first camera's x, y [m] and yaw [rad] of the rig that is expected to miss least, and ``rig_of``
    makes the rig of them; slow tests try all rigs and find none better.
    """

    name: str
    scene: Scene
    surface: MountSurface
    surest: tuple[float, float, float]
    rig_of: Callable
    camera_count: int = 1
    supersampling: int = 4

    @functools.cached_property
    def expected(self):
        """The default method's: the share of vehicles that the rig is expected to miss, inequalities for places."""
        return rig_objective(
            CameraMount(self.surface, camera=MODEL, height_offset_m=HEIGHT_OFFSET_M),
            SilentDetector(),
            camera_count=self.camera_count,
            settings=LossSettings(expected_miss_rate=1.0),
            multiplier_damping=10.0,
            constraints=ZoneAndSpacing(self.surface, camera_count=self.camera_count),
            occlusion=Occlusion.EXACT,
            supersampling=self.supersampling,
            probability=large_and_whole(),
        )

    @functools.cached_property
    def optimum(self):
        """What the best rig is expected to miss."""
        return self.value(self.space.feasible(self.rig_of(np.array(self.surest))))

    def regret(self, value):
        """How far a value lies above the optimum, as a share of the spread; below 0 where it is better."""
        return (value - self.optimum) / (1.0 - self.optimum)

    def value(self, mount_pose):
        """Share of vehicles that a rig is expected to miss."""
        return self.expected.evaluate(mount_pose, self.scenes).objective

    @functools.cached_property
    def scenes(self):
        """The scene; vehicle k belongs to camera k."""
        packed = DeviceScene.pack(self.scene)
        return [AssignedScene(packed, np.arange(packed.vehicle_count, dtype=np.int32))]

    @functools.cached_property
    def space(self):
        """All rigs: level cameras anywhere on the surface, looking anywhere."""
        return SearchSpace.over(self.expected.mount, self.camera_count, constraints=self.expected.constraints)

    def budget(self, renders):
        """The value, for so many rigs."""
        most = renders * self.camera_count
        return BudgetedValue(lambda rigs: map(self.value, rigs), self.space, scene_count=1, camera_renders_max=most)


def single(point):
    """The rig of one camera at x, y [m], yaw [rad]."""
    return np.array([[*point, 0.0, 0.0, 0.0, 0.0]])


def turned(point):
    """Four cameras, each a quarter turn about the origin from the one before; the first at x, y [m], yaw [rad]."""
    turn = 0.5 * math.pi * np.arange(4)
    x, y, yaw = point
    rig = np.zeros((4, 7))
    rig[:, X_M] = np.cos(turn) * x - np.sin(turn) * y
    rig[:, Y_M] = np.sin(turn) * x + np.cos(turn) * y
    rig[:, YAW_RAD] = yaw + turn
    return rig


def _block(size_m, centre_m, rgb=GREY, *, roll_rad=0.0):
    box = trimesh.creation.box(extents=size_m)
    box.apply_transform(trimesh.transformations.rotation_matrix(roll_rad, [1.0, 0.0, 0.0]))
    box.apply_translation(centre_m)
    return Mesh.create(box.vertices, box.faces, rgb)


def _vehicle(k, size_m, centre_m):
    mesh = _block(size_m, centre_m, PAINT[k])
    return Vehicle(k + 1, "van", mesh, Box(np.array(centre_m, float), np.array(size_m, float), 0.0))


def _ground():
    return _block([80.0, 80.0, 0.2], [0.0, 0.0, -0.1], (90, 90, 90))


def _scene(name, blocks, ego, vehicles):
    sky = Sky(np.array([200, 200, 200], np.uint8), np.array([180, 180, 180], np.uint8))
    return Scene(name, merge([_ground(), *blocks]), ego, tuple(vehicles), sky)


def _surface(low_m, high_m, height_of, cell_m=0.05):
    size = np.round((np.asarray(high_m) - low_m) / cell_m).astype(int) + 1
    x, y = (low + cell_m * np.arange(n) for low, n in zip(low_m, size, strict=True))
    height_m = np.broadcast_to(height_of(x[:, None], y[None, :]), tuple(size))
    return MountSurface(np.array(height_m, np.float32), np.asarray(low_m, float), cell_m)


def _body(surface, every=4):
    """An ego vehicle under a mount surface: its top, and a block below."""
    rows, columns = (np.unique(np.r_[np.arange(0, n, every), n - 1]) for n in surface.height_m.shape)
    x = surface.origin_m[0] + surface.cell_m * rows
    y = surface.origin_m[1] + surface.cell_m * columns
    vertex = np.stack([*np.meshgrid(x, y, indexing="ij"), surface.height_m[np.ix_(rows, columns)]], axis=-1).reshape(
        -1, 3
    )
    i = (np.arange(len(x) - 1)[:, None] * len(y) + np.arange(len(y) - 1)).ravel()
    faces = np.r_[np.c_[i, i + len(y), i + len(y) + 1], np.c_[i, i + len(y) + 1, i + 1]]
    low, high = surface.bounds_m
    top = float(surface.height_m.min()) - 0.05
    block = _block([*(high - low), top], [*(0.5 * (low + high)), 0.5 * top])
    return merge([Mesh.create(vertex, faces, GREY), block])


@functools.cache
def behind_a_wall():
    """One camera and one van; a wall hides most of it from most of the roof."""
    surface = _surface([-1.2, -0.7], [1.2, 0.7], lambda x, y: 1.5 + 0.0 * (x + y))
    wall = _block([0.4, 12.0, 6.0], [3.2, -5.6, 3.0])  # its end stands at y = 0.4
    van = _vehicle(0, [2.4, 6.0, 3.0], [9.0, 1.2, 1.5])
    return World(
        "behind a wall",
        _scene("wall", [wall], _body(surface), [van]),
        surface,
        (1.1504155, 0.6998618, 0.6509291),
        single,
    )


@functools.cache
def square():
    """Four cameras and four vans, one on each side, each half hidden by a post; the same after a quarter turn."""
    surface = _surface([-0.9, -0.9], [0.9, 0.9], lambda x, y: 1.5 + 0.0 * (x + y))
    blocks, vans = [], []
    for k in range(4):
        c, s = round(math.cos(0.5 * math.pi * k)), round(math.sin(0.5 * math.pi * k))
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], float)
        blocks.append(_block(np.abs(turn @ [0.3, 0.9, 6.0]), turn @ [3.0, 0.2, 3.0]))
        vans.append(_vehicle(k, np.abs(turn @ [2.4, 5.0, 3.0]), turn @ [8.0, 0.0, 1.5]))
    scene = _scene("square", blocks, _body(surface), vans)
    return World("square", scene, surface, (0.8863997, -0.9, -0.501848), turned, 4, 2)


@functools.cache
def bump():
    """One camera on a roof with a bump, and a van behind a fence; who stands higher sees more of it."""

    def height(x, y):
        return 1.5 + 0.7 * np.exp(-((x - 0.5) ** 2 + (y + 0.2) ** 2) / 0.18)

    surface = _surface([-1.2, -0.7], [1.2, 0.7], height)
    # its top slopes, so that what is seen does not change by whole rows of the image
    fence = _block([0.2, 30.0, 3.2], [5.0, 0.0, 0.0], roll_rad=0.06)
    van = _vehicle(0, [2.4, 5.0, 2.6], [9.0, 0.0, 1.3])
    return World(
        "bump", _scene("bump", [fence], _body(surface, 2), [van]), surface, (0.5410202, -0.2008734, 0.4767085), single
    )
