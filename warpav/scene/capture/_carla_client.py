"""CARLA's client package: whether a server is there, its blueprints, its images, and its poses as right-handed ones."""

from __future__ import annotations

import importlib
import math
import re
import socket
import time
from collections.abc import Mapping
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial import KDTree

from warpav.core.errors import InputError, install_text
from warpav.core.frames import (
    EGO_FROM_CARLA,
    carla_from_ego_pose,
    ego_from_carla_pose,
    rotation_from_yaw_pitch_roll,
    yaw_pitch_roll_from_rotation,
)
from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens
from warpav.scene._scene import Box, outline_gap_m
from warpav.scene.capture._capture import rigid_pose

Remote: TypeAlias = Any  # something that the optional package ``carla`` defines; its types cannot be named here
REACH_S = 2.5  # time within which a server answers
_VERSION_REQUEST = b"\x94\x00\x01\xa7version\x91\x91\xc2"  # MessagePack: [request, number 1, "version", [[false]]]
_ANSWER_BEGINS = b"\x94\x01\x01"  # [answer, number 1,
_CATEGORY_OF_BASE_TYPE = {"car": "car", "van": "van", "truck": "lorry", "bus": "bus"}


def import_carla() -> ModuleType:
    try:
        return importlib.import_module("carla")
    except ImportError as error:
        raise InputError(f"CARLA: expected its Python client 0.9.16, got: {error}; {install_text('carla')}") from None


def unreachable(host: str, port: int) -> str | None:
    """Why no CARLA server is there, by a request for its version, as others crash the client; None: one is there."""
    deadline_s = time.monotonic() + REACH_S
    fault = "no address"
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except OSError as error:
        return f"the host's name is not known ({error.strerror or error})"
    for family, kind, protocol, _, address in addresses:
        try:
            with socket.socket(family, kind, protocol) as probe:
                probe.settimeout(max(deadline_s - time.monotonic(), 0.05))
                probe.connect(address)
                probe.settimeout(max(deadline_s - time.monotonic(), 0.05))
                probe.sendall(_VERSION_REQUEST)
                answer, length = b"", len(_ANSWER_BEGINS)
                while len(answer) < length and (part := probe.recv(length - len(answer))):
                    answer += part
                if answer == _ANSWER_BEGINS:
                    return None
                fault = "an answer that is not CARLA's"
        except TimeoutError:
            fault = f"no answer within {REACH_S:g} s"
        except OSError as error:
            fault = (error.strerror or str(error)).lower()
    return fault


def release_of(version: str) -> str:
    """``0.9.16`` of ``0.9.16-2-gabcdef``; builds from source describe themselves so."""
    match = re.match(r"\d+\.\d+\.\d+", version)
    return match.group() if match else version


def set_attributes(blueprint: Remote, values: Mapping[str, str | None]) -> None:
    """Those that the blueprint has and lets be changed."""
    for name, value in values.items():
        if value is not None and blueprint.has_attribute(name) and blueprint.get_attribute(name).is_modifiable:
            blueprint.set_attribute(name, value)


def colours_of(blueprint: Remote) -> list[str]:
    return list(blueprint.get_attribute("color").recommended_values) if blueprint.has_attribute("color") else []


def category_of(blueprint: Remote) -> str | None:
    """What a blueprint is: car, van, lorry or bus; None for what has two wheels, or none."""
    if blueprint.has_attribute("base_type"):
        base_type = blueprint.get_attribute("base_type").as_str().lower()
        if base_type:
            return _CATEGORY_OF_BASE_TYPE.get(base_type)
    wheels = blueprint.get_attribute("number_of_wheels").as_int() if blueprint.has_attribute("number_of_wheels") else 0
    return "car" if wheels >= 4 else None


_DEPTH_RANGE_M = 1000.0  # where the depth camera's 24 bits end
_SKY_M = 0.999 * _DEPTH_RANGE_M  # the sky's dome is drawn somewhere beyond the range, so its depth is cut there


def depth_from_bgra(bgra: np.ndarray) -> np.ndarray:
    """Metres from what CARLA's depth camera sends, [row, column, 4]: 24 bits, red lowest, over the range of 1 km."""
    depth_m = code_from_bgra(bgra) * (_DEPTH_RANGE_M / (2**24 - 1))
    return np.where(depth_m < _SKY_M, depth_m, np.inf).astype(np.float32)


def code_from_bgra(bgra: np.ndarray) -> np.ndarray:
    """One number per pixel [row, column] from what CARLA's instance camera sends: semantic tag + 256 G + 65536 B.

    Green and blue are the low and the high byte of a number that the server gives the object. That is the actor's id
    on small maps and the engine's own number on large ones, so only the whole colour is compared.
    """
    blue, green, red = (bgra[..., channel].astype(np.int32) for channel in range(3))
    return red + 256 * green + 65536 * blue


def check_pinhole(model: CameraModel) -> None:
    """Raise a ValueError for a camera that CARLA does not have."""
    centred = CameraModel(model.width_px, model.height_px, model.fov_rad)
    if model.lens is not Lens.PINHOLE or not np.allclose(model.intrinsics, centred.intrinsics, rtol=0.0, atol=1e-3):
        raise ValueError(
            "CARLA's cameras are pinholes with square pixels and the principal point in the centre, got a "
            f"{model.lens} lens with intrinsics {model.intrinsics.round(2).tolist()}"
        )


_SAME_PLACE_M = 2.5  # below the distance between the centres of neighbouring lanes


def inverse_pose(pose: np.ndarray) -> np.ndarray:
    return rigid_pose(pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3])


def point_of(vector: Remote) -> np.ndarray:
    """A ``carla.Vector3D`` with y turned around."""
    return EGO_FROM_CARLA @ [vector.x, vector.y, vector.z]


def pose_of(transform: Remote) -> np.ndarray:
    """Right-handed pose [4, 4] of an object with CARLA's ``location`` and ``rotation``."""
    location, turn = transform.location, transform.rotation
    position_m, yaw_rad, pitch_rad, roll_rad = ego_from_carla_pose(
        np.array([location.x, location.y, location.z]), pitch_deg=turn.pitch, yaw_deg=turn.yaw, roll_deg=turn.roll
    )
    return rigid_pose(rotation_from_yaw_pitch_roll(yaw_rad, pitch_rad, roll_rad), position_m)


def transform_of(carla: ModuleType, pose: np.ndarray) -> Remote:
    """The ``carla.Transform`` of a right-handed pose."""
    yaw_rad, pitch_rad, roll_rad = yaw_pitch_roll_from_rotation(pose[:3, :3])
    location_m, pitch_deg, yaw_deg, roll_deg = carla_from_ego_pose(
        pose[:3, 3], yaw_rad=yaw_rad, pitch_rad=pitch_rad, roll_rad=roll_rad
    )
    x, y, z = (float(value) for value in location_m)
    return carla.Transform(carla.Location(x=x, y=y, z=z), carla.Rotation(pitch=pitch_deg, yaw=yaw_deg, roll=roll_deg))


def place_of(transform: Remote) -> tuple[float, float, float, float]:
    """Position [m] and heading [rad], right-handed; rounded, so that sorting does not hang on the last bits."""
    pose = pose_of(transform)
    x, y, z = (round(float(value), 4) for value in pose[:3, 3])
    return x, y, z, round(math.atan2(pose[1, 0], pose[0, 0]), 6)


def ego_pose_of_wheels(wheel_m: np.ndarray, radius_m: np.ndarray) -> np.ndarray | None:
    """The ego frame [4, 4] by the ground contacts of wheels, [wheel, 3], below the rear axle; None if unlikely."""
    if len(wheel_m) < 4:
        return None
    order = np.argsort(wheel_m[:, 0], kind="stable")
    touch_m = wheel_m - radius_m[:, None] * [0.0, 0.0, 1.0]
    rear_m, front_m = (pair[np.argsort(pair[:, 1])] for pair in (touch_m[order[:2]], touch_m[order[-2:]]))
    forward_m = front_m.mean(axis=0) - rear_m.mean(axis=0)
    left_m = 0.5 * (rear_m[1] - rear_m[0] + front_m[1] - front_m[0])
    base_m, track_m = np.linalg.norm(forward_m), np.linalg.norm(left_m)
    if not (1.0 < base_m < 10.0 and 0.8 < track_m < 3.5 and np.linalg.norm(rear_m.mean(axis=0)) < 10.0):
        return None
    forward = forward_m / base_m
    up = np.cross(forward, left_m)
    up /= np.linalg.norm(up)
    turn = np.stack([forward, np.cross(up, forward), up], axis=-1)
    if min(turn[0, 0], turn[2, 2]) < math.cos(math.radians(5.0)):
        return None
    return rigid_pose(turn, rear_m.mean(axis=0))


def meets_box(box: Box, origin_m: np.ndarray, ray: np.ndarray, *, margin_m: float) -> np.ndarray:
    """Which rays from a point meet a box that is larger by a margin on each side."""
    start_m, along = box.local_m(origin_m), ray @ box.ego_from_box
    along = np.where(np.abs(along) < 1e-12, 1e-12, along)
    half_m = 0.5 * box.size_m + margin_m
    ends = np.sort(np.stack([(-half_m - start_m) / along, (half_m - start_m) / along]), axis=0)
    return np.min(ends[1], axis=-1) >= np.maximum(np.max(ends[0], axis=-1), 0.0)


def boxes_overlap(first: Box, second: Box) -> bool:
    """Whether two upright boxes overlap; frozen vehicles do not collide, so CARLA may not report it."""
    is_level = abs(second.center_m[2] - first.center_m[2]) < 0.5 * (first.size_m[2] + second.size_m[2])
    return bool(is_level) and outline_gap_m(first.outline_m, second.outline_m) < 0.0


def lane_places(carla_map: Remote, *, spacing_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Places of normal driving: the map's own spawn points, and points along its driving lanes outside junctions.

    Of poses within 2.5 m of each other one is kept, the map's own before those of lanes. The order does not depend on
    the order in which the client lists them, which is none in particular.

    Shapes: returns [place, 3].
    """
    own, along = [], []
    for transform in carla_map.get_spawn_points():  # these hang above the road
        place = place_of(transform)
        lane = carla_map.get_waypoint(transform.location)
        if lane is not None:
            ground = place_of(lane.transform)
            if math.hypot(ground[0] - place[0], ground[1] - place[1]) < _SAME_PLACE_M:
                place = (*place[:2], ground[2], place[3])
        own.append(place)
    for waypoint in carla_map.generate_waypoints(spacing_m):
        if waypoint.lane_type.name == "Driving" and not waypoint.is_junction:
            along.append(place_of(waypoint.transform))
    places = np.array(sorted(own) + sorted(along), np.float64).reshape(-1, 4)
    kept = np.ones(len(places), bool)
    if len(places):
        tree = KDTree(places[:, :3])
        for index, position_m in enumerate(places[:, :3]):
            if kept[index]:
                near = np.array(tree.query_ball_point(position_m, _SAME_PLACE_M))
                kept[near[near > index]] = False
    return places[kept, :3], places[kept, 3]
