"""Values of rigs on fixed scenes: many at once where a rig's value follows from what each camera detects by itself."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from warpav.optimisation.assignment import AssignedScene
from warpav.optimisation.objective import RigObjective
from warpav.optimisation.polish import expected_miss_rate, shares_of
from warpav.optimisation.single_cameras import SingleCameras
from warpav.scene.device_scene import DeviceScene

RigValues = Callable[[np.ndarray], Iterable[float]]
"""Values of rigs, float32 [rig, camera, 7], one after the other; a search keeps those before one that fails."""


def single_cameras_of(objective: RigObjective) -> SingleCameras | None:
    """The cameras of an objective, where a rig's value follows from what each of them detects by itself; else None."""
    return objective.single_cameras if objective.is_by_single_cameras else None


def rig_values_of(objective: RigObjective, scenes: Sequence[AssignedScene]) -> RigValues:
    """The values of rigs by an objective: by single cameras where that can be, else one rig after the other."""
    cameras = single_cameras_of(objective)
    if cameras is not None:
        [(weight, _)] = objective.losses
        object_weight = objective.object_weight(scenes)
        return SingleCameraValues(cameras, [each.scene for each in scenes], weight=weight, object_weight=object_weight)
    return lambda rigs: (objective.evaluate(pose, scenes).objective for pose in rigs)


class SingleCameraValues:
    """Expected miss rates of rigs by what their cameras detect by themselves, all rigs of a call rendered together.

    They are those of the objective to 1e-6.

    Attributes:
        cameras: What the cameras are, and how likely one is to detect.
        scenes: The scenes.
        weight: Of the expected miss rate in the value.
        object_weight: Of each object of the scenes in the expected miss rate, float64 [object]; None: all alike.
    """

    def __init__(
        self,
        cameras: SingleCameras,
        scenes: Sequence[DeviceScene],
        *,
        weight: float = 1.0,
        object_weight: np.ndarray | None = None,
    ) -> None:
        """Values on some scenes, which are on the device of the mount."""
        self.cameras, self.scenes, self.weight, self.object_weight = cameras, tuple(scenes), weight, object_weight
        self._looked: list[tuple[np.ndarray, np.ndarray]] = []

    def __call__(self, rigs: np.ndarray) -> Iterator[float]:
        """The value of every rig, of mount poses float32 [rig, camera, 7]."""
        rig_count, camera_count = rigs.shape[:2]
        pose = rigs.reshape(rig_count * camera_count, -1)
        found = self.detection_probability(pose)
        self._looked.append((pose, found))
        share = shares_of(self.object_weight)
        for of_rig in found.reshape(rig_count, camera_count, -1):
            yield self.weight * expected_miss_rate(of_rig, share)

    def detection_probability(self, mount_pose: np.ndarray) -> np.ndarray:
        """The probability that each camera detects each object, float32 [camera, object], the objects scene by scene.

        Args:
            mount_pose: As the mount counts them, float [camera, 7].
        """
        found = [self.cameras.detection_probability(mount_pose, scene) for scene in self.scenes]
        return np.concatenate([np.zeros((len(mount_pose), 0), np.float32), *found], axis=1)

    @property
    def looked_at(self) -> tuple[np.ndarray, np.ndarray]:
        """All cameras of all rigs so far, float32 [camera, 7], and what each detects, float32 [camera, object]."""
        pose, found = zip(*self._looked, strict=True)
        return np.concatenate(pose), np.concatenate(found)
