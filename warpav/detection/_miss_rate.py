"""What rigs are expected to miss by the probability that each camera detects each object; cameras err independently."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

SUREST = 0.9999
"""Greatest probability that counts, as in the loss."""
_BLOCK = 512


def expected_miss_rate(detection_probability: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Share of the objects that a rig misses: the weighted sum of the products of 1 - p; weights sum to 1."""
    missed = np.prod(1.0 - np.minimum(np.asarray(detection_probability, np.float64), SUREST), axis=0)
    return float(missed.mean() if weight is None else weight @ missed)


def expected_miss_slope(
    detection_probability: np.ndarray, jacobian: np.ndarray, weight: np.ndarray | None = None
) -> np.ndarray:
    """Derivatives of `expected_miss_rate` to mount poses, [camera, 7], of those of p, [camera, object, 7]."""
    missed = 1.0 - np.minimum(np.asarray(detection_probability, np.float64), SUREST)
    others = np.stack([np.prod(np.delete(missed, camera, axis=0), axis=0) for camera in range(len(missed))])
    share = np.full(missed.shape[1], 1.0 / max(missed.shape[1], 1)) if weight is None else weight
    return -np.einsum("o,co,cok->ck", share, others, jacobian)


def false_alarm_cost(detection_probability: np.ndarray, charge: np.ndarray | None) -> np.ndarray:
    """What the false alarms of each camera cost, float64 [camera].

    Where a detector may find an object or may not, it draws loose boxes, several, or of another kind: it raises false
    alarms about in proportion to p (1 - p). ``charge``: of each of those, as a share of the misses, float [object].
    """
    found = np.minimum(np.asarray(detection_probability, np.float64), SUREST)
    return np.zeros(len(found)) if charge is None else (found * (1.0 - found)) @ charge


def shares_of(weight: np.ndarray | None) -> np.ndarray | None:
    """Weights of objects, of a sum above 0, divided by it, as `expected_miss_rate` takes them."""
    return None if weight is None else np.asarray(weight, np.float64) / np.sum(weight)


@dataclass(frozen=True)
class Fusion:
    """Which road users count only where a camera and a LiDAR find them, other sensors with beams among the latter.

    Sensors err independently: with a what all cameras miss of such a one and b what all LiDARs miss, it is missed with
    a + b - ab. So a miss rate is a weighted sum of products still, and slopes, prices and replacements are what they
    are, where objects have three columns each in a matrix of probabilities: what all sensors find, what cameras find,
    and what LiDARs find. Their weights are w, 0, 0, and of those that need both -w, w, w.
    """

    within_m: float = 0.0  # horizontal distance of a box's centre from the ego frame's origin below which it is so [m]

    @property
    def is_set(self) -> bool:
        return self.within_m > 0.0

    def needs_both(self, distance_m: np.ndarray) -> np.ndarray:
        """Which objects at horizontal distances [m] need both, bool [object]."""
        return np.asarray(distance_m) < self.within_m

    def weights(self, distance_m: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
        """Weights of the three columns of objects of one scene, of weights 1 or others, float64 [3 object]."""
        weight = np.ones(len(distance_m)) if weight is None else weight
        both = np.where(self.needs_both(distance_m), weight, 0.0)
        return np.concatenate([weight - 2.0 * both, both, both])

    @staticmethod
    def columns(found: np.ndarray, is_lidar: Sequence[bool] | np.ndarray, counts: Sequence[int]) -> np.ndarray:
        """What each sensor finds or its slopes, [camera, object, ...], in columns of scenes with so many objects."""
        own = np.asarray(is_lidar, bool).reshape(-1, *(1,) * (found.ndim - 1))
        columns = np.zeros((len(found), 3 * found.shape[1], *found.shape[2:]), found.dtype)
        for column, part in zip(Fusion.triples(counts).T, (found, found * ~own, found * own), strict=True):
            columns[:, column] = part
        return columns

    @staticmethod
    def triples(counts: Sequence[int]) -> np.ndarray:
        """The columns of every object of scenes with so many, int [object, 3]."""
        first = 3 * np.cumsum([0, *counts])
        parts = [start + np.arange(3 * count).reshape(3, count).T for start, count in zip(first, counts, strict=False)]
        return np.concatenate([np.zeros((0, 3), int), *parts])


def missed_probability(detection_probability: np.ndarray) -> np.ndarray:
    """The probability that a rig misses each object, cameras erring independently: the product of 1 - p, [object]."""
    return np.prod(1.0 - np.minimum(np.asarray(detection_probability, np.float64), SUREST), axis=0)


def further_gain(missed: np.ndarray, detection_probability: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """The gain of each camera over a rig, 0..1, float64 [camera]; see the module. ``missed`` float [object]."""
    if weight is not None:
        missed = missed * (weight / np.mean(weight))
    gain = np.empty(len(detection_probability))
    for first in range(0, len(gain), _BLOCK):  # matrices may be large, and kept in half precision
        found = np.asarray(detection_probability[first : first + _BLOCK], np.float64)
        gain[first : first + _BLOCK] = np.minimum(found, SUREST) @ missed
    return gain / len(missed)
