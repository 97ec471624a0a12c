"""Valid lower bounds on an object's miss probability that are linear in the choice: lifted tangents.

An object is missed with probability ``u = exp(-sum L)``, the sum over the cameras S of the rig, where a camera's
``L = -log(1 - p)`` is 0 if it does not see the object and inf if it never misses it. For any level z >= 0

    u >= (1 + z) exp(-z) - sum over S of phi(L),   phi(L) = exp(-z) L                    where L <= z,
                                                   phi(L) = (1 + z) exp(-z) - exp(-L)    where L > z.

Where all L <= z this is the tangent of the exponential at z. Otherwise one camera with L' > z takes the right side to
``exp(-L') - sum over the others of phi``, and ``phi(L) >= exp(-z) (1 - exp(-L))`` on both branches, so that even
``exp(-L') (1 - sum over the others of (1 - exp(-L)))`` is not below it, which is at most u. At z = 0 it is ``u >= 1 - sum p``,
the submodular cut of the empty rig. It is finite where p = 1, never above the tangent's and never below 1 - sum p's
best, and of all levels the one that a fractional choice violates most has a closed condition (`cut_level`).

Sources: Nemhauser and Wolsey (1981), Maximizing submodular set functions: formulations and analysis of algorithms (the
cut at z = 0); Ahmed and Atamtuerk (2011), Maximizing a class of submodular utility functions, Mathematical Programming 128
(lifting such cuts for concave functions of a sum).
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

    The derivative of the right side by z is ``exp(-z) (sum of x min(L, z) - z)``, whose bracket is concave in z and 0 at
    0: it is positive up to one root and negative beyond, or nowhere positive. Newton's steps from the right reach it.

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
