"""Where descents begin: the best of simple rigs, of rigs spread evenly over all there are, and of their mixture."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from warpav.optimisation import YAW_RAD, AssignedScene, RigObjective, SearchSpace, highest_mount_pose

_HIGHEST_TURNS = 4
"""Turns at which the cameras around the highest point are evaluated, over the angle from one camera to the next."""


def _first_rigs(space: SearchSpace, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Rigs to begin with, the most promising first, float32 [camera, 7] each; there is no end to them.

    The cameras around the highest point, as they are and turned by parts of the angle between them; then a scrambled
    Sobol sequence, each of its rigs moved to the nearest feasible one.
    """
    from scipy.stats import qmc

    highest = highest_mount_pose(space.constraints, space.camera_count)
    step_rad = 2.0 * math.pi / space.camera_count
    # first the half turn, which is farthest from the rig as it is
    for k in sorted(range(_HIGHEST_TURNS), key=lambda k: abs(k / _HIGHEST_TURNS - 0.5) if k else -1.0):
        pose = highest.copy()
        pose[:, YAW_RAD] += k / _HIGHEST_TURNS * step_rad
        yield space.feasible(pose)
    sequence = qmc.Sobol(max(space.size, 1), scramble=True, rng=rng)
    while True:
        yield space.pose_of(sequence.random(1)[0, : space.size])


@dataclass(frozen=True, eq=False)
class _Start:
    """A rig that was evaluated."""

    mount_pose: np.ndarray  # it satisfies all constraints, float32 [camera, 7]
    value: float  # its objective on the scenes where it was evaluated


def evaluate_starts(
    objective: RigObjective,
    scenes: Sequence[AssignedScene],
    space: SearchSpace,
    count: int,
    rng: np.random.Generator,
    *,
    known: np.ndarray,
) -> list[_Start]:
    """Evaluate a known rig, `_first_rigs`, and one made of the best cameras of all of them; the best come first.

    ``known`` float [camera, 7].

    The last one is made where the objective tells which camera finds which object: single cameras are exchanged for
    those of other rigs as long as that lowers the expected number of missed objects (`exchange_cameras`). It costs no
    more renders than its own evaluation.
    """
    starts: list[_Start] = []
    probability: list[np.ndarray] = []

    def evaluate(mount_pose: np.ndarray) -> None:
        pose = space.feasible(space.in_order(mount_pose))
        found = objective.evaluate(pose, scenes, detection_probability=True)
        starts.append(_Start(pose, found.objective))
        if found.detection_probability is not None:
            probability.append(found.detection_probability)

    evaluate(known)
    rigs = _first_rigs(space, rng)
    while len(starts) < count:
        if len(starts) == count - 1 and len(starts) == len(probability) > 1:
            best = int(np.argmin([each.value for each in starts]))
            first = best * space.camera_count + np.arange(space.camera_count)
            chosen = exchange_cameras(
                np.concatenate(probability),
                first,
                is_frozen=space.is_frozen,
                weight=objective.object_weight(scenes),
            )
            evaluate(np.concatenate([each.mount_pose for each in starts])[chosen])
        else:
            evaluate(next(rigs))
    finite = [each for each in starts if math.isfinite(each.value)]
    if not finite:
        raise ValueError(f"none of {count} rigs had a finite value")
    return sorted(finite, key=lambda each: each.value)


def exchange_cameras(
    detection_probability: np.ndarray,
    chosen: np.ndarray,
    *,
    is_frozen: np.ndarray | None = None,
    weight: np.ndarray | None = None,
) -> np.ndarray:
    """Exchange one camera of a rig after the other for the best of all candidates, until nothing lowers the loss.

    Returns candidates, int [camera]; one may be there twice. ``chosen`` int [camera]; ``is_frozen`` bool [camera].

    The loss is the expected number of objects that the rig misses, the sum of the products of 1 - p over its cameras;
    no exchange of a single camera lowers that of the result.
    """
    missed = 1.0 - np.asarray(detection_probability, np.float64)
    chosen = np.array(chosen)
    while True:
        before = chosen.copy()
        for camera in range(len(chosen)) if is_frozen is None else np.flatnonzero(~is_frozen):
            others = np.prod(missed[np.delete(chosen, camera)], axis=0)
            if weight is not None:
                others = others * weight
            loss = missed @ others
            best = int(np.argmin(loss))
            # what only rounding tells apart would be exchanged for ever
            if loss[best] < loss[chosen[camera]] * (1.0 - 1e-9):
                chosen[camera] = best
        if np.array_equal(before, chosen):
            return chosen
