"""The task of placing cameras: scenes, a vehicle, cameras, a detector and an objective, joined.

`Placement` is what `warpav.optimise` and `warpav.evaluate` take. It can be made of objects, or of a configuration
(`Placement.from_config`); both ways lead to the same objects.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cache, cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

import numpy as np

from warpav.core.errors import ArgumentError, InputError
from warpav.core.progress import NullProgress, Progress
from warpav.core.section import Section
from warpav.detection import DetectionProbability, LidarProbability
from warpav.optimisation import (
    HEIGHT_DELTA_M,
    LOG_ZOOM,
    LOSSES,
    PITCH_RAD,
    X_M,
    Y_M,
    YAW_RAD,
    AssignedScene,
    CameraMount,
    CameraProbability,
    Importance,
    ImportanceSettings,
    Loss,
    LossFunction,
    LossOptions,
    LossSchedule,
    ObjectProbability,
    PoolRules,
    Reference,
    RequiredPoints,
    RigLimits,
    RigObjective,
    RobustSettings,
    UserLoss,
    check_categories,
    losses_of,
    range_text,
    single_cameras_of,
)
from warpav.raster.mesh import Mesh
from warpav.rig import Rig
from warpav.runs._detector_fit import ensure_fit, fit_config
from warpav.runs._mounts import (
    camera_models,
    checked_frozen,
    constraints_of,
    made_symmetric,
    objective_options,
    rig_limits,
    rig_modules,
)
from warpav.runs._networks import Networks, load_networks
from warpav.runs._rig_source import read_baselines, read_start, with_added_cameras
from warpav.runs._scene_set import (
    SceneSet,
    are_town,
    check_zones,
    checked_scenes,
    checked_vehicle,
    known_vehicle,
    load_scene_set,
    own_vehicle,
    pack_scenes,
    scene_options,
)
from warpav.runs.config import AUTO, BY_HAND, Config, RigConfig
from warpav.runs.config._schema import NO_REQUIREMENTS
from warpav.scene import DeviceScene, Scene
from warpav.sight import Requirement, read_requirements

if TYPE_CHECKING:
    import trimesh

    from warpav.detection import Detector
    from warpav.raster.camera import CameraModel
    from warpav.thesis import Segregation

_ORIENTATION_SCENES = 200
"""Training scenes by which the orientations are chosen, at most; of more, so many that are evenly spread."""

_DEGREES_OF_FREEDOM = {
    "x_m": X_M,
    "y_m": Y_M,
    "height_m": HEIGHT_DELTA_M,
    "yaw_rad": YAW_RAD,
    "pitch_rad": PITCH_RAD,
    "log_focal": LOG_ZOOM,
}
"""Degrees of freedom of a camera on the mount surface, and their column among its mount pose."""


_DetectionProbabilities = DetectionProbability | tuple[DetectionProbability | LidarProbability, ...]
"""The model of detection probability of all cameras, or of each module."""


class Stream(IntEnum):
    """Purposes of random numbers: one more draw for one of them moves nothing for the others."""

    SEGREGATION = 0
    START = 1
    BATCHES = 2
    SEARCH = 3
    STARTS = 4


class _PlacementOptions(TypedDict, total=False):
    """Further arguments of `Placement`, which says what they mean."""

    fov_deg: float | None
    ego: str | Path | Mesh | trimesh.Trimesh | tuple[Any, Any] | None
    zones: str | Path | None
    modules: Mapping[str, int | str | tuple[int, int]] | None
    freeze: str | Sequence[str]
    rig: RigConfig | Mapping[str, Any] | None
    losses: Mapping[str, float] | Sequence[tuple[float, Loss | LossFunction]] | None
    importance: ImportanceSettings | Mapping[str, Any] | None
    requirements: str | Path | Sequence[Requirement] | None
    robust: RobustSettings | Mapping[str, Any] | None
    fusion: str | float | None
    probability: DetectionProbability | None


@dataclass(frozen=True, eq=False)
class _Parts:
    """What a placement was given as objects; None: as its configuration says."""

    start: Rig | None = None  # the rig that the optimiser starts from, as it was given
    freeze: tuple[str, ...] = ()
    scenes: tuple[list[Scene], list[Scene]] | None = None  # of training and of validation
    ego: Mesh | None = None
    detector: Detector | None = None
    probability: _DetectionProbabilities | None = None  # one, or one for each module; None: that of `ensure_fit`
    losses: tuple[tuple[float, Loss], ...] | None = None
    requirements: tuple[Requirement, ...] | None = None

    @property
    def has_own_scenes(self) -> bool:
        """Whether no configuration can name its scenes."""
        return self.scenes is not None and (self.ego is not None or not all(map(are_town, self.scenes)))


@dataclass(frozen=True, eq=False)
class _Prepared:
    """What a placement has after its work: on the device, assigned, ready to be measured against."""

    scenes: SceneSet
    networks: Networks
    probability: _DetectionProbabilities | None
    objective: RigObjective
    segregation: Callable[[], Segregation]
    train: list[AssignedScene]
    validation: list[AssignedScene]
    test: list[AssignedScene]


class Placement:
    """Which cameras a vehicle is to carry, in which traffic, for which detector.

    Nothing is loaded or rendered before it is needed: `prepare` does it with progress, everything else calls it.

    Attributes:
        config: All numbers, as a configuration; scenes, detectors and vehicles that are objects have no place there.
        parts: Scenes, detectors and vehicles that are objects.
    """

    def __init__(
        self,
        train: Sequence[Scene],
        *,
        validation: Sequence[Scene] = (),
        cameras: int | str | None = None,
        detector: str | Path | Detector | None = None,
        device: str | None = None,
        start: str | Path | Rig | None = None,
        config: Config | None = None,
        **options: Unpack[_PlacementOptions],
    ) -> None:
        """A placement from objects.

        Args:
            train: Scenes that the optimiser sees, at least one, all around the same ego vehicle.
            validation: Scenes on which rigs are compared; none: the training scenes.
            cameras: Number of cameras, 1 to 16, of modules also a range such as ``"2..8"``; None: those of ``start``,
                else as many as ``modules`` allow, else ``config.rig.cameras``.
            detector: Path of an ONNX file, ``"builtin"``, or an object with the `Detector` protocol.
            device: Warp device such as ``"cuda:0"``.
            start: The rig to start from: a `Rig`, a path, a preset, ``"random"`` or ``"highest"``.
            config: What the arguments leave out; None: the shipped configuration ``quick``.
            **options: Of these names:

                - ``fov_deg``: horizontal field of view of every camera [deg].
                - ``ego``: the vehicle that carries the cameras, in the ego frame [m]: path of a mesh file, name of a
                  vehicle that ships with warpav such as ``"bus"``, `Mesh`, trimesh, or ``(vertices [n, 3], faces
                  [m, 3])``; None: the scenes' own.
                - ``zones``: YAML file of zones anywhere on the body, see `warpav.rig._zone.read_zones`; None: roof and
                  bonnet, of modules those that the body suggests.
                - ``modules``: camera modules of the shipped catalogue, or of ``rig={"catalogue": path}``, each with its
                  number or a range of it, such as ``{"front_8mp_30": 1, "fisheye_3mp_190": "0..4"}``; None: equal
                  cameras.
                - ``freeze``: names of cameras of ``start`` that stay as they are. With them, ``start`` may have fewer
                  cameras than ``cameras`` says; the others are added.
                - ``rig``: other settings of the section ``rig``, such as ``{"min_spacing_m": 0.3}``.
                - ``losses``: weights by name, such as ``{"expected_miss_rate": 1.0}``, or a list of weights and losses,
                  of `warpav.losses` or of one's own (see `LossFunction`); they replace those of the method.
                - ``importance``: weights of road users, as in the section ``importance``:
                  ``{"category": {"pedestrian": 2.0}}``.
                - ``requirements``: what has to be seen near the vehicle: a YAML file, the name of a template such as
                  ``"near_field"``, or what `warpav.read_requirements` gives; ``()``: nothing; None: as ``config`` says.
                - ``robust``: whether the loss of a camera or errors of mounting count, as in the section ``robust``:
                  ``{"camera_loss": "worst"}``, ``{"mount_error_m": 0.02, "mount_error_deg": 1.0}``.
                - ``fusion``: ``"any"`` sensor may find a road user; ``"both"``: a camera and a LiDAR must; ``60.0``:
                  both must nearer than so many metres.
                - ``probability``: the detector's model of detection probability, as `warpav.runs._detector_fit.fit`
                  gives it; None: the stored one, which is fitted first if there is none.

        Raises:
            InputError: An argument cannot be used; the text names it.
            TypeError: An argument is of another type, or there is none of that name.
        """
        known = _PlacementOptions.__annotations__
        for name in options.keys() - known.keys():
            near = difflib.get_close_matches(name, known, 1)
            raise TypeError(f"{name}: expected one of {', '.join(known)}" + (f"; did you mean {near[0]}?" * bool(near)))
        scenes = checked_scenes("train", train), checked_scenes("validation", validation, least=0)
        own_detector = None if detector is None or isinstance(detector, (str, Path)) else detector
        if own_detector is not None and not callable(getattr(own_detector, "detect", None)):
            raise TypeError(
                "detector: expected the path of an ONNX file, 'builtin' or an object with detect(images_rgb) and "
                f"names, got {type(own_detector).__name__}"
            )
        ego, losses, requirements, modules = map(options.get, ("ego", "losses", "requirements", "modules"))
        start_rig = start if isinstance(start, Rig) else None
        if cameras is None and start_rig is not None and modules is None:
            cameras = len(start_rig.cameras)
        base = Config() if config is None else config
        given: dict[str, object] = {
            "rig.modules": None if modules is None else dict(modules),
            "rig.cameras": cameras,
            "camera.fov_deg": options.get("fov_deg"),
            "device": device,
            "detector.model": _named(detector),
            "scenes.ego": _named(ego),
            "mount.zones": _named(options.get("zones")),
            "rig.start": "random" if start_rig is not None else _named(start),
            "rig.freeze": None if start is None else [],
            "losses": {**dict.fromkeys(LOSSES, 0.0), **losses} if isinstance(losses, Mapping) else None,
            "importance": _section(options.get("importance")),
            "requirements": _named(requirements),
            "robust": _section(options.get("robust")),
            "lidar.fusion": options.get("fusion"),
            **{f"rig.{name}": value for name, value in (_section(options.get("rig")) or {}).items()},
        }
        given = {name: value for name, value in given.items() if value is not None}
        self.config = base.replace({**given, **scene_options(*scenes, base)})
        rig_modules(self.config)  # that there are such
        names = (freeze,) if isinstance(freeze := options.get("freeze") or (), str) else tuple(freeze)
        self.parts = _Parts(
            _checked_start(self.config, start_rig, names),
            names or self.config.rig.freeze,
            scenes,
            ego=None if ego is None or isinstance(ego, (str, Path)) else checked_vehicle(ego),
            detector=own_detector,
            probability=options.get("probability"),
            losses=None if losses is None or isinstance(losses, Mapping) else _checked_losses(losses),
            requirements=None
            if requirements is None or isinstance(requirements, (str, Path))
            else _checked_requirements(requirements, self.config),
        )
        if not self.parts.freeze and self.parts.losses is None:
            around = self.parts.ego or own_vehicle(self.config) or scenes[0][0].ego
            self.config = made_symmetric(self.config, around, self.parts.start)
        self._prepared: _Prepared | None = None

    @classmethod
    def from_config(cls, config: Config, *, start: Rig | None = None) -> Placement:
        """The placement that a configuration describes; nothing is written.

        The rig of ``rig.start`` is read and zones are looked up on the vehicle now, scenes and detector when they are
        first needed.

        Args:
            config: The configuration.
            start: The rig that ``rig.start`` means, where it has been read already.

        Raises:
            InputError: The rig of ``rig.start``, one of ``baselines.rigs``, modules or zones cannot be used, or a
                weight is that of an unknown category.
        """
        read_baselines(config)
        check_zones(config)
        if config.scenes.source == "town":  # others may have categories of their own
            check_categories(config.importance)
        start = read_start(config) if start is None else start
        if config.may_be_symmetric and (ego := known_vehicle(config)) is not None:
            config = made_symmetric(config, ego, start)
        return cls._of(config, _Parts(start, config.rig.freeze))

    @classmethod
    def _of(cls, config: Config, parts: _Parts) -> Placement:
        placement = cls.__new__(cls)
        placement.config, placement.parts, placement._prepared = config, parts, None
        return placement

    @property
    def own_detector(self) -> str | None:
        """Class of the detector where that is an object; None where a configuration describes it."""
        return None if self.parts.detector is None else type(self.parts.detector).__name__

    def as_seen(self, scenes: Sequence[Scene]) -> Iterator[Scene]:
        """Scenes around the vehicle of the placement, with its targets."""
        ego = self.parts.ego if self.parts.ego is not None else own_vehicle(self.config)
        for scene in scenes:
            around = scene if ego is None else scene.around(ego)
            yield around.targeting(self.config.scenes.targets)

    @property
    def start_rig(self) -> Rig | None:
        """The rig that the optimiser starts from, with the cameras that it lacks, if it is a certain one."""
        start = self.parts.start
        return start and with_added_cameras(start, self.config, self.parts.freeze)

    def with_config(self, config: Config) -> Placement:
        """The same placement with other numbers; scenes, detector and fit are taken along as they are."""
        if self.config.rig.is_symmetric and config.may_be_symmetric:
            config = config.model_copy(update={"rig": config.rig.mirrored()})
        placement = Placement._of(config, self.parts)
        done = self._prepared
        if done is not None and not _have_one_objective(config, self.config):
            done = _assembled(placement, done.scenes, done.networks, done.probability)
        placement._prepared = done
        return placement

    def prepare(self, progress: Progress | None = None) -> Placement:
        """Load the scenes and the detector, and fit its detection probability if there is no fit.

        Returns:
            The same placement.

        Raises:
            InputError: The device, the detector or a scene cannot be used.
        """
        if self._prepared is None:
            progress = progress or NullProgress()
            parts = self.parts
            networks = load_networks(self.config) if parts.detector is None else Networks(parts.detector, None)
            if parts.scenes is None:
                scenes = load_scene_set(self.config, progress)
            else:
                own = [scene for part in parts.scenes for scene in part]
                steps = progress.steps("scenes", self.as_seen(own), count=len(own))
                scenes = pack_scenes(steps, (len(parts.scenes[0]), len(parts.scenes[1])), self.config, progress)
            probability = parts.probability
            if probability is None and _needs_fit(self.config, parts.losses):
                probability = _fitted(self.config, progress, detector=parts.detector, ego=parts.ego)
            self._prepared = _assembled(self, scenes, networks, probability)
        return self

    @property
    def _ready(self) -> _Prepared:
        self.prepare()
        assert self._prepared is not None
        return self._prepared

    @property
    def objective(self) -> RigObjective:
        """What is minimised; it knows the mount surface, the constraints and the detector."""
        return self._ready.objective

    @property
    def fitted_probabilities(self) -> tuple[tuple[CameraModel, DetectionProbability], ...]:
        """The model of detection probability of every camera or module, with its camera; none where none was needed."""
        probability, config = self._ready.probability, self.config
        if probability is None or config.losses.probability != "fitted":
            return ()
        cameras = camera_models(config)
        models = probability if isinstance(probability, tuple) else (probability,) * len(cameras)
        pairs = zip(cameras, models, strict=True)
        return tuple((camera, model) for camera, model in pairs if isinstance(model, DetectionProbability))

    @property
    def mount(self) -> CameraMount:
        """Where the cameras may stand, and their model."""
        return self.objective.mount

    @property
    def segregation(self) -> Segregation:
        """Orientations that share the vehicles among the cameras."""
        return self._ready.segregation()

    @property
    def train(self) -> list[AssignedScene]:
        """Training scenes, each vehicle assigned to an orientation."""
        return self._ready.train

    @property
    def validation(self) -> list[AssignedScene]:
        """Scenes on which rigs are compared, likewise; the training scenes if there are none."""
        return self._ready.validation

    @property
    def search_scenes(self) -> list[AssignedScene]:
        """Scenes of a search by a pool: those of training and of validation, each once."""
        train = self.train
        known = {id(each.scene) for each in train}
        return [*train, *(each for each in self.validation if id(each.scene) not in known)]

    @property
    def test(self) -> list[AssignedScene]:
        """Test scenes of the configuration, likewise; none where the placement is made of objects."""
        return self._ready.test

    @property
    def ego(self) -> Mesh:
        """The vehicle that carries the cameras."""
        return self._ready.scenes.ego

    @property
    def shown(self) -> Scene:
        """The scene for figures."""
        return self._ready.scenes.shown

    @property
    def detector(self) -> Detector:
        """The detector."""
        return self._ready.networks.detector

    @property
    def limits(self) -> RigLimits | None:
        """How many cameras of which module a rig may have; None where all are equal."""
        return rig_limits(self.config, self.mount.surface)

    @cached_property
    def requirements(self) -> tuple[Requirement, ...]:
        """What has to be seen near the vehicle; empty: nothing."""
        if self.parts.requirements is not None:
            return self.parts.requirements
        source = self.config.requirements
        if source == AUTO:
            is_robust = self.config.robust.asked_for is not None
            if self.parts.losses is not None or is_robust or not self.config.knows_requirements:
                return ()
            return tuple(replace(each, share=None) for each in read_requirements("near_field"))
        return () if source is None else read_requirements(source)

    @cached_property
    def test_points(self) -> RequiredPoints | None:
        """The requirements' test objects around the vehicle; None where nothing is required."""
        if not self.requirements:
            return None
        return RequiredPoints(self.requirements, self.ego, device=str(self.mount.device))

    @property
    def rules(self) -> PoolRules | None:
        """The design rules of a search by a pool; None: none."""
        cameras = single_cameras_of(self.objective) if self.config.keeps_rules else None
        return None if cameras is None else PoolRules(self.config.rules.limits, cameras, self.ego)

    @property
    def frozen_rig(self) -> Rig | None:
        """The rig of which some cameras are frozen: all rigs have their cameras in its order. None: none is."""
        return self.start_rig if self.parts.freeze else None

    @cached_property
    def yaw_rad(self) -> np.ndarray:
        """The orientation that each camera takes, unless its rig began otherwise [rad], [camera]."""
        orientation_rad = self.segregation.yaw_rad
        if self.frozen_rig is None:
            return orientation_rad
        from warpav.thesis import nearest_cameras

        return orientation_rad[np.argsort(nearest_cameras(orientation_rad, self.frozen_rig))]

    @property
    def starts_by_hand(self) -> bool:
        """Whether the search tries rigs by hand first, and begins with the best."""
        return self.config.rig.start == BY_HAND and self.parts.start is None

    @property
    def has_ordered_start(self) -> bool:
        """Whether the cameras of the rig that a run starts from are in the order of `yaw_rad`."""
        config = self.config
        is_random = self.start_rig is None and config.rig.start == "random"
        return is_random or config.optimiser.starts > 1

    def random_numbers(self, stream: Stream) -> np.random.Generator:
        """Random numbers for one purpose, from ``run.seed``."""
        return np.random.default_rng([self.config.run.seed, int(stream)])

    def assigned(self, scenes: list[AssignedScene], rig: Rig | None) -> list[AssignedScene]:
        """The scenes with vehicles assigned to the cameras of a rig."""
        if rig is None or len(rig.cameras) != len(self.segregation.yaw_rad):
            return scenes
        from warpav.thesis import assign_to_nearest_cameras

        return assign_to_nearest_cameras(scenes, self.segregation.yaw_rad, rig)

    def observed(self, scenes: Sequence[Scene], *, progress: Progress | None = None) -> list[AssignedScene]:
        """Other scenes as this placement sees them: around its vehicle, with its targets, assigned, on its device."""
        progress = progress or NullProgress()
        scenes = checked_scenes("scenes", scenes)
        self.prepare(progress)
        known = self._ready.scenes
        packed = []
        for scene in progress.steps("scenes", self.as_seen(scenes), count=len(scenes)):
            known.check_vehicle(scene)
            packed.append(DeviceScene.pack(scene, device=self.mount.device))
        areas = known.areas_of(packed, self.config.thesis.rotations)
        from warpav.thesis import cameras_of

        of_scene = [cameras_of(area[:, self.segregation.rotation]) for area in areas]
        return [AssignedScene(*each) for each in zip(packed, of_scene, strict=True)]

    def value_and_grad(
        self, rig: Rig, scenes: Sequence[Scene] | None = None
    ) -> tuple[float, dict[str, dict[str, float]]]:
        """The objective of a rig, and its gradient to the poses of the cameras on the mount surface.

        The objective is the weighted sum of the losses, without the constraints. Gradients flow through the boundaries
        of what the cameras see; what a frozen camera would gain is 0.

        Args:
            rig: As many cameras as the placement has, of its camera model, anywhere; of a symmetric placement a
                symmetric rig, whose pairs move together.
            scenes: Where to look; None: all training scenes.

        Returns:
            The objective; and by name of the camera the derivatives to ``x_m``, ``y_m`` [1/m] and ``yaw_rad``
            [1/rad], and to ``height_m``, ``pitch_rad`` and ``log_focal`` where these are free.

        Raises:
            InputError: The rig does not fit the placement.
        """
        found = self.objective.evaluate(
            self.mount_pose_of(rig), self._scenes_for(rig, scenes), gradient=True, with_constraints=False
        )
        assert found.gradient is not None
        rows = self.mount.rows_of_cameras(self.mount_pose_of(rig))
        images = [self.mount.is_symmetric and camera.position_m[1] < 0.0 for camera in rig.cameras]
        columns = {
            name: column
            for name, column in _DEGREES_OF_FREEDOM.items()
            if name in ("x_m", "y_m", "yaw_rad") or self.mount.is_free[column]
        }
        gradient = {
            camera.name: {
                name: float(found.gradient[row, column]) * (-1.0 if is_image and name in ("y_m", "yaw_rad") else 1.0)
                for name, column in columns.items()
            }
            for camera, row, is_image in zip(rig.cameras, rows, images, strict=True)
        }
        return found.objective, gradient

    def detection_probabilities(self, rig: Rig, scenes: Sequence[Scene] | None = None) -> np.ndarray:
        """The probability that each camera of a rig detects each object, by the model of detection probability.

        Args:
            rig: As in `value_and_grad`.
            scenes: Where to look; None: all training scenes.

        Returns:
            0..1, float [camera, object]; the objects scene by scene.

        Raises:
            InputError: The rig does not fit the placement, or the objective takes no part in detection probability.
        """
        found = self.objective.evaluate(
            self.mount_pose_of(rig), self._scenes_for(rig, scenes), detection_probability=True
        )
        if found.detection_probability is None:
            raise InputError("losses: expected a loss that knows detection probabilities, such as expected_miss_rate")
        return found.detection_probability

    def mount_pose_of(self, rig: Rig) -> np.ndarray:
        """The cameras of a rig as the placement's mount counts them, float32 [camera, 7]."""
        if not isinstance(rig, Rig):
            raise TypeError(f"rig: expected a Rig, got {type(rig).__name__}")
        least, most = self.config.rig.camera_range
        if not least <= len(rig.cameras) <= most:
            count = f"{least}" if least == most else f"{least} to {most}"
            raise ArgumentError("rig", f"expected {count} cameras as the placement has, got {len(rig.cameras)}")
        for camera in rig.cameras:
            if not self.mount.has_model(camera.model):
                expected = "modules of the placement" if self.mount.is_mixed else f"model {self.mount.camera}"
                raise ArgumentError("rig", f"expected cameras of the placement's {expected}, got {camera.model}")
        return self.mount.mount_pose_of_rig(rig)

    def add_camera_models(self, rig: Rig, progress: Progress | None = None) -> None:
        """Give the objective the models of detection probability of a rig's cameras, so that it judges them too.

        Where it needs none, or does not follow from single cameras, nothing happens.
        """
        objective, parts = self.objective, self.parts
        if not objective.is_by_single_cameras or parts.probability is not None:
            return
        progress = progress or NullProgress()
        for model in dict.fromkeys(camera.model for camera in rig.cameras):
            if objective.probability_of(model) is None:
                fit = ensure_fit(self.config, detector=parts.detector, ego=parts.ego, camera=model, progress=progress)
                probability = CameraProbability.of(self.config.losses, fit)
                assert probability is not None
                objective.add_camera_model(model, probability)

    def _scenes_for(self, rig: Rig, scenes: Sequence[Scene] | None) -> list[AssignedScene]:
        return self.assigned(self.train if scenes is None else self.observed(scenes), rig)

    def _repr_html_(self) -> str:
        return f"<b>Placement</b>: {repr(self).removeprefix('Placement(').removesuffix(')')}"

    def __repr__(self) -> str:
        config = self.config
        scenes = "own" if self.parts.has_own_scenes else config.scenes.source
        detector = config.detector.model if self.parts.detector is None else "own"
        cameras = (
            f"{config.rig.cameras} cameras of {config.camera.fov_deg:g} deg, {config.camera.width_px} x "
            f"{config.camera.height_px} px"
        )
        if config.rig.modules is not None:
            each = (f"{range_text(pair)} {name}" for name, pair in config.rig.modules.items())
            cameras = f"{range_text(config.rig.camera_range)} cameras ({', '.join(each)})"
        return f"Placement({cameras}, {scenes} scenes, detector {detector}, {config.device})"


def placement_on(
    scenes: SceneSet, config: Config, networks: Networks, probability: _DetectionProbabilities | None
) -> Placement:
    """A placement on scenes that are on the device already."""
    placement = Placement._of(config, _Parts(read_start(config), config.rig.freeze, probability=probability))
    placement._prepared = _assembled(placement, scenes, networks, probability)
    return placement


def needed_fit(config: Config, progress: Progress) -> _DetectionProbabilities | None:
    """What `ensure_fit` gives, where the losses of a configuration need it; else None."""
    return _fitted(config, progress) if _needs_fit(config) else None


def _fitted(
    config: Config, progress: Progress, *, detector: Detector | None = None, ego: Mesh | None = None
) -> _DetectionProbabilities:
    if config.rig.modules is None:
        return ensure_fit(config, detector=detector, ego=ego, progress=progress)
    config = fit_config(config, progress)  # once for all modules
    return tuple(
        ensure_fit(config, detector=detector, ego=ego, progress=progress, camera=model)
        if model.beams is None
        else LidarProbability(model.beams)
        for model in camera_models(config)
    )


def _needs_fit(config: Config, losses: Sequence[tuple[float, Loss]] | None = None) -> bool:
    if losses is None:
        return config.losses.weights["expected_miss_rate"] > 0.0
    return any(loss.needs(LossSchedule()).detection_probability for _, loss in losses)


def _checked_start(config: Config, start: Rig | None, freeze: tuple[str, ...]) -> Rig | None:
    """The rig to start from, that of an argument or of the configuration, whose cameras ``freeze`` names."""
    if start is None:
        start = read_start(config, freeze)
    else:
        count = len(with_added_cameras(start, config, freeze).cameras)
        if not config.rig.camera_range[0] <= count <= config.rig.cameras:
            may_add = count < config.rig.cameras and config.rig.modules is None
            hint = "; name in `freeze` those that stay, and others are added" if may_add else ""
            raise ArgumentError(
                "start", f"expected a rig of {config.rig.cameras} cameras, as `cameras` says, got {count}{hint}"
            )
    if freeze and start is None:
        raise ArgumentError("freeze", f"expected a rig as `start` that has the cameras, got {', '.join(freeze)}")
    if start is not None and freeze:
        if len(freeze) >= config.rig.cameras:
            raise ArgumentError("freeze", f"expected fewer than all {config.rig.cameras} cameras")
        checked_frozen(config, start, freeze)
    return start


def _checked_requirements(requirements: Sequence[Requirement], config: Config) -> tuple[Requirement, ...]:
    found = tuple(requirements)
    for each in found:
        if not isinstance(each, Requirement):
            raise TypeError(f"requirements: expected what read_requirements gives, got {type(each).__name__}")
    if found and not config.knows_requirements:
        raise ArgumentError("requirements", f"expected none: {NO_REQUIREMENTS}")
    return found


def _have_one_objective(one: Config, other: Config) -> bool:
    """Whether two configurations differ in nothing but how the optimiser steps, or what a search by a pool adds."""
    dampings = [{each.optimiser.damping(are_inequalities=flag) for flag in (True, False)} for each in (one, other)]
    steps = {"run": other.run, "optimiser": other.optimiser, "robust": other.robust, "rules": other.rules}
    steps |= {"requirements": other.requirements}
    return one.run.seed == other.run.seed and dampings[0] == dampings[1] and one.model_copy(update=steps) == other


def _assembled(
    placement: Placement, scenes: SceneSet, networks: Networks, probability: _DetectionProbabilities | None
) -> _Prepared:
    """The objective, and the vehicles of all scenes assigned to orientations, which happens where somebody asks."""
    config, parts, start = placement.config, placement.parts, placement.start_rig
    rotation_count, train_count = config.thesis.rotations, len(scenes.train)

    @cache
    def segregation() -> Segregation:
        looked_at = scenes.train[:: -(-train_count // _ORIENTATION_SCENES)]
        rng = placement.random_numbers(Stream.SEGREGATION)
        from warpav.thesis import choose_orientations

        return choose_orientations(scenes.areas(looked_at, rotation_count), camera_count, rotation_count, rng)

    def assigned_camera(scene: DeviceScene) -> np.ndarray:
        from warpav.thesis import cameras_of

        return cameras_of(scenes.areas([scene], rotation_count)[0][:, segregation().rotation])

    assigned = [AssignedScene(scene, partial(assigned_camera, scene)) for scene in scenes.scenes]
    mount = scenes.mount
    if start is not None and parts.freeze:
        mount = mount.freezing(checked_frozen(config, start, parts.freeze), parts.freeze)
    constraints = constraints_of(config, mount.surface, mount.frozen)
    camera_count = config.rig.cameras if constraints.module is None else len(constraints.module)
    importance = Importance.of(config.importance)
    if importance is not None:
        importance.check(scenes.scenes)
    reference = Reference.NON_OCCLUDED if config.method == "thesis" else Reference.ALONE
    options = LossOptions(config.losses, reference, networks.differentiable)
    objective = RigObjective(
        mount,
        networks.detector,
        camera_count=camera_count,
        losses=losses_of(options) if parts.losses is None else parts.losses,
        camera_probability=_camera_probabilities(config, probability, mount.surface.modules),
        constraints=constraints,
        importance=importance,
        options=objective_options(config),
    )
    train, others = assigned[:train_count], assigned[train_count:]
    validation_count = len(scenes.validation)
    held = others[:validation_count] or train, others[validation_count:]
    return _Prepared(scenes, networks, probability, objective, segregation, train, *held)


def _camera_probabilities(
    config: Config, probability: _DetectionProbabilities | None, modules: Sequence[str]
) -> ObjectProbability | list[ObjectProbability] | None:
    """How likely a camera is to detect, of a mount's modules each; one model stands for all of these."""
    models = probability if isinstance(probability, tuple) else (probability,)
    found = [
        replace(model, curve=config.lidar.curve)
        if isinstance(model, LidarProbability)
        else CameraProbability.of(config.losses, model)
        for model in models
    ]
    counts = config.rig.module_counts
    if counts is None or found == [None]:
        return found[0]
    of_module = dict(zip(counts, found * (len(counts) // len(found)), strict=True))
    return [each for name in modules if (each := of_module[name]) is not None]


def _checked_losses(losses: Sequence[tuple[float, Loss | LossFunction]]) -> tuple[tuple[float, Loss], ...]:
    found = []
    for each in losses:
        if (
            not isinstance(each, tuple)
            or len(each) != 2
            or isinstance(each[0], bool)
            or not isinstance(each[0], (int, float))
        ):
            raise TypeError(f"losses: expected pairs of a weight and a loss, such as (0.1, my_loss), got {each!r}")
        found.append((float(each[0]), each[1] if isinstance(each[1], Loss) else UserLoss.of(each[1])))
    return tuple(found)


def _named(source: object) -> str | None:
    """A path or a name as files have it; None for an object."""
    return str(source) if isinstance(source, (str, Path)) else None


def _section(settings: Section | Mapping[str, Any] | None) -> dict[str, Any] | None:
    """The settings of a section that are given, as they are written in files."""
    if isinstance(settings, Section):
        return settings.model_dump(mode="json", exclude_unset=True)
    return None if settings is None else dict(settings)
