"""Rigs as an engineer draws them by hand: at the corners, crosswise, at the edge, around the highest point.

A search starts from the best of them and keeps what comes of polishing it, so its result is never behind. Where a hand
would vary a number, some values are tried one after the other: the angle of the corners, how far the front pair is set
back, the pitch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from warpav.core.errors import InputError
from warpav.optimisation.baselines import TOP_M, edge_mount_pose, highest_mount_pose
from warpav.optimisation.constraints import Constraints
from warpav.optimisation.mount import MOUNT_POSE_SIZE, PITCH_RAD, X_M, Y_M, YAW_RAD, CameraMount

CORNER_DEG = (44, 40, 42, 46, 48)
"""Half the angle between the cameras of a pair at the front, and at the rear [deg]; the first is tried first."""

SET_BACK_M = (0.3, 0.0, 0.6)
"""How far behind the front edge the front pair stands [m]."""

PITCH_DEG = (12, 0, 6, 18)
"""Pitches, nose down [deg]."""

_ALONG_RAD = math.radians(20.0)
"""A camera that looks so nearly along an axis of the vehicle stands amid that edge."""


_SAME_RAD = math.radians(1.0)
"""A zone that turns a camera by more is not for it."""


@dataclass(frozen=True, eq=False)
class HandRig:
    """A rig by hand."""

    name: str
    numbers: str  # what was varied, in words
    mount_pose: np.ndarray  # float32 [camera, 7], of symmetric mounts without the mirror images
    value: float = math.inf  # of the objective


def directions_rad(name: str, count: int, corner_deg: float) -> np.ndarray:
    """Yaws of the cameras of a rig by hand [rad], float64 [camera].

    ``corners``: pairs at the corners, then one ahead, one behind, left and right. ``cross``: evenly round, the first
    ahead.
    """
    if name != "corners" or count < 4:
        return np.angle(np.exp(2j * math.pi * np.arange(count) / count))
    corner = math.radians(corner_deg)
    four = [corner, -corner, math.pi - corner, corner - math.pi]
    axes = [0.0, math.pi, 0.5 * math.pi, -0.5 * math.pi]
    more = np.angle(np.exp(2j * math.pi * (np.arange(max(count - 8, 0)) + 0.25) / max(count - 8, 1)))
    return np.array([*four, *axes, *more])[:count]


def hand_mount_pose(
    mount: CameraMount, constraints: Constraints, yaw_rad: np.ndarray, *, set_back_m: float, pitch_deg: float
) -> np.ndarray | None:
    """Cameras at the edge of the top, each where it looks outwards, float32 [camera, 7]; those ahead are set back.

    None where no zone lets one of them look so, or a symmetric mount has no pair or no middle for it.
    """
    surface = constraints.surface
    if mount.is_symmetric:  # the mirror images follow
        yaw_rad = yaw_rad[np.sin(yaw_rad) > -1e-9]
    is_mountable = np.ones(surface.height_m.shape, bool) if surface.is_mountable is None else surface.is_mountable
    place_m = surface.origin_m + surface.cell_m * np.argwhere(is_mountable)
    point_m = surface.point_m(place_m, surface.height_at_m(place_m))
    is_top = point_m[:, 2] >= point_m[:, 2].max() - TOP_M
    place_m, point_m = place_m[is_top], point_m[is_top]
    half_m = np.abs(point_m[:, 1]).max() if mount.is_symmetric else None
    low_m, high_m = point_m[:, :2].min(axis=0), point_m[:, :2].max(axis=0)
    if half_m is not None:
        low_m, high_m = np.array([low_m[0], -half_m]), np.array([high_m[0], half_m])
    look = np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], axis=1)
    side = np.where(np.abs(look) > math.sin(_ALONG_RAD), np.sign(look), 0.0)
    wanted_m = 0.5 * (low_m + high_m) + 0.5 * side * (high_m - low_m)
    wanted_m[:, 0] -= np.where(side[:, 0] > 0.0, set_back_m, 0.0)
    at_place = np.pad(place_m, ((0, 0), (0, MOUNT_POSE_SIZE - 2))).astype(np.float32)
    is_pair = mount.is_pair(at_place)
    pose = np.zeros((len(yaw_rad), MOUNT_POSE_SIZE))
    pose[:, YAW_RAD], pose[:, PITCH_RAD] = yaw_rad, math.radians(pitch_deg)
    for camera, each_m in enumerate(wanted_m):
        at_place[:, YAW_RAD] = yaw_rad[camera]
        may_be = np.abs(np.sin(0.5 * (mount.clipped(at_place)[:, YAW_RAD] - yaw_rad[camera]))) < _SAME_RAD
        may_be &= is_pair == (side[camera, 1] != 0.0) if mount.is_symmetric else True
        if not may_be.any():
            return None
        distance_m = np.linalg.norm(point_m[:, :2] - each_m, axis=1)
        pose[camera, [X_M, Y_M]] = place_m[np.where(may_be, distance_m, np.inf).argmin()]
    return _placed(mount, constraints, pose)


def _placed(mount: CameraMount, constraints: Constraints, pose: np.ndarray) -> np.ndarray:
    pose = mount.clipped(mount.off_the_skin(pose))
    pose[:, [X_M, Y_M]] = constraints.project(pose[:, [X_M, Y_M]])
    return mount.clipped(pose).astype(np.float32)


def rig_by_hand(name: str, mount: CameraMount, constraints: Constraints, count: int) -> np.ndarray:
    """The rig by hand of a name, with the numbers that are tried first, float32 [camera, 7].

    ``name``: ``corners``, ``cross``, ``edge`` or ``highest``.
    """
    if name in _OF_SURFACE:
        return _placed(mount, constraints, _OF_SURFACE[name](constraints, count))
    set_back_m = SET_BACK_M[0] if name == "corners" else 0.0
    yaw_rad = directions_rad(name, count, CORNER_DEG[0])
    pose = hand_mount_pose(mount, constraints, yaw_rad, set_back_m=set_back_m, pitch_deg=PITCH_DEG[0])
    if pose is None:
        raise InputError(f"{name}: expected zones in which cameras may look so, got none for one of them")
    return pose


_OF_SURFACE = {"edge": edge_mount_pose, "highest": highest_mount_pose}


def by_hand(
    mount: CameraMount,
    constraints: Constraints,
    count: int,
    values_of: Callable[[Sequence[np.ndarray]], Sequence[float]],
) -> list[HandRig]:
    """Rigs by hand of equal cameras, the best first: of each kind the best of what a hand would try.

    ``values_of`` gives the objective of rigs, each float32 [camera, 7].
    """

    def rated(rigs: list[HandRig]) -> list[HandRig]:
        values = values_of([rig.mount_pose for rig in rigs])
        return [replace(rig, value=float(value)) for rig, value in zip(rigs, values, strict=True)]

    pitches = PITCH_DEG if mount.is_free[PITCH_RAD] else (0,)
    kinds = [("cross", {"corner": CORNER_DEG[:1], "back": (0.0,), "pitch": pitches})]
    if count >= 4:
        kinds.append(("corners", {"corner": CORNER_DEG, "back": SET_BACK_M, "pitch": pitches}))
    found = [best for name, tried in kinds if (best := _best_of_kind(mount, constraints, name, count, tried, rated))]
    if not mount.is_symmetric:
        found += rated([HandRig(name, "", rig_by_hand(name, mount, constraints, count)) for name in _OF_SURFACE])
    return sorted(found, key=lambda rig: rig.value)


def _best_of_kind(
    mount: CameraMount,
    constraints: Constraints,
    name: str,
    count: int,
    tried: Mapping[str, Sequence[float]],
    rated: Callable[[list[HandRig]], list[HandRig]],
) -> HandRig | None:
    """The best rig of a kind: one number is varied after the other; None where the mount has no place for it."""
    now = {key: values[0] for key, values in tried.items()}
    best: HandRig | None = None
    for key, values in tried.items():
        several = []
        for value in values if best is None else values[1:]:
            each = {**now, key: value}
            yaw_rad = directions_rad(name, count, each["corner"])
            pose = hand_mount_pose(mount, constraints, yaw_rad, set_back_m=each["back"], pitch_deg=each["pitch"])
            if pose is None:
                return None
            front = f"{each['corner']:g} deg, front pair {each['back']:g} m back, " if name == "corners" else ""
            several.append((value, HandRig(name, f"{front}pitch {each['pitch']:g} deg", pose)))
        if not several:
            continue
        for (value, _), rig in zip(several, rated([rig for _, rig in several]), strict=True):
            if best is None or rig.value < best.value:
                best, now = rig, {**now, key: value}
    return best
