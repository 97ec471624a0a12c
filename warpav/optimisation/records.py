"""What a run of an optimiser did, step by step, and the rigs that it looked at on the way."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from warpav.optimisation.constraints import min_camera_distance_m
from warpav.optimisation.mount import HEIGHT_DELTA_M, LOG_ZOOM, PITCH_RAD, YAW_RAD, CameraMount


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
        training_objective: Objective of the feasible poses on all validation scenes, None where they were not checked.
        best_training_objective: The lowest of them so far, None before the first check.
        gradient: Of the loss to what the step moves: ``position_per_m`` to x and y on the surface, [camera][2], and
            ``yaw_per_rad``, [camera]; 0 for frozen cameras.
        free: What else is free, before the step: pitch_deg, height_m (above the surface) and fov_deg, each [camera].
        descent: From 0, of those that the run has one after the other.
        stage: Of the search by a pool, see `Found`; None: a step of a descent.
        bound: No rig of `pool_cameras` is below it; None before the first selection, and in a descent.
        pool_cameras: Cameras of the pool of the last selection, which the bound is over; likewise None.
        camera_renders: One camera in one scene each, so far; None in a descent.
        modules: Module of every camera, where the rig mixes them; empty otherwise.
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
    stage: str | None = None
    bound: float | None = None
    camera_renders: int | None = None
    pool_cameras: int | None = None
    modules: list[str] = field(default_factory=list)


@dataclass(eq=False)
class Candidate:
    """A rig that satisfies the constraints, and its objective on all validation scenes.

    Attributes:
        mount_pose: Mount poses, float32 [camera, 7].
        training_objective: Its objective on all validation scenes.
        iteration: Steps before it.
        descent: The descent that it belongs to, from 0.
        detection_probability: As in `Evaluation`; None where it was not asked for.
    """

    mount_pose: np.ndarray
    training_objective: float
    iteration: int
    descent: int
    detection_probability: np.ndarray | None = None


def rig_fields(mount: CameraMount, mount_pose: np.ndarray) -> dict[str, Any]:
    """What a record says of a rig at ``mount_pose``, float32 [camera, 7]; of pairs the cameras one by one."""
    rig, row = mount.rig(mount_pose), mount.rows_of_cameras(mount_pose)
    position_m = np.array([camera.position_m for camera in rig.cameras])
    distance_m = min_camera_distance_m(position_m)
    side = np.where(np.append(False, row[1:] == row[:-1]), np.float32(-1.0), np.float32(1.0))  # of mirror images
    free: dict[str, list[float]] = {}
    if mount.is_free[PITCH_RAD]:
        free["pitch_deg"] = np.degrees(mount_pose[row, PITCH_RAD]).tolist()
    if mount.is_free[HEIGHT_DELTA_M]:
        height_m = mount_pose[row, HEIGHT_DELTA_M].astype(np.float64) + mount.height_offset_m
        free["height_m"] = height_m.tolist()
    if mount.is_free[LOG_ZOOM]:
        free["fov_deg"] = [math.degrees(camera.model.fov_rad) for camera in rig.cameras]
    return {
        "positions_m": position_m.tolist(),
        "yaw_deg": (np.degrees(mount_pose[row, YAW_RAD]) * side).tolist(),
        "min_camera_distance_m": distance_m if math.isfinite(distance_m) else None,
        "free": free,
        "modules": [camera.module for camera in rig.cameras if camera.module is not None],
    }


def named_part(name: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays as the part of a state that has this name."""
    return {f"{name}_{key}": value for key, value in arrays.items()}


def part_of(state: Mapping[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    """The arrays that are the part of a state with this name."""
    return {key.removeprefix(f"{name}_"): value for key, value in state.items() if key.startswith(f"{name}_")}
