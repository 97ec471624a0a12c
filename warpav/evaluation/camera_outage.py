"""What a rig is expected to miss when any one of its cameras fails.

Cameras err independently, so a rig misses object o with the probability m_o, the product over its cameras of 1 - p_io;
without camera c, with the product over the others. Both follow from the probabilities of detection; nothing is rendered
again. The mean over all objects, times 100, is the number of expected misses per 100 objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from warpav.optimisation.miss_rate import expected_miss_rate, shares_of


@dataclass(frozen=True)
class CameraOutage:
    """A rig without one of its cameras."""

    camera: str
    expected_misses_per_100: float
    difference_per_100: float
    weighted_expected_misses_per_100: float | None = None
    weighted_difference_per_100: float | None = None


@dataclass(frozen=True)
class CameraOutages:
    """A rig without each of its cameras in turn."""

    expected_misses_per_100: float
    weighted_expected_misses_per_100: float | None
    cameras: tuple[CameraOutage, ...]

    @classmethod
    def of(
        cls, camera: Sequence[str], detection_probability: np.ndarray, weight: np.ndarray | None = None
    ) -> CameraOutages | None:
        """From what each camera detects.

        Args:
            detection_probability: Of each camera for each object, 0..1, float [camera, object].
        """
        if detection_probability.shape[1] == 0:
            return None
        share = None if weight is None or not weight.any() else shares_of(weight)
        others = [np.delete(detection_probability, k, axis=0) for k in range(len(camera))]
        plain, *without = (100.0 * expected_miss_rate(each) for each in (detection_probability, *others))
        if share is None:
            outages = (CameraOutage(name, rate, rate - plain) for name, rate in zip(camera, without, strict=True))
            return cls(plain, None, tuple(outages))
        weighted, *weighted_without = (
            100.0 * expected_miss_rate(each, share) for each in (detection_probability, *others)
        )
        numbers = zip(camera, without, weighted_without, strict=True)
        outages = (
            CameraOutage(name, rate, rate - plain, by_weight, by_weight - weighted) for name, rate, by_weight in numbers
        )
        return cls(plain, weighted, tuple(outages))

    @property
    def worst(self) -> CameraOutage:
        """The outage with most expected misses, by their weights where these are set; of equal ones the first."""
        return max(self.cameras, key=_expected_misses)

    def to_json(self) -> dict[str, Any]:
        """As ``evaluation.json`` has it; without weights their numbers are left out."""
        cameras = [asdict(each) for each in self.cameras]
        found = {**asdict(self), "cameras": cameras, "worst": self.worst.camera}
        for each in (found, *cameras):
            for name in [name for name, value in each.items() if value is None]:
                del each[name]
        return found


def _expected_misses(outage: CameraOutage) -> float:
    weighted = outage.weighted_expected_misses_per_100
    return outage.expected_misses_per_100 if weighted is None else weighted
