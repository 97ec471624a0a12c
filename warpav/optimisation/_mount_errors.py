"""Errors of mounting: how far cameras may be off, and the twelve errors that a mean over them is taken of.

The rule of degree 3 is exact for every cubic polynomial of the six degrees of freedom, each even within its tolerance.
Source: Stroud 1957, Remarks on the disposition of points in numerical integration formulas; the rule C_n 3-1 of
Stroud 1971, Approximate calculation of multiple integrals.

Errors of different cameras are independent, and cameras err independently. So the expected share of objects that a rig
misses is a product of means that know of one camera each: ``E[prod_i (1 - p_i(e_i))] = prod_i (1 - E[p_i(e_i)])``. A
camera that detects with its mean probability is all that pool, selection, polish and price need to know.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warpav.core.errors import ArgumentError
from warpav.optimisation._mount import (
    HEIGHT_DELTA_M,
    MOUNT_POSE_SIZE,
    PITCH_RAD,
    ROLL_RAD,
    X_M,
    Y_M,
    YAW_RAD,
    CameraMount,
)

COLUMNS = {"x": X_M, "y": Y_M, "z": HEIGHT_DELTA_M, "yaw": YAW_RAD, "pitch": PITCH_RAD, "roll": ROLL_RAD}
"""Degrees of freedom, and their columns in a mount pose: places along the surface that a camera stands on (forwards and
to the left on a roof) and off it, directions as in a rig's file."""

ANGLES = ("yaw", "pitch", "roll")


@dataclass(frozen=True)
class MountErrors:
    """How far cameras may be off, each number evenly within its tolerance and independently of the others."""

    position_m: float = 0.0  # greatest error of a place [m], in each direction, at least 0
    angle_rad: float = 0.0  # greatest error of an angle [rad], of each of the three, at least 0

    def __post_init__(self) -> None:
        for name, value in (("position_m", self.position_m), ("angle_rad", self.angle_rad)):
            if not 0.0 <= value < math.inf:
                raise ArgumentError(name, f"expected a finite number of at least 0, got {value!r}")

    @property
    def tolerance(self) -> np.ndarray:
        """Greatest errors in the order of `COLUMNS` [m, rad], float64 [6]."""
        return np.array([self.angle_rad if degree in ANGLES else self.position_m for degree in COLUMNS])

    @property
    def draws(self) -> np.ndarray:
        """The errors that a mean is taken over, as they are added to a mount pose, float64 [draw, 7].

        Point k of 2n has sqrt(2/3) (cos, sin) of (2r - 1) k pi / n for its degrees of freedom 2r - 1 and 2r.
        """
        count = len(COLUMNS)
        turn = np.outer(np.arange(1, 2 * count + 1), np.arange(1, count, 2)) * math.pi / count
        share = math.sqrt(2.0 / 3.0) * np.stack([np.cos(turn), np.sin(turn)], axis=-1).reshape(2 * count, count)
        draws = np.zeros((2 * count, MOUNT_POSE_SIZE))
        draws[:, list(COLUMNS.values())] = share * self.tolerance
        return draws


def outside_skin(misplaced: np.ndarray, mount_pose: np.ndarray, mount: CameraMount) -> np.ndarray:
    """Cameras with errors [..., camera, 7], float32; those below the surface that they stand on are on it.

    A camera that is flush with the skin cannot be off inwards: there it would see the body's inside alone.
    """
    kept = np.array(misplaced, np.float32)
    skin_m = np.minimum(mount_pose[:, HEIGHT_DELTA_M], -mount.height_offset_m).astype(np.float32)
    kept[..., HEIGHT_DELTA_M] = np.maximum(kept[..., HEIGHT_DELTA_M], skin_m)
    return kept
