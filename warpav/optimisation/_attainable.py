"""Which objects can be found at all: by a single camera somewhere on the mount.

Traffic hides traffic. What stands behind a lorry is missed by every rig, and of what is far away the detector finds
little from anywhere; so the misses of the best rig are not 0, and how much a rig loses shows only beside what can be
had. An object counts as attainable if one of many cameras, spread over the mount's places and directions as the first
pool of a search is, detects it with a probability of at least `_LIKELY`. That takes no detector, and no rig.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpav.optimisation._objective import RigObjective, single_cameras_of
from warpav.optimisation._pool import CameraPool, Drawing, spread_mount_poses
from warpav.optimisation.losses._scene_on_tape import AssignedScene

_CAMERAS = 128
"""Cameras that are spread over the mount."""
_LIKELY = 0.5
"""Probability from which on a camera rather detects an object than not."""


def attainable_objects(
    objective: RigObjective, scenes: Sequence[AssignedScene], *, cameras: int = _CAMERAS, drawing: Drawing | None = None
) -> list[np.ndarray] | None:
    """Which objects of each scene some camera on the mount is likely to detect, bool [object] each."""
    single = single_cameras_of(objective)
    if single is None:
        return None
    packed = [assigned.scene for assigned in scenes]
    if not any(scene.vehicle_count for scene in packed):
        return [np.zeros(0, bool) for _ in packed]
    pose = spread_mount_poses(single.mount, objective.constraints.of_single_cameras, cameras, seed=0)
    pool = CameraPool.empty(packed, single, drawing).extended(pose, may_see_nothing=True)
    is_likely = pool.detection_probability.max(axis=0, initial=0.0) >= _LIKELY
    return np.split(is_likely, np.cumsum([scene.vehicle_count for scene in packed])[:-1])
