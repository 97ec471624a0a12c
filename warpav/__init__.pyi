"""Types of the public names, for editors and type checkers; ``__init__.py`` imports them when they are first used."""

from typing import Final

from warpav.core.errors import InputError
from warpav.core.progress import Progress
from warpav.detection import Detections, Detector, render, scan
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh
from warpav.rig import (
    Module,
    Rig,
    export_rig,
    import_rig,
    propose_zones,
    read_modules,
    read_rig,
    read_zones,
    write_rig,
    write_zones,
)
from warpav.rig import RigCamera as Camera
from warpav.rig import preset_rig as preset
from warpav.runs import (
    Placement,
    Result,
    RigEvaluation,
    RunFolder,
    check_detector,
    evaluate,
    fit,
    front,
    highest_rig,
    load_scenes,
    losses,
    optimise,
    random_rig,
    read_detector,
    read_run,
    resume,
    rig_by_hand,
    robustness,
)
from warpav.runs.config import Config
from warpav.scene import Scene, read_scenes, read_vehicle, write_scenes
from warpav.scene._files import town  # `warpav.scene.town` is a package
from warpav.sight import check_requirements, coverage, read_requirements
from warpav.view import plot

__version__: Final[str]

__all__ = [
    "Camera",
    "CameraModel",
    "Config",
    "Detections",
    "Detector",
    "InputError",
    "Mesh",
    "Module",
    "Placement",
    "Progress",
    "Result",
    "Rig",
    "RigEvaluation",
    "RunFolder",
    "Scene",
    "check_detector",
    "check_requirements",
    "coverage",
    "evaluate",
    "export_rig",
    "fit",
    "front",
    "highest_rig",
    "import_rig",
    "load_scenes",
    "losses",
    "optimise",
    "plot",
    "preset",
    "propose_zones",
    "random_rig",
    "read_detector",
    "read_modules",
    "read_requirements",
    "read_rig",
    "read_run",
    "read_scenes",
    "read_vehicle",
    "read_zones",
    "render",
    "resume",
    "rig_by_hand",
    "robustness",
    "scan",
    "town",
    "write_rig",
    "write_scenes",
    "write_zones",
]
