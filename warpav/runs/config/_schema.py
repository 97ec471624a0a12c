"""Sections of the configuration: every option, what it takes, and what it is by default."""

from __future__ import annotations

import difflib
import math
import operator
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import ConfigDict, Field, PrivateAttr, model_validator

from warpav.core.errors import InputError
from warpav.core.section import Degrees, Expectation, Metres, Section, mistake, shown
from warpav.core.yaml_file import read_yaml
from warpav.optimisation import (
    METHOD_LOSSES,
    ImportanceSettings,
    LidarSettings,
    LossSettings,
    OptimiserSettings,
    RobustSettings,
    RuleSettings,
    ThesisSettings,
    VisibilitySettings,
)
from warpav.raster.lens import Lens, LensShape, checked_distortion
from warpav.rig import PLAIN
from warpav.runs.config._fields import (
    AUTO,
    BY_HAND,
    COUNTS_TEXT,
    MAX_SEED,
    MOST_CAMERAS,
    NAMED_STARTS,
    START_TEXT,
    CameraNames,
    CatalogueFile,
    DetectorModel,
    Device,
    Distortion,
    Folder,
    FovRange,
    HeightRange,
    Heights,
    Labels,
    LabelsOrFile,
    Levels,
    MeshFile,
    ModuleCounts,
    PitchRange,
    Places,
    PresetNames,
    Recordings,
    Requirements,
    RigFiles,
    Seeds,
    Targets,
    Vehicles,
    ZonesFile,
    read_count,
)
from warpav.scene import ROAD_USERS, road_user_of
from warpav.sight import template_names

EXTENDS = "extends"
"""Key of a file that names another file, on top of which it stands."""

USUAL_OPTIONS = (
    *("run.seed", "run.out", "run.iterations", "run.pictures", "device", "method"),
    *("scenes.source", "scenes.level", "scenes.train_seeds", "scenes.test_seeds", "scenes.folder", "scenes.ego"),
    *("scenes.targets", "scenes.recordings", "rig.cameras", "rig.start", "rig.freeze", "rig.min_spacing_m"),
    *("rig.free.pitch_deg", "rig.free.height_m", "rig.free.fov_deg", "rig.modules", "rig.max_cost", "rig.symmetric"),
    *("camera.fov_deg", "camera.width_px", "camera.height_px", "camera.lens", "mount.zones", "detector.model"),
    *("detector.confidence_min", "importance.category", "requirements", "robust.camera_loss", "optimiser.pool_cameras"),
)
"""Options that users set; ``warpav config show`` shows these, and with ``--all`` the others."""

KEPT_FILES = {
    "rig.start": "rig_start.yaml",
    "mount.zones": "zones.yaml",
    "rig.catalogue": "modules.yaml",
    "requirements": "requirements.yaml",
}
"""Options of which a run keeps the file in its folder: a value of this name means the file beside the configuration."""


def config_dir() -> Path:
    """The folder of the shipped configurations: the installed package's own, else the checkout's."""
    package = Path(__file__).resolve().parents[2]
    for folder in (package / "configs", package.parent / "configs"):
        if (folder / "quick.yaml").is_file():
            return folder
    raise InputError(f"shipped configurations: expected a folder configs in {package}, got none; reinstall warpav")


def config_names() -> list[str]:
    """Names of the shipped configurations, such as ``quick``."""
    return sorted(file.stem for file in config_dir().glob("*.yaml"))


def find_config(path: str | Path) -> Path:
    """The file that ``path`` means: an existing file, or a shipped configuration by its name."""
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
    if file.parent == Path() and file.suffix not in ("", ".yaml", ".yml"):  # as rig.cameras, of rig.cameras 6
        hint = f"an option is given with its value, as {path}=VALUE"
    raise InputError(f"{path}: config: expected a YAML file or a shipped name, got {str(path)!r}; {hint}")


@cache
def _shipped_values(name: str) -> dict[str, Any]:
    """What a shipped configuration says, as its file has it; not to be changed."""
    return read_yaml(config_dir() / f"{name}.yaml")[0]


class RunConfig(Section):
    """The run as a whole."""

    seed: int = Field(default=0, ge=0, le=MAX_SEED, description="seed of every random choice of the run")
    out: Folder | None = Field(
        default=None, description="run folder; null takes runs/<config name> and numbers it when that exists"
    )
    iterations: int = Field(default=100, ge=1, le=1_000_000, description="optimiser steps")
    batch_size: int = Field(default=4, ge=1, description="scenes per step of a descent")
    checkpoint_every: int | None = Field(
        default=None,
        ge=1,
        le=1_000_000,
        description="steps after which the state of a run is written, from which warpav optimise --resume goes on; "
        "null: 10, of a search by a pool 1",
    )
    pictures: Literal["few", "all", "none"] = Field(
        default="few",
        description="what a run draws: few, the six of the report's first page; all; none. warpav report RUN --full "
        "draws all of them later",
    )


_SOURCES_OF = {
    "level": ("town",),
    "recordings": ("traffic",),
    "test_recordings": ("traffic",),
    "places": ("places",),
    "selection_places": ("places",),
    "test_places": ("places",),
    "vehicles": ("town", "traffic", "places"),
}
"""Options of scenes that some of their sources take alone."""


class SceneConfig(Section):
    """Which traffic scenes are trained and tested on."""

    source: Literal["town", "traffic", "places", "captured", "folder"] = Field(
        default="town",
        description="town builds the embedded street scenes; traffic those of recorded traffic; places mixes both; "
        "captured takes images of embedded ones and makes meshes of these; folder reads scene_<seed>.glb files",
    )
    level: Levels | None = Field(
        default=None,
        description="of the embedded street scenes: easy, where everything is near and can be seen from the roof; "
        "urban, as long and busy as real streets; dense, full of people and of what hides them; motorway, fast and "
        "far; of a list, seeds take turns; null: easy",
    )
    moments_per_street: int = Field(
        default=1, ge=1, le=1_000_000, description="seeds in a row that show one street, of the levels urban and dense"
    )
    train_seeds: Seeds = Field(default=tuple(range(60)), description="scenes that the optimiser sees")
    validation_seeds: Seeds | None = Field(
        default=None, description="scenes on which rigs of a run are compared; null: the training scenes"
    )
    test_seeds: Seeds = Field(default=tuple(range(5000, 5040)), description="scenes that only the evaluation sees")
    folder: Folder | None = Field(
        default=None,
        description="where source: folder finds its scene_<seed>.glb files, and where source: captured keeps what it "
        "makes; null keeps that in the user's cache",
    )
    ego: MeshFile | None = Field(
        default=None,
        description="mesh of your own vehicle, which takes the place of every scene's own, or a name that warpav "
        "vehicle list shows, such as bus; warpav vehicle check examines and repairs meshes; null: the scene's own",
    )
    mirror: bool = Field(
        default=False, description="train on every scene's mirror image as well, against traffic that keeps to one side"
    )
    targets: Targets = Field(
        default=("vehicle",), description="road users that rigs are optimised and evaluated for; others only hide them"
    )

    recordings: Recordings | None = Field(
        default=None,
        description="files and folders of recorded traffic that source: traffic takes, as warpav scenes traffic does; "
        "null: those that ship with warpav",
    )
    test_recordings: Recordings | None = Field(
        default=None, description="the same for the test alone; null: the last third of scenes.recordings, by name"
    )
    places: Places | None = Field(
        default=None,
        description="what source: places takes scenes of in turn: levels of the town such as town:dense, sind, paths "
        "of recorded traffic; without scenes.test_places the last third is for the test",
    )
    selection_places: Places | None = Field(
        default=None, description="the same for the scenes of scenes.validation_seeds; null: those of the search"
    )
    test_places: Places | None = Field(default=None, description="the same for the test scenes alone")
    vehicles: Vehicles | None = Field(
        default=None,
        description="vehicles of other makers in the places of some in the traffic of town and recordings: shipped, "
        "mesh files, and folders of these; null: warpav's own alone",
    )
    vehicles_share: float | None = Field(
        default=None,
        gt=0.0,
        le=1.0,
        description="of the vehicles in whose places a mesh of scenes.vehicles could stand, those in whose places one "
        "does; null: 0.5",
    )

    @property
    def search_scene_count(self) -> int:
        """Scenes on which a search by a pool chooses: of training, with their mirror images, and of validation."""
        return len(self.train_seeds) * (1 + self.mirror) + len(self.validation_seeds or ())

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
        for name, sources in _SOURCES_OF.items():
            value = getattr(self, name)
            if value is not None and self.source not in sources:
                text = f"expected null, as only scenes.source {' and '.join(sources)} takes it, got {shown(value)}"
                mistake(f"{text}; set scenes.{name}=null", name, "source")
        if self.vehicles_share is not None and self.vehicles is None:
            text = f"expected null without scenes.vehicles, got {self.vehicles_share:g}"
            mistake(f"{text}; say which vehicles there are", "vehicles_share", "vehicles")
        if self.source == "places" and len(self.places or ()) < 1 + (self.test_places is None):
            text = f"expected two places or more, such as [sind, town:dense], got {len(self.places or ())}"
            mistake(f"{text}; or scenes.test_places", "places", "source")
        if self.selection_places is not None and self.validation_seeds is None:
            mistake("expected null without scenes.validation_seeds", "selection_places", "validation_seeds")
        if self.moments_per_street > 1 and (self.source != "town" or set(self.level or ("easy",)) - {"urban", "dense"}):
            mistake("expected 1 but for embedded streets of level urban or dense", "moments_per_street", "level")
        if self.source == "folder" and self.folder is None:
            mistake("expected a folder of scenes because scenes.source is folder, got none", "folder", "source")
        if self.source == "folder" and self.folder and not self.folder.is_dir():
            text = f"expected an existing folder, got {str(self.folder)!r}; warpav scenes make --out writes one"
            mistake(text, "folder")
        return self


class _FreeConfig(Section):
    """What the optimiser moves besides x, y and yaw, each within two bounds; null leaves it as configured."""

    pitch_deg: PitchRange = Field(
        default=(-10.0, 20.0), description="bounds of each camera's pitch, nose-down positive; null: level cameras"
    )
    height_m: HeightRange = Field(
        default=None, description="bounds of each camera's height above the mount surface, around rig.height_offset_m"
    )
    fov_deg: FovRange = Field(
        default=None, description="bounds of each camera's horizontal field of view, around camera.fov_deg"
    )


class RigConfig(Section):
    """How many cameras there are, where they start, how close they may come, and what else of them is free."""

    cameras: int = Field(
        default=4, ge=1, le=MOST_CAMERAS, description="cameras on the vehicle; of modules also a range, such as 2..8"
    )
    start: Annotated[str, Expectation(START_TEXT)] = Field(
        default=BY_HAND, description=f"rig that the optimiser starts from: {START_TEXT}"
    )
    freeze: CameraNames = Field(
        default=(),
        description="cameras of rig.start that stay as they are, by name: their places, directions and lenses; the "
        "others are optimised around them, and cameras that rig.start lacks for rig.cameras are added",
    )
    height_offset_m: Metres = Field(
        default=0.25, ge=0.0, le=2.0, description="height of the cameras above the mount surface"
    )
    min_spacing_m: Metres = Field(default=0.2, gt=0.0, le=5.0, description="minimum distance between two cameras")
    free: _FreeConfig = Field(default=_FreeConfig(), description="what is optimised besides x, y and yaw")
    fewest_cameras: int | None = Field(
        default=None, ge=1, le=MOST_CAMERAS, description="cameras at least, rig.cameras being the most; null: as many"
    )
    modules: ModuleCounts | None = Field(
        default=None,
        description="camera modules that the rig is made of, each with its number or a range of it; they stand in the "
        "zones that they fit; null: equal cameras as the section camera says",
    )
    catalogue: CatalogueFile | None = Field(
        default=None, description="catalogue of the modules; null: the one that ships with warpav"
    )
    max_cost: float | None = Field(
        default=None, gt=0.0, description="what all cameras may cost together, in the unit of the catalogue"
    )
    symmetric: bool | Literal["auto"] = Field(
        default="auto",
        description="whether cameras stand in mirrored pairs, or in the middle where a zone is centred; auto: where "
        "the search is the one by a pool, and vehicle, zones, modules and the rig to start from are symmetric",
    )

    _is_mirrored: bool = PrivateAttr(default=False)

    @model_validator(mode="before")
    @classmethod
    def _counted(cls, data: object) -> object:
        """The ends of a range of cameras apart; without a number as many as the modules allow."""
        if not isinstance(data, dict):
            return data
        result, cameras, modules = dict(data), data.get("cameras"), data.get("modules")
        if isinstance(cameras, str) and ".." in cameras:
            least, most = read_count(cameras, "a number of cameras from 1 to 16, or a range such as 2..8", "cameras")
            if data.get("fewest_cameras") not in (None, least):
                mistake(f"expected null where rig.cameras is {least}..{most}", "fewest_cameras", "cameras")
            result |= {"cameras": most, "fewest_cameras": least if least < most else None}
        elif cameras is None and isinstance(modules, Mapping) and modules:
            counts = [read_count(count, COUNTS_TEXT, "modules") for count in modules.values()]
            least, most = (sum(pair[end] for pair in counts) for end in range(2))
            if most > MOST_CAMERAS:
                text = f"expected at most {MOST_CAMERAS} cameras, or rig.cameras, got modules that allow {most}"
                mistake(text, "modules", "cameras")
            result |= {"cameras": max(most, 1), "fewest_cameras": max(least, 1) if least < most else None}
        return result

    @property
    def module_counts(self) -> Mapping[str, tuple[int, int]] | None:
        """Least and greatest number of each module, of plain cameras in pairs too; None: cameras one by one."""
        return {PLAIN: self.camera_range} if self.modules is None and self.is_symmetric else self.modules

    @property
    def is_symmetric(self) -> bool:
        """Whether cameras stand in mirrored pairs; False while nobody has looked at the vehicle for ``auto``."""
        return self.symmetric is True or (self.symmetric == "auto" and self._is_mirrored)

    def mirrored(self) -> RigConfig:
        """The same, of which ``symmetric: auto`` means true."""
        found = self.model_copy()
        found._is_mirrored = True
        return found

    @property
    def camera_range(self) -> tuple[int, int]:
        """The least and the greatest number of cameras."""
        return self.cameras if self.fewest_cameras is None else self.fewest_cameras, self.cameras


class _CaptureConfig(Section):
    """The images that source: captured and warpav scenes capture take of a situation."""

    width_px: int = Field(default=640, ge=32, le=4096, description="image width")
    height_px: int = Field(default=480, ge=32, le=4096, description="image height")
    vehicles: int = Field(default=12, ge=1, le=200, description="vehicles besides the ego vehicle, at most")
    radius_m: Metres = Field(default=30.0, gt=0.0, le=500.0, description="vehicles stand no farther from the ego one")
    rotations: int = Field(default=4, ge=1, le=64, description="images from the ego vehicle all around")
    ego_sides: int = Field(default=4, ge=0, le=64, description="images of the ego vehicle from beside it")
    scene_heights_m: Heights = Field(
        default=(14.0, 28.0, 45.0), description="heights of the images of the whole place from above"
    )


class _ReconstructionConfig(Section):
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


class _CameraConfig(Section):
    """The camera model that all cameras share."""

    fov_deg: Degrees = Field(
        default=90.0, ge=10.0, le=360.0, description="horizontal field of view; beyond 170 a fisheye's or a panorama's"
    )
    width_px: int = Field(default=256, ge=16, le=4096, description="image width")
    height_px: int = Field(default=256, ge=16, le=4096, description="image height")
    near_m: Metres = Field(default=0.1, gt=0.0, le=10.0, description="what is nearer than this is cut away")
    supersampling: Literal[1, 2, 4, 8] = Field(default=1, description="samples per pixel edge of the renderer")
    lens: Literal["pinhole", "brown_conrady", "fisheye", "eucm", "double_sphere", "panorama", "equirectangular"] = (
        Field(default="pinhole", description="how directions become places in the image")
    )
    distortion: Distortion = Field(
        default=(),
        description="OpenCV's: k1 k2 p1 p2 [k3 [k4 k5 k6]] of brown_conrady, k1 k2 k3 k4 of fisheye; alpha beta of "
        "eucm, xi alpha of double_sphere",
    )

    @model_validator(mode="after")
    def _check(self) -> _CameraConfig:
        lens = Lens(self.lens)
        try:
            checked_distortion(lens, self.distortion)
        except ValueError as error:
            mistake(f"expected as many numbers as the lens has, got: {error}", "distortion", "lens")
        if self.fov_deg > self.widest_deg:
            text = f"expected an angle in degrees from 10 deg to {self.widest_deg:g} deg, the widest for this {lens}"
            mistake(f"{text} lens, got {self.fov_deg:g}", "fov_deg", "lens", "distortion")
        return self

    @property
    def widest_deg(self) -> float:
        """The widest field of view that the lens can have [deg]."""
        lens = Lens(self.lens)
        shape = LensShape(lens, self.distortion)
        widest_deg = 170.0
        if shape.has_unit_rays:
            widest_deg = 360.0 if shape.is_panorama else 350.0
        if shape.is_radial:
            # rounded down, so that the angle in a message is one that is taken
            widest_deg = min(widest_deg, math.floor(200.0 * math.degrees(shape.limit_rad)) / 100.0)
        return widest_deg


class _MountConfig(Section):
    """The height map on which cameras may sit."""

    cell_m: Metres = Field(default=0.02, ge=0.002, le=0.5, description="cell size of the height map")
    min_upward_normal: float = Field(
        default=0.8, gt=0.0, le=1.0, description="least vertical part of the unit normal of what makes the height map"
    )
    min_zone_normal: float = Field(
        default=0.9, gt=0.0, le=1.0, description="the same of what carries cameras, not a windscreen (method: default)"
    )
    margin_m: Metres = Field(
        default=0.02, ge=0.0, le=1.0, description="least distance of cameras to the zone's border (method: default)"
    )
    smoothing_tolerance_m: Metres = Field(
        default=1e-4, gt=0.0, le=0.1, description="filled cells are smoothed until no cell changes by more than this"
    )
    zones: ZonesFile | None = Field(
        default=None,
        description="zones anywhere on the body, each with its normal, stand-off and directions, as warpav vehicle "
        "zones proposes them; null: roof and bonnet (method: default)",
    )


class _ClassesConfig(Section):
    """Which labels of the detector count as which kind of road user; null takes the usual names."""

    vehicle: Labels | None = Field(default=None, description="labels of motor vehicles, such as [car, bus]")
    pedestrian: Labels | None = Field(default=None, description="labels of people on foot, such as [person]")
    cyclist: Labels | None = Field(
        default=None, description="labels of people on bicycles; a bicycle alone is none unless it is named here"
    )


_CONFIDENCE_MIN_OF_ALL = 0.5
"""The shipped detector raises half a false alarm an image there, and of vehicles alone at the 0.4 of the default."""
_FALSE_ALARMS_OF_ALL = 0.5
"""Rigs then miss fewer of all road users at equal false alarms, but of vehicles in recordings more."""


class DetectorConfig(Section):
    """The object detector, and when its boxes count."""

    model: DetectorModel = Field(default="builtin", description="builtin or the path of an ONNX file")
    confidence_min: float = Field(
        default=0.4, ge=0.0, lt=1.0, description="least confidence; 0.5 unless given where not only vehicles count"
    )
    iou_min: float = Field(
        default=0.5, gt=0.0, lt=1.0, description="minimum overlap with the true box for a true positive"
    )
    nms_iou_max: float = Field(default=0.5, gt=0.0, le=1.0, description="boxes that overlap more are merged")
    format: Literal[
        "auto",
        "ultralytics",
        "ultralytics-end2end",
        "ultralytics-rtdetr",
        "yolox",
        "yolox-decoded",
        "yolov5",
        "torchvision",
        "rtdetr",
        "rtdetr-single",
    ] = Field(default="auto", description="layout of the file's inputs and outputs; auto finds it out")
    labels: LabelsOrFile = Field(
        default=None, description="labels in the order of the network; null takes those in the file, or else COCO's"
    )
    classes: _ClassesConfig = Field(default=_ClassesConfig(), description="which labels count as which road user")
    input_px: int | None = Field(default=None, ge=32, le=4096, description="input size; null takes the model's own")
    provider: Literal["cpu", "cuda", "tensorrt"] = Field(default="cpu", description="what the network runs on")


class _EvaluationConfig(Section):
    """How rigs are compared."""

    false_alarms_per_image: float = Field(
        default=0.5, gt=0.0, description="rate at which rigs are compared, each at the confidence that leaves so many"
    )


class _BaselineConfig(Section):
    """The rigs that the result is compared with."""

    random_samples: int = Field(
        default=0, ge=0, le=1_000_000, description="random rigs of which the best is taken; 0: none"
    )
    random_scenes: int = Field(default=4, ge=1, description="training scenes on which the random rigs are ranked")
    presets: PresetNames | None = Field(
        default=None, description="presets on the body of the vehicle that a run compares its rig with; null: none"
    )
    rigs: RigFiles | None = Field(
        default=None, description="rigs of your own that a run compares its rig with, named by their files; null: none"
    )
    preset_images: Literal["same_pixels", "same_width", "sensor"] | None = Field(
        default=None,
        description="images of presets, in proportions of their own: same_pixels as many pixels as the run's cameras, "
        "same_width as many columns, sensor all they have; null: same_pixels",
    )


class _ExecutorConfig(Section):
    """Where the tasks of an experiment run."""

    name: Literal["serial", "process", "ray", "slurm"] = Field(
        default="serial",
        description="serial: one after the other; process: in processes of this machine; ray and slurm: on a cluster",
    )
    workers: int | None = Field(default=None, ge=1, description="tasks at a time; null takes as many as fit")
    gpus: int = Field(
        default=1, ge=1, description="GPUs that the processes of a search share in turn, from the one of device on"
    )
    address: str | None = Field(
        default=None, description="of a Ray cluster; null takes RAY_ADDRESS, else a Ray of this machine"
    )
    options: Annotated[dict[str, Any], Expectation("options such as {num_gpus: 1}")] = Field(
        default={}, description="what a task needs: options of ray.remote, or parameters of submitit for Slurm"
    )


NO_REQUIREMENTS = "only the search by a pool, with the loss expected_miss_rate alone, knows requirements"
"""Why others take none."""


_POOL_ALONE = "only the search by a pool, with the loss expected_miss_rate alone, knows it"
_LEAVE = "leave method, optimiser.search and the losses as they are"
_XY_AND_YAW = ("method", "the thesis moves x, y and yaw alone", "take method: default")
_APART = (
    ("rig.modules", "method", "the thesis has equal cameras", "take method: default"),
    ("mount.zones", "method", "the thesis has roof and bonnet alone", "take method: default"),
    ("rig.freeze", "method", "the thesis moves all cameras", "take method: default"),
    *((f"rig.free.{name}", *_XY_AND_YAW) for name in _FreeConfig.model_fields),
    ("rig.modules", "optimiser.search", _POOL_ALONE, _LEAVE),
    ("rig.symmetric", "optimiser.search", _POOL_ALONE, _LEAVE),
    ("rig.symmetric", "method", _POOL_ALONE, _LEAVE),
    ("rig.freeze", "rig.symmetric", "every camera of a pair moves", ""),
    ("rig.free.fov_deg", "rig.modules", "every module has its lens", ""),
    ("rig.free.fov_deg", "rig.symmetric", "the cameras of a pair have one lens", ""),
    ("rig.free.height_m", "rig.modules", "every zone has its stand_off_m", ""),
    ("rig.free.height_m", "mount.zones", "every zone has its stand_off_m", ""),
)
"""Two options that do not go together, why the first one is not to be given, and what else could be done."""


def merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Sections laid over others: what the upper ones leave out comes from below."""
    result = dict(below)
    if "modules" in above and "cameras" not in above:  # of the section rig: modules say how many there are
        result.pop("cameras", None)
    for name, value in above.items():
        under = result.get(name)
        both = isinstance(under, Mapping) and isinstance(value, Mapping)
        result[name] = merged(dict(under or {}), value) if both else value
    return result


def _add_extends(schema: dict[str, Any]) -> None:
    """Let editors know the key that files have besides the options."""
    text = "YAML file, beside this one or by its path, or shipped name, on top of which this file stands"
    schema["properties"][EXTENDS] = {"type": "string", "description": text}


class ConfigTree(Section):
    """Every option of a run."""

    model_config = ConfigDict(json_schema_extra=_add_extends)
    renamed: ClassVar[Mapping[str, str]] = {"segregation": "thesis"}

    run: RunConfig = Field(default=RunConfig(), description="the run as a whole")
    device: Device = Field(default="cpu", description="what renders, and what gradients are computed on")
    method: Literal["thesis", "default"] = Field(
        default="default",
        description="thesis: the losses and constraints as printed; default: the share of road users that the rig is "
        "expected to miss, cameras on roof and bonnet alone",
    )
    scenes: SceneConfig = Field(default=SceneConfig(), description="traffic scenes")
    capture: _CaptureConfig = Field(default=_CaptureConfig(), description="images of scenes")
    reconstruction: _ReconstructionConfig = Field(default=_ReconstructionConfig(), description="scenes from images")
    rig: RigConfig = Field(default=RigConfig(), description="the cameras together")
    camera: _CameraConfig = Field(default=_CameraConfig(), description="each camera")
    mount: _MountConfig = Field(default=_MountConfig(), description="where cameras may sit")
    detector: DetectorConfig = Field(default=DetectorConfig(), description="the object detector")
    thesis: ThesisSettings = Field(default=ThesisSettings(), description="which camera is assigned which vehicle")
    losses: LossSettings = Field(
        default=LossSettings(**METHOD_LOSSES["default"]), description="the objectives; each method has its own"
    )
    importance: ImportanceSettings = Field(default=ImportanceSettings(), description="which road users matter more")
    requirements: Requirements | None = Field(
        default=AUTO,
        description="what has to be seen near the vehicle besides the traffic: the name of a template, such as "
        "near_field, or the path of a YAML file; null: nothing; auto: where the search is the one by a pool, without "
        "robust, the points of near_field join the objective, and none is asked for",
    )
    lidar: LidarSettings = Field(default=LidarSettings(), description="how many points it takes to find a road user")
    robust: RobustSettings = Field(
        default=RobustSettings(), description="rigs that are to bear the loss of a camera, or errors of mounting"
    )
    rules: RuleSettings = Field(default=RuleSettings(), description="design rules, so that a rig can be mounted")
    visibility: VisibilitySettings = Field(default=VisibilitySettings(), description="what hides a vehicle")
    optimiser: OptimiserSettings = Field(default=OptimiserSettings(), description="steps and multipliers")
    evaluation: _EvaluationConfig = Field(default=_EvaluationConfig(), description="how rigs are compared")
    baselines: _BaselineConfig = Field(default=_BaselineConfig(), description="rigs to compare with")
    executor: _ExecutorConfig = Field(default=_ExecutorConfig(), description="where the tasks of an experiment run")

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, data: object) -> object:
        if not isinstance(data, dict):
            return data
        method = data.get("method", cls.model_fields["method"].default)
        if not isinstance(method, str) or method not in METHOD_LOSSES:
            return data  # rejected by the validation that follows, with its location
        if isinstance(data.get("losses"), dict):
            data = {**data, "losses": LossSettings.with_new_names(data["losses"])}  # pyright: ignore[reportCallIssue]
        if method == "thesis":
            return merged(_shipped_values("thesis"), data)
        usual: dict[str, Any] = {"losses": METHOD_LOSSES[method]}
        scenes = data.get("scenes")
        vehicles = ("vehicle", ["vehicle"], ("vehicle",))
        if isinstance(scenes, Mapping) and scenes.get("targets", "vehicle") not in vehicles:
            usual["detector"] = {"confidence_min": _CONFIDENCE_MIN_OF_ALL}
            usual["losses"] = {**usual["losses"], "false_alarms": _FALSE_ALARMS_OF_ALL}
        return merged(usual, data)

    @property
    def shared_gpu_count(self) -> int:
        """GPUs that processes share: ``executor.gpus``; 1 on a CPU, so what GPUs began goes on without them."""
        return self.executor.gpus if self.device.startswith("cuda") else 1

    @property
    def requirements_file(self) -> Path | None:
        """The file of requirements; None where a template is meant, or nothing."""
        known = (None, AUTO, *template_names())
        return None if self.requirements in known else Path(str(self.requirements)).expanduser()

    @property
    def knows_requirements(self) -> bool:
        """Whether the search is the one by a pool, which knows requirements."""
        return self.search_kind == "pool" and self.losses.is_by_single_cameras and self.method != "thesis"

    @property
    def keeps_rules(self) -> bool:
        """Whether rigs keep the design rules, and cameras have bodies where rigs are judged."""
        return self.knows_requirements if self.rules.enforced is None else self.rules.enforced

    @property
    def may_be_symmetric(self) -> bool:
        """Whether ``rig.symmetric: auto`` asks for pairs of a symmetric vehicle."""
        rig = self.rig
        return (
            rig.symmetric == "auto"
            and self.knows_requirements
            and 1 < rig.camera_range[0] == rig.camera_range[1]
            and not rig.freeze
            and rig.free.fov_deg is None
        )

    @property
    def search_kind(self) -> str:
        """Which search it is: ``pool``, or ``descent``, whose steps take batches of scenes."""
        if self.optimiser.search != "auto":
            return self.optimiser.search
        return "pool" if self.losses.is_by_single_cameras else "descent"

    @model_validator(mode="after")
    def _check(self) -> ConfigTree:
        scene_count = len(self.scenes.train_seeds)
        if self.search_kind == "descent" and self.run.batch_size > scene_count:
            mistake(
                f"expected at most the {scene_count} training scene(s), got {self.run.batch_size}; "
                f"set run.batch_size={scene_count} or lower",
                "run.batch_size",
                "scenes.train_seeds",
            )
        for option, other, why, remedy in _APART:
            if (value := self._given(option)) and self._given(other):
                nothing = {"rig.freeze": "none", "rig.symmetric": "auto"}.get(option, "null")
                text = f"expected {nothing}, as {why}, got {shown(value)}"
                mistake(f"{text}; {remedy}" if remedy else text, option, other)
        if self.rig.max_cost is not None and self.rig.modules is None:
            text = f"expected null without rig.modules, got {shown(self.rig.max_cost)}"
            mistake(f"{text}; say which modules there are", "rig.max_cost", "rig.modules")
        self._check_free()
        frozen = self.rig.freeze
        if frozen and self.rig.start in NAMED_STARTS:
            text = f"expected none, for rig.start={self.rig.start} has no cameras of these names, got {shown(frozen)}"
            mistake(f"{text}; set rig.start to the rig that has them", "rig.freeze", "rig.start")
        if len(frozen) >= self.rig.cameras:
            text = f"expected fewer than the {self.rig.cameras} of rig.cameras, so that one can move"
            mistake(f"{text}, got {len(frozen)}", "rig.freeze", "rig.cameras")
        self._check_importance()
        if self.requirements not in (None, AUTO) and not self.knows_requirements:
            mistake(f"expected null: {NO_REQUIREMENTS}", "requirements", "optimiser.search")
        asked = self.robust.asked_for or ("rules.enforced" if self.rules.enforced else None)
        if asked is not None and self._given("optimiser.search"):
            mistake(f"expected null, as {_POOL_ALONE}; {_LEAVE}", asked, "optimiser.search")
        if self.thesis.rotations < self.rig.cameras:
            mistake(
                f"expected at least one direction per camera ({self.rig.cameras}), got {self.thesis.rotations}",
                "thesis.rotations",
                "rig.cameras",
            )
        return self

    def _given(self, option: str) -> object:
        """What an option says that may not go with another; of those that always say something if that is apart."""
        if option == "method":
            return self.method == "thesis"
        if option == "optimiser.search":
            return self.search_kind == "descent" or not self.losses.is_by_single_cameras
        return self.rig.is_symmetric if option == "rig.symmetric" else operator.attrgetter(option)(self)

    def _check_importance(self) -> None:
        if not self.importance.is_set:
            return
        if not self.losses.weights["expected_miss_rate"]:
            text = "expected nothing, as only the loss expected_miss_rate knows weights, and its own is 0"
            mistake(f"{text}; set losses.expected_miss_rate", "importance", "losses.expected_miss_rate")
        for name in self.importance.category:
            kind = name if name in ROAD_USERS else road_user_of(name)
            if kind not in self.scenes.targets:
                text = f"expected road users out of scenes.targets, {', '.join(self.scenes.targets)}, got {name!r}"
                mistake(f"{text}; add {kind} to scenes.targets", "importance.category", "scenes.targets")

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
            if not pair[0] <= value <= pair[1]:
                text = f"expected bounds that hold the {value:g} of {what}, got {shown(pair)}"
                mistake(text, *dict.fromkeys((f"rig.free.{name}", option)))
        if free.fov_deg is None:
            return
        widest_deg = self.camera.widest_deg
        if free.fov_deg[1] > widest_deg:
            text = f"expected at most {widest_deg:g} deg, the widest for this {self.camera.lens} lens"
            mistake(f"{text}, got {shown(free.fov_deg)}", "rig.free.fov_deg", "camera.lens", "camera.distortion")
        alike = self.losses.one_field
        if alike:
            mistake(
                f"expected null, as losses.{alike[0]} takes one field of view for all cameras, got "
                f"{shown(free.fov_deg)}",
                "rig.free.fov_deg",
                f"losses.{alike[0]}",
            )
