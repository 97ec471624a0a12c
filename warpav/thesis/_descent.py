"""Gradient descent on the cameras and gradient ascent on the multipliers (thesis section III.C)."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from warpav.core.errors import InputError
from warpav.optimisation import (
    HEIGHT_DELTA_M,
    LOG_ZOOM,
    PITCH_RAD,
    X_M,
    Y_M,
    YAW_RAD,
    AssignedScene,
    CameraMount,
    Candidate,
    Evaluation,
    IterationRecord,
    LossSchedule,
    NotFiniteError,
    OptimiserSettings,
    RigObjective,
    named_part,
    part_of,
    rig_fields,
)
from warpav.thesis._segregation import BatchChooser
from warpav.thesis._starts import exchange_cameras

_BETAS = (np.float32(0.9), np.float32(0.999))
_EPSILON = np.float32(1e-8)


class AdamW:
    """Adam with bias correction, weight decay decoupled from the gradient, in single precision.

    Source: Loshchilov and Hutter, Decoupled Weight Decay Regularization, 2019, algorithm 2.
    """

    def __init__(self, value: np.ndarray, *, weight_decay: float) -> None:
        """State for ``value``, any shape."""
        self._weight_decay = np.float32(weight_decay)
        self.value = np.array(value, np.float32)  # the numbers now, float32; every step makes a new array
        self._first_moment, self._second_moment = np.zeros_like(self.value), np.zeros_like(self.value)
        self._step_number = 0

    def step(self, gradient: np.ndarray, step_size: np.ndarray) -> None:
        """One step; a negative step size ascends, 0 leaves a number and its moments alone. Shapes as ``value``."""
        self._step_number += 1
        gradient, rate = np.asarray(gradient, np.float32), np.asarray(step_size, np.float32)
        moves = rate != 0.0
        beta1, beta2 = _BETAS
        one = np.float32(1.0)
        first = beta1 * self._first_moment + (one - beta1) * gradient
        second = beta2 * self._second_moment + (one - beta2) * gradient * gradient
        unbiased_first, unbiased_second = (
            moment / (one - beta ** np.float32(self._step_number)) for moment, beta in ((first, beta1), (second, beta2))
        )
        decayed = self.value * (one - np.abs(rate) * self._weight_decay)
        stepped = decayed - rate * unbiased_first / (np.sqrt(unbiased_second) + _EPSILON)
        self._first_moment = np.where(moves, first, self._first_moment)
        self._second_moment = np.where(moves, second, self._second_moment)
        self.value = np.where(moves, stepped, self.value)

    def state(self) -> dict[str, np.ndarray]:
        """Everything that `restore` needs."""
        return {
            "value": self.value,
            "first_moment": self._first_moment,
            "second_moment": self._second_moment,
            "step_number": np.array(self._step_number),
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a state."""
        self.value = np.array(state["value"], np.float32)
        self._first_moment = np.array(state["first_moment"], np.float32)
        self._second_moment = np.array(state["second_moment"], np.float32)
        self._step_number = int(state["step_number"])


class MultiplierAscent:
    """Plain gradient steps on the multipliers of inequalities, which are never negative."""

    def __init__(self, value: np.ndarray) -> None:
        """State for ``value``, any shape, at least 0."""
        self.value = np.array(value, np.float32)  # the multipliers now, float32; every step makes a new array

    def step(self, gradient: np.ndarray, step_size: np.ndarray) -> None:
        """One step, as `AdamW.step` counts them: a negative step size ascends. Shapes as ``value``."""
        self.value = np.maximum(self.value - np.asarray(step_size * gradient, np.float32), np.float32(0.0))

    def state(self) -> dict[str, np.ndarray]:
        """Everything that `restore` needs."""
        return {"value": self.value}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a state."""
        self.value = np.array(state["value"], np.float32)


@dataclass(frozen=True)
class _Schedule:
    """The course of one descent."""

    settings: OptimiserSettings  # how it steps
    step_count: int  # its number of steps

    def progress(self, step: int) -> float:
        """How far along a step is: 0 at the first, 1 at the last."""
        return step / max(self.step_count - 1, 1)

    def step_share(self, step: int) -> float:
        """What a step is of the first one; ``cosine`` goes down to a hundredth."""
        if self.settings.schedule == "constant":
            return 1.0
        return 0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * self.progress(step)))

    def losses(self, step: int, final: LossSchedule) -> LossSchedule:
        """How the losses are at a step: the panorama fades, and the detector has a share from some point on."""
        progress, until = self.progress(step), self.settings.panorama_until
        faded = progress / until if until > 0.0 else 1.0
        is_late = progress >= self.settings.detector_from
        return LossSchedule(max(1.0 - faded, 0.0), final.detector_share if is_late else 0.0)

    def is_time_to_check(self, step: int) -> bool:
        """Whether the rig is evaluated on the validation scenes before a step."""
        return step == 0 or (self.settings.keep == "best" and step % self.settings.check_every == 0)


@dataclass
class Descent:
    """A run of the optimiser; call `step` until you have enough, then `finish`.

    With further starts the run is divided among as many more descents, one after the other, each with steps,
    multipliers and schedule as if it were alone.
    """

    objective: RigObjective  # what is minimised
    scenes: Sequence[AssignedScene]  # the training scenes with their assigned cameras
    settings: OptimiserSettings  # how to step
    start: np.ndarray  # mount poses to start from, float [camera, 7]; brought within the mount's free ranges
    rng: np.random.Generator  # chooses the batches
    iterations: int = 100  # number of steps, at least 1
    batch_size: int = 4  # scenes per step, at least 1
    validation: Sequence[AssignedScene] | None = None  # scenes on which rigs are compared; None: the training scenes
    further_starts: Sequence[np.ndarray] = ()  # where to begin again, each as ``start``

    def __post_init__(self) -> None:
        self.candidates: list[Candidate] = []  # rigs that were evaluated on all validation scenes, in order
        self._failure: str | None = None
        self.iteration = 0  # steps so far
        self.descent = 0  # the descent that is going on, from 0
        self._mount: CameraMount = self.objective.mount
        self.start, *self.further_starts = (self._mount.within(pose) for pose in (self.start, *self.further_starts))
        self._begin(self.start)
        chooser = BatchChooser if self.objective.needs_panorama else _ShuffledBatches
        self._batches = chooser(self.scenes, len(self.start), self.rng)
        self._rate = self._rates()
        are_inequalities = self.objective.constraints.are_inequalities
        self._multiplier_rate = self.settings.multiplier_step(are_inequalities=are_inequalities)

    def _rates(self) -> np.ndarray:
        """First step of every number, float32 [camera, 7]; 0 for what does not move."""
        rate = np.zeros_like(self.start, dtype=np.float32)
        rate[:, [X_M, Y_M]] = self.settings.learning_rate_position_m
        rate[:, YAW_RAD] = math.radians(self.settings.learning_rate_yaw_deg)
        # the others stay where they are: the thesis moves cameras in the plane and turns them about the vertical
        rate[:, PITCH_RAD] = math.radians(self.settings.learning_rate_pitch_deg)
        rate[:, HEIGHT_DELTA_M] = self.settings.learning_rate_height_m
        rate[:, LOG_ZOOM] = self.settings.learning_rate_zoom
        is_moved = self._mount.is_free.copy()
        is_moved[[X_M, Y_M, YAW_RAD]] = True
        rate *= is_moved
        if self._mount.frozen is not None:
            rate[self._mount.frozen.is_frozen] = 0.0
        return rate

    def _begin(self, start: np.ndarray) -> None:
        """Begin a descent with its share of the steps that are left."""
        constraints = self.objective.constraints
        self._begun_at = self.iteration
        left = self.settings.descents - self.descent
        self._schedule = _Schedule(self.settings, round((self.iterations - self.iteration) / left))
        self._pose = AdamW(start, weight_decay=self.settings.weight_decay)
        multiplier = np.zeros(len(constraints.names), np.float32)
        self._multiplier: AdamW | MultiplierAscent = (
            MultiplierAscent(multiplier)
            if constraints.are_inequalities
            else AdamW(multiplier, weight_decay=self.settings.multiplier_weight_decay)
        )

    @property
    def mount_pose(self) -> np.ndarray:
        """Mount poses now, float32 [camera, 7]; they may break the constraints."""
        return self._pose.value.copy()

    @property
    def best(self) -> Candidate:
        """The candidate with the lowest training objective."""
        return _lowest(self.candidates)

    @property
    def start_objective(self) -> float:
        """The objective of the rig that the run begins with."""
        return self.candidates[0].training_objective

    def _of_descent(self, descent: int) -> list[Candidate]:
        return [each for each in self.candidates if each.descent == descent]

    @property
    def _stale_evaluations(self) -> int:
        """Evaluations of this descent since its best rig."""
        own = self._of_descent(self.descent)
        return len(own) - 1 - own.index(_lowest(own))

    @property
    def stop_reason(self) -> str | None:
        """Why the descent has stopped; None while it goes on."""
        if self._failure is not None:
            return self._failure
        if self.descent < len(self.further_starts) or not self._out_of_patience:
            return None
        best, count = _lowest(self._of_descent(self.descent)), self._stale_evaluations
        return f"no better rig in {count} evaluations on the validation scenes since iteration {best.iteration}"

    def step(self) -> IterationRecord:
        """One batch, one step of the cameras, one of the multipliers; where a descent is over, the first of the next.

        A step is taken whole or not at all: whatever stops it, `state` is that before it.
        """
        before = self._position()
        try:
            return self._step()
        except BaseException:
            self._return_to(before)
            raise

    def _step(self) -> IterationRecord:
        if self.descent < len(self.further_starts) and (
            self._steps >= self._schedule.step_count or self._out_of_patience
        ):
            self._check(self._pose.value)
            self.descent += 1
            self._begin(self.further_starts[self.descent - 1])
        checked = self._check(self._pose.value) if self._schedule.is_time_to_check(self._steps) else None
        pose, multiplier = self._pose.value, self._multiplier.value
        result = self.objective.evaluate(
            pose,
            [self.scenes[k] for k in self._batches.choose(self.batch_size)],
            multiplier=multiplier,
            gradient=True,
            schedule=self._schedule.losses(self._steps, self.objective.final_schedule),
        )
        gradient, multiplier_gradient = result.gradient, result.multiplier_gradient
        assert gradient is not None
        assert multiplier_gradient is not None
        if not (math.isfinite(result.total) and np.isfinite(gradient).all()):
            failure = (
                f"iteration {self.iteration}: expected a finite loss and gradient, got {result.total:g}; "
                "lower optimiser.learning_rate_position_m and optimiser.learning_rate_yaw_deg"
            )
            if not any(math.isfinite(each.training_objective) for each in self.candidates):
                raise InputError(failure)
            self._failure, self._pose.value = failure, self.best.mount_pose.copy()
            raise NotFiniteError(failure)
        record = self._record(pose, multiplier, gradient, result, checked)
        self._pose.step(gradient, self._rate * self._schedule.step_share(self._steps))
        if self._mount.is_free.any():
            self._pose.value = self._mount.within(self._pose.value)
        self._multiplier.step(multiplier_gradient, np.full(len(multiplier), -self._multiplier_rate))
        self.iteration += 1
        return record

    def finish(self) -> Candidate:
        """The rig to hand over: the best or the last, always within the constraints.

        After several descents one more rig is evaluated, made of the best cameras of what they found.
        """
        if not self.candidates or self.candidates[-1].iteration != self.iteration:
            self._check(self._pose.value)
            if self.further_starts:
                self._check_mixture()
        return self.best if self.settings.keep == "best" else self.candidates[-1]

    def state(self) -> dict[str, np.ndarray]:
        """Everything that `restore` needs, as arrays of numbers and text: where the last step has led."""
        # without what `finish` has looked at, which it does again
        stepped = [each for each in self.candidates if each.iteration < self.iteration]
        return self._position() | named_part("candidate", _state_of(stepped))

    def _position(self) -> dict[str, np.ndarray]:
        """The state but for its candidates, which steps only add to."""
        return {
            "iteration": np.array(self.iteration),
            "descent": np.array(self.descent),
            "begun_at": np.array(self._begun_at),
            "step_count": np.array(self._schedule.step_count),
            "random_numbers": np.array(json.dumps(self.rng.bit_generator.state)),
            "waiting_scenes": np.array(self._batches.waiting, np.int64),
            **named_part("pose", self._pose.state()),
            **named_part("multiplier", self._multiplier.state()),
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from where another descent of the same arguments was when it gave `state`.

        This one may have more iterations. Then the steps that are left of the last of its descents have the schedule
        that they would have had; those that were taken are as they were.
        """
        found, expected = set(state), set(self.state())
        shape = np.shape(state.get("pose_value", ()))
        if not expected <= found or shape != self.start.shape:
            missing = sorted(expected - found)
            what = f"no {missing[0]}" if missing else f"{' x '.join(map(str, shape))} numbers"
            raise InputError(f"checkpoint: expected the state of a run of {len(self.start)} cameras, got {what}")
        self._return_to(state)
        if self.descent == len(self.further_starts):
            self._schedule = _Schedule(self.settings, self.iterations - self._begun_at)
        self.candidates = _candidates_of(part_of(state, "candidate"))

    def _return_to(self, state: Mapping[str, np.ndarray]) -> None:
        """Be where a `_position` was taken."""
        self.iteration, self.descent = int(state["iteration"]), int(state["descent"])
        self._begun_at = int(state["begun_at"])
        self._schedule = _Schedule(self.settings, int(state["step_count"]))
        self.rng.bit_generator.state = json.loads(str(state["random_numbers"]))
        self._batches.waiting = [int(k) for k in state["waiting_scenes"]]
        self._pose.restore(part_of(state, "pose"))
        self._multiplier.restore(part_of(state, "multiplier"))
        self.candidates = [each for each in self.candidates if each.iteration < self.iteration]

    @property
    def _steps(self) -> int:
        """Steps of this descent so far."""
        return self.iteration - self._begun_at

    @property
    def _out_of_patience(self) -> bool:
        """Whether this descent has been evaluated often enough without a better rig."""
        patience = self.settings.patience
        return patience is not None and self._steps > 0 and self._stale_evaluations >= patience

    def _check(self, mount_pose: np.ndarray) -> Candidate:
        """Evaluate the feasible poses nearest to these on all validation scenes."""
        pose = mount_pose.copy()
        pose[:, [X_M, Y_M]] = self.objective.constraints.project(pose[:, [X_M, Y_M]], pose[:, HEIGHT_DELTA_M])
        scenes, is_mixed = self.validation or self.scenes, bool(self.further_starts)
        found = self.objective.evaluate(pose, scenes, detection_probability=is_mixed)
        candidate = Candidate(pose, found.objective, self.iteration, self.descent, found.detection_probability)
        self.candidates.append(candidate)
        return candidate

    def _check_mixture(self) -> None:
        """Exchange cameras of the best rig for those of the best rigs of the descents."""
        best = [_lowest(self._of_descent(k)) for k in range(self.descent + 1)]
        probability = [each.detection_probability for each in best if each.detection_probability is not None]
        if len(probability) < len(best):
            return
        count = len(self.start)
        first = best.index(_lowest(best)) * count + np.arange(count)
        frozen = self._mount.frozen
        chosen = exchange_cameras(
            np.concatenate(probability),
            first,
            is_frozen=None if frozen is None else frozen.is_frozen,
            weight=self.objective.object_weight(self.validation or self.scenes),
        )
        self._check(np.concatenate([each.mount_pose for each in best])[chosen])

    def _record(
        self,
        pose: np.ndarray,
        multiplier: np.ndarray,
        gradient: np.ndarray,
        result: Evaluation,
        checked: Candidate | None,
    ) -> IterationRecord:
        is_free = self._mount.is_free
        moving = np.where(self._rate > 0.0, gradient, 0.0)
        norm = {
            "position": gradient[:, [X_M, Y_M, *([HEIGHT_DELTA_M] if is_free[HEIGHT_DELTA_M] else [])]],
            "rotation": gradient[:, [YAW_RAD, *([PITCH_RAD] if is_free[PITCH_RAD] else [])]],
        }
        if is_free[LOG_ZOOM]:
            norm["zoom"] = gradient[:, LOG_ZOOM]
        return IterationRecord(
            iteration=self.iteration,
            descent=self.descent,
            loss=result.total,
            terms=result.terms,
            multipliers=dict(zip(self.objective.constraints.names, multiplier.tolist(), strict=True)),
            gradient_norm={name: float(np.linalg.norm(part)) for name, part in norm.items()},
            seconds=result.seconds,
            **rig_fields(self._mount, pose),
            training_objective=checked.training_objective if checked else None,
            best_training_objective=self.best.training_objective if self.candidates else None,
            gradient={
                "position_per_m": moving[:, [X_M, Y_M]].tolist(),
                "yaw_per_rad": moving[:, YAW_RAD].tolist(),
            },
        )


class _ShuffledBatches:
    """Batches that go through all scenes in random order before any comes again."""

    def __init__(self, scenes: Sequence[AssignedScene], camera_count: int, rng: np.random.Generator) -> None:
        """Chooser over ``scenes``; which camera answers for what does not matter."""
        del camera_count
        self._count = len(scenes)
        self._rng = rng
        self.waiting: list[int] = []  # scenes of the present order that are still to come

    def choose(self, batch_size: int) -> list[int]:
        """Indices of the scenes of the next batch."""
        while len(self.waiting) < batch_size:
            self.waiting += [int(k) for k in self._rng.permutation(self._count)]
        batch, self.waiting = self.waiting[:batch_size], self.waiting[batch_size:]
        return batch


def _lowest(candidates: Sequence[Candidate]) -> Candidate:
    """The one with the lowest objective, of equal ones the first; what is not finite is never it beside others."""
    return min(
        candidates,
        key=lambda each: each.training_objective if math.isfinite(each.training_objective) else math.inf,
    )


def _state_of(candidates: Sequence[Candidate]) -> dict[str, np.ndarray]:
    """Candidates as arrays; rigs of fewer cameras than others have rows of NaN behind theirs."""
    fields = ("training_objective", "iteration", "descent")
    state = {name: np.array([getattr(each, name) for each in candidates]) for name in fields}
    poses = [each.mount_pose for each in candidates]
    most = max(map(len, poses), default=0)
    padded = [np.pad(pose, ((0, most - len(pose)), (0, 0)), constant_values=np.nan) for pose in poses]
    state = {"mount_pose": np.array(padded), **state}
    if any(each.detection_probability is not None for each in candidates):
        state["detection_probability"] = np.array([each.detection_probability for each in candidates])
    return state


def _candidates_of(state: Mapping[str, np.ndarray]) -> list[Candidate]:
    """The candidates of `_state_of`."""
    probability = state.get("detection_probability")
    return [
        Candidate(
            np.array(pose[~np.isnan(pose).any(axis=1)], np.float32),
            float(state["training_objective"][k]),
            int(state["iteration"][k]),
            int(state["descent"][k]),
            None if probability is None else np.array(probability[k]),
        )
        for k, pose in enumerate(state["mount_pose"])
    ]


def descent_camera_renders(
    settings: OptimiserSettings, scene_count: int, *, camera_count: int, iterations: int, batch_size: int
) -> int:
    """Camera renders of a whole descent at most, with all evaluations on the scenes on which its rigs are compared."""
    evaluations = settings.starts if settings.starts > 1 else 0
    evaluations += 2 * settings.descents  # before the first step and after the last
    evaluations += settings.descents > 1  # at the mixture of what the descents found
    if settings.keep == "best":
        # as many as there can be: patience may end a descent early and leave its steps to the next
        evaluations += max(iterations - settings.descents, 0) // settings.check_every
    return camera_count * (iterations * batch_size + evaluations * scene_count)


def affordable_iterations(
    settings: OptimiserSettings, scene_count: int, camera_renders: int, *, camera_count: int, batch_size: int
) -> int:
    """Iterations of a descent that so many camera renders pay for, see `descent_camera_renders`; maybe none."""
    count, options = 0, {"camera_count": camera_count, "batch_size": batch_size}
    while descent_camera_renders(settings, scene_count, iterations=count + 1, **options) <= camera_renders:
        count += 1
    return count
