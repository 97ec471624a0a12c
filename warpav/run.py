"""The main job: a configuration becomes an optimised rig beside its baselines, in a run folder."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.config import Config
from warpav.console import show_verdict
from warpav.detection.differentiable import DifferentiableDetector
from warpav.detection.probability import DetectionProbability, stored_file
from warpav.detector_fit import fit_detector
from warpav.errors import InputError, OptionError
from warpav.evaluate import ArmMetrics, assign_to_nearest_cameras, evaluate_rig
from warpav.experiment.statistics import paired_differences
from warpav.gallery import draw_run
from warpav.geometry.mesh import Mesh
from warpav.objective.losses import LossSettings, Reference
from warpav.objective.mount import mount_pose_of_rig
from warpav.objective.objective import AssignedScene, ThesisObjective
from warpav.optimise.baselines import highest_mount_pose, random_mount_pose
from warpav.optimise.gradient import Descent, OptimiserSettings
from warpav.optimise.rivals import random_search
from warpav.optimise.search import BudgetedValue, SearchSpace, run_search
from warpav.optimise.segregation import Segregation, assign_vehicles, segregate
from warpav.render.device_scene import DeviceScene
from warpav.render.renderer import Occlusion
from warpav.report import write_report
from warpav.results import EVALUATION_SCHEMA, RunFolder, check_new_run, write_json
from warpav.rig.rig import Rig, read_rig
from warpav.scene.scene import ROAD_USERS, Scene
from warpav.sources import (
    arm_name,
    camera_model,
    camera_mount,
    check_rig_source,
    checked_device,
    constraints_of,
    detector_use,
    device_name,
    find_rig,
    load_detector,
    load_scenes,
)

if TYPE_CHECKING:
    from warpav.console import RunDisplay

# streams of random numbers: one more draw in one place moves nothing elsewhere
EGO_TOLERANCE_M = 0.2
"""Ego vehicles that were reconstructed from images of different scenes differ by less."""
_SEGREGATION, _START, _BATCHES, _RANDOM_ARM = range(4)


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
    """

    config: Config
    objective: ThesisObjective
    segregation: Segregation
    train: list[AssignedScene]
    validation: list[AssignedScene]
    test: list[AssignedScene]
    ego: Mesh
    shown: Scene

    def random_numbers(self, stream: int) -> np.random.Generator:
        """Random numbers for one purpose, from ``run.seed``."""
        return np.random.default_rng([self.config.run.seed, stream])

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
    device = checked_device(config.device)
    detector = load_detector(config)
    differentiable = None
    if config.losses.detector_gradient > 0.0:
        differentiable = DifferentiableDetector.of(detector, camera_model(config), device=device)
    probability = load_probability(config, display) if config.losses.missed > 0.0 else None
    train_count, validation_seeds = len(config.scenes.train_seeds), config.scenes.validation_seeds or ()
    seeds = (*config.scenes.train_seeds, *validation_seeds, *config.scenes.test_seeds)
    packed: list[DeviceScene] = []
    mirrored: list[DeviceScene] = []
    ego = shown = None
    for k, scene in enumerate(display.steps("scenes", load_scenes(config, seeds), count=len(seeds))):
        ego = scene.ego if ego is None else ego
        if not _is_same_vehicle(scene.ego, ego):
            raise InputError(f"{scene.name}: ego: expected the same vehicle as in the first scene, got another")
        shown = scene if k == train_count + len(validation_seeds) else shown
        packed.append(DeviceScene.pack(scene, device=device))
        if config.scenes.mirror and k < train_count:
            mirrored.append(DeviceScene.pack(scene.mirrored(), device=device))
    packed[train_count:train_count] = mirrored
    train_count += len(mirrored)
    assert ego is not None
    assert shown is not None
    _check_targets(config.scenes.targets, packed, display)
    display.stage("sharing the vehicles among the cameras")
    mount = camera_mount(config, ego)
    middle_m = np.append(ego.bounds_m()[:, :2].mean(axis=0), 0.0)
    segregation = segregate(
        packed[:train_count],
        camera=mount.camera,
        camera_count=config.rig.cameras,
        rotation_count=config.segregation.rotations,
        viewpoint_ego_m=middle_m,
        rng=np.random.default_rng([config.run.seed, _SEGREGATION]),
        device=device,
    )
    assigned = assign_vehicles(packed, segregation, camera=mount.camera, viewpoint_ego_m=middle_m, device=device)
    objective = ThesisObjective(
        mount,
        detector,
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
        ),
        constraints=constraints_of(config, mount.surface),
        confidence_min=config.detector.confidence_min,
        iou_min=config.detector.iou_min,
        occlusion=Occlusion(config.visibility.occlusion),
        supersampling=config.camera.supersampling,
        probability=probability,
        differentiable_detector=differentiable,
    )
    train, held_out = assigned[:train_count], assigned[train_count:]
    validation, test = held_out[: len(validation_seeds)], held_out[len(validation_seeds) :]
    return Problem(config, objective, segregation, train, validation or train, test, ego, shown)


def load_probability(config: Config, display: RunDisplay) -> DetectionProbability:
    """The model of detection probability of the configured detector and its surroundings; fitted now if there is none.

    Raises:
        InputError: It cannot be fitted or read, or was fitted on scenes that the result is judged by.
    """
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


def optimise_rig(config: Config, *, name: str, display: RunDisplay) -> RunFolder:
    """Optimise a rig, compare it with baselines on the test scenes, and leave a run folder.

    Args:
        config: What to do.
        name: Name of the run when ``run.out`` gives none.
        display: Where to show it.

    Returns:
        The run folder.

    Raises:
        InputError: Something in the input is wrong.
        KeyboardInterrupt: The user stopped the run; the run folder, if there is one already, is usable.
    """
    began = time.perf_counter()
    check_new_run(config)
    start_rig = None if config.rig.start in ("random", "highest") else read_start(config)
    problem = load_problem(config, display)
    mount = problem.objective.mount
    start = start_pose(problem, start_rig)
    began_as = None if config.rig.start == "random" else mount.rig(start)
    descent = Descent(
        problem.objective,
        problem.assigned(problem.train, began_as),
        optimiser_settings(config),
        start,
        problem.random_numbers(_BATCHES),
        validation=problem.assigned(problem.validation, began_as),
    )

    folder = RunFolder.create(config, name=name, device=device_name(config.device))
    display.say(f"run folder: {folder.path}")
    folder.write_rig("initial", mount.rig(start))
    try:
        descend(descent, folder, display)
        result = descent.finish()
        folder.write_rig("best", mount.rig(descent.best.mount_pose))
        folder.write_rig("final", mount.rig(descent.candidates[-1].mount_pose))

        arms = compare(problem, {"optimised": result.mount_pose, "start": start}, began_as, display)
        evaluation = {
            **evaluation_of(arms),
            "training_objective": {
                "start": descent.candidates[0].training_objective,
                "optimised": result.training_objective,
            },
            "seconds": {"total": time.perf_counter() - began},
        }
        folder.write_evaluation(evaluation)
        display.stage("figures and report")
        draw_run(
            folder,
            {"start": mount.rig(start), "optimised": mount.rig(result.mount_pose)},
            objective=problem.objective,
            scene=problem.shown,
            assigned=problem.test[0],
            say=display.say,
        )
        report = write_report(folder)
        show_verdict(display.console, evaluation)
        display.say(f"report: {report}   took {time.perf_counter() - began:.0f} s")
    except KeyboardInterrupt:
        display.say(f"stopped; what was reached is in {folder.path}, for warpav evaluate, inspect and report")
        raise
    return folder


def descend(descent: Descent, folder: RunFolder, display: RunDisplay) -> None:
    """Take all steps, each shown and written before the next."""
    config = folder.config()
    mount = descent.objective.mount
    steps = (descent.step() for _ in range(config.run.iterations))
    for record in display.iterations(steps, count=config.run.iterations, min_spacing_m=config.rig.min_spacing_m):
        state = descent.state()
        folder.append_event(record)
        folder.write_checkpoint(state)
        folder.write_rig("final", mount.rig(state["pose_value"]))
        if record.training_objective is not None:
            folder.write_rig("best", mount.rig(descent.best.mount_pose))


def compare(
    problem: Problem, mount_poses: Mapping[str, np.ndarray], began_as: Rig | None, display: RunDisplay
) -> dict[str, ArmMetrics]:
    """Metrics on the test scenes of some rigs on the mount surface, of the highest point, and of the best random rig.

    Args:
        problem: What to measure against.
        mount_poses: Mount poses by the name of the arm, [camera, 5].
        began_as: The rig that these began as; None when camera k took orientation k.
        display: Where to show it.
    """
    config, mount = problem.config, problem.objective.mount
    constraints = problem.objective.constraints
    highest = highest_mount_pose(constraints, config.rig.cameras)
    samples, rng = config.baselines.random_samples, problem.random_numbers(_RANDOM_ARM)
    chosen = rng.choice(len(problem.train), min(config.baselines.random_scenes, len(problem.train)), replace=False)
    display.stage(f"best of {samples} random rigs on {len(chosen)} training scenes")
    space = SearchSpace.over(
        mount,
        config.rig.cameras,
        constraints=constraints,
        yaw_rad=problem.segregation.yaw_rad,
        yaw_reach_rad=0.0,
    )
    scenes = [problem.train[k] for k in chosen]
    value = BudgetedValue.of(problem.objective, scenes, space, render_budget=samples * len(scenes))
    found = run_search(random_search, value, rng)
    poses = {**mount_poses, "highest": highest, "random": found.mount_pose}
    beginnings = {**dict.fromkeys(mount_poses, began_as), "highest": mount.rig(highest), "random": None}
    arms = {}
    for arm, pose in display.steps("comparing", poses.items(), count=len(poses)):
        arms[arm] = evaluate_rig(mount.rig(pose), problem.assigned(problem.test, beginnings[arm]), problem.objective)
    return arms


def measure_rig(source: str, config: Config, *, json_file: Path | None, display: RunDisplay) -> dict[str, Any]:
    """Metrics of one rig on the test scenes: shown, and written to a file.

    Args:
        source: Rig YAML, preset, run folder, or ``highest``.
        config: The scenes, the detector and the objective.
        json_file: Where to write the metrics, in the form of ``evaluation.json``; None for nowhere.
        display: Where to show it.

    Raises:
        InputError: The rig, the file or something in the configuration cannot be used.
    """
    check_rig_source(source)
    if json_file is not None and not json_file.absolute().parent.is_dir():
        raise InputError(f"{json_file}: --json: expected an existing folder to write to, got {str(json_file.parent)!r}")
    problem = load_problem(config, display)
    rig = find_rig(source, config, problem.ego)
    began_as = rig
    if Path(source).is_dir():
        began_as = None if config.rig.start == "random" else RunFolder.open(source).rig("initial")
    metrics = evaluate_rig(rig, problem.assigned(problem.test, began_as), problem.objective)
    evaluation = {"schema": EVALUATION_SCHEMA, **evaluation_of({arm_name(source): metrics})}
    show_verdict(display.console, evaluation)
    if json_file is not None:
        write_json(json_file, evaluation)
        display.say(f"wrote {json_file}")
    return evaluation


def evaluation_of(arms: Mapping[str, ArmMetrics]) -> dict[str, Any]:
    """The content of ``evaluation.json``: metrics by arm, and how the first arm differs from every other."""
    first, *others = arms
    return {
        "scenes": {"test": len(arms[first].per_scene["tp_detection_rate"])},
        "arms": {name: asdict(metrics) for name, metrics in arms.items()},
        "paired": {name: paired_differences(arms[first], arms[name]) for name in others},
    }


def read_start(config: Config) -> Rig:
    """The rig of the file that ``rig.start`` names.

    Raises:
        InputError: It cannot be read, or has another number of cameras than ``rig.cameras``.
    """
    rig = read_rig(config.rig.start)
    if len(rig.cameras) != config.rig.cameras:
        raise InputError(
            f"{config.rig.start}: cameras: expected {config.rig.cameras} as rig.cameras says, got {len(rig.cameras)}; "
            f"set rig.cameras={len(rig.cameras)}"
        )
    return rig


def start_pose(problem: Problem, rig: Rig | None) -> np.ndarray:
    """Mount poses that the optimiser starts from: those of ``rig``, or as ``rig.start`` says.

    Returns:
        float32 [camera, 5], the precision that the optimiser keeps: a start that stays the best is the same rig.

    Raises:
        InputError: The cameras do not fit on the mount surface.
    """
    config, constraints = problem.config, problem.objective.constraints
    if rig is not None:
        return mount_pose_of_rig(rig)
    if config.rig.start == "highest":
        pose = highest_mount_pose(constraints, config.rig.cameras)
    else:
        pose = random_mount_pose(constraints, problem.segregation.yaw_rad, rng=problem.random_numbers(_START))
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
        schedule=optimiser.schedule,
        weight_decay=optimiser.weight_decay,
        multiplier_learning_rate=_multiplier_settings(config)[0],
        multiplier_weight_decay=optimiser.multiplier_weight_decay,
        keep=optimiser.keep,
        check_every=optimiser.check_every,
        panorama_until=optimiser.panorama_until,
        detector_from=optimiser.detector_from,
        patience=optimiser.patience,
    )
