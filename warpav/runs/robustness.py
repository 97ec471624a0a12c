"""What errors of mounting, dirt and loads cost a rig: `mount_tolerance`, `soiling` and `load_states`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from warpav.core.errors import InputError
from warpav.core.progress import Progress
from warpav.evaluation.perturbations import (
    CameraOutages,
    LoadState,
    LoadStates,
    MountTolerance,
    SoiledPart,
    Soiling,
    SoilShape,
)
from warpav.optimisation.losses.scene_on_tape import AssignedScene
from warpav.optimisation.objective import single_cameras_of
from warpav.optimisation.single_cameras import SingleCameras
from warpav.rig.rig import Rig
from warpav.runs.evaluate import weights_on
from warpav.runs.placement import Placement
from warpav.runs.progress import shown_progress
from warpav.scene.scene import Scene
from warpav.view import Canvas, draws

__all__ = ["load_states", "mount_tolerance", "soiling"]

_LOADS = {"nose down": (1.0, 0.0), "nose up": (-1.0, 0.0), "laden": (-1.0, -0.05)}
"""Pitch [deg] and height [m] by name."""


def mount_tolerance(
    rig: Rig,
    scenes: Sequence[Scene],
    placement: Placement,
    *,
    position_m: float = 0.02,
    angle_deg: float = 1.0,
    sample_count: int = 32,
    seed: int = 0,
    progress: bool | Progress | None = None,
) -> MountTolerance:
    """What errors of mounting cost a rig, by rendering its cameras where they are off. Nothing is written."""
    with shown_progress(progress) as shown:
        found = tolerance_on(
            rig,
            placement.observed(scenes, progress=shown),
            placement,
            position_m=position_m,
            angle_rad=math.radians(angle_deg),
            sample_count=sample_count,
            seed=seed,
            progress=shown,
        )
    if found is None:
        raise _unknown_probability(placement, "what mount errors cost")
    return found


def tolerance_on(
    rig: Rig,
    scenes: Sequence[AssignedScene],
    placement: Placement,
    *,
    position_m: float,
    angle_rad: float,
    sample_count: int,
    seed: int = 0,
    progress: Progress | None = None,
) -> MountTolerance | None:
    """What errors of mounting cost a rig on scenes that are on the device, see `mount_tolerance`."""
    cameras = single_cameras_of(placement.objective)
    if cameras is None:
        return None
    packed = [each.scene for each in scenes]
    return MountTolerance.of(
        [camera.name for camera in rig.cameras],
        placement.mount_pose_of(rig),
        cameras,
        packed,
        position_m=position_m,
        angle_rad=angle_rad,
        sample_count=sample_count,
        seed=seed,
        weight=weights_on(packed, placement),
        progress=progress,
    )


def soiling(
    rig: Rig,
    scenes: Sequence[Scene],
    placement: Placement,
    *,
    shape: SoilShape = "disc",
    place: tuple[float, float] = (0.5, 0.5),
    share: float = 0.1,
    progress: bool | Progress | None = None,
) -> Soiling:
    """What a rig is expected to miss when a part of one camera's image is soiled, for each camera in turn.

    The soiled part is opaque: what lies in it is not visible, and what it touches is partly hidden. Nothing is written.

    Args:
        shape: ``disc``; ``rows``, a band from the left edge to the right; ``columns``, one from the upper to the lower.
    """
    part = SoiledPart(shape, place, share)
    with shown_progress(progress) as shown:
        return soiling_of(rig, scenes, placement, part, progress=shown)


def soiling_of(
    rig: Rig, scenes: Sequence[Scene], placement: Placement, part: SoiledPart, *, progress: Progress
) -> Soiling:
    """`soiling` with a part of an image."""
    pose, cameras, seen, weight = _posed(rig, scenes, placement, "what dirt costs", progress)
    names = [camera.name for camera in rig.cameras]
    return Soiling.of(names, pose, cameras, seen, part, weight=weight, progress=progress)


def load_states(
    rig: Rig,
    scenes: Sequence[Scene],
    placement: Placement,
    *,
    states: Mapping[str, tuple[float, float]] | None = None,
    progress: bool | Progress | None = None,
) -> LoadStates:
    """What a rig is expected to miss when a load pitches or lowers the vehicle with its cameras. Nothing is written.

    Args:
        states: Of each load by name ``pitch_deg``, the turn about the ego frame's y axis, nose down positive [deg],
            within 30, and ``height_m``, how far the frame's origin (on the ground below the rear axle) rises [m].
            None: one degree nose down, one degree nose up, and laden: 1 degree nose up and 5 cm lower.
    """
    given = _LOADS if states is None else states
    loads = {name: LoadState(*state) for name, state in given.items()}
    with shown_progress(progress) as shown:
        return load_states_of(rig, scenes, placement, loads, progress=shown)


def load_states_of(
    rig: Rig, scenes: Sequence[Scene], placement: Placement, loads: Mapping[str, LoadState], *, progress: Progress
) -> LoadStates:
    """`load_states` with loads by name."""
    pose, cameras, seen, weight = _posed(rig, scenes, placement, "what loads cost", progress)
    return LoadStates.of(pose, cameras, seen, loads, weight=weight, progress=progress)


def _posed(
    rig: Rig, scenes: Sequence[Scene], placement: Placement, what: str, progress: Progress
) -> tuple[np.ndarray, SingleCameras, list[Scene], np.ndarray | None]:
    """A rig's mount pose, its cameras, scenes as the placement sees them, and the weights of their objects."""
    observed = placement.observed(scenes, progress=progress)
    cameras = single_cameras_of(placement.objective)
    if cameras is None:
        raise _unknown_probability(placement, what)
    weight = weights_on([each.scene for each in observed], placement)
    return placement.mount_pose_of(rig), cameras, list(placement.as_seen(scenes)), weight


def _unknown_probability(placement: Placement, what: str) -> InputError:
    got = ", ".join(loss.name for _, loss in placement.objective.losses)
    return InputError(f"losses: expected the expected_miss_rate alone, with combine=any, for {what}, got {got}")


@draws(MountTolerance, "tolerance", is_figure=True)
def _tolerance_drawing(tolerance: MountTolerance, canvas: Canvas, *, outages: CameraOutages | None = None) -> Any:  # noqa: ANN401
    from warpav.view.figures.statistics import sensitivity_figure

    return sensitivity_figure(tolerance, outages, heading=canvas.title)
