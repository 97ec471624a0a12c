"""Where labels stand: near what they name, clear of each other and of what is drawn; in any plane, in its own unit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

_TURN_RAD = np.linspace(-math.pi, math.pi, 24, endpoint=False)
_TURN_COST = 0.4  # of a radian from the direction that is wished for, in heights of the label
_OUTSIDE = 1e6


class Labels:
    """What is taken of a plane, in boxes of lowest and highest corner, [box, 4]; labels stay within one, if given."""

    def __init__(self, taken: Any = (), *, within: Any = (-math.inf, -math.inf, math.inf, math.inf)) -> None:  # noqa: ANN401
        self._taken, self._weight, self._within = np.zeros((0, 4)), np.zeros(0), np.asarray(within, np.float64)
        self.take(taken)

    def take(self, box: Any, weight: float = 1.0) -> None:  # noqa: ANN401 (array-like)
        """Keep labels clear of boxes, rather of those with more weight where there is no room."""
        box = np.reshape(np.asarray(box, np.float64), (-1, 4))
        self._taken = np.concatenate([self._taken, box])
        self._weight = np.append(self._weight, np.full(len(box), weight))

    def put(self, tried: np.ndarray, size: np.ndarray, *, cost: np.ndarray | float = 0.0, weight: float = 1.0) -> int:
        """The number of the first of some places [place, 2] where the middle of a label of a size [2] costs least.

        It costs the weight of all that it lies on, and its own; its box is taken then.
        """
        low, high = tried - 0.5 * size, tried + 0.5 * size
        near = (low.min(axis=0) < self._taken[:, 2:]).all(axis=1) & (high.max(axis=0) > self._taken[:, :2]).all(axis=1)
        x0, y0, x1, y1 = self._taken[near].T
        is_on = (low[:, :1] < x1) & (low[:, 1:] < y1) & (high[:, :1] > x0) & (high[:, 1:] > y0)
        is_outside = ((low < self._within[:2]) | (high > self._within[2:])).any(axis=-1)
        best = int((is_on @ self._weight[near] + _OUTSIDE * is_outside + cost).argmin())
        self.take([*low[best], *high[best]], weight)
        return best


def around(place: np.ndarray, size: np.ndarray, away: Sequence[float], first_rad: float) -> np.ndarray:
    """Places around one for the middle of a label of a size [2], so far away, the best first, [place, 2].

    Best is near, and in the wished direction.
    """
    far, turn_rad = (each.ravel() for each in np.meshgrid(away, _TURN_RAD, indexing="ij"))
    order = np.argsort(far + _TURN_COST * size[1] * np.abs(turn_rad), kind="stable")
    angle_rad = first_rad + turn_rad[order]
    return place + (far[order, None] + 0.5 * size) * np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=1)
