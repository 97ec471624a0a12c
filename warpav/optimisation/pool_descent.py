"""The search by a pool as a run of the optimiser: state by state, with what a run records of each."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from warpav.core.errors import InputError, OptionError
from warpav.core.executor import Executor
from warpav.core.progress import Progress
from warpav.optimisation.camera_loss import RobustObjective, RobustValue
from warpav.optimisation.constraints import min_camera_distance_m
from warpav.optimisation.further_camera import FurtherCameras, further_cameras
from warpav.optimisation.losses.scene_on_tape import AssignedScene
from warpav.optimisation.miss_rate import expected_miss_rate, shares_of
from warpav.optimisation.mount import HEIGHT_DELTA_M, LOG_ZOOM, PITCH_RAD, YAW_RAD
from warpav.optimisation.mount_errors import MountErrors
from warpav.optimisation.objective import RigObjective, single_cameras_of
from warpav.optimisation.pool import CameraPool
from warpav.optimisation.pool_cache import rows_of
from warpav.optimisation.pool_search import Found, PoolSearchSettings, pool_search
from warpav.optimisation.records import Candidate, IterationRecord, named_part, part_of
from warpav.optimisation.required_points import RequiredPoints
from warpav.optimisation.rig_limits import RigLimits
from warpav.optimisation.search_journal import SearchJournal


class PoolDescent:
    """A run of `pool_search`; call `step` while `verdict` is None, then `finish`. It stands where a `Descent` stands.

    Attributes:
        objective: Of the rig: the expected miss rate alone; the requirements' points stand beside it.
        robust: What is minimised instead; None: the expected miss rate.
        mount_errors: Over which the objective is the mean; None: there are none.
        start_value: What the objective of the start is made of, where it is a robust one and the search has begun.
        start: Mount poses that the rig begins with, float32 [camera, 7].
        candidates: The rigs that were found, each better than those before; the first is the start.
        iteration: Steps so far.
        found: The last state; None before the first step.
        object_weight: Of the objects of all its scenes and of the requirements' points behind them, float64 [object];
            None: all alike.
    """

    def __init__(
        self,
        objective: RigObjective,
        scenes: Sequence[AssignedScene],
        start: np.ndarray,
        settings: PoolSearchSettings,
        *,
        seed: int,
        executor: Executor | None = None,
        cache: Path | None = None,
        progress: Progress | None = None,
        limits: RigLimits | None = None,
        pool: CameraPool | None = None,
        requirements: RequiredPoints | None = None,
        robust: RobustObjective | None = None,
        mount_errors: MountErrors | None = None,
        is_kept: bool = False,
    ) -> None:
        """A run on some scenes.

        Args:
            objective: With the loss ``expected_miss_rate`` alone, without the detector's own word.
            scenes: The scenes of the search.
            start: Where the rig begins, float [camera, 7].
            settings: How much to look at.
            seed: Of the pool.
            executor: Where the pool is drawn; None: here.
            cache: Folder that keeps what is drawn; None: nothing is kept.
            progress: Shows the drawing of the pool.
            limits: How many cameras of which module a rig may have; None where all are equal.
            pool: Of an earlier run of the same cameras on the same scenes, which this one goes on with.
            requirements: What has to be seen near the vehicle besides, see `pool_search`.
            robust: What is minimised; None: the expected miss rate.
            mount_errors: Over which the objective is the mean, see `pool_search`; None: there are none.
            is_kept: Whether `state` is asked for.

        Raises:
            InputError: The objective is made of other losses.
        """
        cameras = single_cameras_of(objective)
        if cameras is None:
            raise OptionError(
                "optimiser.search",
                "expected descent, as a pool knows the loss expected_miss_rate alone, with combine=any and "
                f"detector_share=0, got {', '.join(loss.name for _, loss in objective.losses)}; set "
                "optimiser.search=descent",
            )
        self.objective = objective
        self.start = objective.mount.within(np.asarray(start, np.float32))
        self.candidates: list[Candidate] = []
        self.iteration = 0
        self.found: Found | None = None
        self._traffic_weight = self.object_weight = objective.object_weight(scenes)
        self._requirements = requirements
        if requirements is not None:
            count = sum(each.scene.vehicle_count for each in scenes)
            self.object_weight = requirements.weights_with(self._traffic_weight, count)
        self.robust, self.mount_errors = robust, mount_errors
        if pool is not None and mount_errors is None:
            cameras = pool.cameras
        self._cameras, self._scenes = cameras, [each.scene for each in scenes]
        self.start_value: RobustValue | None = None
        self._final_states = 0
        self._journal = SearchJournal(is_kept=is_kept)
        self._proven: tuple[float, int] | None = None  # the bound of the last selection, and the cameras of its pool
        self._states = pool_search(
            cameras,
            self._scenes,
            objective.constraints,
            objective.camera_count if limits is None else limits.count[1],
            start=self.start,
            settings=settings,
            seed=seed,
            executor=executor,
            cache=cache,
            progress=progress,
            object_weight=self._traffic_weight,
            limits=limits,
            pool=pool,
            requirements=requirements,
            robust=robust,
            mount_errors=mount_errors,
            journal=self._journal,
        )

    @property
    def mount_pose(self) -> np.ndarray:
        """Mount poses of the best rig so far, float32 [camera, 7]."""
        return (self.start if self.found is None else self.found.mount_pose).copy()

    @property
    def best(self) -> Candidate:
        """The last of the candidates."""
        return self.candidates[-1]

    @property
    def verdict(self) -> str | None:
        """Why there is no use in going on, in words; None while there is."""
        if self.found is None or not self.found.is_over:
            return None
        return f"the search has settled, after {self.found.camera_renders} camera renders"

    def step(self) -> IterationRecord:
        """Go on until the search comes to another state.

        Raises:
            InputError: The pool sees nothing, or the cameras do not fit.
        """
        began = time.perf_counter()
        self.found = found = next(self._states)
        if not self.candidates and found.stage != "start":  # it breaks a hard requirement
            self.candidates.append(Candidate(self.start, math.inf, self.iteration, 0))
        if self.start_value is None:
            self.start_value = found.robust
        if not self.candidates or found.objective < self.best.training_objective:
            self.candidates.append(Candidate(found.mount_pose, found.objective, self.iteration, 0))
        record = self._record(found, time.perf_counter() - began)
        self.iteration += 1
        if found.is_final:
            self._final_states = self.iteration
        return record

    def finish(self) -> Candidate:
        """The best rig; where no step was taken, the start."""
        if not self.candidates:
            self.step()
        return self.best

    def further_cameras(self) -> FurtherCameras | None:
        """What traffic each camera of the pool would add to the best rig, which is in it; None before it is drawn."""
        if self.found is None or len(self.found.pool.mount_pose) == len(self.found.mount_pose):
            return None
        pool, objective = self.found.pool, self.objective
        rig = rows_of(self.found.mount_pose + np.float32(0.0), pool.mount_pose)
        assert (rig >= 0).all(), "whatever was rendered is in the pool"
        count = sum(scene.vehicle_count for scene in self._scenes)  # points of requirements stand behind
        return further_cameras(
            pool.mount_pose,
            pool.detection_probability[:, :count],
            rig,
            mount=objective.mount,
            constraints=objective.constraints,
            weight=self._traffic_weight,
        )

    def misplaced_miss_rates(self, mount_pose: np.ndarray) -> dict[str, float] | None:
        """What a rig is expected to miss in the scenes of the search, with errors of mounting and as designed.

        Args:
            mount_pose: The rig, float [camera, 7].

        Returns:
            ``expected_miss_rate``, that with the errors, and ``as_designed``; None for a rig that is not in the pool.
        """
        assert self.found is not None
        pool = self.found.pool
        row = rows_of(mount_pose + np.float32(0.0), pool.mount_pose)
        if (row < 0).any():
            return None
        designed = [self._cameras.detection_probability(mount_pose, scene) for scene in self._scenes]
        share, count = shares_of(self._traffic_weight), sum(scene.vehicle_count for scene in self._scenes)
        return {
            "expected_miss_rate": expected_miss_rate(pool.detection_probability[row, :count], share),
            "as_designed": expected_miss_rate(np.concatenate(designed, axis=1), share),
        }

    def state(self) -> dict[str, np.ndarray]:
        """Everything that `restore` needs but the pool's own cameras, which are in the cache or are drawn again.

        ``iteration`` counts the states that the search comes to again.
        """
        return {"iteration": np.array(self._final_states), **named_part("journal", self._journal.state())}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from where another run of the same arguments was when it gave `state`; this one has taken no step.

        The settings may be others that do not change how a pool begins: rounds, refinements, gap, time.

        Raises:
            InputError: The state is of another search, or not whole.
        """
        what = "more states than it comes to"
        try:
            count = int(state["iteration"])
            self._journal.restore(part_of(state, "journal"))
        except KeyError as error:
            what = f"no {error.args[0]}"
        except (ValueError, IndexError, TypeError):
            what = "arrays that do not fit together"
        else:
            with contextlib.suppress(StopIteration):
                for _ in range(count):
                    self.step()
                return
        raise InputError(f"checkpoint: expected the state of a search by a pool, got {what}")

    def _terms(self, found: Found) -> dict[str, float]:
        """The expected miss rate, and what else there is: the share of the requirements' points that is missed."""
        robust = found.robust
        without = {} if robust is None else {"expected_miss_rate_without_camera": robust.without_camera}
        if self._requirements is None:
            return {"expected_miss_rate": found.objective if robust is None else robust.expected_miss_rate, **without}
        row = rows_of(found.mount_pose + np.float32(0.0), found.pool.mount_pose)
        probability, count = found.pool.detection_probability[row], self._requirements.vehicle_count
        return {
            "expected_miss_rate": expected_miss_rate(probability[:, :-count], shares_of(self._traffic_weight)),
            "requirements": expected_miss_rate(probability[:, -count:], shares_of(self._requirements.weight)),
            **without,
        }

    def _record(self, found: Found, seconds: float) -> IterationRecord:
        if found.stage == "selection":
            self._proven = found.bound, found.pool_cameras
        bound, pool_cameras = self._proven or (None, None)
        mount, pose = self.objective.mount, found.mount_pose
        rig = mount.rig(pose)
        position_m = np.array([camera.position_m for camera in rig.cameras])
        distance_m = min_camera_distance_m(position_m)
        row = mount.rows_of_cameras(pose)
        side = np.where(np.append(False, row[1:] == row[:-1]), np.float32(-1.0), np.float32(1.0))  # of mirror images
        free: dict[str, list[float]] = {}
        if mount.is_free[PITCH_RAD]:
            free["pitch_deg"] = np.degrees(pose[row, PITCH_RAD]).tolist()
        if mount.is_free[HEIGHT_DELTA_M]:
            free["height_m"] = (pose[row, HEIGHT_DELTA_M].astype(np.float64) + mount.height_offset_m).tolist()
        if mount.is_free[LOG_ZOOM]:
            free["fov_deg"] = [math.degrees(camera.model.fov_rad) for camera in rig.cameras]
        return IterationRecord(
            iteration=self.iteration,
            loss=found.objective,
            terms=self._terms(found),
            multipliers={},
            gradient_norm={},
            positions_m=position_m.tolist(),
            yaw_deg=(np.degrees(pose[row, YAW_RAD]) * side).tolist(),
            seconds={"total": seconds},
            min_camera_distance_m=distance_m if math.isfinite(distance_m) else None,
            training_objective=found.objective,
            best_training_objective=self.best.training_objective,
            free=free,
            stage=found.stage,
            bound=bound,
            pool_cameras=pool_cameras,
            camera_renders=found.camera_renders,
            modules=[camera.module for camera in rig.cameras if camera.module is not None],
        )
