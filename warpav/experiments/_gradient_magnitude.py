"""How large the gradients of the losses are, each by itself (the thesis's tables I and V)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from warpav.optimisation import X_M, Y_M, YAW_RAD, AssignedScene, OptimiserSettings, RigObjective, random_mount_pose
from warpav.thesis import AdamW, BatchChooser

LOSS_OF = {
    "OOB": "out_of_bounds",
    "CD": "camera_spacing",
    "IFR": "in_frame_rotation",
    "DOA": "detected_area",
    "AC": "angular_coverage",
    "SB": "surface_blockage",
    "OV": "object_visibility",
}
"""The thesis's names of its losses, and ours."""


def measure_gradient_magnitudes(
    objective: RigObjective,
    scenes: Sequence[AssignedScene],
    yaw_rad: np.ndarray,
    *,
    settings: OptimiserSettings,
    iterations: int,
    batch_size: int = 1,
    seed: int = 0,
) -> dict[str, dict[str, float]]:
    """Mean magnitudes of every loss's gradient along a descent in which all losses count, unscaled.

    It starts at random positions; every iteration differentiates each loss separately, and the cameras follow the sum
    of all. Constraints are losses like the others there: no multipliers. ``positional`` [1/m] and ``rotational``
    [1/rad] are means over cameras and iterations of the absolute values that are not 0; 0 where all are.
    """
    names = [*(loss.name for _, loss in objective.losses), *objective.constraints.names]
    found: dict[str, list[np.ndarray]] = {name: [] for name in names}
    rng = np.random.default_rng([seed, 0])
    start = random_mount_pose(objective.constraints, yaw_rad, rng=rng)
    pose = AdamW(start, weight_decay=settings.weight_decay)
    rate = np.zeros(start.shape)
    rate[:, [X_M, Y_M]] = settings.learning_rate_position_m
    rate[:, YAW_RAD] = math.radians(settings.learning_rate_yaw_deg)
    batches = BatchChooser(scenes, len(start), rng)
    for _ in range(iterations):
        gradients = objective.gradients(pose.value, [scenes[k] for k in batches.choose(batch_size)])
        for name in names:
            found[name].append(gradients[name])
        pose.step(np.sum(list(gradients.values()), axis=0), rate)
    return {
        name: {"positional": _mean(values, [X_M, Y_M]), "rotational": _mean(values, [YAW_RAD])}
        for name, values in found.items()
    }


def _mean(gradients: list[np.ndarray], columns: list[int]) -> float:
    """Mean absolute value of what is not 0 in some columns."""
    size = np.abs(np.array(gradients, np.float64)[..., columns])
    return float(size.sum()) / max(int(np.count_nonzero(size)), 1)
