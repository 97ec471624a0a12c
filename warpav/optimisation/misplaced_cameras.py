"""Cameras that stand and look a little off: what each detects in the mean over errors of its mounting.

The errors of different cameras are independent of each other, and cameras err independently. So the expected share of
objects that a rig misses, the mean over the errors of all its cameras, is a product of means that know of one camera
each: ``E[prod_i (1 - p_i(e_i))] = prod_i (1 - E[p_i(e_i)])``. A camera that detects with its mean probability is all
that a pool, a selection, a polish or a price needs to know; what these prove holds of the expectation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from warpav.core.cache import digest, fingerprint
from warpav.optimisation.ghost_scene import GhostScene
from warpav.optimisation.mount import HEIGHT_DELTA_M, MOUNT_POSE_SIZE
from warpav.optimisation.mount_errors import MountErrors, outside_skin
from warpav.optimisation.single_cameras import SingleCameras
from warpav.scene.device_scene import DeviceScene


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
        return cls(cameras.mount, cameras.probability, *others, errors=errors, _renderers=cameras._renderers)

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpacked, (*super().__reduce__(), self.errors)

    @property
    def identity(self) -> dict[str, str]:
        """As of cameras without errors; the errors are part of ``camera``."""
        plain = super().identity
        code = fingerprint(code=("warpav.optimisation.misplaced_cameras",))
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
