"""Margins of cameras at the points of hard requirements, by the mount poses that a polish moves."""

from __future__ import annotations

import numpy as np

from warpav.optimisation.camera_jacobians import placing_slope
from warpav.optimisation.ghost_scene import GhostScene
from warpav.optimisation.hard_points import HardPoints, Margins
from warpav.optimisation.mount import MIRROR
from warpav.optimisation.single_cameras import SingleCameras


def hard_points(cameras: SingleCameras, ghosts: GhostScene) -> HardPoints | None:
    """The hard points of requirements as a polish of some cameras keeps them met; None where there is none."""
    if not ghosts.is_hard.any():
        return None
    needed = ghosts.ghosts.of_each("cameras")[ghosts.is_hard]
    return HardPoints(lambda mount_pose: camera_margins(cameras, ghosts, mount_pose), needed)


def camera_margins(cameras: SingleCameras, ghosts: GhostScene, mount_pose: np.ndarray) -> Margins:
    """Margins at the hard points, as `GhostScene.margins`; of a pair that of the camera that has the greater one.

    What `SingleCameras.with_jacobian` has just rendered of the same cameras is not rendered again.

    Args:
        cameras: What the cameras are.
        ghosts: The requirements.
        mount_pose: As the mount counts them, float [camera, 7].

    Returns:
        float64 [camera, hard point], and the Jacobian to the mount poses, float64 [camera, hard point, 7].
    """
    pose = np.ascontiguousarray(mount_pose, np.float32)
    own, *mirrored = cameras.sides
    value, jacobian = _of_side(own, ghosts, pose)
    pair = np.flatnonzero(cameras.mount.is_pair(pose))
    for side in mirrored if len(pair) else ():
        image, slope = _of_side(side, ghosts, pose[pair] * MIRROR)
        is_greater = image > value[pair]
        value[pair] = np.where(is_greater, image, value[pair])
        jacobian[pair] = np.where(is_greater[..., None], slope * MIRROR, jacobian[pair])
    return value, jacobian


def _of_side(cameras: SingleCameras, ghosts: GhostScene, pose: np.ndarray) -> Margins:
    """`camera_margins` of cameras of one of `SingleCameras.sides`."""
    count = int(ghosts.is_hard.sum())
    value, by_view = np.zeros((len(pose), count)), np.zeros((len(pose), count, 7))
    panes = cameras.mount.panes_of(pose)
    for pane in dict.fromkeys(panes):
        row = np.array([k for k, each in enumerate(panes) if each == pane])
        value[row], by_view[row] = ghosts.through(pane).margins(*cameras.in_ego(pose[row]))
    return value, placing_slope(cameras.mount, pose).chained(by_view)
