"""warpav: which cameras a vehicle should carry and where, by exact gradients and by search with a proven bound.

This is the public API; every name is imported when it is first used. ``warpav.raster`` is the rasteriser on its own.

The packages below this one stand in layers, which ``pyproject.toml`` lists under ``[tool.importlinter]``: imports only
point downwards.
"""

import importlib
import os
from typing import Any

# onnxruntime opens connections to its maker's telemetry as soon as it is imported, and reads this only then. Here it is
# set before any import through warpav; processes that warpav starts inherit it.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

__version__ = "0.1.0"

_PLACES = {
    "Camera": ("warpav.rig.rig", "RigCamera"),
    "CameraModel": ("warpav.raster.camera", "CameraModel"),
    "Config": ("warpav.runs.config", "Config"),
    "Detections": ("warpav.detection.detector", "Detections"),
    "Detector": ("warpav.detection.detector", "Detector"),
    "InputError": ("warpav.core.errors", "InputError"),
    "Mesh": ("warpav.raster.mesh", "Mesh"),
    "Module": ("warpav.rig.module", "Module"),
    "Placement": ("warpav.runs.placement", "Placement"),
    "Progress": ("warpav.core.progress", "Progress"),
    "Result": ("warpav.runs.result", "Result"),
    "Rig": ("warpav.rig.rig", "Rig"),
    "RigEvaluation": ("warpav.runs.rig_evaluation", "RigEvaluation"),
    "RunFolder": ("warpav.runs.run_folder", "RunFolder"),
    "Scene": ("warpav.scene.scene", "Scene"),
    "check_requirements": ("warpav.sight.check", "check_requirements"),
    "coverage": ("warpav.sight.ground", "coverage"),
    "evaluate": ("warpav.runs.evaluate", "evaluate"),
    "export_rig": ("warpav.rig.formats.convert", "export_rig"),
    "front": ("warpav.runs.front", "front"),
    "highest_rig": ("warpav.runs.evaluate", "highest_rig"),
    "import_rig": ("warpav.rig.formats.convert", "import_rig"),
    "losses": ("warpav.runs.losses", None),
    "optimise": ("warpav.runs.optimise", "optimise"),
    "plot": ("warpav.view", "plot"),
    "preset": ("warpav.rig.presets", "preset_rig"),
    "random_rig": ("warpav.runs.evaluate", "random_rig"),
    "read_detector": ("warpav.runs.networks", "read_detector"),
    "read_modules": ("warpav.rig.catalogue", "read_modules"),
    "read_requirements": ("warpav.sight.read", "read_requirements"),
    "read_rig": ("warpav.rig.rig", "read_rig"),
    "read_run": ("warpav.runs.run_folder", "read_run"),
    "read_scenes": ("warpav.scene.files", "read_scenes"),
    "read_vehicle": ("warpav.scene.own_vehicle", "read_vehicle"),
    "render": ("warpav.detection.images", "render"),
    "resume": ("warpav.runs.jobs", "resume"),
    "robustness": ("warpav.runs.robustness", None),
    "town": ("warpav.scene.files", "town"),
    "write_rig": ("warpav.rig.rig", "write_rig"),
    "write_scenes": ("warpav.scene.files", "write_scenes"),
}
"""Module and name of everything public; None for a module."""

__all__ = list(_PLACES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:  # noqa: ANN401
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _PLACES[name]
    found = importlib.import_module(module)
    found = found if attribute is None else getattr(found, attribute)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
