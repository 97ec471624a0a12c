"""The main job: a configuration becomes an optimised rig beside its baselines, in a run folder."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import InputError
from warpav.evaluation.blind_ground import BlindGround
from warpav.evaluation.metrics import ArmMetrics, ObjectOutcome, evaluate_rig, look_at_scenes, metrics_of
from warpav.evaluation.statistics import paired_differences
from warpav.optimisation.baselines import highest_mount_pose
from warpav.optimisation.gradient import Descent
from warpav.optimisation.rivals import random_search
from warpav.optimisation.search import BudgetedValue, SearchSpace, run_search
from warpav.rig.rig import Rig
from warpav.runs.config import Config
from warpav.runs.problem import Problem, Stream, begin_descent, has_ordered_start, load_problem, read_start
from warpav.runs.progress import show_verdict
from warpav.runs.report.report import write_report
from warpav.runs.run_figures import draw_run
from warpav.runs.run_folder import EVALUATION_SCHEMA, RunFolder, check_new_run, write_json
from warpav.runs.sources import arm_name, check_rig_source, device_name, find_rig, is_run_folder

if TYPE_CHECKING:
    from warpav.optimisation.objective import AssignedScene
    from warpav.runs.progress import RunDisplay
    from warpav.scene.device_scene import DeviceScene


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
    laps = Laps()
    check_new_run(config)
    start_rig = read_start(config)
    problem = load_problem(config, display)
    laps.end("scenes and detector")
    mount = problem.objective.mount
    if config.optimiser.starts > 1:
        display.stage(f"best of {config.optimiser.starts} rigs to start from")
    beginning = begin_descent(problem, start_rig)
    descent, began_as = beginning.descent, beginning.rig
    start = descent.start
    laps.end("looking for a start")

    folder = RunFolder.create(config, name=name, device=device_name(config.device), start=start_rig)
    display.say(f"run folder: {folder.path}")
    folder.write_rig("initial", mount.rig(start))
    try:
        descend(descent, folder, display)
        result = descent.finish()
        folder.write_rig("best", mount.rig(descent.best.mount_pose))
        folder.write_rig("final", mount.rig(descent.candidates[-1].mount_pose))
        laps.end("descent")

        arms = compare(problem, {"optimised": result.mount_pose, "start": start}, began_as, display)
        laps.end("comparison on the test scenes")
        display.stage("ground that no camera sees")
        ground = BlindGround.of({arm: each.rig for arm, each in arms.items()}, scenes_of(problem.test))
        laps.end("ground that no camera sees")
        evaluation = {
            **evaluation_of({arm: each.metrics for arm, each in arms.items()}),
            "training_objective": {
                "start": descent.candidates[0].training_objective,
                "optimised": result.training_objective,
            },
            "descent": {
                "iterations": descent.iteration,
                "planned": config.run.iterations,
                "ended": descent.verdict,
                "kept": result.iteration,
            },
            "constraints": {arm: problem.objective.constraints.margins(each.rig) for arm, each in arms.items()},
            "outcomes": outcomes_of(scenes_of(problem.test), {arm: each.outcomes for arm, each in arms.items()}),
            "ground": ground.table(),
        }
        folder.write_evaluation({**evaluation, "seconds": laps.seconds})
        display.stage("figures and report")
        folder.write_ground(ground.arrays(problem.ego.bounds_m()))
        draw_run(
            folder,
            {"start": mount.rig(start), "optimised": mount.rig(result.mount_pose)},
            objective=problem.objective,
            scene=problem.shown,
            assigned=shown_scenes(problem.test, arms["optimised"].outcomes),
            say=display.say,
        )
        laps.end("figures")
        folder.write_evaluation({**evaluation, "seconds": laps.seconds})
        report = write_report(folder)
        show_verdict(display.console, evaluation)
        display.say(f"report: {report}   took {laps.total_s():.0f} s")
    except KeyboardInterrupt:
        display.say(f"stopped; what was reached is in {folder.path}, for warpav evaluate, inspect and report")
        raise
    return folder


@dataclass(frozen=True)
class Compared:
    """A rig on the test scenes.

    Attributes:
        rig: The rig.
        metrics: Its metrics.
        outcomes: What becomes of every object, [scene][object].
    """

    rig: Rig
    metrics: ArmMetrics
    outcomes: list[list[ObjectOutcome]]


class Laps:
    """Wall time of the stages of a run [s]."""

    def __init__(self) -> None:
        self._began = self._last = time.perf_counter()
        self._seconds: dict[str, float] = {}

    def end(self, stage: str) -> None:
        """The stage that began with the end of the one before ends now."""
        now = time.perf_counter()
        self._seconds[stage] = now - self._last
        self._last = now

    def total_s(self) -> float:
        """Since the beginning [s]."""
        return time.perf_counter() - self._began

    @property
    def seconds(self) -> dict[str, float]:
        """Of every stage that has ended, and ``total`` up to there."""
        return {**self._seconds, "total": self._last - self._began}


def descend(descent: Descent, folder: RunFolder, display: RunDisplay) -> None:
    """Take all steps, or as many as are of use, each shown and written before the next."""
    config = folder.config()
    mount = descent.objective.mount
    steps = (descent.step() for _ in range(config.run.iterations) if descent.verdict is None)
    for record in display.iterations(steps, count=config.run.iterations, min_spacing_m=config.rig.min_spacing_m):
        state = descent.state()
        folder.append_event(record)
        folder.write_checkpoint(state)
        folder.write_rig("final", mount.rig(state["pose_value"]))
        if record.training_objective is not None:
            folder.write_rig("best", mount.rig(descent.best.mount_pose))
    if descent.verdict is not None:
        display.say(f"ended after {descent.iteration} iterations: {descent.verdict}")


def compare(
    problem: Problem, mount_poses: Mapping[str, np.ndarray], began_as: Rig | None, display: RunDisplay
) -> dict[str, Compared]:
    """Look at the test scenes with some rigs on the mount surface, that of the highest point, and the best random rig.

    Args:
        problem: What to measure against.
        mount_poses: Mount poses by the name of the arm, [camera, 7].
        began_as: The rig that these began as; None when camera k took orientation k.
        display: Where to show it.
    """
    config, mount = problem.config, problem.objective.mount
    constraints = problem.objective.constraints
    highest = mount.within(highest_mount_pose(constraints, config.rig.cameras))
    samples, rng = config.baselines.random_samples, problem.random_numbers(Stream.SEARCH)
    chosen = rng.choice(len(problem.train), min(config.baselines.random_scenes, len(problem.train)), replace=False)
    display.stage(f"best of {samples} random rigs on {len(chosen)} training scenes")
    space = SearchSpace.over(
        mount,
        config.rig.cameras,
        constraints=constraints,
        yaw_rad=problem.yaw_rad,
        yaw_reach_rad=0.0,
    )
    scenes = [problem.train[k] for k in chosen]
    value = BudgetedValue.of(problem.objective, scenes, space, render_budget=samples * len(scenes))
    found = run_search(random_search, value, rng)
    poses = {**mount_poses, "highest": highest, "random": found.mount_pose}
    beginnings = {**dict.fromkeys(mount_poses, began_as), "highest": mount.rig(highest), "random": problem.held_rig}
    arms = {}
    for arm, pose in display.steps("comparing", poses.items(), count=len(poses)):
        seen = look_at_scenes(mount.rig(pose), problem.assigned(problem.test, beginnings[arm]), problem.objective)
        arms[arm] = Compared(seen.rig, metrics_of(seen, problem.objective), [look.outcomes for look in seen.looks])
    return arms


def scenes_of(assigned: Sequence[AssignedScene]) -> list[DeviceScene]:
    """The scenes, whoever their vehicles are assigned to."""
    return [item.scene for item in assigned]


def outcomes_of(
    scenes: Sequence[DeviceScene], outcomes: Mapping[str, Sequence[Sequence[ObjectOutcome]]]
) -> list[dict[str, Any]]:
    """Every object of the scenes, where it is, and what becomes of it before every rig, for ``evaluation.json``.

    Args:
        scenes: The scenes.
        outcomes: By the name of the arm, [scene][object].
    """
    return [
        {
            "scene": scene.name,
            "category": scene.category[k],
            "distance_m": round(float(np.hypot(*scene.from_ego_m[k])), 3),
            "bearing_deg": round(float(np.degrees(np.arctan2(*scene.from_ego_m[k][::-1]))), 2),
            "outcome": {arm: each[number][k] for arm, each in outcomes.items()},
        }
        for number, scene in enumerate(scenes)
        for k in range(scene.vehicle_count)
    ]


def shown_scenes(scenes: Sequence[AssignedScene], outcomes: Sequence[Sequence[ObjectOutcome]]) -> list[AssignedScene]:
    """The first scene, and of the others that in which a rig leaves most objects undetected, if it leaves any."""
    undetected = [sum(outcome != ObjectOutcome.DETECTED for outcome in each) for each in outcomes]
    hardest = max(range(1, len(scenes)), key=undetected.__getitem__, default=0)
    return [scenes[0], scenes[hardest]] if hardest and undetected[hardest] else [scenes[0]]


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
    if is_run_folder(source):
        began_as = problem.held_rig if has_ordered_start(config) else RunFolder.open(source).rig("initial")
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
