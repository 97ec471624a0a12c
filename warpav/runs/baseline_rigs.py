"""Rigs to compare with, which need no search: around the highest point of the roof, and random ones."""

from __future__ import annotations

import numpy as np

from warpav.optimisation.baselines import highest_mount_pose
from warpav.optimisation.space import SearchSpace
from warpav.rig.rig import Rig
from warpav.runs.placement import Placement


def highest_rig(placement: Placement) -> Rig:
    """The cameras of a placement around the highest point of its mount surface, evenly turned, the first forward.

    On zones they stand as far off the skin as their zone lets them.

    Args:
        placement: Gives number and model of the cameras, the vehicle and the constraints; frozen cameras stay.

    Raises:
        InputError: The cameras do not fit.
    """
    mount = placement.mount
    pose = highest_mount_pose(placement.objective.constraints, placement.objective.camera_count)
    return mount.rig(mount.within(mount.off_the_skin(pose)))


def random_rig(placement: Placement, seed: int = 0) -> Rig:
    """The cameras of a placement at random positions that satisfy the constraints, in random directions.

    Where zones limit directions, a direction beyond its limits is moved to the nearest one within.

    Args:
        placement: As of `highest_rig`.
        seed: The same seed gives the same rig, at least 0.

    Raises:
        InputError: The cameras do not fit.
    """
    space = SearchSpace.over(
        placement.mount, placement.objective.camera_count, constraints=placement.objective.constraints
    )
    pose = space.random(np.random.default_rng(seed)).astype(np.float32)
    return placement.mount.rig(placement.mount.within(pose))
