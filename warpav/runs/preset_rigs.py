"""Presets beside the rigs of a placement, judged as they are."""

from __future__ import annotations

from warpav.core.progress import NullProgress, Progress
from warpav.optimisation.losses.scene_on_tape import CameraProbability
from warpav.rig.rig import Rig
from warpav.runs.detector_fit import ensure_fit
from warpav.runs.placement import Placement


def know_cameras(rig: Rig, placement: Placement, progress: Progress | None = None) -> None:
    """Let the objective of a placement know how likely cameras of other models are to detect, so that it judges them.

    Where the objective needs no such model, or does not follow from single cameras, nothing happens.

    Args:
        rig: Its cameras.
        placement: Gets to know them.
        progress: As of `ensure_fit`.

    Raises:
        InputError: The model cannot be fitted.
    """
    objective, parts = placement.objective, placement.parts
    if not objective.is_by_single_cameras or parts.probability is not None:
        return
    detector = placement.detector if parts.has_own_detector else None
    for model in dict.fromkeys(camera.model for camera in rig.cameras):
        if objective.probability_of(model) is None:
            fit = ensure_fit(
                placement.config, detector=detector, ego=parts.ego, camera=model, progress=progress or NullProgress()
            )
            probability = CameraProbability.of(placement.config.losses, fit)
            assert probability is not None
            objective.know(model, probability)
