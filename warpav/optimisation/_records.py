"""What a run of an optimiser did, step by step, and the rigs that it looked at on the way."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from warpav.core.errors import InputError
from warpav.optimisation._constraints import min_camera_distance_m
from warpav.optimisation._mount import HEIGHT_DELTA_M, LOG_ZOOM, PITCH_RAD, YAW_RAD, CameraMount


@dataclass(frozen=True)
class IterationRecord:
    """What one step did; every field goes into ``events.jsonl`` as it is."""

    iteration: int  # from 0
    loss: float  # the Lagrangian on the batch, at the poses before the step
    terms: dict[str, float]  # every loss by name, unscaled
    multipliers: dict[str, float]  # every Lagrange multiplier by name
    gradient_norm: dict[str, float]  # l2 norm of the gradient to all positions and to all angles
    positions_m: list[list[float]]  # Camera centres in the ego frame before the step [m], [camera][3]
    yaw_deg: list[float]  # yaw before the step [deg], [camera]
    seconds: dict[str, float]  # wall time: render, detect, backward, total [s]
    min_camera_distance_m: float | None  # smallest distance between two cameras [m]
    training_objective: float | None  # objective of the feasible poses on all validation scenes
    best_training_objective: float | None  # the lowest of them so far, None before the first check
    # of the loss to what the step moves: ``position_per_m`` to x and y on the surface, [camera][2]
    gradient: dict[str, list[Any]] = field(default_factory=dict)
    free: dict[str, list[float]] = field(default_factory=dict)  # what else is free, before the step: pitch_deg
    descent: int = 0  # from 0, of those that the run has one after the other
    stage: str | None = None  # of the search by a pool, see `Found`; None: a step of a descent
    bound: float | None = None  # no rig of `pool_cameras` is below it
    camera_renders: int | None = None  # one camera in one scene each, so far; None in a descent
    pool_cameras: int | None = None  # cameras of the pool of the last selection, which the bound is over; likewise None
    modules: list[str] = field(default_factory=list)  # module of every camera, where the rig mixes them


@dataclass(eq=False)
class Candidate:
    """A rig that satisfies the constraints, and its objective on all validation scenes."""

    mount_pose: np.ndarray  # mount poses, float32 [camera, 7]
    training_objective: float  # its objective on all validation scenes
    iteration: int  # steps before it
    descent: int  # the descent that it belongs to, from 0
    detection_probability: np.ndarray | None = None  # as in `Evaluation`; None where it was not asked for


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


class NotFiniteError(InputError):
    """A descent ends because its loss is no longer finite; what it has found so far is kept."""
