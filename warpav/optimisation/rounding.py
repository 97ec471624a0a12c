"""Poses as a workshop takes them: positions in steps of 5 mm, angles in steps of half a degree."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Collection, Iterator

import numpy as np

from warpav.optimisation.mount import CameraMount, mirror_image
from warpav.rig.rig import Rig, RigCamera

_STEP_M, _STEP_DEG = 0.005, 0.5
_OF_CAMERA, _OF_RIG = 4, 256
"""Roundings of a camera that a rig is made of, and rigs of these, at most."""


def workshop_rig(rig: Rig, frozen: Collection[str] = ()) -> Rig:
    """A rig with all numbers rounded, in the ego frame; cameras of the names ``frozen`` stay."""
    return Rig(each if each.name in frozen else _rounded(each) for each in rig.cameras)


def _rounded(camera: RigCamera, ways: tuple[bool, ...] = (False,) * 4) -> RigCamera:
    """A camera with rounded numbers; ``ways``: whether x, y, yaw, pitch are rounded to the other side."""
    numbers = np.append(camera.position_m / _STEP_M, np.degrees([camera.yaw_rad, camera.pitch_rad]) / _STEP_DEG)
    steps = np.round(numbers)
    other = np.insert(ways, 2, False)
    steps += np.where(other, np.where(numbers >= steps, 1.0, -1.0), 0.0)
    yaw_rad, pitch_rad = np.radians(steps[3:] * _STEP_DEG)
    roll_rad = math.radians(round(math.degrees(camera.roll_rad) / _STEP_DEG) * _STEP_DEG)
    position_m = np.round(steps[:3] * _STEP_M, 6)
    return dataclasses.replace(
        camera, position_m=position_m, yaw_rad=float(yaw_rad), pitch_rad=float(pitch_rad), roll_rad=roll_rad
    )


def roundings(
    mount_pose: np.ndarray, mount: CameraMount, is_held: np.ndarray, fits: Callable[[np.ndarray], bool]
) -> Iterator[np.ndarray]:
    """Mount poses [camera, 7] of a rig with rounded numbers, the nearest first.

    Args:
        mount_pose: Of the rig as it is.
        mount: What they are on.
        is_held: Which cameras stay as they are, bool [camera].
        fits: Whether a camera, [1, 7], keeps what it must keep alone.
    """
    choices = [
        [pose] if held else list(itertools.islice(_of_camera(pose, mount.of_single_cameras, fits), _OF_CAMERA))
        for pose, held in zip(mount_pose, is_held, strict=True)
    ]
    chosen = sorted(itertools.islice(itertools.product(*(range(len(each)) for each in choices)), 4**8), key=sum)
    for numbers in chosen[:_OF_RIG]:
        yield np.array([each[k] for each, k in zip(choices, numbers, strict=True)], np.float32)


def _of_camera(pose: np.ndarray, mount: CameraMount, fits: Callable[[np.ndarray], bool]) -> Iterator[np.ndarray]:
    cameras = mount.rig(pose[None]).cameras
    is_in_the_middle = mount.is_symmetric and len(cameras) == 1
    for ways in sorted(itertools.product((False, True), repeat=4), key=sum):
        if is_in_the_middle and (ways[1] or ways[2]):
            continue
        rounded = _rounded(cameras[0], ways)
        pair = [rounded] if len(cameras) == 1 else [rounded, mirror_image(rounded)]
        rig = Rig(dataclasses.replace(camera, name=f"side_{k}") for k, camera in enumerate(pair))
        found = mount.mount_pose_of_rig(rig)
        if fits(found):
            yield found[0]
