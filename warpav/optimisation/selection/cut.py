"""Lower bounds on an object's miss probability that are linear in the choice: lifted tangents.

A rig S misses an object with probability ``u = exp(-sum of L)``, the sum over its cameras of ``L = -log(1 - p)``, which
is 0 for a camera that does not see the object and inf for one that never misses it. For any level z >= 0

    u >= (1 + z) exp(-z) - sum over S of phi(L),   phi(L) = exp(-z) L                    where L <= z,
                                                   phi(L) = (1 + z) exp(-z) - exp(-L)    where L > z.

Proof: where all L <= z this is the tangent of the exponential at z. Otherwise take one camera with L' > z: the right
side is ``exp(-L')`` less phi of the others. As ``phi(L) >= exp(-z) (1 - exp(-L))`` on both branches, and
``exp(-z) > exp(-L')``, it is at most ``exp(-L') (1 - sum over the others of (1 - exp(-L)))``, and so at most u.

At z = 0 it is ``u >= 1 - sum of p``, the submodular cut of the empty rig; for larger z it takes off a tangent what no
single camera can bring, so it is finite where p = 1. One condition gives the level that a fractional choice violates
most (`cut_level`), and for a whole rig that cut is tight.

Sources: Nemhauser and Wolsey (1981), Maximizing submodular set functions: formulations and analysis of algorithms, for
z = 0; Ahmed and Atamtürk (2011), Maximizing a class of submodular utility functions, for the lifting of such cuts where
the function is a concave one of a sum.
"""

from __future__ import annotations

import numpy as np

MOST_LEVEL = 30.0
"""Greatest level [log of a miss probability]: such a cut asks for no more than 3e-12."""


def cut_constant(level: np.ndarray) -> np.ndarray:
    """The right side for an empty rig, ``(1 + z) exp(-z)``, in the shape of the levels."""
    return (1.0 + level) * np.exp(-level)


def cut_coefficient(missed: np.ndarray, log_missed: np.ndarray, level: np.ndarray) -> np.ndarray:
    """What a camera takes off the right side, phi(L), 0..1; concave and increasing in L.

    Args:
        missed: Probability 1 - p that the camera misses the object, any shape.
        log_missed: L = -log(1 - p), 0..inf, likewise.
        level: z >= 0, of a shape that broadcasts.
    """
    decay = np.exp(-level)
    return np.where(log_missed <= level, decay * log_missed, decay * (1.0 + level) - missed)


def cut_slope(missed: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Derivative of `cut_coefficient` by the detection probability p = 1 - missed, exp(-z)..1; continuous."""
    decay = np.exp(-level)
    return np.where(missed >= decay, decay / np.maximum(missed, decay), 1.0)


def cut_level(fraction: np.ndarray, log_missed: np.ndarray) -> np.ndarray:
    """The level of the cut that a fractional choice violates most, for every object, 0..30, float64 [object].

    The derivative of the right side by z is ``exp(-z) (sum of x min(L, z) - z)``. Its bracket is concave in z and 0 at
    z = 0, so it is positive up to one root and negative beyond, or nowhere positive. Newton's steps from the right
    reach that root.

    Args:
        fraction: Share x of every camera of the choice, 0..1, float64 [camera].
        log_missed: L, 0..inf, float64 [camera, object].
    """
    level = np.minimum(fraction @ np.minimum(log_missed, MOST_LEVEL), MOST_LEVEL)
    while True:
        is_above = log_missed > level
        share_above = fraction @ is_above
        sum_below = fraction @ np.where(is_above, 0.0, log_missed)
        root = np.where(share_above < 1.0, sum_below / np.maximum(1.0 - share_above, 1e-12), level)
        lower = np.minimum(root, level)
        if (lower >= level - 1e-9).all():
            return lower
        level = lower
