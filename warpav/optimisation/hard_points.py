"""Points of hard requirements near the edge of what they ask for, as linear inequalities of a descent.

A camera's margin at a point is what it sees over what is asked of it, so it meets the point from 1 on. A point that so
many cameras have to meet stays met while its so many best margins stay at 1 or above. Each of these that a step could
take below 1 becomes an inequality ``margin + jacobian . move >= 1``, by its tangent at the rig and by those at rigs
that were refused: where an object that is seen whole begins to leave the image the margin has a kink, of which only the
far side has a slope. They are tangents, so whether a rig meets a point is still for the render of that rig to say.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

Margins = tuple[np.ndarray, np.ndarray]
"""Margins of cameras at points [camera, point], and their Jacobian to the mount poses [camera, point, 7]."""
KEPT_BACK = 0.05
"""How far above 1 a margin is kept, where it is not below already, as tangents are not exact."""
CONTRADICTION = 0.3
"""How far below what was rendered a tangent may be; one that is lower by more has been proven wrong."""


@dataclass(frozen=True, eq=False)
class HardPoints:
    """Points that have to be met.

    Attributes:
        margins: Of cameras, float [camera, 7], at every point.
        needed: How many cameras must meet each, int [point].
    """

    margins: Callable[[np.ndarray], Margins]
    needed: np.ndarray

    def edges(
        self,
        mount_pose: np.ndarray,
        margins: Margins,
        reach: np.ndarray,
        refused: Sequence[tuple[np.ndarray, Margins]] = (),
    ) -> Edges:
        """The inequalities of a rig.

        Args:
            mount_pose: Its cameras, float [camera, 7].
            margins: Theirs.
            reach: How far each number of a mount pose may move, at least 0, float [camera, 7].
            refused: Mount poses and margins of rigs that broke a point.
        """
        value, jacobian = margins
        rank = np.argsort(np.argsort(-value, axis=0, kind="stable"), axis=0, kind="stable")
        counts = (rank < self.needed) & (value > 0.0)
        tangents = [(value, jacobian, counts)]
        for other_pose, (other, slope) in refused:
            here = other + np.einsum("cok,ck->co", slope, mount_pose.astype(np.float64) - other_pose)
            is_lost = counts & (value >= 1.0) & (other < 1.0) & (other > 0.0)
            tangents.append((np.maximum(here, value), slope, is_lost & (here >= value - CONTRADICTION)))
        rows = []
        for each, slope, holds in tangents:
            lowest = each - np.einsum("cok,ck->co", np.abs(slope), reach)
            camera, point = np.nonzero(holds & (lowest < 1.0 + KEPT_BACK))
            rows.append((camera, each[camera, point], slope[camera, point]))
        return Edges(*(np.concatenate(each) for each in zip(*rows, strict=True)))


@dataclass(frozen=True, eq=False)
class Edges:
    """Inequalities ``margin + jacobian . move of the camera >= low``.

    Attributes:
        camera: Whose margin each is about, int [row].
        margin: What its tangent says of the margin before the move, float64 [row].
        jacobian: Its Jacobian to the camera's mount pose, float64 [row, 7].
    """

    camera: np.ndarray
    margin: np.ndarray
    jacobian: np.ndarray

    @property
    def spare(self) -> np.ndarray:
        """How far each margin may fall: to a little over 1, not at all where it is below that, float64 [row]."""
        return np.maximum(self.margin - (1.0 + KEPT_BACK), 0.0)

    def slope(self, camera_count: int) -> np.ndarray:
        """The Jacobians as those of a rig of so many cameras, float64 [row, camera, 7]."""
        result = np.zeros((len(self.camera), camera_count, self.jacobian.shape[1]))
        result[np.arange(len(self.camera)), self.camera] = self.jacobian
        return result
