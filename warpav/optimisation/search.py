"""What all searches for a rig share: where its cameras may stand, what looking at a rig costs, and what was found."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from warpav.optimisation.assignment import AssignedScene
from warpav.optimisation.baselines import random_mount_pose
from warpav.optimisation.constraints import Constraints
from warpav.optimisation.mount import HEIGHT_DELTA_M, MOUNT_POSE_SIZE, X_M, Y_M, YAW_RAD, CameraMount
from warpav.optimisation.objective import RigObjective
from warpav.optimisation.rig_values import RigValues, rig_values_of


@dataclass(frozen=True, eq=False)
class SearchSpace:
    """All rigs that a search may try.

    Searches without gradients work in the unit cube of the numbers that are free, those with ``low < high``.

    Attributes:
        mount: Where the cameras may stand.
        constraints: What the rigs must satisfy.
        low: Least mount pose of every camera, float64 [camera, 7]; x and y are the mount surface's.
        high: Greatest mount pose of every camera, likewise. A yaw that is free over the whole circle has no ends.
    """

    mount: CameraMount
    constraints: Constraints
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def over(
        cls,
        mount: CameraMount,
        camera_count: int,
        *,
        constraints: Constraints,
        yaw_rad: np.ndarray | None = None,
        yaw_reach_rad: float = math.pi,
    ) -> SearchSpace:
        """Cameras anywhere on the mount surface, as configured but for what is free.

        Args:
            mount: Where the cameras may stand, and what else is free.
            camera_count: Number of cameras, at least 1.
            constraints: What the rigs must satisfy.
            yaw_rad: Middle of every camera's range of directions [rad], [camera]; None: evenly round the vehicle.
            yaw_reach_rad: How far a camera may turn from there [rad], 0..pi; 0 leaves the directions as they are.
        """
        low = np.zeros((camera_count, MOUNT_POSE_SIZE))
        high = np.zeros((camera_count, MOUNT_POSE_SIZE))
        low[:, [X_M, Y_M]], high[:, [X_M, Y_M]] = mount.surface.bounds_m
        for camera, module in enumerate([] if constraints.module is None else constraints.module):
            low[camera, [X_M, Y_M]], high[camera, [X_M, Y_M]] = mount.surface.bounds_of(int(module))
        middle = 2.0 * math.pi * np.arange(camera_count) / camera_count if yaw_rad is None else np.asarray(yaw_rad)
        low[:, YAW_RAD], high[:, YAW_RAD] = middle - yaw_reach_rad, middle + yaw_reach_rad
        has_ends = np.isfinite(mount.low)
        has_ends[YAW_RAD] = False
        low[:, has_ends], high[:, has_ends] = mount.low[has_ends], mount.high[has_ends]
        if mount.frozen is not None:
            is_frozen = mount.frozen.is_frozen
            low[is_frozen] = high[is_frozen] = mount.frozen.mount_pose[is_frozen]
        return cls(mount, constraints, low, high)

    def __post_init__(self) -> None:
        if self.low.shape != self.high.shape or self.low.shape[1:] != (MOUNT_POSE_SIZE,) or not len(self.low):
            raise ValueError(
                f"low and high must be [camera, {MOUNT_POSE_SIZE}], got {self.low.shape} and {self.high.shape}"
            )
        if not (self.low <= self.high).all():
            raise ValueError("low must not exceed high")

    @property
    def camera_count(self) -> int:
        """Number of cameras."""
        return len(self.low)

    @property
    def is_frozen(self) -> np.ndarray:
        """Which cameras stay as they are, bool [camera]."""
        frozen = self.mount.frozen
        return np.zeros(self.camera_count, bool) if frozen is None else frozen.is_frozen

    @cached_property
    def free(self) -> np.ndarray:
        """Which numbers are searched, bool [camera, 7]."""
        return self.high > self.low

    @cached_property
    def goes_round(self) -> np.ndarray:
        """Which free numbers are yaws without ends, bool [free]."""
        is_yaw = np.zeros_like(self.free)
        is_yaw[:, YAW_RAD] = self.high[:, YAW_RAD] - self.low[:, YAW_RAD] >= 2.0 * math.pi - 1e-9
        return is_yaw[self.free]

    @property
    def size(self) -> int:
        """How many numbers are searched."""
        return int(np.count_nonzero(self.free))

    def pose_of(self, unit: np.ndarray) -> np.ndarray:
        """The feasible rig nearest to a point of the unit cube, float32 [camera, 7].

        Args:
            unit: The free numbers, camera by camera, any finite values [free]; those beyond 0..1 are brought back, yaws
                without ends by whole turns.
        """
        pose = self.low.copy()
        inside = np.where(self.goes_round, np.mod(unit, 1.0), np.clip(unit, 0.0, 1.0))
        pose[self.free] += inside * (self.high - self.low)[self.free]
        return self.feasible(pose)

    def unit_of(self, mount_pose: np.ndarray) -> np.ndarray:
        """The point of the unit cube of a rig, float64 [free]."""
        free = self.free
        unit = (np.asarray(mount_pose, np.float64)[free] - self.low[free]) / (self.high - self.low)[free]
        return np.where(self.goes_round, np.mod(unit, 1.0), unit)

    def feasible(self, mount_pose: np.ndarray) -> np.ndarray:
        """The nearest rig that satisfies all constraints, float32 [camera, 7], the precision that objectives keep.

        Yaws are brought to -pi..pi.

        Raises:
            InputError: The cameras do not fit on the mount surface.
        """
        pose = np.array(mount_pose, np.float64)
        height_delta_m = self.mount.within(pose.astype(np.float32))[:, HEIGHT_DELTA_M]
        pose[:, [X_M, Y_M]] = self.constraints.project(pose[:, [X_M, Y_M]], height_delta_m)
        pose[:, YAW_RAD] = (pose[:, YAW_RAD] + math.pi) % (2.0 * math.pi) - math.pi
        return self.mount.within(pose.astype(np.float32))

    def violation_m(self, mount_pose: np.ndarray) -> float:
        """By how much a rig breaks the constraints [m]; exactly 0 if it does not."""
        return self.constraints.violation_m(self.mount.rig(mount_pose))

    def random(self, rng: np.random.Generator) -> np.ndarray:
        """A feasible rig, uniform among them, float64 [camera, 7]; places as `random_mount_pose` draws them.

        Raises:
            InputError: The cameras do not fit on the mount surface.
        """
        middle_rad = 0.5 * (self.low + self.high)[:, YAW_RAD]
        pose = random_mount_pose(self.constraints, middle_rad, rng=rng)
        others = self.free.copy()
        others[:, [X_M, Y_M]] = False
        pose[others] = rng.uniform(self.low[others], self.high[others])
        kept = np.ones(MOUNT_POSE_SIZE, bool)
        kept[[X_M, Y_M, YAW_RAD]] = False
        fixed = ~self.free & kept
        pose[fixed] = self.low[fixed]
        return pose

    def in_order(self, mount_pose: np.ndarray) -> np.ndarray:
        """The same rig with its cameras in the order of the ranges of yaw; frozen ones keep their places.

        Cameras that were chosen one by one, or come from elsewhere, may be asked to answer for the vehicles in certain
        directions. The sum of the squared angles to the middles of the ranges is smallest.
        """
        from scipy.optimize import linear_sum_assignment

        pose, movable = np.array(mount_pose), np.flatnonzero(~self.is_frozen)
        middle_rad = 0.5 * (self.low + self.high)[movable, YAW_RAD]
        difference = middle_rad[:, None] - pose[None, movable, YAW_RAD]
        _, order = linear_sum_assignment(np.angle(np.exp(1j * difference)) ** 2)
        pose[movable] = pose[movable[order]]
        return pose


class BudgetSpentError(Exception):
    """The next look would cost more than what is left of the budget."""


@dataclass(frozen=True)
class SearchRecord:
    """The state of a search after a look at a rig.

    Attributes:
        camera_renders: Camera renders so far.
        best_value: Lowest value so far; inf before the first finite one.
        seconds: Wall time so far [s].
    """

    camera_renders: int
    best_value: float
    seconds: float = field(compare=False)


@dataclass(frozen=True, eq=False)
class SearchResult:
    """What a search found.

    Attributes:
        mount_pose: The best rig, which satisfies all constraints, float32 [camera, 7].
        value: Its value.
        camera_renders: Camera renders that were spent, never more than the budget.
        history: One entry for each rig that was looked at.
        error: What ended the search early; None if nothing did.
    """

    mount_pose: np.ndarray
    value: float
    camera_renders: int
    history: tuple[SearchRecord, ...]
    error: str | None = None


class BudgetedValue:
    """The value of a rig, lower is better, at a price: it counts camera renders and remembers the best rig.

    A camera render is one scene drawn once by one camera, with or without a gradient; a rig of N cameras on S scenes
    costs N S of them. Rigs are made feasible before they are looked at.

    Attributes:
        space: The rigs that may be tried.
        scene_count: Camera renders that a look at one camera costs.
        camera_renders_max: Camera renders that all looks together may cost.
        camera_renders: Camera renders so far.
        history: One entry for each rig that was looked at.
    """

    def __init__(self, rig_values: RigValues, space: SearchSpace, *, scene_count: int, camera_renders_max: int) -> None:
        """A fresh budget.

        Args:
            rig_values: Values of rigs, always on the same scenes. What is not finite is never best.
            space: The rigs that may be tried.
            scene_count: Number of scenes, at least 1.
            camera_renders_max: Camera renders that may be spent, enough for at least one rig.

        Raises:
            ValueError: The budget is too small for one rig.
        """
        self.space = space
        self.scene_count = scene_count
        self.camera_renders_max = camera_renders_max
        self.camera_renders = 0
        self.history: list[SearchRecord] = []
        self._rig_values = rig_values
        self._best_pose: np.ndarray | None = None
        self._best_value = math.inf
        self._began = time.perf_counter()
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
    def camera_renders_per_rig(self) -> int:
        """Camera renders that a look at a rig costs."""
        return self.scene_count * self.space.camera_count

    @property
    def camera_renders_left(self) -> int:
        """Camera renders that may still be spent."""
        return self.camera_renders_max - self.camera_renders

    @property
    def rigs_left(self) -> int:
        """How many rigs can still be looked at."""
        return self.camera_renders_left // self.camera_renders_per_rig

    @property
    def best_mount_pose(self) -> np.ndarray | None:
        """The best rig so far, float32 [camera, 7]; None before the first finite value."""
        return None if self._best_pose is None else self._best_pose.copy()

    def __call__(self, mount_pose: np.ndarray) -> float:
        """Value of the feasible rig nearest to a mount pose; inf where it is not finite.

        Raises:
            BudgetSpentError: There is not enough left for it.
        """
        return float(self.of_rigs([mount_pose])[0])

    def of_rigs(self, mount_poses: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
        """Values of rigs that do not depend on one another, as by one call after another, but rendered together.

        Args:
            mount_poses: Of every rig, float [rig, camera, 7].

        Returns:
            Their values, inf where they are not finite, float64 [rig].

        Raises:
            BudgetSpentError: There is not enough left for all; those that could be paid have been looked at.
        """
        affordable = min(len(mount_poses), self.rigs_left)
        rigs = np.array([self.space.feasible(pose) for pose in mount_poses[:affordable]], np.float32)
        values, found = iter(self._rig_values(rigs.copy())), []
        for pose in rigs:
            self.spend(self.camera_renders_per_rig)
            found.append(float(next(values)))
            self.record(pose, found[-1])
        if affordable < len(mount_poses):
            raise BudgetSpentError
        return np.where(np.isfinite(found), found, math.inf)

    def spend(self, camera_renders: int) -> None:
        """Count camera renders that gave no value, before they are made.

        Raises:
            BudgetSpentError: There are fewer left; none is counted.
        """
        if camera_renders > self.camera_renders_left:
            raise BudgetSpentError
        self.camera_renders += camera_renders

    def record(self, mount_pose: np.ndarray, value: float) -> None:
        """Remember a rig whose camera renders have been counted.

        Args:
            mount_pose: It must satisfy the constraints.
            value: Its value on the scenes of this object.

        Raises:
            ValueError: It does not satisfy them.
        """
        if math.isfinite(value) and value < self._best_value:
            if self.space.violation_m(mount_pose) > 0.0:
                raise ValueError("only rigs that satisfy the constraints can be the best")
            self._best_pose, self._best_value = np.array(mount_pose, np.float32), value
        self.history.append(SearchRecord(self.camera_renders, self._best_value, time.perf_counter() - self._began))

    @contextmanager
    def within(self, camera_renders: int) -> Iterator[None]:
        """At most so many more camera renders inside the block; running out of them ends the block, not the search."""
        whole = self.camera_renders_max
        self.camera_renders_max = min(whole, self.camera_renders + camera_renders)
        try:
            yield
        except BudgetSpentError:
            pass
        finally:
            self.camera_renders_max = whole

    def result(self, error: str | None = None) -> SearchResult:
        """What was found so far.

        Raises:
            ValueError: No rig had a finite value.
        """
        if self._best_pose is None:
            raise ValueError(f"none of {len(self.history)} rigs had a finite value" + (f"; {error}" if error else ""))
        return SearchResult(self._best_pose, self._best_value, self.camera_renders, tuple(self.history), error)


Search = Callable[[BudgetedValue, np.random.Generator], None]
"""Looks at rigs until it is content or the budget is spent; deterministic in the generator."""


def run_search(search: Search, value: BudgetedValue, rng: np.random.Generator) -> SearchResult:
    """Search until the budget is spent.

    A search that fails keeps what it found before; the result says why it ended.

    Raises:
        Exception: Whatever the search or the value raises before the first rig with a finite value.
    """
    error = None
    try:
        search(value, rng)
    except BudgetSpentError:
        pass
    except Exception as failure:
        if value.best_mount_pose is None:
            raise
        error = f"{type(failure).__name__}: {failure}"
    return value.result(error)
