"""Presets beside the rigs of a placement: on its vehicle, with images that its network gets, and judged as they are."""

from __future__ import annotations

import dataclasses

from warpav.core.progress import NullProgress, Progress
from warpav.optimisation.losses.scene_on_tape import CameraProbability
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh
from warpav.rig.on_body import MovedRig
from warpav.rig.presets import preset_on_vehicle
from warpav.rig.rig import Rig
from warpav.runs.config import Config
from warpav.runs.detector_fit import ensure_fit
from warpav.runs.mounts import FLUSH_NEAR_M, camera_models
from warpav.runs.placement import Placement


def preset_for(name: str, config: Config, ego: Mesh) -> MovedRig:
    """A preset on a vehicle, its images in their own proportions, as ``baselines.preset_images`` says.

    Args:
        name: The preset.
        config: Gives the number of pixels and the near plane.
        ego: The vehicle.

    Raises:
        InputError: There is no such preset.
    """
    moved = preset_on_vehicle(name, ego)
    cameras = [dataclasses.replace(each, model=_network_model(each.model, config)) for each in moved.rig.cameras]
    return dataclasses.replace(moved, rig=Rig(cameras))


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


def _network_model(model: CameraModel, config: Config) -> CameraModel:
    """A camera with the image that a network gets of it; one flush with a body sees what is a centimetre away."""
    model = dataclasses.replace(model, near_m=min(config.camera.near_m, FLUSH_NEAR_M))
    known = camera_models(config)
    match config.baselines.preset_images:
        case "sensor":
            return model
        case "same_width":
            width_px = max(each.width_px for each in known)
            return model.with_pixels(width_px**2 * model.height_px / model.width_px)
    pixels = [each.width_px * each.height_px for each in known]
    return model.with_pixels(sum(pixels) / len(pixels))
