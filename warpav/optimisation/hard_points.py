"""Points of hard requirements near the edge of what they ask for, as linear inequalities of a descent.

A camera's margin at a point is what it sees over what is asked of it, so it meets the point from 1 on. A point that so
many cameras have to meet stays met while the so many best margins stay at 1 or above. Of these, those that a step could
take below 1 become inequalities ``margin + jacobian . move >= 1``. They are tangents: whether a rig meets a point is
still for the render of that rig to say.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Margins = tuple[np.ndarray, np.ndarray]
"""Margins of cameras at points [camera, point], and their Jacobian to the mount poses [camera, point, 7]."""
KEPT_BACK = 0.02
"""How far above 1 a margin is kept where it is, as tangents are not exact."""


@dataclass(frozen=True, eq=False)
class HardPoints:
    """Points that have to be met.

    Attributes:
        margins: Of cameras, float [camera, 7], at every point.
        needed: How many cameras must meet each, int [point].
    """

    margins: Callable[[np.ndarray], Margins]
    needed: np.ndarray

    def edges(self, margins: Margins, reach: np.ndarray) -> Edges:
        """The inequalities of a rig.

        Args:
            margins: Of its cameras.
            reach: How far each number of a mount pose may move, at least 0, float [camera, 7].
        """
        value, jacobian = margins
        rank = np.argsort(np.argsort(-value, axis=0, kind="stable"), axis=0, kind="stable")
        lowest = value - np.einsum("cok,ck->co", np.abs(jacobian), reach)
        camera, point = np.nonzero((rank < self.needed) & (value > 0.0) & (lowest < 1.0 + KEPT_BACK))
        return Edges(camera, value[camera, point], jacobian[camera, point])


@dataclass(frozen=True, eq=False)
class Edges:
    """Inequalities ``value + jacobian . move of the camera >= low``.

    Attributes:
        camera: Whose margin each is about, int [row].
        value: The margin, float64 [row].
        jacobian: Its Jacobian to the camera's mount pose, float64 [row, 7].
    """

    camera: np.ndarray
    value: np.ndarray
    jacobian: np.ndarray

    @property
    def low(self) -> np.ndarray:
        """What each margin may not go below: a little over 1, or where it is, if that is less, float64 [row]."""
        return np.minimum(self.value, 1.0 + KEPT_BACK)

    def by_rig(self, camera_count: int) -> np.ndarray:
        """The Jacobians as those of a rig of so many cameras, float64 [row, camera, 7]."""
        result = np.zeros((len(self.camera), camera_count, self.jacobian.shape[1]))
        result[np.arange(len(self.camera)), self.camera] = self.jacobian
        return result
