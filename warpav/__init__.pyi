"""Types of the public names, for editors and type checkers; ``__init__.py`` imports them when they are first used."""

from typing import Final

from warpav.core.errors import InputError
from warpav.core.progress import Progress
from warpav.detection.detector import Detections, Detector
from warpav.detection.images import render
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh
from warpav.rig.catalogue import read_modules
from warpav.rig.chart import propose_zones
from warpav.rig.formats.convert import export_rig, import_rig
from warpav.rig.module import Module
from warpav.rig.presets import preset_rig as preset
from warpav.rig.rig import Rig, read_rig, write_rig
from warpav.rig.rig import RigCamera as Camera
from warpav.rig.zone import read_zones, write_zones
from warpav.runs import losses, robustness
from warpav.runs._networks import read_detector
from warpav.runs._result import Result
from warpav.runs._rig_evaluation import RigEvaluation
from warpav.runs._run_folder import RunFolder, read_run
from warpav.runs._scene_set import load_scenes
from warpav.runs.config import Config
from warpav.runs.detector_check import check_detector
from warpav.runs.detector_fit import fit
from warpav.runs.evaluate import evaluate, highest_rig, random_rig
from warpav.runs.front import front
from warpav.runs.jobs import resume
from warpav.runs.optimise import optimise, rig_by_hand
from warpav.runs.placement import Placement
from warpav.scene.files import read_scenes, town, write_scenes
from warpav.scene.own_vehicle import read_vehicle
from warpav.scene.scene import Scene
from warpav.sight.check import check_requirements
from warpav.sight.ground import coverage
from warpav.sight.read import read_requirements
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
    "town",
    "write_rig",
    "write_scenes",
    "write_zones",
]
