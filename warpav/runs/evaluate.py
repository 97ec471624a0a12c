"""Rigs on the scenes of a placement."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from warpav.core.errors import ArgumentError, InputError
from warpav.core.progress import Progress
from warpav.evaluation.camera_outage import CameraOutages
from warpav.evaluation.metrics import SceneObservations, metrics_of, observe_scenes
from warpav.evaluation.mount_tolerance import MountTolerance
from warpav.evaluation.rig_evaluation import RigEvaluation, seen_objects
from warpav.evaluation.robustness import LoadState, LoadStates, SoiledPart, Soiling, SoilShape
from warpav.optimisation.assignment import AssignedScene
from warpav.optimisation.rig_values import single_cameras_of
from warpav.optimisation.single_cameras import SingleCameras
from warpav.rig.rig import Rig
from warpav.runs.placement import Placement
from warpav.runs.progress import shown_progress
from warpav.scene.device_scene import DeviceScene
from warpav.scene.scene import Scene
from warpav.view import Canvas, drawing_of

_LOADS = {"nose down": (1.0, 0.0), "nose up": (-1.0, 0.0), "laden": (-1.0, -0.05)}
"""Pitch [deg] and height [m] by name."""


def evaluate(
    rigs: Rig | Mapping[str, Rig],
    scenes: Sequence[Scene],
    placement: Placement,
    *,
    progress: bool | Progress | None = None,
) -> RigEvaluation:
    """Measure rigs on scenes, with the detector of a placement and around its vehicle. Nothing is written.

    Args:
        rigs: A rig, or several by name. They need not be the placement's: only of rigs with its number and model of
            cameras the objective is known.
        scenes: Scenes that no rig was optimised on.
        placement: Gives the detector, the vehicle, the targets and the objective.
        progress: As of `warpav.runs.optimise.optimise`.

    Raises:
        InputError: There is no rig or no scene, or a scene is around another vehicle.
        TypeError: An argument is of another type.
    """
    if not isinstance(placement, Placement):
        raise TypeError(f"placement: expected a Placement, got {type(placement).__name__}")
    named = {"rig": rigs} if isinstance(rigs, Rig) else dict(rigs)
    if not named:
        raise ArgumentError("rigs", "expected at least one rig, got none")
    for name, rig in named.items():
        if not isinstance(rig, Rig):
            raise TypeError(f"rigs: expected rigs by name, got {type(rig).__name__} as {name!r}")
    with shown_progress(progress) as shown:
        return evaluate_on(named, placement.observed(scenes, progress=shown), placement, progress=shown)


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
    """What errors of mounting cost a rig, by rendering its cameras where they are off. Nothing is written.

    Args:
        rig: As many cameras as the placement has, of its camera model.
        scenes: Scenes that no rig was optimised on.
        placement: Gives the vehicle, the targets, the model of detection probability and the weights of objects.
        position_m: Greatest error of a place in each direction [m], positive.
        angle_deg: Greatest error of yaw, pitch and roll [deg], positive.
        sample_count: Draws of all errors together, at least 1.
        seed: Of the draws.
        progress: As of `warpav.runs.optimise.optimise`.

    Returns:
        Expected misses per 100 objects: of the rig, of the draws, and with each camera off in each degree of freedom.

    Raises:
        InputError: The rig does not fit the placement, whose objective has to be the expected miss rate alone; a number
            is not positive, or the scenes hold no objects.
    """
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
    """What errors of mounting cost a rig on scenes that are on the device, see `mount_tolerance`.

    None where the objective is not the expected miss rate alone.
    """
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
        weight=_weights_on(packed, placement),
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
        rig: As many cameras as the placement has, of its camera model.
        scenes: Scenes that no rig was optimised on.
        placement: Gives the vehicle, the targets, the model of detection probability and the weights of objects.
        shape: ``disc``; ``rows``, a band from the left edge to the right; ``columns``, one from the upper to the lower.
        place: Its middle as shares of the image's width and height from the upper left corner, 0..1.
        share: Its area as a share of the image's, in (0, 1]; what lies beyond the image's edge counts too.
        progress: As of `warpav.runs.optimise.optimise`.

    Returns:
        Expected misses per 100 objects of the clean rig, and with each camera soiled.

    Raises:
        InputError: The rig does not fit the placement, whose objective has to be the expected miss rate alone with
            ``visibility.occlusion=exact``; a number is out of its range, or the scenes hold no objects.
    """
    part = SoiledPart(shape, place, share)
    with shown_progress(progress) as shown:
        pose, cameras, seen, weight = _posed(rig, scenes, placement, "what dirt costs", shown)
        names = [camera.name for camera in rig.cameras]
        return Soiling.of(names, pose, cameras, seen, part, weight=weight, progress=shown)


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
        rig: As many cameras as the placement has, of its camera model.
        scenes: Scenes that no rig was optimised on, without a load.
        placement: Gives the vehicle, the targets, the model of detection probability and the weights of objects.
        states: Of each load by name ``pitch_deg``, the turn about the ego frame's y axis, nose down positive [deg],
            within 30, and ``height_m``, how far the frame's origin (on the ground below the rear axle) rises [m].
            None: one degree nose down, one degree nose up, and laden: 1 degree nose up and 5 cm lower.
        progress: As of `warpav.runs.optimise.optimise`.

    Returns:
        Expected misses per 100 objects of the rig without a load, and under each.

    Raises:
        InputError: The rig does not fit the placement, whose objective has to be the expected miss rate alone; a number
            is out of its range, or the scenes hold no objects.
    """
    given = _LOADS if states is None else states
    loads = {name: LoadState(*state) for name, state in given.items()}
    with shown_progress(progress) as shown:
        pose, cameras, seen, weight = _posed(rig, scenes, placement, "what loads cost", shown)
        return LoadStates.of(pose, cameras, seen, loads, weight=weight, progress=shown)


def _posed(
    rig: Rig, scenes: Sequence[Scene], placement: Placement, what: str, progress: Progress
) -> tuple[np.ndarray, SingleCameras, list[Scene], np.ndarray | None]:
    """A rig's mount pose, its cameras, scenes as the placement sees them, and the weights of their objects."""
    observed = placement.observed(scenes, progress=progress)
    cameras = single_cameras_of(placement.objective)
    if cameras is None:
        raise _unknown_probability(placement, what)
    weight = _weights_on([each.scene for each in observed], placement)
    return placement.mount_pose_of(rig), cameras, list(placement.as_seen(scenes)), weight


def _weights_on(scenes: Sequence[DeviceScene], placement: Placement) -> np.ndarray | None:
    """Weights of the objects of scenes; None where none are set, or all of these objects have none."""
    importance = placement.objective.importance
    weight = None if importance is None else importance.weights_of(scenes)
    return weight if weight is not None and weight.any() else None


def _unknown_probability(placement: Placement, what: str) -> InputError:
    got = ", ".join(loss.name for _, loss in placement.objective.losses)
    return InputError(f"losses: expected the expected_miss_rate alone, with combine=any, for {what}, got {got}")


@drawing_of.register(MountTolerance)
def _tolerance_drawing(tolerance: MountTolerance, canvas: Canvas, *, outages: CameraOutages | None = None) -> Any:  # noqa: ANN401
    from warpav.view.figures.sensitivity import sensitivity_figure

    return sensitivity_figure(tolerance, outages, heading=canvas.title)


@drawing_of.register(CameraOutages)
def _outages_drawing(outages: CameraOutages, canvas: Canvas) -> Any:  # noqa: ANN401 (see warpav.view.drawing_of)
    from warpav.view.figures.sensitivity import sensitivity_figure

    return sensitivity_figure(None, outages, heading=canvas.title)


@drawing_of.register(RigEvaluation)
def _drawing(evaluation: RigEvaluation, canvas: Canvas) -> Any:  # noqa: ANN401 (see warpav.view.drawing_of)
    from warpav.view.figures.statistics import recall_figure

    if not evaluation.objects:
        raise InputError("plot: expected an evaluation with objects, got none")
    headings = {"distance_m": "Recall by distance [m]", "sector": "Recall by sector", "category": "Recall by category"}
    groupings = {
        heading: {name: metrics.recall_by[by] for name, metrics in evaluation.metrics.items()}
        for by, heading in headings.items()
    }
    title = canvas.title or f"{len(evaluation.scenes)} scenes, {len(evaluation.objects)} objects"
    return recall_figure(groupings, title=title)


def evaluate_on(
    rigs: Mapping[str, Rig],
    scenes: list[AssignedScene],
    placement: Placement,
    *,
    began_as: Mapping[str, Rig | None] | None = None,
    progress: Progress,
) -> RigEvaluation:
    """Measure rigs on scenes that are on the device.

    Args:
        rigs: By name.
        scenes: Of `Placement.observed`, or of the placement itself.
        placement: Likewise.
        began_as: The rig that a rig began as, by name, see `Placement.assigned`; without one a rig is its own.
        progress: Shows how many rigs are done.
    """
    began_as = {} if began_as is None else began_as
    observations = {
        name: observe_scenes(
            rig, placement.assigned(scenes, began_as.get(name, rig)), placement.objective, with_probability=True
        )
        for name, rig in progress.steps("comparing", rigs.items(), count=len(rigs))
    }
    packed = [assigned.scene for assigned in scenes]
    return RigEvaluation(
        dict(rigs),
        {name: metrics_of(observed, placement.objective) for name, observed in observations.items()},
        tuple(scene.name for scene in packed),
        seen_objects(observations, packed, rigs),
        {name: _outages_of(observed, placement) for name, observed in observations.items()},
    )


def _outages_of(observed: SceneObservations, placement: Placement) -> CameraOutages | None:
    """A rig without each of its cameras; None where it is not known what they detect."""
    found = observed.detection_probability
    if found is None:
        return None
    names = [camera.name for camera in observed.rig.cameras]
    return CameraOutages.of(names, found, _weights_on(observed.scenes, placement))
