"""Detectors of configurations and of folders, and what identifies a fit of their detection probability."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from warpav.core.cache import digest
from warpav.core.errors import InputError, OptionError, install_text
from warpav.core.records import Form, read_form
from warpav.core.warp_setup import checked_device
from warpav.runs._mounts import camera_model
from warpav.runs._scene_set import own_vehicle_digest, recordings_digest
from warpav.runs.config import Config, with_absolute_paths

if TYPE_CHECKING:
    from warpav.detection import Detector, DetectorUse, DifferentiableDetector, OnnxDetector
    from warpav.raster.camera import CameraModel
    from warpav.raster.mesh import Mesh


def read_detector(
    model: str | Path = "builtin",
    *,
    targets: Sequence[str] = ("vehicle",),
    **options: Any,  # noqa: ANN401 (by option)
) -> OnnxDetector:
    """The detector in an ONNX file, as `warpav.Placement` reads it: ``detector.detect(images_rgb)``.

    To optimise for it, give the placement the path and not this object: then the fit of its detection probability is
    stored, and used again by other processes.

    Args:
        model: Path of the file, or ``builtin``.
        targets: Kinds of road users that it is to find: ``vehicle``, ``pedestrian``, ``cyclist``.
        **options: Options of the section ``detector`` of a configuration, such as ``format="yolox"``,
            ``confidence_min=0.4``, ``labels=["person", "car"]`` or ``classes={"vehicle": ["car"]}``.

    Raises:
        InputError: The file or an option cannot be used.
    """
    given = {"scenes.targets": list(targets), "detector.model": str(model)}
    given |= {f"detector.{name}": value for name, value in options.items()}
    return load_detector(Config().replace(given))


def load_detector(config: Config, *, every_road_user: bool = False) -> OnnxDetector:
    """The detector of the configuration, tried on a grey image of the configured camera."""
    from warpav.detection import GREY

    detector = opened_detector(config, every_road_user=every_road_user)
    # what a network cannot do shows at once, not when scenes have been rendered and a run folder lies there
    detector.detect(np.full((1, config.camera.height_px, config.camera.width_px, 3), GREY, np.uint8))
    return detector


def opened_detector(config: Config, *, every_road_user: bool = False) -> OnnxDetector:
    """As `load_detector`, but not tried."""
    from warpav.detection import OnnxDetector

    return OnnxDetector(
        config.detector.model,
        confidence_min=config.detector.confidence_min,
        nms_iou_max=config.detector.nms_iou_max,
        family=config.detector.format,
        labels=config.detector.labels,
        classes=dict(config.detector.classes),
        targets=None if every_road_user and "vehicle" in config.scenes.targets else config.scenes.targets,
        input_px=config.detector.input_px,
        provider=config.detector.provider,
    )


def detector_use(config: Config, ego: Mesh | None = None, camera: CameraModel | None = None) -> DetectorUse:
    """The detector, and everything in the configuration on which its detection probability in a view depends."""
    from warpav.detection import DetectorUse

    config = with_absolute_paths(config)  # a run folder writes them so, and finds the same fit
    vehicle = own_vehicle_digest(config) if ego is None else digest(ego.vertex_m.tobytes(), ego.triangle.tobytes())
    free = {name: pair for name, pair in config.rig.free.model_dump(mode="json").items() if pair is not None}
    return DetectorUse(
        model_path(config),
        {
            "detector": config.detector.model_dump(mode="json", exclude={"model", "provider"}),
            "camera": _camera_settings(config, camera),
            "scenes": _scene_settings(config),
            **({} if vehicle is None else {"scenes.ego": vehicle}),
            "rig.height_offset_m": config.rig.height_offset_m,
            "visibility.occlusion": config.visibility.occlusion,
            **({"rig.free": free} if free else {}),
        },
    )


def any_camera_use(config: Config) -> DetectorUse:
    """The detector, and what its detection probability depends on when pixels of the network's input are counted.

    Field of view, lens, image size, pose and vehicle are not among it.
    """
    from warpav.detection import RECIPE, DetectorUse

    config = with_absolute_paths(config)
    return DetectorUse(
        model_path(config),
        {
            "cameras": f"any, mixture {RECIPE}",
            "detector": config.detector.model_dump(mode="json", exclude={"model", "provider"}),
            "camera.supersampling": config.camera.supersampling,
            "scenes": _scene_settings(config),
            "visibility.occlusion": config.visibility.occlusion,
        },
    )


def any_camera_config(config: Config) -> Config:
    """The configuration with which a fit for any camera is made: around the scenes' own vehicle.

    A network that takes images of any size does not care to what size others are scaled before.
    """
    changes: dict[str, object] = {"scenes.ego": None}
    if config.detector.input_px is not None and opened_detector(config).takes_any_size:
        changes["detector.input_px"] = None
    return config.replace(changes)


def model_path(config: Config) -> Path:
    """The ONNX file of the detector that a configuration names."""
    from warpav.detection import BUILTIN_MODEL_PATH

    return BUILTIN_MODEL_PATH if config.detector.model == "builtin" else Path(config.detector.model).expanduser()


def _scene_settings(config: Config) -> dict[str, Any]:
    unseen = {"train_seeds", "validation_seeds", "test_seeds", "mirror", "ego", "recordings", "test_recordings"}
    unseen |= {"places", "selection_places", "test_places", "moments_per_street"}
    # curves of embedded scenes are fitted on those of the level easy, and all on vehicles of our own
    unseen |= {"level", "vehicles", "vehicles_share"}
    recordings = recordings_digest(config)
    settings = config.scenes.model_dump(mode="json", exclude=unseen)
    return settings if recordings is None else {**settings, "recordings": recordings}


def _camera_settings(config: Config, camera: CameraModel | None) -> dict[str, Any]:
    settings = config.camera.model_dump(mode="json")
    if camera is None:
        return settings
    settings |= {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "fov_deg": round(math.degrees(camera.fov_rad), 9),
        "lens": str(camera.lens),
        "distortion": list(camera.distortion),
    }
    if camera.focal_px is not None:
        settings |= {"focal_px": list(camera.focal_px), "centre_px": list(camera.centre_px or ())}
    return settings


@dataclass(frozen=True, eq=False)
class Networks:
    detector: Detector  # the detector
    differentiable: DifferentiableDetector | None  # the same network, differentiable; None where no loss needs it


# From here on detections are kept, so that rigs can be compared at equal false alarms below their own threshold too.
_REPORTED_CONFIDENCE = 0.25


def load_networks(config: Config) -> Networks:
    """Load the detector, differentiable as well where the losses of the configuration need it."""
    device = checked_device(config.device)
    least = min(config.detector.confidence_min, _REPORTED_CONFIDENCE)
    detector = load_detector(config.replace({"detector.confidence_min": least}))
    differentiable = None
    if config.losses.weights["detector_gradient"] > 0.0:
        try:
            from warpav.detection import DifferentiableDetector
        except ImportError as error:
            raise OptionError(
                "losses.detector_gradient",
                f"expected PyTorch and onnx, got no package {error.name!r}; "
                f"{install_text('torch')}, or set losses.detector_gradient=0",
            ) from error
        differentiable = DifferentiableDetector.of(detector, camera_model(config), device=device)
    return Networks(detector, differentiable)


_NETWORK_OPTIONS = ("detector.model", "detector.format", "detector.labels", "detector.classes", "detector.input_px")
"""Options that say what a network is: a panel asks the files."""


class _NetworkForm(Form):
    """What a file beside a network says of it: options of the section ``detector``, and the size of its images."""

    format: Any = None
    labels: Any = None
    classes: Any = None
    input_px: Any = None
    confidence_min: Any = None
    nms_iou_max: Any = None
    width_px: int | None = Field(None, ge=1, description="a whole number above 0, beside height_px")
    height_px: int | None = Field(None, ge=1, description="a whole number above 0, beside width_px")


def networks_in(folder: Path, config: Config) -> dict[str, Config]:
    """The configurations that have the ONNX files of a folder as their detectors, by name, each tried on an image.

    A file that fixes its input gets images that fill it, in the proportions of the configured camera; one that takes
    any size gets images of the configured size. ``name.yaml`` beside ``name.onnx`` describes it, see `_NetworkForm`.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of ONNX files, got {'a file' if folder.exists() else 'none'}")
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() == ".onnx" and file.is_file())
    if not files:
        raise InputError(f"{folder}: expected ONNX files such as yolox_nano_coco.onnx, got none")
    named: dict[str, Path] = {}
    for file in files:
        name = re.sub(r"[^a-z0-9]+", "_", file.stem.lower()).strip("_")
        if not name:
            raise InputError(f"{file}: expected a name with letters or digits, got none; rename the file")
        if name in named:
            raise InputError(
                f"{folder}: expected networks of different names, got {named[name].name} and {file.name}, both {name}; "
                "rename one of them"
            )
        named[name] = file.absolute()
    return {name: _panel_config(file, config) for name, file in named.items()}


def _panel_config(file: Path, config: Config) -> Config:
    asked = {"format": "auto", "labels": None, "classes": {}, "input_px": None}
    described = _description(file.with_suffix(".yaml"))
    asked_of_file = {f"detector.{name}": value for name, value in asked.items()}
    found = config.replace({"detector.model": str(file), **asked_of_file, **described})
    detector = load_detector(found)
    if detector.takes_any_size or "camera.width_px" in described:
        return found
    width_px, height_px = config.camera.width_px, config.camera.height_px
    rows, columns = detector.input_size_px(height_px, width_px)
    scale = min(columns / width_px, rows / height_px)
    size_px = (max(1, round(width_px * scale)), max(1, round(height_px * scale)))
    return found.replace({"camera.width_px": size_px[0], "camera.height_px": size_px[1]})


def _description(file: Path) -> dict[str, object]:
    if not file.is_file():
        return {}
    form, mistakes = read_form(_NetworkForm, file)
    if (form.width_px is None) != (form.height_px is None):
        mistakes.note("expected width_px and height_px, got one of them", "width_px")
        mistakes.refuse()
    size_px = {"width_px", "height_px"}
    given = form.model_dump(exclude_unset=True)
    return {f"{'camera' if name in size_px else 'detector'}.{name}": value for name, value in given.items()}


def check_panel_options(option_names: Sequence[str]) -> None:
    """Reject options that a panel takes from its files."""
    for option in option_names:
        if option.startswith(_NETWORK_OPTIONS):
            raise InputError(
                f"command line ({option}): expected an option that all networks of a panel share, got one that each "
                "file answers; leave it out"
            )
