"""What a further camera would bring: the duals of a relaxation as prices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpav.core.errors import ArgumentError
from warpav.optimisation.selection.cut import cut_coefficient, cut_slope


@dataclass(frozen=True, eq=False)
class Price:
    """Duals of a bound on all rigs of a pool.

    Attributes:
        bound: The bound, an expected miss rate.
        object_count: Number of objects of the pool.
        cut_object: Objects of the cuts that hold it up, int [cut].
        cut_level: Their levels, float64 [cut].
        cut_dual: Their duals, > 0; an object's sum to its weight at most, float64 [cut].
        row_dual: What the bound rises by for a unit more of a row's limit, float64 [row]; 0 where the row is slack.
        dearest: Cost of the dearest camera that the bound takes: who costs less would replace it.
    """

    bound: float
    object_count: int
    cut_object: np.ndarray
    cut_level: np.ndarray
    cut_dual: np.ndarray
    row_dual: np.ndarray
    dearest: float

    def reduced_cost(self, detection_probability: np.ndarray, coefficient: np.ndarray | None = None) -> np.ndarray:
        """How much lower the bound would be with one more camera in the pool, if negative; float64 [camera].

        No rig of the pool and one such camera is below ``bound + min(0, reduced cost)``; the most negative promises
        most. Where conflicts hold the bound up, the new camera is taken to be free of them.

        Args:
            detection_probability: Of the new cameras for the pool's objects, 0..1, float [camera, object].
            coefficient: Theirs in the rows, float [camera, row]; None: 0.

        Raises:
            ArgumentError: Probabilities of another number of objects, or not within 0..1.
        """
        missed = self._missed(detection_probability)
        with np.errstate(divide="ignore"):
            gain = cut_coefficient(missed, -np.log(missed), self.cut_level) @ self.cut_dual
        return -gain - self.dearest - (0.0 if coefficient is None else np.asarray(coefficient) @ self.row_dual)

    def reduced_cost_slope(self, detection_probability: np.ndarray) -> np.ndarray:
        """Derivative of the reduced cost by each probability, <= 0 and continuous, float64 [camera, object].

        Raises:
            ArgumentError: As `reduced_cost`.
        """
        missed = self._missed(detection_probability)
        slope = np.zeros((len(missed), self.object_count))
        share = -self.cut_dual * cut_slope(missed, self.cut_level)
        np.add.at(slope.T, self.cut_object, share.T)
        return slope

    def _missed(self, detection_probability: np.ndarray) -> np.ndarray:
        """1 - p for every cut, float64 [camera, cut]."""
        probability = np.asarray(detection_probability, np.float64)
        if probability.ndim != 2 or probability.shape[1] != self.object_count:
            raise ArgumentError(
                "detection_probability", f"expected [camera, {self.object_count}], got {list(probability.shape)}"
            )
        if not ((probability >= 0.0) & (probability <= 1.0)).all():
            raise ArgumentError("detection_probability", "expected probabilities 0..1, got others or NaN")
        return 1.0 - probability[:, self.cut_object]
