"""Where a descent begins: the best of a few rigs, simple ones and ones spread evenly over all there are."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from warpav.objective.mount import YAW_RAD
from warpav.optimise.baselines import highest_mount_pose
from warpav.optimise.search import BudgetedValue, SearchSpace

HIGHEST_TURNS = 4
"""Turns at which the cameras around the highest point are looked at, over the angle from one camera to the next."""


def first_rigs(space: SearchSpace, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Rigs to begin with, the most promising first, float32 [camera, 7] each; there is no end to them.

    The cameras around the highest point, as they are and turned by parts of the angle between them; then a scrambled
    Sobol sequence, each of its rigs moved to the nearest feasible one.
    """
    from scipy.stats import qmc

    highest = highest_mount_pose(space.constraints, space.camera_count)
    step_rad = 2.0 * math.pi / space.camera_count
    # first the half turn, which is farthest from the rig as it is
    for k in sorted(range(HIGHEST_TURNS), key=lambda k: abs(k / HIGHEST_TURNS - 0.5) if k else -1.0):
        pose = highest.copy()
        pose[:, YAW_RAD] += k / HIGHEST_TURNS * step_rad
        yield space.feasible(pose)
    sequence = qmc.Sobol(max(space.size, 1), scramble=True, rng=rng)
    while True:
        yield space.pose_of(sequence.random(1)[0, : space.size])


def best_start(value: BudgetedValue, count: int, rng: np.random.Generator, *, known: np.ndarray) -> np.ndarray:
    """The best of ``count`` rigs: a known one, then `first_rigs`.

    Args:
        value: Where to look; a look at each rig is paid from its budget.
        count: How many, at least 1.
        rng: Scrambles the sequence.
        known: A rig that is looked at first, float [camera, 7].

    Returns:
        float32 [camera, 7], feasible.

    Raises:
        BudgetSpentError: There is not enough left for them.
        ValueError: No rig had a finite value.
    """
    rigs = first_rigs(value.space, rng)
    found = [(value(pose), pose) for pose in (value.space.feasible(known), *(next(rigs) for _ in range(count - 1)))]
    lowest, pose = min(found, key=lambda each: each[0])
    if not math.isfinite(lowest):
        raise ValueError(f"none of {count} rigs had a finite value")
    return pose
