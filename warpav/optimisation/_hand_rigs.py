"""Rigs as an engineer draws them by hand: at the corners, crosswise, at the edge, as known vehicles carry them.

A search starts from the best of them and keeps what comes of polishing it, so its result is never behind. Where a hand
would vary a number, some values are tried one after the other: the angle of the corners, how far the front pair is set
back, the pitch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from warpav.core.errors import InputError
from warpav.optimisation._baselines import TOP_M, edge_mount_pose, highest_mount_pose
from warpav.optimisation._constraints import Constraints
from warpav.optimisation._mount import MOUNT_POSE_SIZE, PITCH_RAD, X_M, Y_M, YAW_RAD, CameraMount
from warpav.rig import AS_BUILT, Role, preset_rig

_CORNER_DEG = (44, 40, 42, 46, 48)
"""Half the angle between the cameras of a pair at the front, and at the rear [deg]; the first is tried first."""

_SET_BACK_M = (0.3, 0.0, 0.6)  # how far behind the front edge the front pair stands [m]

_PITCH_DEG = (12, 0, 6, 18)  # pitches, nose down [deg]

_GROUND_FROM_M = 2.0  # from how far off the body on a layout of a known vehicle is pitched to see the ground [m]

_ALONG_RAD = math.radians(20.0)  # a camera that looks so nearly along an axis of the vehicle stands amid that edge

_SAME_RAD = math.radians(1.0)  # a zone that turns a camera by more is not for it

_FRONT_RAD = math.radians(15.0)
"""Modules for the front, and for the rear, look so far aside at most where there are several."""


@dataclass(frozen=True, eq=False)
class HandRig:
    name: str
    numbers: str  # what was varied, in words
    mount_pose: np.ndarray  # float32 [camera, 7], of symmetric mounts without the mirror images
    value: float = math.inf  # of the objective

    def __str__(self) -> str:
        return f"{self.name}, {self.numbers}" if self.numbers else self.name


@dataclass(frozen=True, eq=False)
class _Layout:
    """Where cameras look and stand.

    Attributes:
        yaw_rad: Of every camera [rad], [camera].
        side: Where it stands between the ends of its zones, -1..1 (front and left: 1), [camera, 2].
        module: Which of the mount's modules it is, int [camera]; None: there is one.
    """

    yaw_rad: np.ndarray
    side: np.ndarray
    module: np.ndarray | None = None

    def of_pairs(self) -> _Layout:
        """Those on the left and in the middle: the mirror images follow."""
        kept = np.sin(self.yaw_rad) > -1e-9
        return _Layout(self.yaw_rad[kept], self.side[kept])


def _looking_outwards(yaw_rad: np.ndarray, module: np.ndarray | None = None) -> _Layout:
    """Each at the edge or corner to which it looks."""
    look = np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], axis=1)
    return _Layout(yaw_rad, np.where(np.abs(look) > math.sin(_ALONG_RAD), np.sign(look), 0.0), module)


def directions_rad(name: str, count: int, first_deg: float) -> np.ndarray:
    """Yaws of the cameras of a rig by hand [rad], float64 [camera].

    ``corners``: pairs at the corners, then one ahead, one behind, left and right. ``cross``: evenly round, from
    ``first_deg``.
    """
    if name != "corners" or count < 4:
        first = 0.0 if name == "corners" else math.radians(first_deg)
        return np.angle(np.exp(2j * math.pi * np.arange(count) / count + 1j * first))
    corner = math.radians(first_deg)
    four = [corner, -corner, math.pi - corner, corner - math.pi]
    axes = [0.0, math.pi, 0.5 * math.pi, -0.5 * math.pi]
    more = np.angle(np.exp(2j * math.pi * (np.arange(max(count - 8, 0)) + 0.25) / max(count - 8, 1)))
    return np.array([*four, *axes, *more])[:count]


def _layout(name: str, mount: CameraMount, constraints: Constraints, count: int, first_deg: float) -> _Layout:
    """Where the cameras of ``corners``, ``cross`` or a known vehicle look and stand."""
    if constraints.module is not None:
        yaw_rad = np.zeros(len(constraints.module))
        for kind in np.unique(constraints.module):
            own = np.flatnonzero(constraints.module == kind)
            is_pair = mount.surface.pairs[kind] if mount.is_symmetric else None
            yaw_rad[own] = _directions_of_role(mount.roles[kind], name, len(own), first_deg, is_pair=is_pair)
        return _looking_outwards(yaw_rad, constraints.module)
    found = _as_built(name) if name in AS_BUILT else _looking_outwards(directions_rad(name, count, first_deg))
    return found.of_pairs() if mount.is_symmetric else found


def _are_alike(mount: CameraMount) -> bool:
    """Whether all cameras are of one kind, and may look anywhere."""
    return len(set(mount.surface.modules)) <= 1 and mount.roles[0] in (Role.ANY, Role.SURROUND)


@cache
def _as_built(name: str) -> _Layout:
    """The layout of a known vehicle, between the ends of its rig."""
    cameras = [camera for camera in preset_rig(name).cameras if camera.name.startswith(AS_BUILT[name])]
    position_m = np.array([camera.position_m[:2] for camera in cameras])
    low_m, high_m = position_m.min(axis=0), position_m.max(axis=0)
    side = 2.0 * (position_m - low_m) / np.maximum(high_m - low_m, 1e-6) - 1.0
    yaw_rad = np.array([camera.yaw_rad for camera in cameras])
    ahead = np.abs(np.sin(yaw_rad)) < math.sin(_SAME_RAD)
    side[ahead, 1] = 0.0  # those that look along the vehicle stand in its middle
    return _Layout(np.where(ahead, np.where(np.cos(yaw_rad) > 0.0, 0.0, math.pi), yaw_rad), side)


def _directions_of_role(role: Role, name: str, count: int, first_deg: float, *, is_pair: bool | None) -> np.ndarray:
    """Yaws of so many modules of a kind [rad], of pairs those on the left."""
    between = (np.arange(count) + 0.5) / count  # 0..1
    if role in (Role.FRONT, Role.REAR):
        aside = _FRONT_RAD * (between if is_pair else 2.0 * between - 1.0)
        aside = np.zeros(count) if is_pair is False else aside
        return aside if role is Role.FRONT else math.pi - aside
    if is_pair:
        corner = math.radians(first_deg)
        return np.array([corner, math.pi - corner]) if count == 2 and name == "corners" else math.pi * between
    if is_pair is False:  # in the middle
        return np.where(np.arange(count) % 2 == 0, 0.0, math.pi)
    if role is Role.SIDE:
        sides = (math.pi, count - count // 2), (-math.pi, count // 2)
        return np.concatenate([turn * (np.arange(own) + 0.5) / max(own, 1) for turn, own in sides])
    return directions_rad(name, count, first_deg)


def _hand_mount_pose(
    mount: CameraMount, constraints: Constraints, layout: _Layout, *, set_back_m: float, pitch_deg: float
) -> np.ndarray | None:
    """Cameras of a layout, float32 [camera, 7]; those ahead are set back.

    Plain cameras stand on the top, modules in their zones. None where no zone lets one of them look so, or a symmetric
    mount has no pair or no middle for it.
    """
    surface = constraints.surface
    is_mountable = np.ones(surface.height_m.shape, bool) if surface.is_mountable is None else surface.is_mountable
    place_m = surface.origin_m + surface.cell_m * np.argwhere(is_mountable)
    point_m = surface.point_m(place_m, surface.height_at_m(place_m))
    if layout.module is None:
        is_top = point_m[:, 2] >= point_m[:, 2].max() - TOP_M
        place_m, point_m = place_m[is_top], point_m[is_top]
    at_place = np.pad(place_m, ((0, 0), (0, MOUNT_POSE_SIZE - 2))).astype(np.float32)
    is_pair, module = mount.is_pair(at_place), mount.module_of(at_place)
    pose = np.zeros((len(layout.yaw_rad), MOUNT_POSE_SIZE))
    pose[:, YAW_RAD], pose[:, PITCH_RAD] = layout.yaw_rad, math.radians(pitch_deg)
    for camera, (side, yaw_rad) in enumerate(zip(layout.side, layout.yaw_rad, strict=True)):
        at_place[:, YAW_RAD] = yaw_rad
        turned = np.abs(np.sin(0.5 * (mount.clipped(at_place)[:, YAW_RAD] - yaw_rad)))
        if layout.module is not None:
            own = module == layout.module[camera]
            may_be = own & (turned <= turned[own].min(initial=np.inf) + _SAME_RAD)
        else:
            own = np.ones(len(place_m), bool)
            may_be = turned < _SAME_RAD
            may_be &= is_pair == (abs(math.sin(yaw_rad)) > math.sin(_SAME_RAD)) if mount.is_symmetric else True
        if not may_be.any():
            return None
        low_m, high_m = point_m[own, :2].min(axis=0), point_m[own, :2].max(axis=0)
        if mount.is_symmetric:
            half_m = np.abs(point_m[own, 1]).max()
            low_m[1], high_m[1] = -half_m, half_m
        wanted_m = 0.5 * (low_m + high_m) + 0.5 * side * (high_m - low_m) - [set_back_m * (side[0] > 0.0), 0.0]
        distance_m = np.linalg.norm(point_m[:, :2] - wanted_m, axis=1)
        pose[camera, [X_M, Y_M]] = place_m[np.where(may_be, distance_m, np.inf).argmin()]
    return _placed(mount, constraints, pose)


def _placed(mount: CameraMount, constraints: Constraints, pose: np.ndarray) -> np.ndarray:
    pose = mount.clipped(mount.off_the_skin(pose))
    pose[:, [X_M, Y_M]] = constraints.project(pose[:, [X_M, Y_M]])
    return mount.clipped(pose).astype(np.float32)


def _ground_pitch_deg(mount: CameraMount, constraints: Constraints) -> int:
    """The pitch from which the ground is seen from `_GROUND_FROM_M` off the body, as far as cameras may [deg]."""
    height_m = float(constraints.surface.highest_point_m()[2]) + mount.height_offset_m
    half_rad = mount.camera.half_field[1]
    return round(math.degrees(max(math.atan2(height_m, _GROUND_FROM_M) - half_rad, 0.0)))


def mount_pose_by_hand(
    name: str, mount: CameraMount, constraints: Constraints, count: int, corner_deg: float | None = None
) -> np.ndarray:
    """The rig ``corners``, ``cross``, ``edge`` or ``highest``, with the numbers tried first, float32 [camera, 7]."""
    if name in _OF_SURFACE:
        rows = count if constraints.module is None else len(constraints.module)
        return _placed(mount, constraints, _OF_SURFACE[name](constraints, rows))
    constraints = constraints.of_any_modules if _are_alike(mount) else constraints
    set_back_m = _SET_BACK_M[0] if name == "corners" else 0.0
    layout = _layout(name, mount, constraints, count, (corner_deg or _CORNER_DEG[0]) if name == "corners" else 0.0)
    pose = _hand_mount_pose(mount, constraints, layout, set_back_m=set_back_m, pitch_deg=_PITCH_DEG[0])
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
    """Rigs by hand, the best first: all that a hand would try of each kind, one number varied after the other.

    ``values_of`` gives the objective of rigs, each float32 [camera, 7].
    """

    def rated(rigs: list[HandRig]) -> list[HandRig]:
        values = values_of([rig.mount_pose for rig in rigs])
        found.extend(replace(rig, value=float(value)) for rig, value in zip(rigs, values, strict=True))
        return found[-len(rigs) :]

    found, of_surface = list[HandRig](), constraints
    constraints = constraints.of_any_modules if _are_alike(mount) else constraints
    is_pitched = bool(mount.is_free[PITCH_RAD])
    pitches = _PITCH_DEG if is_pitched else (0,)
    rounds = (0.0, 180.0 / count) if _are_alike(mount) and count != 4 else (0.0,)  # of four the other is `corners`
    kinds = [("cross", {"first": rounds, "back": (0.0,), "pitch": pitches})]
    if count >= 4:
        kinds.append(("corners", {"first": _CORNER_DEG, "back": _SET_BACK_M, "pitch": pitches}))
    if _are_alike(mount):
        pitch_deg = _ground_pitch_deg(mount, constraints) if is_pitched else 0
        as_built = {"first": (0.0,), "back": (0.0,), "pitch": (pitch_deg,)}
        kinds += [(name, as_built) for name in AS_BUILT if len(_as_built(name).yaw_rad) == count]
    for name, tried in kinds:
        _try_kind(mount, constraints, name, count, tried, rated)
    if not mount.is_symmetric:
        rated([HandRig(name, "", mount_pose_by_hand(name, mount, of_surface, count)) for name in _OF_SURFACE])
    return sorted(found, key=lambda rig: rig.value)


def _try_kind(
    mount: CameraMount,
    constraints: Constraints,
    name: str,
    count: int,
    tried: Mapping[str, Sequence[float]],
    rated: Callable[[list[HandRig]], list[HandRig]],
) -> None:
    """Rate rigs of a kind: one number is varied after the other, where the mount has a place for them."""
    now = {key: values[0] for key, values in tried.items()}
    best: HandRig | None = None
    for key, values in tried.items():
        several = []
        for value in values if best is None else values[1:]:
            each = {**now, key: value}
            layout = _layout(name, mount, constraints, count, each["first"])
            pose = _hand_mount_pose(mount, constraints, layout, set_back_m=each["back"], pitch_deg=each["pitch"])
            if pose is not None:
                first = f"{each['first']:g} deg, " if each["first"] else ""
                back = f"front pair {each['back']:g} m back, " if name == "corners" else ""
                several.append((value, HandRig(name, f"{first}{back}pitch {each['pitch']:g} deg", pose)))
        if not several:
            continue
        for (value, _), rig in zip(several, rated([rig for _, rig in several]), strict=True):
            if best is None or rig.value < best.value:
                best, now = rig, {**now, key: value}
