"""Presets beside the rigs of a placement, judged as they are."""

from __future__ import annotations

from warpav.core.progress import NullProgress, Progress
from warpav.optimisation.losses.scene_on_tape import CameraProbability
from warpav.rig.rig import Rig
from warpav.runs.detector_fit import ensure_fit
from warpav.runs.placement import Placement


def know_cameras(rig: Rig, placement: Placement, progress: Progress | None = None) -> None:
    """Give a placement's objective the models of detection probability of other cameras, so that it judges them."""
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
