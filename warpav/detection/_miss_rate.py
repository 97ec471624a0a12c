"""What rigs are expected to miss by the probability that each camera detects each object; cameras err independently."""

from __future__ import annotations

import numpy as np

SUREST = 0.9999
"""Greatest probability that counts, as in the loss."""
_BLOCK = 512


def expected_miss_rate(detection_probability: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Share of the objects that a rig misses: the weighted mean of the products of 1 - p; weights sum to 1."""
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


def shares_of(weight: np.ndarray | None) -> np.ndarray | None:
    """Weights of objects, at least 0 and not all 0, divided by their sum, as `expected_miss_rate` takes them."""
    return None if weight is None else np.asarray(weight, np.float64) / np.sum(weight)


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
