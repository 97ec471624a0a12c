"""Values of rigs at a price: what looking at a rig costs, and what was found."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from warpav.detection import expected_miss_rate, false_alarm_cost, shares_of
from warpav.optimisation._objective import RigObjective, single_cameras_of
from warpav.optimisation._single_cameras import SingleCameras
from warpav.optimisation._space import SearchSpace
from warpav.optimisation.losses._scene_on_tape import AssignedScene
from warpav.scene import DeviceScene

_RigValues = Callable[[np.ndarray], Iterable[float]]
"""Values of rigs, float32 [rig, camera, 7], one after the other; a search keeps those before one that fails."""


def rig_values_of(objective: RigObjective, scenes: Sequence[AssignedScene]) -> _RigValues:
    """The values of rigs by an objective: by single cameras where that can be, else one rig after the other."""
    cameras = single_cameras_of(objective)
    if cameras is not None:
        [(weight, _)] = objective.losses
        object_weight = objective.object_weight(scenes)
        packed = [each.scene for each in scenes]
        weights = {"object_weight": object_weight, "charge": objective.charge_of(packed)}
        return SingleCameraValues(cameras, packed, weight=weight, **weights)
    return lambda rigs: (objective.evaluate(pose, scenes).objective for pose in rigs)


class SingleCameraValues:
    """Expected miss rates of rigs by what their cameras detect by themselves, all rigs of a call rendered together.

    They are those of the objective to 1e-6, and what ``charge`` asks for false alarms, see `false_alarm_cost`.
    ``weight`` is that of the expected miss rate in the value.
    """

    def __init__(
        self,
        cameras: SingleCameras,
        scenes: Sequence[DeviceScene],
        *,
        weight: float = 1.0,
        object_weight: np.ndarray | None = None,
        charge: np.ndarray | None = None,
    ) -> None:
        self.cameras, self.scenes, self.weight, self.object_weight = cameras, tuple(scenes), weight, object_weight
        self.charge = charge
        self._looked: list[tuple[np.ndarray, np.ndarray]] = []

    def __call__(self, rigs: np.ndarray) -> Iterator[float]:
        """The value of every rig, of mount poses float32 [rig, camera, 7]."""
        rig_count, camera_count = rigs.shape[:2]
        pose = rigs.reshape(rig_count * camera_count, -1)
        found = self.detection_probability(pose)
        self._looked.append((pose, found))
        share = shares_of(self.object_weight)
        for of_rig in found.reshape(rig_count, camera_count, -1):
            yield self.weight * (expected_miss_rate(of_rig, share) + false_alarm_cost(of_rig, self.charge).sum())

    def detection_probability(self, mount_pose: np.ndarray) -> np.ndarray:
        """The probability that each camera detects each object, float32 [camera, object], scene by scene."""
        found = [self.cameras.detection_probability(mount_pose, scene) for scene in self.scenes]
        return np.concatenate([np.zeros((len(mount_pose), 0), np.float32), *found], axis=1)

    @property
    def looked_at(self) -> tuple[np.ndarray, np.ndarray]:
        """All cameras of all rigs so far, float32 [camera, 7], and what each detects, float32 [camera, object]."""
        pose, found = zip(*self._looked, strict=True)
        return np.concatenate(pose), np.concatenate(found)


class _BudgetSpentError(Exception):
    """The next look would cost more than what is left of the budget."""


@dataclass(frozen=True)
class SearchRecord:
    """The state of a search after a look at a rig."""

    camera_renders: int  # camera renders so far
    best_value: float  # lowest value so far; inf before the first finite one
    seconds: float = field(compare=False)  # wall time so far [s]


class BudgetedValue:
    """The value of a rig, lower is better, at a price: it counts camera renders and remembers the best rig.

    A rig of N cameras on S scenes costs N S of them. Rigs are made feasible before they are looked at.
    """

    def __init__(
        self, rig_values: _RigValues, space: SearchSpace, *, scene_count: int, camera_renders_max: int
    ) -> None:
        self.space, self.scene_count, self.camera_renders_max = space, scene_count, camera_renders_max
        self.camera_renders = 0  # so far
        self.history: list[SearchRecord] = []  # one entry for each rig that was looked at
        self.best_pose: np.ndarray | None = None  # the best rig so far, float32 [camera, 7]; None: none was finite
        self.value = math.inf  # its value
        self.error: str | None = None  # what ended a search early
        self._rig_values, self._began = rig_values, time.perf_counter()
        if scene_count < 1 or self.camera_renders_per_rig > camera_renders_max:
            raise ValueError(
                f"camera_renders_max must be at least one rig's {max(self.camera_renders_per_rig, 1)} camera renders, "
                f"got {camera_renders_max}"
            )

    @classmethod
    def of(
        cls, objective: RigObjective, scenes: Sequence[AssignedScene], space: SearchSpace, *, camera_renders_max: int
    ) -> BudgetedValue:
        """The objective on fixed scenes, computed the fastest way there is (`rig_values_of`)."""
        return cls(
            rig_values_of(objective, scenes), space, scene_count=len(scenes), camera_renders_max=camera_renders_max
        )

    @property
    def mount_pose(self) -> np.ndarray:
        """The best rig, which satisfies all constraints, float32 [camera, 7]; only after one of a finite value."""
        assert self.best_pose is not None
        return self.best_pose

    @property
    def camera_renders_per_rig(self) -> int:
        return self.scene_count * self.space.camera_count

    @property
    def camera_renders_left(self) -> int:
        return self.camera_renders_max - self.camera_renders

    @property
    def rigs_left(self) -> int:
        return self.camera_renders_left // self.camera_renders_per_rig

    def __call__(self, mount_pose: np.ndarray) -> float:
        """Value of the feasible rig nearest to a mount pose; inf where it is not finite."""
        return float(self.of_rigs([mount_pose])[0])

    def of_rigs(self, mount_poses: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
        """Values of rigs [rig, camera, 7] that do not depend on one another, rendered together; inf: not finite."""
        affordable = min(len(mount_poses), self.rigs_left)
        rigs = np.array([self.space.feasible(pose) for pose in mount_poses[:affordable]], np.float32)
        values, found = iter(self._rig_values(rigs.copy())), []
        for pose in rigs:
            self.spend(self.camera_renders_per_rig)
            found.append(float(next(values)))
            self.record(pose, found[-1])
        if affordable < len(mount_poses):
            raise _BudgetSpentError
        return np.where(np.isfinite(found), found, math.inf)

    def spend(self, camera_renders: int) -> None:
        """Count camera renders that gave no value, before they are made."""
        if camera_renders > self.camera_renders_left:
            raise _BudgetSpentError
        self.camera_renders += camera_renders

    def record(self, mount_pose: np.ndarray, value: float) -> None:
        """Remember a rig whose camera renders have been counted."""
        if math.isfinite(value) and value < self.value:
            self.best_pose, self.value = np.array(mount_pose, np.float32), value
        self.history.append(SearchRecord(self.camera_renders, self.value, time.perf_counter() - self._began))


Search = Callable[[BudgetedValue, np.random.Generator], None]
"""Looks at rigs until it is content or the budget is spent; deterministic in the generator."""


def run_search(search: Search, value: BudgetedValue, rng: np.random.Generator) -> BudgetedValue:
    """Search until the budget is spent; one that fails keeps what it found before, and says why it ended."""
    try:
        search(value, rng)
    except _BudgetSpentError:
        pass
    except Exception as failure:
        if value.best_pose is None:
            raise
        value.error = f"{type(failure).__name__}: {failure}"
    if value.best_pose is None:
        raise ValueError(f"none of {len(value.history)} rigs had a finite value")
    return value
