"""Gradient descent on the cameras and gradient ascent on the multipliers (thesis section III.C)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from warpav.core.errors import InputError
from warpav.optimisation.constraints import min_camera_distance_m
from warpav.optimisation.missed import Stage
from warpav.optimisation.mount import LOG_ZOOM, PITCH_RAD, RISE_M, X_M, Y_M, YAW_RAD, CameraMount
from warpav.optimisation.objective import AssignedScene, Evaluation, RigObjective
from warpav.optimisation.segregation import BatchChooser, ShuffledBatches
from warpav.optimisation.settings import OptimiserSettings
from warpav.optimisation.starts import exchange_cameras
from warpav_kernels.placement import update


@dataclass(frozen=True)
class IterationRecord:
    """What one step did; every field goes into ``events.jsonl`` as it is.

    Attributes:
        iteration: From 0.
        loss: The Lagrangian on the batch, at the poses before the step.
        terms: Every loss by name, unscaled.
        multipliers: Every Lagrange multiplier by name.
        gradient_norm: L2 norm of the gradient to all positions and to all angles; where it is free, to all zooms.
        positions_m: Camera centres in the ego frame before the step [m], [camera][3].
        yaw_deg: Yaw before the step [deg], [camera].
        seconds: Wall time: render, detect, backward, total [s].
        min_camera_distance_m: Smallest distance between two cameras [m].
        training_objective: Objective of the feasible poses on all validation scenes, None where it was not looked at.
        best_training_objective: The lowest of them so far, None before the first look.
        gradient: Of the loss to what the step moves: ``position_per_m`` to x and y on the surface, [camera][2], and
            ``yaw_per_rad``, [camera]; 0 for what is held.
        free: What else is free, before the step: pitch_deg, height_m (above the surface) and fov_deg, each [camera].
        descent: From 0, of those that the run has one after the other.
    """

    iteration: int
    loss: float
    terms: dict[str, float]
    multipliers: dict[str, float]
    gradient_norm: dict[str, float]
    positions_m: list[list[float]]
    yaw_deg: list[float]
    seconds: dict[str, float]
    min_camera_distance_m: float | None
    training_objective: float | None
    best_training_objective: float | None
    gradient: dict[str, list[Any]] = field(default_factory=dict)
    free: dict[str, list[float]] = field(default_factory=dict)
    descent: int = 0


class AdamW:
    """AdamW on one array of numbers, on the device of the objective."""

    def __init__(self, value: np.ndarray, *, weight_decay: float, device: str) -> None:
        """State for ``value``, any shape."""
        self._shape = value.shape
        self._device = device
        self._weight_decay = weight_decay
        self._step_number = 0
        flat = np.ascontiguousarray(value, np.float32).ravel()
        self._value = wp.array(flat, dtype=float, device=device)
        self._first_moment = wp.zeros_like(self._value)
        self._second_moment = wp.zeros_like(self._value)

    @property
    def value(self) -> np.ndarray:
        """The numbers now, a copy."""
        return self._value.numpy().reshape(self._shape).copy()

    @value.setter
    def value(self, value: np.ndarray) -> None:
        self._value.assign(np.ascontiguousarray(value, np.float32).ravel())

    def step(self, gradient: np.ndarray, step_size: np.ndarray) -> None:
        """One step; a negative step size ascends, 0 leaves a number as it is. Shapes as ``value``."""
        self._step_number += 1
        wp.launch(
            update.adamw_step_kernel,
            dim=self._value.shape[0],
            inputs=[
                wp.array(np.ascontiguousarray(gradient, np.float32).ravel(), dtype=float, device=self._device),
                wp.array(np.ascontiguousarray(step_size, np.float32).ravel(), dtype=float, device=self._device),
                self._weight_decay,
                0.9,
                0.999,
                1e-8,
                self._step_number,
            ],
            outputs=[self._first_moment, self._second_moment, self._value],
            device=self._device,
            record_tape=False,
        )

    def state(self) -> dict[str, np.ndarray]:
        """Everything that a checkpoint needs."""
        return {
            "value": self.value,
            "first_moment": self._first_moment.numpy().copy(),
            "second_moment": self._second_moment.numpy().copy(),
            "step_number": np.array(self._step_number),
        }


class MultiplierAscent:
    """Plain gradient steps on the multipliers of inequalities, which are never negative."""

    def __init__(self, value: np.ndarray) -> None:
        """State for ``value``, any shape, at least 0."""
        self._value = np.array(value, np.float32)

    @property
    def value(self) -> np.ndarray:
        """The numbers now, a copy."""
        return self._value.copy()

    def step(self, gradient: np.ndarray, step_size: np.ndarray) -> None:
        """One step, as `AdamW.step` counts them: a negative step size ascends. Shapes as ``value``."""
        self._value = np.maximum(self._value - np.asarray(step_size * gradient, np.float32), np.float32(0.0))

    def state(self) -> dict[str, np.ndarray]:
        """Everything that a checkpoint needs."""
        return {"value": self.value}


@dataclass(eq=False)
class Candidate:
    """A rig that satisfies the constraints, and its objective on all validation scenes.

    ``chance`` is what `Evaluation` tells of the single cameras.
    """

    mount_pose: np.ndarray
    training_objective: float
    iteration: int
    descent: int
    chance: np.ndarray | None = None


def _lowest(candidates: Sequence[Candidate]) -> Candidate:
    return min(candidates, key=lambda candidate: candidate.training_objective)


@dataclass
class Descent:
    """A run of the optimiser; call `step` until you have enough, then `finish`.

    With further starts the run is divided among as many more descents, one after the other, each with steps,
    multipliers and stages as if it were alone.

    Attributes:
        objective: What is lowered.
        scenes: The training scenes with their assigned cameras.
        settings: How to step.
        start: Mount poses to start from, float [camera, 7].
        iterations: Number of steps, at least 1.
        batch_size: Scenes per step, at least 1.
        rng: Chooses the batches.
        validation: Scenes on which rigs are compared; None: the training scenes.
        further_starts: Where to begin again, each as ``start``; ``settings.descents`` - 1 of them.
        candidates: Rigs that were looked at on all validation scenes, in order.
        iteration: Steps so far.
        descent: The descent that is going on, from 0.
    """

    objective: RigObjective
    scenes: Sequence[AssignedScene]
    settings: OptimiserSettings
    start: np.ndarray
    rng: np.random.Generator
    iterations: int = 100
    batch_size: int = 4
    validation: Sequence[AssignedScene] | None = None
    further_starts: Sequence[np.ndarray] = ()
    candidates: list[Candidate] = field(default_factory=list)

    def __post_init__(self) -> None:
        if len(self.further_starts) != self.settings.descents - 1:
            raise ValueError(
                f"{self.settings.descents} descents need as many starts, got {1 + len(self.further_starts)}"
            )
        self.iteration = 0
        self.descent = 0
        self._mount: CameraMount = self.objective.mount
        self._begin(self.start)
        is_informed = self.objective.settings.needs_panorama
        self._batches = (BatchChooser if is_informed else ShuffledBatches)(self.scenes, len(self.start), self.rng)
        rate = np.zeros_like(self.start, dtype=np.float32)
        rate[:, [X_M, Y_M]] = self.settings.learning_rate_position_m
        rate[:, YAW_RAD] = self.settings.learning_rate_yaw_rad
        # the others stay where they are: the thesis moves cameras in the plane and turns them about the vertical
        rate[:, PITCH_RAD] = self.settings.learning_rate_pitch_rad
        rate[:, RISE_M] = self.settings.learning_rate_height_m
        rate[:, LOG_ZOOM] = self.settings.learning_rate_zoom
        is_moved = self._mount.is_free.copy()
        is_moved[[X_M, Y_M, YAW_RAD]] = True
        self._rate = rate * is_moved
        self._multiplier_rate = self.settings.multiplier_step(
            are_inequalities=self.objective.constraints.are_inequalities
        )
        if self._mount.held is not None:
            self._rate[self._mount.held.is_held] = 0.0

    def _begin(self, start: np.ndarray) -> None:
        """Begin a descent with its share of the steps that are left."""
        device, constraints = self.objective.device, self.objective.constraints
        self._begun_at = self.iteration
        left = self.settings.descents - self.descent
        self._step_count = round((self.iterations - self.iteration) / left)
        self._pose = AdamW(self._mount.within(start), weight_decay=self.settings.weight_decay, device=device)
        multiplier = np.zeros(len(constraints.names), np.float32)
        self._multiplier: AdamW | MultiplierAscent = (
            MultiplierAscent(multiplier)
            if constraints.are_inequalities
            else AdamW(multiplier, weight_decay=self.settings.multiplier_weight_decay, device=device)
        )

    def step(self) -> IterationRecord:
        """One batch, one step of the cameras, one of the multipliers; where a descent is over, the first of the next.

        Raises:
            InputError: The loss is no longer finite.
        """
        if self.descent < len(self.further_starts) and (self._steps >= self._step_count or self._is_of_no_use):
            self._look()
            self.descent += 1
            self._begin(self.further_starts[self.descent - 1])
        look = self._look() if self._is_time_to_look() else None
        pose, multiplier = self._pose.value, self._multiplier.value
        batch = [self.scenes[k] for k in self._batches.choose(self.batch_size)]
        result = self.objective.evaluate(pose, batch, multiplier=multiplier, gradient=True, stage=self._stage())
        gradient, multiplier_gradient = result.gradient, result.multiplier_gradient
        assert gradient is not None
        assert multiplier_gradient is not None
        if not (math.isfinite(result.total) and np.isfinite(gradient).all()):
            raise InputError(
                f"iteration {self.iteration}: expected a finite loss and gradient, got {result.total:g}; "
                "lower optimiser.learning_rate_position_m and optimiser.learning_rate_yaw_deg"
            )
        record = self._record(pose, multiplier, gradient, result, look)
        self._pose.step(gradient, self._rate * self._schedule())
        if self._mount.is_free.any():
            self._pose.value = self._mount.within(self._pose.value)
        self._multiplier.step(multiplier_gradient, np.full(len(multiplier), -self._multiplier_rate))
        self.iteration += 1
        return record

    def finish(self) -> Candidate:
        """The rig to hand over: the best or the last, always within the constraints.

        After several descents one more rig is looked at, made of the best cameras of what they found.
        """
        if not self.candidates or self.candidates[-1].iteration != self.iteration:
            self._look()
            if self.further_starts:
                self._look_at_mixture()
        return self.best if self.settings.keep == "best" else self.candidates[-1]

    @property
    def best(self) -> Candidate:
        """The candidate with the lowest training objective."""
        return _lowest(self.candidates)

    def state(self) -> dict[str, Any]:
        """Everything that a checkpoint needs, as arrays."""
        return {
            "iteration": np.array(self.iteration),
            **{f"pose_{name}": value for name, value in self._pose.state().items()},
            **{f"multiplier_{name}": value for name, value in self._multiplier.state().items()},
        }

    @property
    def _steps(self) -> int:
        """Steps of this descent so far."""
        return self.iteration - self._begun_at

    def _is_time_to_look(self) -> bool:
        if self._steps == 0:
            return True
        return self.settings.keep == "best" and self._steps % self.settings.check_every == 0

    def _look(self, mount_pose: np.ndarray | None = None) -> Candidate:
        """Evaluate the feasible poses nearest to these, or to the present ones, on all validation scenes."""
        pose = self._pose.value if mount_pose is None else mount_pose
        pose[:, [X_M, Y_M]] = self.objective.constraints.project(pose[:, [X_M, Y_M]], pose[:, RISE_M])
        found = self.objective.evaluate(pose, self.validation or self.scenes, chances=bool(self.further_starts))
        candidate = Candidate(pose, found.objective, self.iteration, self.descent, found.chance)
        self.candidates.append(candidate)
        return candidate

    def _look_at_mixture(self) -> None:
        """Exchange cameras of the best rig for those of the best rigs of the descents."""
        own = [[each for each in self.candidates if each.descent == k] for k in range(self.descent + 1)]
        best = [_lowest(each) for each in own]
        chances = [each.chance for each in best if each.chance is not None]
        if len(chances) < len(best):
            return
        count = len(self.start)
        first = best.index(_lowest(best)) * count + np.arange(count)
        held = self._mount.held
        chosen = exchange_cameras(np.concatenate(chances), first, is_held=None if held is None else held.is_held)
        self._look(np.concatenate([each.mount_pose for each in best])[chosen])

    @property
    def verdict(self) -> str | None:
        """Why there is no use in going on, in words; None while there is."""
        if self.descent < len(self.further_starts) or not self._is_of_no_use:
            return None
        looks, best = self._looks_in_vain
        return f"no better rig in {looks} looks at the validation scenes since iteration {best.iteration}"

    @property
    def _is_of_no_use(self) -> bool:
        """Whether this descent has lost patience."""
        patience = self.settings.patience
        return patience is not None and self._steps > 0 and self._looks_in_vain[0] >= patience

    @property
    def _looks_in_vain(self) -> tuple[int, Candidate]:
        """Looks of this descent since its best rig, and that rig."""
        own = [each for each in self.candidates if each.descent == self.descent]
        best = _lowest(own)
        return len(own) - 1 - own.index(best), best

    @property
    def _progress(self) -> float:
        return self._steps / max(self._step_count - 1, 1)

    def _stage(self) -> Stage:
        last = self.objective.last_stage
        faded = self._progress / self.settings.panorama_until if self.settings.panorama_until > 0.0 else 1.0
        is_late = self._progress >= self.settings.detector_from
        return Stage(max(1.0 - faded, 0.0), last.detector_share if is_late else 0.0)

    def _schedule(self) -> float:
        if self.settings.schedule == "constant":
            return 1.0
        progress = self._progress
        return 0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * progress))

    def _record(
        self,
        pose: np.ndarray,
        multiplier: np.ndarray,
        gradient: np.ndarray,
        result: Evaluation,
        look: Candidate | None,
    ) -> IterationRecord:
        rig = self._mount.rig(pose)
        position_m = np.array([camera.position_m for camera in rig.cameras])
        distance_m = min_camera_distance_m(position_m)
        is_free = self._mount.is_free
        moving = np.where(self._rate > 0.0, gradient, 0.0)
        free: dict[str, np.ndarray] = {}
        norm = {
            "position": gradient[:, [X_M, Y_M, *([RISE_M] if is_free[RISE_M] else [])]],
            "rotation": gradient[:, [YAW_RAD, *([PITCH_RAD] if is_free[PITCH_RAD] else [])]],
        }
        if is_free[PITCH_RAD]:
            free["pitch_deg"] = np.degrees(pose[:, PITCH_RAD])
        if is_free[RISE_M]:
            free["height_m"] = pose[:, RISE_M].astype(np.float64) + self._mount.height_offset_m
        if is_free[LOG_ZOOM]:
            free["fov_deg"] = np.degrees([camera.model.fov_rad for camera in rig.cameras])
            norm["zoom"] = gradient[:, LOG_ZOOM]
        return IterationRecord(
            iteration=self.iteration,
            descent=self.descent,
            loss=result.total,
            terms=result.terms,
            multipliers=dict(zip(self.objective.constraints.names, multiplier.tolist(), strict=True)),
            gradient_norm={name: float(np.linalg.norm(part)) for name, part in norm.items()},
            positions_m=position_m.tolist(),
            yaw_deg=np.degrees(pose[:, YAW_RAD]).tolist(),
            seconds=result.seconds,
            min_camera_distance_m=distance_m if math.isfinite(distance_m) else None,
            training_objective=look.training_objective if look else None,
            best_training_objective=self.best.training_objective if self.candidates else None,
            gradient={
                "position_per_m": moving[:, [X_M, Y_M]].tolist(),
                "yaw_per_rad": moving[:, YAW_RAD].tolist(),
            },
            free={name: numbers.tolist() for name, numbers in free.items()},
        )
