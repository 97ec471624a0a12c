"""Plausibility checks of a rig: sides that contradict names, cameras below ground, far away, or off the vehicle."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Iterator

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.rig._camera_body import nearest_on
from warpav.rig._on_body import are_inside
from warpav.rig._rig import Rig, RigCamera

FAR_M = 100.0
"""No camera of a vehicle is farther from its rear axle; such a file holds another unit, or a camera beside the road."""

_VEHICLE_M = 20.0  # no camera of a bus is farther from its rear axle
_HEIGHT_M = (0.2, 5.0)

OFF_SKIN_M = 0.5
"""A camera farther off the skin of its vehicle stands on a mast, or belongs to another vehicle."""

_INSIDE_M = 0.02
"""What is no deeper in the body than this is flush [m]."""

_SIDES = {"left": 1.0, "right": -1.0}
_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")
_LIES_M = 0.05
_LOOKS = math.sin(math.radians(10.0))
_SAME_PLACE_M = 1e-3


def mirrored_cameras(cameras: Iterable[RigCamera]) -> Iterator[str]:
    """One message per camera whose name contradicts its side, as of a left-handed file read as right-handed."""
    for camera in cameras:
        sides = {word.lower() for word in _WORD.findall(camera.name)} & set(_SIDES)  # CAM_FRONT_LEFT, rearRight
        if len(sides) != 1:
            continue
        side = sides.pop()
        forward_y = camera.ego_from_camera[1, 2]
        is_all_round = camera.model.beams is not None and camera.model.beams.is_all_round
        looks_away = not is_all_round and _SIDES[side] * forward_y < -_LOOKS
        is_wrong = _SIDES[side] * camera.position_m[1] < -_LIES_M or looks_away
        if is_wrong:
            yaw_deg = math.degrees(math.atan2(forward_y, camera.ego_from_camera[0, 2]))
            yield (
                f"camera {camera.name!r}: expected it on the {side} (y {'>' if side == 'left' else '<'} 0) and "
                f"pointing there, got y = {camera.position_m[1]:.3f} m and yaw {yaw_deg:.1f} deg (left is positive)"
            )


def description(camera: RigCamera) -> str:
    """A camera in one line: position, angles, lens, image size."""
    x, y, z = camera.position_m
    yaw, pitch, roll = (
        math.degrees(math.remainder(angle, 2.0 * math.pi))
        for angle in (camera.yaw_rad, camera.pitch_rad, camera.roll_rad)
    )
    model = camera.model
    return (
        f"{camera.name}: at {x:.3f} {y:.3f} {z:.3f} m, yaw {yaw:.1f} pitch {pitch:.1f} roll {roll:.1f} deg, "
        f"{model.lens_text} {math.degrees(model.fov_rad):.1f} deg, {model.size_text}{'' if model.beams else ' px'}"
    )


def _in_millimetres(rig: Rig) -> str:
    """One line where all positions are far away, but as millimetres those of a vehicle's cameras; else empty."""
    position = np.array([camera.position_m for camera in rig.cameras])
    position_m = 1e-3 * position
    is_far = np.linalg.norm(position, axis=1) > FAR_M
    is_near = np.linalg.norm(position_m, axis=1) < _VEHICLE_M
    is_above = (_HEIGHT_M[0] <= position_m[:, 2]) & (position_m[:, 2] <= _HEIGHT_M[1])
    if not (is_far & is_near & is_above).all():
        return ""
    given, metres = (", ".join(f"{value:g}" for value in of[0]) for of in (position, position_m))
    return (
        f"camera {rig.cameras[0].name!r}: expected position_m in metres, got [{given}]; all positions look like "
        f"millimetres: divide them by 1000, [{metres}]"
    )


def folded_lenses(cameras: Iterable[RigCamera]) -> Iterator[str]:
    """One message per camera whose distortion folds within its image, which is empty beyond."""
    for camera in cameras:
        (fx, _, cx), (_, fy, cy), _ = camera.model.intrinsics.tolist()
        across, down = max(cx, camera.model.width_px - cx) / fx, max(cy, camera.model.height_px - cy) / fy
        shape = camera.model.shape
        if any(shape.distortion) and shape.is_radial and shape.edge < math.hypot(across, down):
            yield (
                f"camera {camera.name!r}: its lens's distortion folds {math.degrees(shape.limit_rad):.1f} deg from the "
                "axis, before the corners; from there on the image is empty"
            )


def oddities(rig: Rig) -> Iterator[str]:
    """Other implausible properties that may be intended, one message each."""
    unit = _in_millimetres(rig)
    if unit:
        yield unit
    yield from folded_lenses(rig.cameras)
    for camera in rig.cameras:
        if camera.position_m[2] < 0.0:
            yield f"camera {camera.name!r} lies {-camera.position_m[2]:.3f} m below the ground"
        if not unit and np.linalg.norm(camera.position_m) > FAR_M:
            yield f"camera {camera.name!r} lies more than {FAR_M:g} m from the rear axle"
        if abs(camera.roll_rad) > 0.5 * math.pi:
            yield f"camera {camera.name!r} is mounted upside down (roll {math.degrees(camera.roll_rad):.1f} deg)"
    for one, other in itertools.combinations(rig.cameras, 2):
        if np.linalg.norm(one.position_m - other.position_m) < _SAME_PLACE_M:
            yield f"cameras {one.name!r} and {other.name!r} share one position"


def off_skin_m(rig: Rig, vehicle: Mesh) -> np.ndarray:
    """How far cameras are off the skin of a vehicle [m], float64 [camera]; negative: in its body, and not behind glass.

    ``vehicle`` in the ego frame [m].
    """
    position_m = [camera.position_m for camera in rig.cameras]
    distance_m = np.linalg.norm(nearest_on(vehicle, position_m) - position_m, axis=1)
    is_inside = are_inside(vehicle, position_m) & [camera.behind_glass is None for camera in rig.cameras]
    return np.where(is_inside & (distance_m > _INSIDE_M), -distance_m, distance_m)


def off_vehicle(rig: Rig, vehicle: Mesh) -> str:
    """One line about cameras of a rig in the body of its vehicle or far off its skin; empty where none is."""
    if unit := _in_millimetres(rig):
        return unit
    away_m = off_skin_m(rig, vehicle)
    told = [
        f"{camera.name} {abs(off_m):.2f} m {'inside' if off_m < 0.0 else 'off'}"
        for camera, off_m in zip(rig.cameras, away_m, strict=True)
        if not 0.0 <= off_m <= OFF_SKIN_M
    ]
    if not told:
        return ""
    return (
        f"expected cameras outside of the vehicle's body and at most {OFF_SKIN_M:g} m off its skin, got {len(told)} of "
        f"{len(rig.cameras)} elsewhere: {', '.join(told)}; name the vehicle that carries it by scenes.ego, or move "
        "them: position_m is from the ground below the middle of the rear axle"
    )
