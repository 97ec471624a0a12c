"""What rigs are measured against: scenes whose vehicles are shared among the cameras, a mount surface, an objective.

Loading takes two steps, so that runs that differ in nothing but seeds, losses and steps load their scenes once:
`load_traffic` gives what depends on none of these, `problem_on` the rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np

from warpav.core.errors import InputError, OptionError
from warpav.detection.differentiable import DifferentiableDetector
from warpav.detection.probability import DetectionProbability, stored_file
from warpav.evaluation.metrics import assign_to_nearest_cameras, nearest_cameras
from warpav.optimisation.baselines import highest_mount_pose, random_mount_pose
from warpav.optimisation.gradient import Descent, OptimiserSettings
from warpav.optimisation.losses import LossSettings, Reference
from warpav.optimisation.mount import CameraMount
from warpav.optimisation.objective import AssignedScene, RigObjective
from warpav.optimisation.search import SearchSpace
from warpav.optimisation.segregation import Segregation, areas_around, assign_vehicles, choose_orientations
from warpav.optimisation.starts import look_at_starts
from warpav.raster.decide import Occlusion
from warpav.raster.mesh import Mesh
from warpav.rig.rig import Rig
from warpav.runs.config import NAMED_STARTS, Config, RigConfig, RunConfig, changed_config
from warpav.runs.detector_fit import fit_detector
from warpav.runs.sources import (
    camera_model,
    camera_mount,
    checked_device,
    checked_held,
    constraints_of,
    detector_use,
    find_file_rig,
    load_detector,
    load_scenes,
)
from warpav.scene.device_scene import DeviceScene
from warpav.scene.scene import ROAD_USERS, Scene

if TYPE_CHECKING:
    from warpav.detection.onnx_detector import OnnxDetector
    from warpav.runs.progress import RunDisplay

LEAST_FIT_SCENES = 20
"""Training scenes of the user's own on which p(detected) can be fitted and judged."""

EGO_TOLERANCE_M = 0.2
"""Ego vehicles that were reconstructed from images of different scenes differ by less."""


class Stream(IntEnum):
    """Purposes of random numbers: one more draw for one of them moves nothing for the others."""

    SEGREGATION = 0
    START = 1
    BATCHES = 2
    SEARCH = 3
    STARTS = 4


@dataclass(frozen=True, eq=False)
class Traffic:
    """Scenes on the device, and the vehicle that carries the cameras.

    Attributes:
        train: Training scenes; with ``scenes.mirror`` their mirror images after them.
        validation: Scenes on which the rigs of a run are compared; maybe none.
        test: Test scenes.
        mount: Where the cameras may stand, and their model.
        ego: The vehicle that carries them.
        shown: The first test scene, for pictures.
    """

    train: list[DeviceScene]
    validation: list[DeviceScene]
    test: list[DeviceScene]
    mount: CameraMount
    ego: Mesh
    shown: Scene
    _areas: dict[int, list[np.ndarray]] = field(default_factory=dict, repr=False)

    @property
    def scenes(self) -> list[DeviceScene]:
        """All scenes: those of training, of validation, of the test."""
        return [*self.train, *self.validation, *self.test]

    def with_cameras(self, config: Config) -> Traffic:
        """The same scenes with other cameras, on another mount surface; nothing is loaded."""
        return replace(self, mount=camera_mount(config, self.ego), _areas={})

    def areas(self, rotation_count: int) -> list[np.ndarray]:
        """Area of every vehicle alone in directions all round [px^2], seen from the middle of the ego vehicle.

        Args:
            rotation_count: Number of directions, evenly spread from yaw 0.

        Returns:
            One [vehicle, rotation] for each of `scenes`; rendered when first asked for.
        """
        if rotation_count not in self._areas:
            self._areas[rotation_count] = areas_around(
                self.scenes,
                np.arange(rotation_count) * (2.0 * math.pi / rotation_count),
                np.append(self.ego.bounds_m()[:, :2].mean(axis=0), 0.0),
                self.mount.camera,
                device=self.mount.device,
            )
        return self._areas[rotation_count]


@dataclass(frozen=True)
class Problem:
    """Everything that a rig is measured against.

    Attributes:
        config: The configuration.
        objective: The training objective; it knows the mount surface and the detector.
        segregation: Orientations that share the vehicles among the cameras.
        train: Training scenes, each vehicle assigned to an orientation.
        validation: Scenes on which the rigs of a run are compared, likewise; the training scenes if there are none.
        test: Test scenes, likewise.
        ego: The vehicle that carries the cameras.
        shown: The first test scene, for pictures.
        held_rig: The rig of ``rig.start`` where ``rig.freeze`` holds some of its cameras: all rigs have their cameras
            in its order. None where none is held.
    """

    config: Config
    objective: RigObjective
    segregation: Segregation
    train: list[AssignedScene]
    validation: list[AssignedScene]
    test: list[AssignedScene]
    ego: Mesh
    shown: Scene
    held_rig: Rig | None = None

    @property
    def yaw_rad(self) -> np.ndarray:
        """The orientation that each camera takes, unless its rig began otherwise [rad], [camera]."""
        orientation_rad = self.segregation.yaw_rad
        if self.held_rig is None:
            return orientation_rad
        return orientation_rad[np.argsort(nearest_cameras(orientation_rad, self.held_rig))]

    def random_numbers(self, stream: Stream) -> np.random.Generator:
        """Random numbers for one purpose, from ``run.seed``."""
        return _random_numbers(self.config, stream)

    def assigned(self, scenes: list[AssignedScene], rig: Rig | None) -> list[AssignedScene]:
        """The scenes with vehicles assigned to the cameras of a rig.

        Args:
            scenes: Some of the problem's scenes.
            rig: Its cameras are paired with the orientations by their directions; None pairs camera k with
                orientation k. A rig keeps the pairs it began with, so for one that has moved this is its start.
        """
        if rig is None or len(rig.cameras) != len(self.segregation.yaw_rad):
            return scenes
        return assign_to_nearest_cameras(scenes, self.segregation.yaw_rad, rig)


def load_problem(config: Config, display: RunDisplay) -> Problem:
    """Load the detector, build or read the scenes, and share their vehicles among the cameras.

    Raises:
        InputError: The device, the detector or a scene cannot be used.
    """
    networks = load_networks(config)
    traffic = load_traffic(config, display)
    probability = load_probability(config, display)
    display.stage("sharing the vehicles among the cameras")
    return problem_on(traffic, config, networks, probability)


def traffic_part(config: Config) -> Config:
    """The configuration with nothing but what `load_traffic` looks at; the traffic of equal parts is the same."""
    return Config(
        run=RunConfig(batch_size=1),
        device=config.device,
        scenes=config.scenes,
        capture=config.capture,
        reconstruction=config.reconstruction,
        rig=RigConfig(height_offset_m=config.rig.height_offset_m, free=config.rig.free),
        camera=config.camera,
        mount=config.mount,
    )


def same_scenes(one: Config, other: Config) -> bool:
    """Whether two configurations have the same scenes on the same device; cameras and mount surface may differ."""
    parts = [(each.device, each.scenes, each.capture, each.reconstruction) for each in (one, other)]
    return parts[0] == parts[1]


def load_traffic(config: Config, display: RunDisplay) -> Traffic:
    """Build or read the scenes, and find where cameras may stand.

    Raises:
        InputError: The device or a scene cannot be used.
    """
    config = traffic_part(config)
    device = checked_device(config.device)
    train_count = len(config.scenes.train_seeds)
    test_from = train_count + len(config.scenes.validation_seeds or ())
    seeds = (*config.scenes.train_seeds, *(config.scenes.validation_seeds or ()), *config.scenes.test_seeds)
    packed: list[DeviceScene] = []
    mirrored: list[DeviceScene] = []
    ego = shown = None
    for k, scene in enumerate(display.steps("scenes", load_scenes(config, seeds, say=display.say), count=len(seeds))):
        ego = scene.ego if ego is None else ego
        if not _is_same_vehicle(scene.ego, ego):
            raise InputError(f"{scene.name}: ego: expected the same vehicle as in the first scene, got another")
        shown = scene if k == test_from else shown
        packed.append(DeviceScene.pack(scene, device=device))
        if config.scenes.mirror and k < train_count:
            mirrored.append(DeviceScene.pack(scene.mirrored(), device=device))
    assert ego is not None
    assert shown is not None
    _check_targets(config.scenes.targets, packed, display)
    return Traffic(
        packed[:train_count] + mirrored,
        packed[train_count:test_from],
        packed[test_from:],
        camera_mount(config, ego),
        ego,
        shown,
    )


@dataclass(frozen=True, eq=False)
class Networks:
    """The detector, and what losses need of it.

    Attributes:
        detector: The detector.
        differentiable: The same network, differentiable; None where no loss needs it.
    """

    detector: OnnxDetector
    differentiable: DifferentiableDetector | None


def load_networks(config: Config) -> Networks:
    """Load the detector, differentiable as well where the losses of the configuration need it.

    Raises:
        InputError: The device or the detector cannot be used.
    """
    device = checked_device(config.device)
    detector = load_detector(config)
    differentiable = None
    if config.losses.detector_gradient > 0.0:
        differentiable = DifferentiableDetector.of(detector, camera_model(config), device=device)
    return Networks(detector, differentiable)


def load_probability(config: Config, display: RunDisplay) -> DetectionProbability | None:
    """The model of detection probability, where the losses need one; fitted now if there is none yet.

    It is that of the configured detector and its surroundings. Where there are too few scenes of the user's own to fit
    it on, the embedded ones stand for them.

    Raises:
        InputError: It cannot be fitted or read, or was fitted on scenes that the result is judged by.
    """
    if config.losses.missed == 0.0:
        return None
    scene_count = len(config.scenes.train_seeds)
    if config.scenes.source != "town" and scene_count < LEAST_FIT_SCENES:
        display.say(
            f"p(detected) is that of the embedded scenes: to fit it on others takes {LEAST_FIT_SCENES}, "
            f"scenes.train_seeds has {scene_count}"
        )
        config = changed_config(config, ["scenes.source=town", "scenes.folder=null"])
    use = detector_use(config)
    if stored_file(use) is None:
        display.say("p(detected) has not been fitted for this detector and camera yet; that is done once, now")
        fit_detector(
            config,
            words=["warpav", "detector", "fit"],
            fit_seeds=None,
            held_out_seeds=None,
            out=None,
            again=False,
            display=display,
        )
    return DetectionProbability.find(use, unseen=config.scenes.test_seeds)


def problem_on(
    traffic: Traffic, config: Config, networks: Networks, probability: DetectionProbability | None
) -> Problem:
    """What rigs are measured against, on scenes that are there already.

    Args:
        traffic: Of `load_traffic`, from this configuration or from one with the same `traffic_part`.
        config: The configuration.
        networks: Of `load_networks`, from this configuration.
        probability: Of `load_probability`, likewise.
    """
    areas = traffic.areas(config.segregation.rotations)
    train_count = len(traffic.train)
    segregation = choose_orientations(
        areas[:train_count],
        config.rig.cameras,
        config.segregation.rotations,
        _random_numbers(config, Stream.SEGREGATION),
    )
    assigned = assign_vehicles(traffic.scenes, [area[:, segregation.rotation] for area in areas])
    mount, held_rig = traffic.mount, read_start(config) if config.rig.freeze else None
    if held_rig is not None:
        mount = mount.holding(checked_held(config, held_rig), config.rig.freeze)
    objective = RigObjective(
        mount,
        networks.detector,
        camera_count=config.rig.cameras,
        settings=LossSettings(
            in_frame_rotation=config.losses.in_frame_rotation,
            detected_area=config.losses.detected_area,
            surface_blockage=config.losses.surface_blockage,
            object_visibility=config.losses.object_visibility,
            angular_coverage=config.losses.angular_coverage,
            missed=config.losses.missed,
            detector_gradient=config.losses.detector_gradient,
            min_detected_area=config.losses.min_detected_area,
            min_unblocked_area=config.losses.min_unblocked_area,
            reference=Reference.NON_OCCLUDED if config.method == "thesis" else Reference.ALONE,
            epsilon=config.losses.epsilon,
            multiplier_damping=_multiplier_settings(config)[1],
            window_softness_rad=math.radians(config.losses.window_softness_deg),
            detector_share=config.losses.detector_share,
            combine=config.losses.combine,
            probability=config.losses.probability,
        ),
        constraints=constraints_of(config, mount.surface, mount.held),
        confidence_min=config.detector.confidence_min,
        iou_min=config.detector.iou_min,
        occlusion=Occlusion(config.visibility.occlusion),
        supersampling=config.camera.supersampling,
        probability=probability,
        differentiable_detector=networks.differentiable,
    )
    train, held_out = assigned[:train_count], assigned[train_count:]
    validation_count = len(traffic.validation)
    validation, test = held_out[:validation_count] or train, held_out[validation_count:]
    return Problem(config, objective, segregation, train, validation, test, traffic.ego, traffic.shown, held_rig)


@dataclass(frozen=True)
class Beginning:
    """Where a descent begins.

    Attributes:
        descent: Before its first step.
        rig: The rig whose cameras the orientations are paired with; None when camera k takes orientation k. See
            `Problem.assigned`.
    """

    descent: Descent
    rig: Rig | None


def begin_descent(problem: Problem, start_rig: Rig | None = None) -> Beginning:
    """A descent on the training scenes, with the steps of the configuration.

    It starts from the rig that ``rig.start`` means, or from the best of ``optimiser.starts`` rigs on the validation
    scenes, that one among them; with ``optimiser.descents`` from the second best after that, and so on.

    Args:
        problem: What to lower.
        start_rig: The rig of the file that ``rig.start`` names, see `read_start`.

    Raises:
        InputError: The cameras do not fit on the mount surface.
    """
    config, mount = problem.config, problem.objective.mount
    start = start_pose(problem, start_rig)
    if has_ordered_start(config):
        further: list[np.ndarray] = []
        rig = problem.held_rig
        if config.optimiser.starts > 1:
            space = SearchSpace.over(
                mount,
                config.rig.cameras,
                constraints=problem.objective.constraints,
                yaw_rad=problem.yaw_rad,
            )
            rng = problem.random_numbers(Stream.STARTS)
            found = look_at_starts(
                problem.objective, problem.validation, space, config.optimiser.starts, rng, known=start
            )
            # those without a finite value are no starts; then some are taken twice
            start, *further = [found[k % len(found)].mount_pose for k in range(config.optimiser.descents)]
    else:
        further, rig = [], mount.rig(start)
    return Beginning(descent_from(problem, start, rig, further_starts=further), rig)


def has_ordered_start(config: Config) -> bool:
    """Whether the cameras of the rig that a run starts from are in the order of `Problem.yaw_rad`."""
    return config.rig.start == "random" or config.optimiser.starts > 1


def descent_from(
    problem: Problem, start: np.ndarray, began_as: Rig | None, *, further_starts: Sequence[np.ndarray] = ()
) -> Descent:
    """A descent on the training scenes from a rig.

    Args:
        problem: What to lower.
        start: Its mount poses, float32 [camera, 7].
        began_as: Whose cameras take the orientations, see `Problem.assigned`.
        further_starts: Where it begins again, see `Descent`.
    """
    return Descent(
        problem.objective,
        problem.assigned(problem.train, began_as),
        optimiser_settings(problem.config),
        start,
        problem.random_numbers(Stream.BATCHES),
        validation=problem.assigned(problem.validation, began_as),
        further_starts=further_starts,
    )


def read_start(config: Config) -> Rig | None:
    """The rig that ``rig.start`` names; None where it names none.

    Raises:
        InputError: It cannot be read, has another number of cameras than ``rig.cameras``, or cameras of ``rig.freeze``
            that cannot be held.
    """
    if config.rig.start in NAMED_STARTS:
        return None
    rig = find_file_rig(config.rig.start)
    if len(rig.cameras) != config.rig.cameras:
        raise InputError(
            f"{config.rig.start}: cameras: expected {config.rig.cameras} as rig.cameras says, got {len(rig.cameras)}; "
            f"set rig.cameras={len(rig.cameras)}"
        )
    checked_held(config, rig)
    return rig


def start_pose(problem: Problem, rig: Rig | None) -> np.ndarray:
    """Mount poses that the optimiser starts from: those of ``rig``, or as ``rig.start`` says.

    Returns:
        float32 [camera, 7], the precision that the optimiser keeps: a start that stays the best is the same rig.

    Raises:
        InputError: The cameras do not fit on the mount surface.
        ValueError: ``rig.start`` names a file and ``rig`` is None.
    """
    config, constraints = problem.config, problem.objective.constraints
    if rig is not None:
        return problem.objective.mount.start_pose_of_rig(rig)
    if config.rig.start not in NAMED_STARTS:
        raise ValueError(f"the rig of {config.rig.start} has to be read first, see read_start")
    if config.rig.start == "highest":
        pose = highest_mount_pose(constraints, config.rig.cameras)
    else:
        pose = random_mount_pose(constraints, problem.segregation.yaw_rad, rng=problem.random_numbers(Stream.START))
    return pose.astype(np.float32)


def _multiplier_settings(config: Config) -> tuple[float, float]:
    """Step and damping of the multipliers, the method's own where the configuration gives none."""
    step, damping = (0.25, 0.0) if config.method == "thesis" else (1.0, 10.0)
    optimiser = config.optimiser
    return (
        step if optimiser.multiplier_learning_rate is None else optimiser.multiplier_learning_rate,
        damping if optimiser.multiplier_damping is None else optimiser.multiplier_damping,
    )


def optimiser_settings(config: Config) -> OptimiserSettings:
    """The optimiser's settings, angles in radians."""
    optimiser = config.optimiser
    return OptimiserSettings(
        iterations=config.run.iterations,
        batch_size=config.run.batch_size,
        learning_rate_position_m=optimiser.learning_rate_position_m,
        learning_rate_yaw_rad=math.radians(optimiser.learning_rate_yaw_deg),
        learning_rate_pitch_rad=math.radians(optimiser.learning_rate_pitch_deg),
        learning_rate_height_m=optimiser.learning_rate_height_m,
        learning_rate_zoom=optimiser.learning_rate_zoom,
        schedule=optimiser.schedule,
        weight_decay=optimiser.weight_decay,
        multiplier_learning_rate=_multiplier_settings(config)[0],
        multiplier_weight_decay=optimiser.multiplier_weight_decay,
        keep=optimiser.keep,
        check_every=optimiser.check_every,
        panorama_until=optimiser.panorama_until,
        detector_from=optimiser.detector_from,
        patience=optimiser.patience,
        starts=optimiser.starts,
        descents=optimiser.descents,
    )


def _random_numbers(config: Config, stream: Stream) -> np.random.Generator:
    return np.random.default_rng([config.run.seed, int(stream)])


def _check_targets(targets: Sequence[str], scenes: Sequence[DeviceScene], display: RunDisplay) -> None:
    """Say which targets no scene holds.

    Raises:
        InputError: None of them is in any scene.
    """
    there = {ROAD_USERS[kind] for scene in scenes for kind in scene.road_user_index}
    absent = [target for target in targets if target not in there]
    if not absent:
        return
    text = f"no {' and no '.join(absent)} in any of the {len(scenes)} scenes"
    hint = "" if "vehicle" in absent else "; scenes made from images hold people as parts of the environment"
    if not there:
        raise OptionError("scenes.targets", f"expected road users that the scenes hold, got {text}{hint}")
    display.say(f"scenes.targets: {text}, so nothing is optimised or judged for them{hint}")


def _is_same_vehicle(one: Mesh, other: Mesh) -> bool:
    """Whether two meshes may show the same vehicle; how low they reach is left out.

    How much of its sides images show above the ground differs from scene to scene, by half a metre and more.
    """
    difference_m = np.abs(one.bounds_m() - other.bounds_m())
    difference_m[0, 2] = 0.0
    return bool(difference_m.max() <= EGO_TOLERANCE_M)
