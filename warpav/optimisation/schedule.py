"""How steps and losses change over a descent."""

from __future__ import annotations

import math
from dataclasses import dataclass

from warpav.optimisation.losses.loss import LossSchedule
from warpav.optimisation.settings import OptimiserSettings


@dataclass(frozen=True)
class Schedule:
    """The course of one descent.

    Attributes:
        settings: How it steps.
        step_count: Its number of steps.
    """

    settings: OptimiserSettings
    step_count: int

    def progress(self, step: int) -> float:
        """How far along a step is: 0 at the first, 1 at the last."""
        return step / max(self.step_count - 1, 1)

    def step_share(self, step: int) -> float:
        """What a step is of the first one; ``cosine`` goes down to a hundredth."""
        if self.settings.schedule == "constant":
            return 1.0
        return 0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * self.progress(step)))

    def losses(self, step: int, final: LossSchedule) -> LossSchedule:
        """How the losses are at a step: the panorama fades, and the detector has a share from some point on."""
        progress, until = self.progress(step), self.settings.panorama_until
        faded = progress / until if until > 0.0 else 1.0
        is_late = progress >= self.settings.detector_from
        return LossSchedule(max(1.0 - faded, 0.0), final.detector_share if is_late else 0.0)

    def is_time_to_check(self, step: int) -> bool:
        """Whether the rig is evaluated on the validation scenes before a step."""
        return step == 0 or (self.settings.keep == "best" and step % self.settings.check_every == 0)
