"""Poses as a workshop takes them: positions in steps of 5 mm, angles in steps of half a degree."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Collection, Iterator

import numpy as np

from warpav.optimisation._mount import CameraMount, mirror_image
from warpav.rig import Rig, RigCamera

STEP_M, STEP_DEG = 0.005, 0.5


def workshop_rig(rig: Rig, staying: Collection[str] = ()) -> Rig:
    """A rig with all numbers rounded, in the ego frame; cameras of the names ``staying`` stay as they are."""
    return Rig(each if each.name in staying else _rounded(each) for each in rig.cameras)


def _rounded(camera: RigCamera, ways: tuple[bool, ...] = (False,) * 5) -> RigCamera:
    """A camera with rounded numbers; ``ways``: whether x, y, z, yaw, pitch are rounded to the other side."""
    numbers = np.append(camera.position_m / STEP_M, np.degrees([camera.yaw_rad, camera.pitch_rad]) / STEP_DEG)
    steps = np.round(numbers)
    steps += np.where(ways, np.where(numbers >= steps, 1.0, -1.0), 0.0)
    yaw_rad, pitch_rad = np.radians(steps[3:] * STEP_DEG)
    roll_rad = math.radians(round(math.degrees(camera.roll_rad) / STEP_DEG) * STEP_DEG)
    position_m = np.round(steps[:3] * STEP_M, 6)
    return dataclasses.replace(
        camera, position_m=position_m, yaw_rad=float(yaw_rad), pitch_rad=float(pitch_rad), roll_rad=roll_rad
    )


def roundings(pose: np.ndarray, mount: CameraMount, fits: Callable[[np.ndarray], bool]) -> Iterator[np.ndarray]:
    """Mount poses [7] of a camera, or a pair, with rounded numbers, the nearest first.

    Args:
        pose: As it is.
        mount: What it is on, of single cameras.
        fits: Whether a camera, [1, 7], keeps what it must keep alone.
    """
    cameras = mount.rig(pose[None]).cameras
    is_in_the_middle = mount.is_symmetric and len(cameras) == 1
    known = set[bytes]()
    for ways in sorted(itertools.product((False, True), repeat=5), key=sum):
        if is_in_the_middle and (ways[1] or ways[3]):
            continue
        rounded = _rounded(cameras[0], ways)
        pair = [rounded] if len(cameras) == 1 else [rounded, mirror_image(rounded)]
        rig = Rig(dataclasses.replace(camera, name=f"side_{k}") for k, camera in enumerate(pair))
        found = mount.mount_pose_of_rig(rig)
        if found.tobytes() not in known and fits(found):
            yield found[0]
        known.add(found.tobytes())
