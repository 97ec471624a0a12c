"""Poses as a workshop takes them: positions in steps of 5 mm, angles in steps of half a degree."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Collection, Iterator

import numpy as np

from warpav.optimisation.mount import PITCH_RAD, ROLL_RAD, YAW_RAD, CameraMount
from warpav.rig.rig import Rig

STEP_M, STEP_RAD = 0.005, math.radians(0.5)
_MOST_TRIED = 256


def workshop_rig(rig: Rig, frozen: Collection[str] = ()) -> Rig:
    """A rig with all numbers rounded, in the ego frame; cameras of the names ``frozen`` stay."""

    def rounded(value: float) -> float:
        return math.radians(0.5 * round(2.0 * math.degrees(value)))

    return Rig(
        camera
        if camera.name in frozen
        else dataclasses.replace(
            camera,
            position_m=np.round(camera.position_m / STEP_M) * STEP_M,
            yaw_rad=rounded(camera.yaw_rad),
            pitch_rad=rounded(camera.pitch_rad),
            roll_rad=rounded(camera.roll_rad),
        )
        for camera in rig.cameras
    )


def roundings(mount_pose: np.ndarray, mount: CameraMount, is_held: np.ndarray) -> Iterator[np.ndarray]:
    """Mount poses [camera, 7] of a rig with rounded numbers, the nearest first: angles may be rounded the other way.

    ``is_held`` bool [camera]: those that stay as they are.
    """
    variants = []
    for pose, held in zip(mount_pose.astype(np.float64), is_held, strict=True):
        ways = []
        for number in (YAW_RAD, PITCH_RAD, ROLL_RAD):
            steps = pose[number] / STEP_RAD
            near = [round(steps)]
            if number != ROLL_RAD and abs(steps - near[0]) > 1e-3:
                near.append(near[0] + (1 if steps > near[0] else -1))
            ways.append([(each * STEP_RAD, abs(each - steps)) for each in near])
        variants.append([] if held else sorted(itertools.product(*ways), key=lambda way: sum(off for _, off in way)))
    choices = itertools.product(*(each or [None] for each in variants))
    far = sorted(
        itertools.islice(choices, 16 * _MOST_TRIED),
        key=lambda each: sum(off for way in each if way is not None for _, off in way),
    )
    for chosen in far[:_MOST_TRIED]:
        pose = mount_pose.astype(np.float64)
        for row, way in enumerate(chosen):
            if way is not None:
                pose[row, [YAW_RAD, PITCH_RAD, ROLL_RAD]] = [angle for angle, _ in way]
        rig = workshop_rig(mount.rig(pose.astype(np.float32)), _names(mount, is_held))
        yield np.where(is_held[:, None], mount_pose, mount.mount_pose_of_rig(rig))


def _names(mount: CameraMount, is_held: np.ndarray) -> list[str]:
    return [] if mount.frozen is None else [mount.frozen.camera[k].name for k in np.flatnonzero(is_held)]
