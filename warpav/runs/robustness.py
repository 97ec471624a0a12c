"""What errors of mounting, dirt and loads cost a rig: `mount_tolerance`, `soiling` and `load_states`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from warpav.core.errors import InputError
from warpav.core.progress import Progress
from warpav.optimisation import (
    AssignedScene,
    LoadState,
    LoadStates,
    MountErrors,
    MountTolerance,
    PosedRig,
    SoiledPart,
    Soiling,
    SoilShape,
    single_cameras_of,
)
from warpav.rig import Rig
from warpav.runs._evaluate import weights_on
from warpav.runs._placement import Placement
from warpav.runs._progress import shown_progress
from warpav.scene import Scene

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
    errors = MountErrors(position_m, math.radians(angle_deg))
    with shown_progress(progress) as shown:
        observed = placement.observed(scenes, progress=shown)
        found = tolerance_on(rig, observed, placement, errors, sample_count=sample_count, seed=seed, progress=shown)
    if found is None:
        raise _unknown_probability(placement, "what mount errors cost")
    return found


def tolerance_on(
    rig: Rig,
    scenes: Sequence[AssignedScene],
    placement: Placement,
    errors: MountErrors,
    *,
    sample_count: int,
    seed: int = 0,
    progress: Progress | None = None,
) -> MountTolerance | None:
    """What errors of mounting cost a rig on scenes that are on the device, see `mount_tolerance`."""
    posed = _posed(rig, scenes, placement)
    packed = [each.scene for each in scenes]
    return posed and MountTolerance.of(posed, packed, errors, sample_count=sample_count, seed=seed, progress=progress)


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
    posed = _known_rig(rig, scenes, placement, "what dirt costs", progress)
    return Soiling.of(posed, list(placement.as_seen(scenes)), part, progress=progress)


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
    posed = _known_rig(rig, scenes, placement, "what loads cost", progress)
    return LoadStates.of(posed, list(placement.as_seen(scenes)), loads, progress=progress)


def _known_rig(rig: Rig, scenes: Sequence[Scene], placement: Placement, what: str, progress: Progress) -> PosedRig:
    posed = _posed(rig, placement.observed(scenes, progress=progress), placement)
    if posed is None:
        raise _unknown_probability(placement, what)
    return posed


def _posed(rig: Rig, scenes: Sequence[AssignedScene], placement: Placement) -> PosedRig | None:
    """A rig whose cameras are rendered one by one; None where the objective does not follow from single cameras."""
    cameras = single_cameras_of(placement.objective)
    if cameras is None:
        return None
    weight = weights_on([each.scene for each in scenes], placement)
    return PosedRig([camera.name for camera in rig.cameras], placement.mount_pose_of(rig), cameras, weight)


def _unknown_probability(placement: Placement, what: str) -> InputError:
    got = ", ".join(loss.name for _, loss in placement.objective.losses)
    return InputError(f"losses: expected the expected_miss_rate alone, with combine=any, for {what}, got {got}")
