"""Cameras that stand and look a little off: what each detects in the mean over errors of its mounting.

The errors of different cameras are independent of each other, and cameras err independently. So the expected share of
objects that a rig misses, the mean over the errors of all its cameras, is a product of means that know of one camera
each: ``E[prod_i (1 - p_i(e_i))] = prod_i (1 - E[p_i(e_i)])``. A camera that detects with its mean probability is all
that a pool, a selection, a polish or a price needs to know; what these prove holds of the expectation.

The mean is over twelve fixed errors, the same for every camera: the rule of degree 3 that is exact for every cubic
polynomial of the six degrees of freedom, each even within its tolerance.

Source: Stroud 1957, Remarks on the disposition of points in numerical integration formulas; the rule C_n 3-1 of
Stroud 1971, Approximate calculation of multiple integrals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from warpav.core.errors import ArgumentError
from warpav.core.fingerprint import digest, fingerprint
from warpav.optimisation.ghost_scene import GhostScene
from warpav.optimisation.mount import (
    HEIGHT_DELTA_M,
    MOUNT_POSE_SIZE,
    PITCH_RAD,
    ROLL_RAD,
    X_M,
    Y_M,
    YAW_RAD,
    CameraMount,
)
from warpav.optimisation.single_cameras import SingleCameras
from warpav.scene.device_scene import DeviceScene

COLUMNS = {"x": X_M, "y": Y_M, "z": HEIGHT_DELTA_M, "yaw": YAW_RAD, "pitch": PITCH_RAD, "roll": ROLL_RAD}
"""Degrees of freedom, and their columns in a mount pose: places along the surface that a camera stands on (forwards and
to the left on a roof) and off it, directions as in a rig's file."""

ANGLES = ("yaw", "pitch", "roll")


@dataclass(frozen=True)
class MountErrors:
    """How far cameras may be off, each number evenly within its tolerance and independently of the others.

    Attributes:
        position_m: Greatest error of a place [m], in each direction, at least 0.
        angle_rad: Greatest error of an angle [rad], of each of the three, at least 0.

    Raises:
        InputError: A number is out of its range.
    """

    position_m: float = 0.0
    angle_rad: float = 0.0

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
    """Cameras with errors of mounting, those that would be below the surface that they stand on at that surface.

    A camera that is flush with the skin cannot be off inwards: there it would see the body's inside alone.

    Args:
        misplaced: Mount poses with errors, float [..., camera, 7].
        mount_pose: Those without, float [camera, 7]; one that is below the surface itself can be off no further.
        mount: Has the surface.

    Returns:
        Mount poses, float32 [..., camera, 7].
    """
    kept = np.array(misplaced, np.float32)
    skin_m = np.minimum(mount_pose[:, HEIGHT_DELTA_M], -mount.height_offset_m).astype(np.float32)
    kept[..., HEIGHT_DELTA_M] = np.maximum(kept[..., HEIGHT_DELTA_M], skin_m)
    return kept


@dataclass(frozen=True, eq=False)
class MisplacedCameras(SingleCameras):
    """Cameras of one mount, each with the mean of its probabilities over errors of its mounting.

    Poses are those without errors. Of a pair each of the two has errors of its own. Points of requirements, which are
    met or not, are seen without errors.

    Attributes:
        errors: Of the mounting.
    """

    errors: MountErrors = field(kw_only=True)

    @classmethod
    def of(cls, cameras: SingleCameras, errors: MountErrors) -> MisplacedCameras:
        """The same cameras with errors of mounting."""
        others = (cameras.occlusion, cameras.supersampling, cameras.thread_count, cameras.is_mirrored)
        return cls(cameras.mount, cameras.probability, *others, errors=errors)

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpacked, (*super().__reduce__(), self.errors)

    @property
    def identity(self) -> dict[str, str]:
        """As of cameras without errors; the errors are part of ``camera``."""
        plain = super().identity
        code = fingerprint(code=("warpav.optimisation.mount_errors",))
        return {
            **plain,
            "camera": digest(plain["camera"], self.errors.draws.tobytes()),
            "version": digest(plain["version"], code),
        }

    def _misplaced(self, pose: np.ndarray) -> np.ndarray:
        """Cameras [camera, 7] with each of the errors, float32 [draw, camera, 7]."""
        return outside_skin(pose.astype(np.float64) + self.errors.draws[:, None], pose, self.mount)

    def _alone(self, pose: np.ndarray, scene: DeviceScene | GhostScene) -> np.ndarray:
        if isinstance(scene, GhostScene):
            return super()._alone(pose, scene)
        misplaced = self._misplaced(pose)
        found = super()._alone(misplaced.reshape(-1, MOUNT_POSE_SIZE), scene)
        return found.reshape(*misplaced.shape[:2], scene.vehicle_count).mean(axis=0, dtype=np.float64)

    def _alone_with_jacobian(
        self, pose: np.ndarray, scenes: Sequence[DeviceScene | GhostScene]
    ) -> tuple[np.ndarray, np.ndarray]:
        misplaced = self._misplaced(pose)
        traffic = [scene for scene in scenes if isinstance(scene, DeviceScene)]
        probability, jacobian = super()._alone_with_jacobian(misplaced.reshape(-1, MOUNT_POSE_SIZE), traffic)
        shape = (*misplaced.shape[:2], probability.shape[1])
        # one that ends at the skin stays there when its camera is raised a little
        is_at_skin = misplaced[..., HEIGHT_DELTA_M] == np.float32(-self.mount.height_offset_m)
        is_stopped = is_at_skin & (self.errors.draws[:, None, HEIGHT_DELTA_M] < 0.0)
        jacobian = jacobian.reshape(*shape, MOUNT_POSE_SIZE)
        jacobian[..., HEIGHT_DELTA_M][is_stopped] = 0.0
        probability, jacobian = probability.reshape(shape).mean(axis=0), jacobian.mean(axis=0)
        if len(traffic) == len(scenes):
            return probability, jacobian
        seen, slope = super()._alone_with_jacobian(pose, scenes[len(traffic) :])
        return np.concatenate([probability, seen], axis=1), np.concatenate([jacobian, slope], axis=1)


def _unpacked(plain: Callable[..., SingleCameras], parts: tuple[Any, ...], errors: MountErrors) -> MisplacedCameras:
    return MisplacedCameras.of(plain(*parts), errors)
