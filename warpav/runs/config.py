"""The configuration: one tree, read strictly from YAML and ``key=value`` overrides.

A file and the overrides are joined first and validated once, so that both have the same rules and the same messages.
Every mistake is reported at once, one line each: where it stands, the field, what was expected, what came, a hint.
Units are part of the names; lengths and angles in files may also carry their own (``20 cm``, ``1.57 rad``).
Relative paths are relative to the working directory.
"""

from __future__ import annotations

import contextlib
import difflib
import functools
import inspect
import math
import operator
import re
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import annotated_types
import yaml
from pydantic import (
    BeforeValidator,
    Field,
    PlainSerializer,
    ValidationError,
    WithJsonSchema,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from warpav.core.errors import InputError, OptionError
from warpav.core.section import Expectation, Section, mistake, shown
from warpav.core.units import DEGREES_PER_UNIT, METRES_PER_UNIT, NUMBER_OR_TEXT, Degrees, Metres, range_reader
from warpav.core.yaml_file import Location, parse_yaml, read_yaml
from warpav.optimisation.settings import (
    METHOD_LOSSES,
    ONE_FIELD_LOSSES,
    LossSettings,
    OptimiserSettings,
    SegregationSettings,
    VisibilitySettings,
)
from warpav.raster.lens import Lens, LensShape, checked_distortion
from warpav.rig.presets import preset_names
from warpav.scene.scene import ROAD_USERS

if TYPE_CHECKING:
    from warpav.runs.placement import Placement

COMMAND_LINE = "command line"
NAMED_STARTS = ("random", "highest")
"""What rig.start may be besides a rig."""

START_FILE = "rig_start.yaml"
"""A rig.start of this name is the file beside the configuration, as a run leaves it."""

MAX_SEED = 2**31 - 1
MAX_SEED_COUNT = 100_000


_SEEDS_TEXT = "seeds as a range such as 1000..1009 or a list such as [1, 2, 3]"


def _read_seeds(value: object) -> tuple[int, ...]:
    seeds: list[int] = []
    for item in value if isinstance(value, (list, tuple)) else [value]:
        match = re.fullmatch(r"\s*([0-9]+)\s*\.\.\s*([0-9]+)\s*", item) if isinstance(item, str) else None
        if match:
            first, last = int(match[1]), int(match[2])
            if last < first:
                mistake(f"expected a range whose end is not below its start, got {item!r}; write {last}..{first}")
            if last > MAX_SEED or last - first >= MAX_SEED_COUNT:
                mistake(f"expected at most {MAX_SEED_COUNT} seeds up to {MAX_SEED}, got {item!r}")
            seeds.extend(range(first, last + 1))
        elif isinstance(item, int) and not isinstance(item, bool):
            if not 0 <= item <= MAX_SEED:
                mistake(f"expected seeds from 0 to {MAX_SEED}, got {item}")
            seeds.append(item)
        else:
            mistake(f"expected {_SEEDS_TEXT}, got {shown(value)}")
    if not seeds:
        mistake(f"expected {_SEEDS_TEXT}, got none; at least one scene is needed")
    twice = sorted({seed for seed in seeds if seeds.count(seed) > 1}) if len(set(seeds)) < len(seeds) else []
    if twice:
        mistake(f"expected every seed once, got {twice[0]} twice")
    return tuple(seeds)


def _shown_seeds(seeds: tuple[int, ...]) -> str | list[int]:
    if len(seeds) > 1 and seeds == tuple(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]}..{seeds[-1]}"
    return list(seeds)


Seeds = Annotated[
    tuple[int, ...],
    BeforeValidator(_read_seeds),
    PlainSerializer(_shown_seeds),
    Expectation(_SEEDS_TEXT),
    WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "integer"}, {"type": "array"}]}),
]


_TARGETS_TEXT = f"a list out of {', '.join(ROAD_USERS)}"


def _read_targets(value: object) -> tuple[str, ...]:
    targets = list(value) if isinstance(value, (list, tuple)) else [value]
    for target in targets:
        if target not in ROAD_USERS:
            near = difflib.get_close_matches(str(target), ROAD_USERS, 1, 0.6)
            hint = f"; did you mean {near[0]}?" if near else ""
            mistake(f"expected {_TARGETS_TEXT}, got {shown(target)}{hint}")
    if not targets:
        mistake(f"expected {_TARGETS_TEXT}, got none; a rig has to be made for somebody")
    return tuple(each for each in ROAD_USERS if each in targets)


def _read_path(value: object) -> object:
    if isinstance(value, str):
        if not value.strip():
            mistake(f"expected a path, got {value!r}")
        return Path(value).expanduser()
    return value


def _read_device(value: object) -> object:
    if not isinstance(value, str) or not re.fullmatch(r"cpu|cuda:[0-9]{1,2}", value):
        hint = "; write cuda:0 for the first GPU" if value in ("cuda", "gpu", "cuda0") else ""
        mistake(f"expected cpu or a GPU such as cuda:0, got {shown(value)}{hint}")
    return value


_START_TEXT = "random, highest, a preset, a run folder or the path of a rig YAML"


def _read_start(value: object) -> object:
    if isinstance(value, str) and value not in NAMED_STARTS:
        names = preset_names()
        if value not in names and not (Path(value).expanduser() / "config.yaml").is_file():
            _existing_file(value, _START_TEXT, [value], [*NAMED_STARTS, *names])
    return value


_NAMES_TEXT = "a list of names of cameras of rig.start, such as [front, rear]"


def _read_names(value: object) -> tuple[Any, ...]:
    names = tuple(value) if isinstance(value, (list, tuple)) else (value,)
    for name in names:
        if not isinstance(name, str) or not name:
            mistake(f"expected {_NAMES_TEXT}, got {shown(value)}")
        if names.count(name) > 1:
            mistake(f"expected every name once, got {name!r} {names.count(name)} times")
    return names


def _read_model(value: object) -> object:
    if isinstance(value, str) and value != "builtin":
        _existing_file(value, "builtin or the path of an ONNX file", [value], ["builtin"])
    return value


def _read_mesh_file(value: object) -> object:
    if isinstance(value, str):
        _existing_file(value, "the path of a mesh file, or null", [value], [])
    return _read_path(value)


def _existing_file(value: str, expected: str, candidates: Sequence[str], words: Sequence[str]) -> None:
    if any(Path(candidate).expanduser().is_file() for candidate in candidates):
        return
    near = difflib.get_close_matches(value, words, 1, 0.6)
    hint = f"did you mean {near[0]}?" if near else "no such file"
    mistake(f"expected {expected}, got {value!r}; {hint}")


class RunConfig(Section):
    """The run as a whole."""

    seed: int = Field(default=0, ge=0, le=MAX_SEED, description="seed of every random choice of the run")
    out: Annotated[Path, BeforeValidator(_read_path), PlainSerializer(str), Expectation("a folder")] | None = Field(
        default=None, description="run folder; null takes runs/<config name> and numbers it when that exists"
    )
    iterations: int = Field(default=100, ge=1, le=1_000_000, description="optimiser steps")
    batch_size: int = Field(default=4, ge=1, description="scenes per step")


class SceneConfig(Section):
    """Which traffic scenes are trained and tested on."""

    source: Literal["town", "captured", "folder"] = Field(
        default="town",
        description="town builds the embedded street scenes; captured takes images of them and makes meshes of these; "
        "folder reads scene_<seed>.glb files",
    )
    train_seeds: Seeds = Field(default=tuple(range(30)), description="scenes that the optimiser sees")
    validation_seeds: Seeds | None = Field(
        default=None, description="scenes on which rigs of a run are compared; null: the training scenes"
    )
    test_seeds: Seeds = Field(default=tuple(range(1000, 1010)), description="scenes that only the evaluation sees")
    folder: Annotated[Path, BeforeValidator(_read_path), PlainSerializer(str), Expectation("a folder")] | None = Field(
        default=None,
        description="where source: folder finds its scene_<seed>.glb files, and where source: captured keeps what it "
        "makes; null keeps that in the user's cache",
    )
    ego: (
        Annotated[
            Path,
            BeforeValidator(_read_mesh_file),
            PlainSerializer(str),
            Expectation("the path of a mesh file"),
        ]
        | None
    ) = Field(
        default=None,
        description="mesh of your own vehicle, which takes the place of every scene's own; warpav vehicle check "
        "examines and mends it; null: the scene's own",
    )
    mirror: bool = Field(
        default=False,
        description="train on every scene's mirror image as well, against traffic that keeps to one side",
    )
    targets: Annotated[
        tuple[str, ...],
        BeforeValidator(_read_targets),
        PlainSerializer(list),
        Expectation(_TARGETS_TEXT),
        WithJsonSchema({"type": "array", "items": {"enum": list(ROAD_USERS)}, "minItems": 1}),
    ] = Field(
        default=("vehicle",),
        description="the road users that rigs are optimised and judged for; all others only stand in the way",
    )

    @model_validator(mode="after")
    def _check(self) -> SceneConfig:
        for name in ("train_seeds", "validation_seeds"):
            both = sorted(set(getattr(self, name) or ()) & set(self.test_seeds))
            if both:
                mistake(
                    f"expected test scenes that are not trained on, got {len(both)} seed(s) in both, such as {both[0]}",
                    "test_seeds",
                    name,
                )
        if self.source == "folder":
            if self.folder is None:
                mistake("expected a folder of scenes because scenes.source is folder, got none", "folder", "source")
            if not self.folder.is_dir():
                mistake(
                    f"expected an existing folder, got {str(self.folder)!r}; warpav scenes make --out writes one",
                    "folder",
                )
        return self


class CaptureConfig(Section):
    """The images that source: captured and warpav scenes capture take of a situation."""

    width_px: int = Field(default=640, ge=32, le=4096, description="image width")
    height_px: int = Field(default=480, ge=32, le=4096, description="image height")
    vehicles: int = Field(default=12, ge=1, le=200, description="vehicles besides the ego vehicle, at most")
    radius_m: Metres = Field(
        default=30.0, gt=0.0, le=500.0, description="vehicles stand no farther from the ego vehicle"
    )
    rotations: int = Field(default=4, ge=1, le=64, description="images from the ego vehicle all around")
    ego_sides: int = Field(default=4, ge=0, le=64, description="images of the ego vehicle from beside it")
    scene_heights_m: Annotated[
        tuple[float, ...],
        BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value),
        PlainSerializer(list),
        Expectation("a list of heights in metres, such as [14, 28, 45]"),
    ] = Field(default=(14.0, 28.0, 45.0), description="heights of the images of the whole place from above")


class ReconstructionConfig(Section):
    """How source: captured and warpav scenes reconstruct make meshes from images."""

    method: Literal["poisson", "signed_distance", "nksr"] = Field(
        default="poisson", description="surface method; nksr needs the package of that name"
    )
    radius_m: Metres = Field(
        default=40.0, gt=1.0, le=1000.0, description="the environment beyond is drawn on a sphere of this radius"
    )
    max_height_m: Metres = Field(default=10.0, gt=0.0, le=1000.0, description="what is higher is left out")
    far_depth_m: Metres = Field(default=900.0, gt=1.0, description="depths from here on are sky")
    vehicle_points: int = Field(default=200_000, ge=200, description="points that are kept of each vehicle")
    vehicle_triangles: int = Field(default=4500, ge=50, description="triangles of each vehicle")
    vehicle_cell_m: Metres = Field(default=0.03, ge=0.005, le=1.0, description="cells in which a vehicle is found")
    environment_points: int = Field(default=150_000, ge=200, description="points that are kept of the environment")
    environment_triangles: int = Field(default=36_000, ge=50, description="triangles of the environment")
    environment_cell_m: Metres = Field(
        default=0.25, ge=0.02, le=5.0, description="cells in which the environment is found"
    )


_PITCHES_TEXT = "two angles from -60 deg to 60 deg, the lower one first, such as [-20, 20]"
_HEIGHTS_TEXT = "two heights from 0 m to 2 m, the lower one first, such as [0.05, 0.4]"
_FOVS_TEXT = "two angles from 10 deg to 170 deg, the lower one first, such as [60, 110]"
_RANGE_AS_LIST = PlainSerializer(lambda value: None if value is None else list(value))
_RANGE_SCHEMA = WithJsonSchema(
    {"anyOf": [{"type": "array", "items": NUMBER_OR_TEXT, "minItems": 2, "maxItems": 2}, {"type": "null"}]}
)

Range = tuple[float, float] | None
PitchRange = Annotated[
    Range,
    range_reader(DEGREES_PER_UNIT, _PITCHES_TEXT, low=-60.0, high=60.0),
    _RANGE_AS_LIST,
    Expectation(_PITCHES_TEXT),
    _RANGE_SCHEMA,
]
HeightRange = Annotated[
    Range,
    range_reader(METRES_PER_UNIT, _HEIGHTS_TEXT, low=0.0, high=2.0),
    _RANGE_AS_LIST,
    Expectation(_HEIGHTS_TEXT),
    _RANGE_SCHEMA,
]
FovRange = Annotated[
    Range,
    range_reader(DEGREES_PER_UNIT, _FOVS_TEXT, low=10.0, high=170.0),
    _RANGE_AS_LIST,
    Expectation(_FOVS_TEXT),
    _RANGE_SCHEMA,
]


class FreeConfig(Section):
    """What the optimiser moves besides x, y and yaw, each within two bounds; null leaves it as configured."""

    pitch_deg: PitchRange = Field(default=None, description="bounds of each camera's pitch, nose-down positive")
    height_m: HeightRange = Field(
        default=None, description="bounds of each camera's height above the mount surface, around rig.height_offset_m"
    )
    fov_deg: FovRange = Field(
        default=None, description="bounds of each camera's horizontal field of view, around camera.fov_deg"
    )


class RigConfig(Section):
    """How many cameras there are, where they start, how close they may come, and what else of them is free."""

    cameras: int = Field(default=4, ge=2, le=16, description="cameras on the vehicle")
    start: Annotated[str, BeforeValidator(_read_start), Expectation(_START_TEXT)] = Field(
        default="random", description=f"rig that the optimiser starts from: {_START_TEXT}"
    )
    freeze: Annotated[
        tuple[str, ...],
        BeforeValidator(_read_names),
        PlainSerializer(list),
        Expectation(_NAMES_TEXT),
        WithJsonSchema({"anyOf": [{"type": "array", "items": {"type": "string"}}, {"type": "string"}]}),
    ] = Field(
        default=(),
        description="cameras of rig.start that stay as they are, by name: their places, directions and lenses; the "
        "others are optimised around them",
    )
    height_offset_m: Metres = Field(
        default=0.25, ge=0.0, le=2.0, description="height of the cameras above the mount surface"
    )
    min_spacing_m: Metres = Field(default=0.2, gt=0.0, le=5.0, description="least distance between two cameras")
    free: FreeConfig = Field(default=FreeConfig(), description="what is optimised besides x, y and yaw")


class CameraConfig(Section):
    """The camera model that all cameras share."""

    fov_deg: Degrees = Field(
        default=90.0, ge=10.0, le=360.0, description="horizontal field of view; beyond 170 a fisheye's or a panorama's"
    )
    width_px: int = Field(default=256, ge=16, le=4096, description="image width")
    height_px: int = Field(default=256, ge=16, le=4096, description="image height")
    near_m: Metres = Field(default=0.1, gt=0.0, le=10.0, description="what is nearer than this is cut away")
    supersampling: Literal[1, 2, 4, 8] = Field(default=1, description="samples per pixel edge of the renderer")
    lens: Literal["pinhole", "brown_conrady", "fisheye", "panorama"] = Field(
        default="pinhole", description="how directions become places in the image"
    )
    distortion: Annotated[
        tuple[float, ...],
        BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value),
        PlainSerializer(list),
        Expectation("a list of numbers, such as [-0.31, 0.11, 0.0, 0.0]"),
    ] = Field(default=(), description="OpenCV's: k1 k2 p1 p2 [k3 [k4 k5 k6]] of brown_conrady, k1 k2 k3 k4 of fisheye")

    @model_validator(mode="after")
    def _check(self) -> CameraConfig:
        lens = Lens(self.lens)
        try:
            shape = LensShape(lens, checked_distortion(lens, self.distortion))
        except ValueError as error:
            mistake(f"expected as many numbers as the lens has, got: {error}", "distortion", "lens")
        widest_deg = 170.0
        if shape.has_unit_rays:
            widest_deg = 360.0 if lens is Lens.PANORAMA else 350.0
        if shape.is_radial:
            # rounded down, so that the angle in the message is one that is taken
            widest_deg = min(widest_deg, math.floor(200.0 * math.degrees(shape.limit_rad)) / 100.0)
        if self.fov_deg > widest_deg:
            text = f"expected an angle in degrees from 10 deg to {widest_deg:g} deg, the widest for this {lens} lens"
            mistake(f"{text}, got {self.fov_deg:g}", "fov_deg", "lens", "distortion")
        return self


class MountConfig(Section):
    """The height map on which cameras may sit."""

    cell_m: Metres = Field(default=0.02, ge=0.002, le=0.5, description="cell size of the height map")
    min_upward_normal: float = Field(
        default=0.8,
        gt=0.0,
        le=1.0,
        description="least vertical part of the unit normal of what the height map is made of",
    )
    min_zone_normal: float = Field(
        default=0.9,
        gt=0.0,
        le=1.0,
        description="the same of what can carry a camera; a windscreen cannot (method: default)",
    )
    margin_m: Metres = Field(
        default=0.02,
        ge=0.0,
        le=1.0,
        description="least distance of a camera's centre to the border of the mountable zone (method: default)",
    )
    smoothing_tolerance_m: Metres = Field(
        default=1e-4, gt=0.0, le=0.1, description="filled cells are smoothed until no cell changes by more than this"
    )


_LABELS_TEXT = "a list of labels, such as [car, bus], or the path of a file with one a line"
_CLASSES_TEXT = "a list of labels of the detector, such as [car, bus]"


def _read_labels(value: object) -> object:
    if isinstance(value, str):
        _existing_file(value, _LABELS_TEXT, [value], [])
        return value
    return tuple(value) if isinstance(value, list) else value


Labels = Annotated[
    tuple[str, ...],
    BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value),
    PlainSerializer(list),
    Expectation(_CLASSES_TEXT),
]


class ClassesConfig(Section):
    """Which labels of the detector count as which kind of road user; null takes the usual names."""

    vehicle: Labels | None = Field(default=None, description="labels of motor vehicles, such as [car, bus]")
    pedestrian: Labels | None = Field(default=None, description="labels of people on foot, such as [person]")
    cyclist: Labels | None = Field(
        default=None, description="labels of people on bicycles; a bicycle alone is none unless it is named here"
    )


class DetectorConfig(Section):
    """The object detector, and when its boxes count."""

    model: Annotated[str, BeforeValidator(_read_model), Expectation("builtin or the path of an ONNX file")] = Field(
        default="builtin", description="builtin or the path of an ONNX file"
    )
    confidence_min: float = Field(default=0.1, ge=0.0, lt=1.0, description="least confidence of a detection")
    iou_min: float = Field(
        default=0.5, gt=0.0, lt=1.0, description="least overlap with the true box for a true positive"
    )
    nms_iou_max: float = Field(default=0.65, gt=0.0, le=1.0, description="boxes that overlap more are merged")
    format: Literal[
        "auto",
        "ultralytics",
        "ultralytics-end2end",
        "ultralytics-rtdetr",
        "yolox",
        "yolox-decoded",
        "torchvision",
        "rtdetr",
        "rtdetr-single",
    ] = Field(default="auto", description="layout of the file's inputs and outputs; auto finds it out")
    labels: Annotated[
        tuple[str, ...] | str | None,
        BeforeValidator(_read_labels),
        PlainSerializer(lambda value: list(value) if isinstance(value, tuple) else value),
        Expectation(_LABELS_TEXT),
    ] = Field(
        default=None,
        description="labels in the order of the network's classes; null takes those in the file, or else COCO's",
    )
    classes: ClassesConfig = Field(default=ClassesConfig(), description="which labels count as which road user")
    input_px: int | None = Field(default=None, ge=32, le=4096, description="input size; null takes the model's own")
    provider: Literal["cpu", "cuda", "tensorrt"] = Field(default="cpu", description="what the network runs on")


class BaselineConfig(Section):
    """The rigs that the result is compared with."""

    random_samples: int = Field(default=100, ge=1, le=1_000_000, description="random rigs of which the best is taken")
    random_scenes: int = Field(default=4, ge=1, description="training scenes on which the random rigs are ranked")


class ExecutorConfig(Section):
    """Where the tasks of an experiment run."""

    name: Literal["serial", "process", "ray", "slurm"] = Field(
        default="serial",
        description="serial: one after the other; process: in processes of this machine; ray and slurm: on a cluster",
    )
    workers: int | None = Field(default=None, ge=1, description="tasks at a time; null takes as many as fit")
    address: str | None = Field(
        default=None, description="of a Ray cluster; null takes RAY_ADDRESS, else a Ray of this machine"
    )
    options: Annotated[dict[str, Any], Expectation("options such as {num_gpus: 1}")] = Field(
        default={}, description="what a task needs: options of ray.remote, or parameters of submitit for Slurm"
    )


class Config(Section):
    """Everything that a run of warpav can be told."""

    run: RunConfig = Field(default=RunConfig(), description="the run as a whole")
    device: Annotated[str, BeforeValidator(_read_device), Expectation("cpu or a GPU such as cuda:0")] = Field(
        default="cpu", description="what renders, and what gradients are computed on"
    )
    method: Literal["thesis", "default"] = Field(
        default="default",
        description="thesis: the losses and constraints as printed; default: the share of road users that the rig is "
        "expected to miss, cameras on roof and bonnet alone",
    )
    scenes: SceneConfig = Field(default=SceneConfig(), description="traffic scenes")
    capture: CaptureConfig = Field(default=CaptureConfig(), description="images of scenes")
    reconstruction: ReconstructionConfig = Field(default=ReconstructionConfig(), description="scenes from images")
    rig: RigConfig = Field(default=RigConfig(), description="the cameras together")
    camera: CameraConfig = Field(default=CameraConfig(), description="each camera")
    mount: MountConfig = Field(default=MountConfig(), description="where cameras may sit")
    detector: DetectorConfig = Field(default=DetectorConfig(), description="the object detector")
    segregation: SegregationSettings = Field(
        default=SegregationSettings(), description="which camera answers for which vehicle"
    )
    losses: LossSettings = Field(
        default=LossSettings(**METHOD_LOSSES["default"]), description="the objectives; each method has its own"
    )
    visibility: VisibilitySettings = Field(default=VisibilitySettings(), description="what hides a vehicle")
    optimiser: OptimiserSettings = Field(default=OptimiserSettings(), description="steps and multipliers")
    baselines: BaselineConfig = Field(default=BaselineConfig(), description="rigs to compare with")
    executor: ExecutorConfig = Field(default=ExecutorConfig(), description="where the tasks of an experiment run")

    @classmethod
    def load(cls, path: str | Path | None = None, *overrides: str) -> Config:
        """The configuration of a YAML file or a shipped name, such as ``quick``, with ``key=value`` overrides.

        Args:
            path: The file or the name; None: the defaults, which are those of ``quick``.
            overrides: Such as ``"rig.cameras=6"``; the value is read as YAML.

        Raises:
            InputError: Anything is wrong; one line a mistake.
        """
        return load_config(path, overrides, origin="override")

    def placement(self) -> Placement:
        """The placement that it describes; scenes and detector are loaded when they are first needed.

        Raises:
            InputError: The rig of ``rig.start`` cannot be used.
        """
        from warpav.runs.build import build

        return build(self)

    @model_validator(mode="before")
    @classmethod
    def _add_losses_of_method(cls, data: object) -> object:
        if not isinstance(data, dict):
            return data
        method = data.get("method", cls.model_fields["method"].default)
        losses = data.get("losses", {})
        if not isinstance(method, str) or method not in METHOD_LOSSES or not isinstance(losses, dict):
            return data  # refused in a moment, with its place
        return {**data, "losses": {**METHOD_LOSSES[method], **losses}}

    @model_validator(mode="after")
    def _check(self) -> Config:
        scene_count = len(self.scenes.train_seeds)
        if self.run.batch_size > scene_count:
            mistake(
                f"expected at most the {scene_count} training scene(s), got {self.run.batch_size}; "
                f"set run.batch_size={scene_count} or lower",
                "run.batch_size",
                "scenes.train_seeds",
            )
        self._check_free()
        self._check_freeze()
        if self.segregation.rotations < self.rig.cameras:
            mistake(
                f"expected at least one direction per camera ({self.rig.cameras}), got {self.segregation.rotations}",
                "segregation.rotations",
                "rig.cameras",
            )
        return self

    def _check_freeze(self) -> None:
        frozen = self.rig.freeze
        if not frozen:
            return
        if self.rig.start in NAMED_STARTS:
            text = f"expected none, for rig.start={self.rig.start} has no cameras of these names, got {shown(frozen)}"
            mistake(f"{text}; set rig.start to the rig that has them", "rig.freeze", "rig.start")
        if len(frozen) >= self.rig.cameras:
            text = f"expected fewer than the {self.rig.cameras} of rig.cameras, so that one can move"
            mistake(f"{text}, got {len(frozen)}", "rig.freeze", "rig.cameras")
        if self.method == "thesis":
            text = f"expected none, as the thesis moves all cameras, got {shown(frozen)}; take method: default"
            mistake(text, "rig.freeze", "method")

    def _check_free(self) -> None:
        free = self.rig.free
        configured = {
            "pitch_deg": (0.0, "level cameras", "rig.free.pitch_deg"),
            "height_m": (self.rig.height_offset_m, "rig.height_offset_m", "rig.height_offset_m"),
            "fov_deg": (self.camera.fov_deg, "camera.fov_deg", "camera.fov_deg"),
        }
        for name, (value, what, option) in configured.items():
            pair = getattr(free, name)
            if pair is None:
                continue
            fields = dict.fromkeys((f"rig.free.{name}", option))
            if not pair[0] <= value <= pair[1]:
                text = f"expected bounds that hold the {value:g} of {what}, got {shown(pair)}"
                mistake(text, *fields)
            if self.method == "thesis":
                mistake(
                    f"expected null, as the thesis moves x, y and yaw alone, got {shown(pair)}; take method: default",
                    f"rig.free.{name}",
                    "method",
                )
        if free.fov_deg is None:
            return
        if self.camera.lens != "pinhole":
            text = f"expected null or a pinhole, got {shown(free.fov_deg)} for a {self.camera.lens} lens"
            mistake(text, "rig.free.fov_deg", "camera.lens")
        alike = [name for name in ONE_FIELD_LOSSES if getattr(self.losses, name)]
        if alike:
            mistake(
                f"expected null, as losses.{alike[0]} takes one field of view for all cameras, got "
                f"{shown(free.fov_deg)}",
                "rig.free.fov_deg",
                f"losses.{alike[0]}",
            )


def load_config(path: str | Path | None = None, overrides: Sequence[str] = (), *, origin: str = COMMAND_LINE) -> Config:
    """The configuration of a YAML file and ``key=value`` overrides.

    Args:
        path: A YAML file, the name of a shipped configuration (``quick``, ``thesis``), or None for the defaults.
        overrides: Texts such as ``rig.cameras=6`` or ``scenes.test_seeds=[1, 2]``; the value is read as YAML.
        origin: What messages call the source of the overrides.

    Returns:
        The validated, immutable tree.

    Raises:
        InputError: Anything is wrong; one line per mistake, each with its place, its field, what was expected and
            what came.
    """
    file = find_config(path) if path is not None else None
    data, line_of = _read_file(file) if file else ({}, {})
    rig = data.get("rig")
    if file and isinstance(rig, dict) and rig.get("start") == START_FILE and (file.parent / START_FILE).is_file():
        rig["start"] = str((file.parent / START_FILE).absolute())
    return _validated(data, overrides, file, line_of, origin)


def changed_config(config: Config, overrides: Sequence[str], *, origin: str | None = COMMAND_LINE) -> Config:
    """The configuration with other values for some options.

    Args:
        config: The configuration.
        overrides: As of :func:`load_config`.
        origin: What messages call the source of the overrides; None: they do not name it.

    Raises:
        InputError: An override is wrong, or does not fit the rest.
    """
    return _validated(config.model_dump(mode="json"), overrides, None, {}, origin)


def with_absolute_paths(config: Config) -> Config:
    """The same configuration, whose files are found from every working directory; ``run.out`` stays as it is."""
    overrides = []
    for option, value in (
        ("scenes.folder", config.scenes.folder),
        ("scenes.ego", config.scenes.ego),
        ("detector.model", None if config.detector.model == "builtin" else config.detector.model),
        ("detector.labels", config.detector.labels if isinstance(config.detector.labels, str) else None),
        ("rig.start", config.rig.start if _is_path(config.rig.start) else None),
    ):
        if value is not None:
            overrides.append(f"{option}={flow_text(str(Path(value).expanduser().absolute()))}")
    return changed_config(config, overrides) if overrides else config


def _is_path(start: str) -> bool:
    path = Path(start).expanduser()
    return start not in NAMED_STARTS and (path.is_file() or (path / "config.yaml").is_file())


def overridden_option(override: str) -> str:
    """The option's name in an override such as ``rig.cameras=6``.

    Raises:
        InputError: It is none.
    """
    return ".".join(_read_override(override, _override_place(override, COMMAND_LINE))[0])


def _validated(
    data: dict[str, Any],
    overrides: Sequence[str],
    file: Path | None,
    line_of: Mapping[Location, int],
    origin: str | None = COMMAND_LINE,
) -> Config:
    override_of: dict[Location, str] = {}
    for override in overrides:
        place = _override_place(override, origin)
        location, value = _read_override(override, place)
        override_of[location] = place
        _put(data, location, value, place)
    try:
        return Config.model_validate(data)
    except ValidationError as error:
        lines = [_explain(found, file, line_of, override_of) for found in error.errors(include_url=False)]
        raise InputError("\n".join(dict.fromkeys(lines))) from None


@contextlib.contextmanager
def placed_config(path: str | Path, overrides: Sequence[str] = ()) -> Iterator[Config]:
    """The configuration as of :func:`load_config`, to be used inside a ``with`` block.

    What turns out wrong with an option only when it is used is told as what is wrong with it at once: with the file
    and the line, or the override, where it stands.

    Raises:
        InputError: As :func:`load_config`; and for every :class:`OptionError` of the block.
    """
    config = load_config(path, overrides)
    try:
        yield config
    except OptionError as error:
        file = find_config(path)
        override_of = {_read_override(each)[0]: _override_place(each, COMMAND_LINE) for each in overrides}
        place = _place(tuple(error.option.split(".")), file, _read_file(file)[1], override_of)
        raise InputError(f"{place}: {error}") from None


def dump_config(config: Config) -> str:
    """The whole tree as YAML that :func:`load_config` reads back to an equal tree."""
    return yaml.dump(config.model_dump(mode="json"), Dumper=_FlowListDumper, sort_keys=False, allow_unicode=True)


def option_values(config: Config) -> dict[str, object]:
    """Every option by its dotted name, such as ``rig.cameras``, in the order of the tree, as written in files."""
    tree = config.model_dump(mode="json")
    return {
        ".".join(location): functools.reduce(operator.getitem, location, tree) for location in _option_locations(Config)
    }


@dataclass(frozen=True)
class DescribedOption:
    """One option of the configuration, for documentation.

    Attributes:
        name: Dotted, such as ``rig.cameras``.
        section: Dotted name of its section; empty for what stands at the top.
        section_description: What the section is about.
        expected: What the option takes, in words: type, unit, range.
        default: As written in files.
        description: What it does.
    """

    name: str
    section: str
    section_description: str
    expected: str
    default: object
    description: str


def described_options() -> Iterator[DescribedOption]:
    """Every option with what is known of it, in the order of the tree, what stands at the top first."""
    default_of = option_values(Config())

    def walk(section: type[Section], prefix: str) -> Iterator[DescribedOption]:
        inner = {name: _section_of(field.annotation) for name, field in section.model_fields.items()}
        for name, field in section.model_fields.items():
            if inner[name] is None:
                yield DescribedOption(
                    name=prefix + name,
                    section=prefix.rstrip("."),
                    section_description=inspect.getdoc(section) or "",
                    expected=_expected(field),
                    default=default_of[prefix + name],
                    description=field.description or "",
                )
        for name, below in inner.items():
            if below is not None:
                yield from walk(below, f"{prefix}{name}.")

    return walk(Config, "")


def overrides_from(base: Config, config: Config) -> list[str]:
    """The overrides that make one configuration of another, as :func:`load_config` takes them.

    Args:
        base: The configuration that is overridden.
        config: What it becomes.
    """
    before = option_values(base)
    changed = {name: value for name, value in option_values(config).items() if value != before[name]}
    return [f"{name}={flow_text(value)}" for name, value in changed.items()]


def flow_text(value: object) -> str:
    """A value as YAML on one line."""
    return yaml.safe_dump(value, default_flow_style=True, width=math.inf, allow_unicode=True).partition("\n")[0]


def read_seeds(text: str, place: str) -> tuple[int, ...]:
    """Seeds from a range such as ``1000..1009`` or a list such as ``[1, 2, 3]``.

    Args:
        text: What the user wrote.
        place: Where it stands, for messages.

    Raises:
        InputError: It is neither, or a seed is out of range or there twice.
    """
    try:
        return _read_seeds(parse_yaml(text, place, has_lines=False)[0])
    except PydanticCustomError as error:
        raise InputError(f"{place}: {error.message()}") from None


def config_dir() -> Path:
    """The folder of the shipped configurations: the installed package's own, else the checkout's."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "configs", package.parent / "configs"):
        if (folder / "quick.yaml").is_file():
            return folder
    raise InputError(f"shipped configurations: expected a folder configs in {package}, got none; reinstall warpav")


def config_names() -> list[str]:
    """Names of the shipped configurations, such as ``quick``."""
    return sorted(file.stem for file in config_dir().glob("*.yaml"))


def find_config(path: str | Path) -> Path:
    """The file that ``path`` means: an existing file, or a shipped configuration by its name.

    Raises:
        InputError: Neither exists.
    """
    file = Path(path).expanduser()
    if file.is_file():
        return file
    shipped = config_dir() / f"{file.stem}.yaml"
    named = str(path) in (file.stem, shipped.name, f"configs/{shipped.name}")
    if named and shipped.is_file():
        return shipped
    if (file / "config.yaml").is_file():
        raise InputError(
            f"{path}: config: expected a YAML file or a shipped name, got a run folder; {file / 'config.yaml'} repeats "
            f"it, rig.start={file} begins with its rig"
        )
    near = difflib.get_close_matches(file.stem, config_names(), 1, 0.6)
    hint = f"did you mean {near[0]}?" if near else f"shipped ones are {', '.join(config_names())}"
    raise InputError(f"{path}: config: expected a YAML file or a shipped name, got {str(path)!r}; {hint}")


def _read_file(file: Path) -> tuple[dict[str, Any], dict[Location, int]]:
    data, line_of = read_yaml(file)
    if data is not None and not isinstance(data, dict):
        raise InputError(f"{file}:1: expected sections such as 'rig: {{cameras: 4}}', got {shown(data)}")
    if data is not None and {"frame", "cameras"} <= data.keys():
        raise InputError(f"{file}: expected a configuration, got a rig file; rig.start={file} begins with it")
    return data or {}, line_of


class _FlowListDumper(yaml.SafeDumper):
    """Dumper that writes lists on one line."""


_FlowListDumper.add_representer(
    list, lambda dumper, value: dumper.represent_sequence("tag:yaml.org,2002:seq", value, flow_style=True)
)


def _override_place(override: str, origin: str | None) -> str:
    """Where an override stands, for messages; empty where that needs no saying."""
    return "" if origin is None else f"{origin} ({override})"


def _read_override(override: str, place: str = COMMAND_LINE) -> tuple[Location, object]:
    key, equals, text = override.partition("=")
    location = tuple(part.strip() for part in key.split("."))
    if not equals or not all(location):
        near = difflib.get_close_matches(key, [".".join(name) for name in _option_locations(Config)], 1, 0.6)
        hint = f"did you mean {near[0]}=...?" if near else "for example rig.cameras=6"
        raise InputError(_placed(place, f"expected key=value, got {override!r}; {hint}"))
    return location, parse_yaml(text, place or key, has_lines=False)[0]


def _placed(place: str, text: str) -> str:
    return f"{place}: {text}" if place else text


def _put(data: dict[str, Any], location: Location, value: object, place: str) -> None:
    for depth, part in enumerate(location[:-1], start=1):
        if data.get(part) is None:
            data[part] = {}
        data = data[part]
        if not isinstance(data, dict):
            outer = ".".join(location[:depth])
            raise InputError(_placed(place, f"{outer}: expected a section, got {shown(data)} in the file"))
    data[location[-1]] = value


def _section_of(annotation: object) -> type[Section] | None:
    return annotation if isinstance(annotation, type) and issubclass(annotation, Section) else None


def _option_locations(section: type[Section], prefix: Location = ()) -> Iterator[Location]:
    for name, field in section.model_fields.items():
        inner = _section_of(field.annotation)
        if inner:
            yield from _option_locations(inner, (*prefix, name))
        else:
            yield (*prefix, name)


def _explain(
    found: Mapping[str, Any],
    file: Path | None,
    line_of: Mapping[Location, int],
    override_of: Mapping[Location, str],
) -> str:
    """One line about one mistake that the validation found."""
    section: type[Section] = Config
    field: FieldInfo | None = None
    location: Location = ()
    for part in found["loc"]:  # the tail of a location can be an index, or a name that pydantic gave a validator
        known = section.model_fields.get(str(part)) if field is None else None
        if field is not None:
            break
        location = (*location, str(part))
        inner = _section_of(known.annotation) if known else None
        if inner:
            section = inner
        else:
            field = known
            if known is None:
                break
    fields = found.get("ctx", {}).get("fields", ()) if found["type"] == "mistake" else ()
    locations = [(*location, *name.split(".")) for name in fields] or [location]
    overridden = [name for name in locations if _override_at(name, override_of) is not None]
    written = [name for name in locations if name in line_of]
    place = _place((overridden or written or locations)[0], file, line_of, override_of)
    location = locations[0]

    if found["type"] == "extra_forbidden":
        text = _unknown_option(section, location)
    elif found["type"] == "mistake":
        text = found["ctx"]["text"]
    elif field is None:
        text = f"expected a section with {', '.join(section.model_fields)}, got {shown(found['input'])}"
    else:
        default = "null" if field.get_default() is None else shown(field.get_default())
        text = f"expected {_expected(field)}, got {shown(found['input'])}"
        choices = [str(choice) for choice in _choices(field)]
        near = difflib.get_close_matches(str(found["input"]), choices, 1, 0.6)
        text += f"; did you mean {near[0]}?" if near else f"; {field.description} (default {default})"
    return _placed(place, f"{'.'.join(location)}: {text}")


def _override_at(location: Location, override_of: Mapping[Location, str]) -> str | None:
    for key, override in reversed(list(override_of.items())):
        if key[: len(location)] == location or location[: len(key)] == key:
            return override
    return None


def _place(
    location: Location,
    file: Path | None,
    line_of: Mapping[Location, int],
    override_of: Mapping[Location, str],
) -> str:
    override = _override_at(location, override_of)
    if override is not None:
        return override
    if file is None:
        return "defaults"
    for length in range(len(location), 0, -1):
        if location[:length] in line_of:
            return f"{file}:{line_of[location[:length]]}"
    return str(file)


def _unknown_option(section: type[Section], location: Location) -> str:
    names = list(section.model_fields)
    unknown = location[-1]
    elsewhere = [".".join(name) for name in _option_locations(Config) if name[-1] == unknown]
    near = difflib.get_close_matches(unknown, names, 1, 0.5)
    hint = elsewhere[0] if elsewhere else ".".join((*location[:-1], near[0])) if near else ""
    return f"expected one of {', '.join(names)}, got {unknown!r}" + (f"; did you mean {hint}?" if hint else "")


def _choices(field: FieldInfo) -> tuple[object, ...]:
    return typing.get_args(field.annotation) if typing.get_origin(field.annotation) is Literal else ()


def _expected(field: FieldInfo) -> str:
    """What a field expects, in words, from its type and its limits."""
    annotation, metadata, optional = field.annotation, list(field.metadata), ""
    if typing.get_origin(annotation) in (types.UnionType, typing.Union):
        inner = next(member for member in typing.get_args(annotation) if member is not type(None))
        annotation, optional = inner, ", or null"
        if typing.get_origin(inner) is Annotated:
            annotation = typing.get_args(inner)[0]
            metadata += typing.get_args(inner)[1:]
    words = next((item for item in metadata if isinstance(item, Expectation)), None)
    if _choices(field):
        return " or ".join([", ".join(map(str, _choices(field)[:-1])), str(_choices(field)[-1])]).removeprefix(" or ")
    limits = _limits(metadata, words.unit if words else "")
    if words:
        return words.text.replace("{range}", limits) + optional
    noun = {bool: "true or false", int: "a whole number", float: "a number"}.get(typing.cast(type, annotation), "text")
    return noun + limits + optional


def _limits(metadata: Sequence[object], unit: str) -> str:
    low = high = ""
    for item in metadata:
        if isinstance(item, annotated_types.Ge):
            low = f" from {_number(item.ge)}{unit}"
        elif isinstance(item, annotated_types.Gt):
            low = f" above {_number(item.gt)}{unit}"
        elif isinstance(item, annotated_types.Le):
            high = f" to {_number(item.le)}{unit}"
        elif isinstance(item, annotated_types.Lt):
            high = f" below {_number(item.lt)}{unit}"
    return low + (f" and{high}" if low and high.startswith(" below") else high)


def _number(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
