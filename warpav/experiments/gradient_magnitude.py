"""How large the gradients of the losses are, each by itself (the thesis's tables I and V)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from warpav.optimisation.baselines import random_mount_pose
from warpav.optimisation.losses.scene_on_tape import AssignedScene
from warpav.optimisation.mount import X_M, Y_M, YAW_RAD
from warpav.optimisation.objective import RigObjective
from warpav.optimisation.settings import OptimiserSettings
from warpav.thesis.descent import AdamW
from warpav.thesis.segregation import BatchChooser

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

THESIS_RUNS = 10
THESIS_ITERATIONS = 100
THESIS_SETTINGS = OptimiserSettings(
    learning_rate_position_m=0.25, learning_rate_yaw_deg=math.degrees(0.25), weight_decay=1e-3
)
THESIS_BATCH_SIZE = 1


@dataclass(frozen=True)
class _GradientMagnitude:
    """Mean absolute value of a loss's gradient, over all its numbers that are not 0.

    Attributes:
        positional: To x and y [1/m]; 0 where all of them are 0.
        rotational: To the yaw [1/rad]; likewise.
    """

    positional: float
    rotational: float
    positional_share: float
    rotational_share: float


class _Mean:
    """Mean absolute value of numbers that are not 0."""

    def __init__(self) -> None:
        self._sum, self._count, self._all = 0.0, 0, 0

    def add(self, values: np.ndarray) -> None:
        self._sum += float(np.abs(values, dtype=np.float64).sum())
        self._count += int(np.count_nonzero(values))
        self._all += values.size

    @property
    def value(self) -> float:
        return self._sum / max(self._count, 1)

    @property
    def share(self) -> float:
        return self._count / max(self._all, 1)


def measure_gradient_magnitudes(
    objective: RigObjective,
    scenes: Sequence[AssignedScene],
    yaw_rad: np.ndarray,
    *,
    runs: int = THESIS_RUNS,
    settings: OptimiserSettings = THESIS_SETTINGS,
    iterations: int = THESIS_ITERATIONS,
    batch_size: int = THESIS_BATCH_SIZE,
    seed: int = 0,
    finished: Callable[[int], object] | None = None,
) -> dict[str, _GradientMagnitude]:
    """Mean magnitudes of every loss's gradient along descents in which all losses count, unscaled.

    Every run starts at random positions; every iteration differentiates each loss separately, and the cameras follow
    the sum of all. Constraints are losses like the others there: no multipliers. Numbers that are not 0 are pooled over
    cameras, iterations and runs.
    """
    if runs < 1:
        raise ValueError(f"runs must be at least 1, got {runs}")
    names = [*(loss.name for _, loss in objective.losses), *objective.constraints.names]
    positional, rotational = ({name: _Mean() for name in names} for _ in range(2))
    for run in range(runs):
        rng = np.random.default_rng([seed, run])
        start = random_mount_pose(objective.constraints, yaw_rad, rng=rng)
        pose = AdamW(start, weight_decay=settings.weight_decay)
        rate = np.zeros(start.shape)
        rate[:, [X_M, Y_M]] = settings.learning_rate_position_m
        rate[:, YAW_RAD] = math.radians(settings.learning_rate_yaw_deg)
        batches = BatchChooser(scenes, len(start), rng)
        for _ in range(iterations):
            batch = [scenes[k] for k in batches.choose(batch_size)]
            gradients = objective.gradients(pose.value, batch)
            for name in names:
                positional[name].add(gradients[name][:, [X_M, Y_M]])
                rotational[name].add(gradients[name][:, YAW_RAD])
            pose.step(np.sum(list(gradients.values()), axis=0), rate)
        if finished is not None:
            finished(run)
    return {
        name: _GradientMagnitude(
            positional[name].value, rotational[name].value, positional[name].share, rotational[name].share
        )
        for name in names
    }
