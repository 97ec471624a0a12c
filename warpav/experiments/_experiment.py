"""The runner of studies: a task for each arm and run seed, every result in a file of its own as soon as it is there.

`warpav.experiments._result_folder` says what the folder holds. The same command again does what is missing, and nothing
else.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml

from warpav.core.cache import digest, user_cache_folder
from warpav.core.errors import ArgumentError
from warpav.core.executor import Executor, Outcome
from warpav.core.files import write_json, write_text
from warpav.core.progress import NullProgress, Progress
from warpav.experiments._arms import Arm, FoundRig, constraint_loss, find_rig_of, resized
from warpav.experiments._gradient_magnitude import measure_gradient_magnitudes
from warpav.experiments._result_folder import (
    RESULTS,
    SCHEMA,
    is_there,
    objective_on_tests,
    open_folder,
    results_in,
    unseeded,
)
from warpav.experiments._rows import OWN_JUDGE, ROWS, rows_of, table_of, write_rows
from warpav.experiments._study import GRADIENTS, Judge, Study
from warpav.optimisation import (
    AssignedScene,
    Drawing,
    attainable_objects,
    highest_mount_pose,
    metrics_of,
    observe_scenes,
    rig_values_of,
)
from warpav.raster.mesh import Mesh
from warpav.rig import write_rig
from warpav.runs import (
    RUNS_FOLDER,
    Placement,
    SceneSet,
    camera_mount,
    constraints_of,
    drawn,
    git_commit,
    load_networks,
    load_scene_set,
    load_scenes,
    needed_fit,
    own_vehicle_digest,
    placement_on,
    prepare_scenes,
    recordings_digest,
    requirements_of,
    rule_margins,
    same_scenes,
    scene_part,
    traffic_fleet_digest,
)
from warpav.runs.config import AUTO, Config, load_config, with_absolute_paths

_Task = TypeVar("_Task")


@dataclass(frozen=True)
class _ArmTask:
    """One run of one arm, small enough to travel to another process."""

    arm: Arm
    config: Config
    camera_renders_max: int | None
    file: Path  # of the result
    made_with: str
    judge: Judge = "detector"


@dataclass(frozen=True)
class Finished:
    folder: Path
    results: dict[str, list[dict[str, Any]]]
    failed: list[str]
    done: int


class _TrafficOfProcess:
    """The traffic that was loaded last in this process; tasks that need the same do not load it again."""

    def __init__(self) -> None:
        self._key: Config | None = None
        self._made_of: tuple[str | None, ...] = ()  # what files hold
        self._traffic: SceneSet | None = None

    def __call__(self, config: Config, progress: Progress) -> SceneSet:
        key = scene_part(config)
        made_of = own_vehicle_digest(config), recordings_digest(config), traffic_fleet_digest(config)
        is_same = self._key is not None and same_scenes(key, self._key) and made_of == self._made_of
        if self._traffic is None or not is_same:
            self._traffic = None  # two of them may not fit into memory
            self._traffic, self._key, self._made_of = load_scene_set(config, progress), key, made_of
        elif key != self._key:
            self._traffic, self._key = self._traffic.with_cameras(config), key
        return self._traffic


traffic_of_process = _TrafficOfProcess()


def run_study(
    study: Study,
    config: Config,
    *,
    arms: Sequence[Arm] | None = None,
    runs: int | None = None,
    camera_renders_max: int | None = None,
    out: Path | None = None,
    progress: Progress,
) -> Finished:
    """Do what is missing of a study, show its table and write its rows.

    The folder gets ``rows.csv`` and ``table.md``, of all results that it holds.
    """
    study.check(config)
    if config.requirements == AUTO:  # its arms are compared by what they are expected to miss
        config = load_config(config, ["requirements=null"])
    runs_of = {} if runs is not None else study.runs_of
    runs = study.runs if runs is None else runs
    camera_renders_max = study.camera_renders_max if camera_renders_max is None else camera_renders_max
    for option, value in (("runs", runs), ("budget", camera_renders_max)):
        if value is not None and value < 1:
            raise ArgumentError(option, f"expected at least 1, got {value}")
    arms = study.arms if arms is None else arms
    for arm in arms:
        if arm.method != GRADIENTS:
            arm.check(config, camera_renders_max)
    _try_networks(arms, config, progress)
    folder = (out or config.run.out or RUNS_FOLDER / study.name).absolute()
    runs_of = {arm.name: runs_of.get(arm.name, runs) for arm in arms}
    tasks = _tasks(study, arms, config, runs_of, camera_renders_max, folder / RESULTS)
    open_folder(folder, study.name, config, camera_renders_max)
    waiting = [task for task in tasks if not is_there(task.file, task.made_with)]
    if len(waiting) < len(tasks):
        progress.say(f"{len(tasks) - len(waiting)} of {len(tasks)} results are in {folder} already")
    failed = []
    try:
        if waiting:
            _check_places(arms, config, make_scenes_ready(config, progress))
        done = outcomes(_run_arm, waiting, config, folder)
        for outcome in progress.steps("runs", done, count=len(waiting)) if waiting else ():
            progress.say(_line(outcome))
            if outcome.error is not None:
                failed.append(f"{outcome.task.file.stem}: {outcome.error}")
    except KeyboardInterrupt:
        progress.say(f"stopped; what is finished is in {folder}, and the same command goes on from there")
        raise
    results = results_in(folder, [arm.name for arm in (*study.arms, *arms)])
    written = Finished(folder, results, failed, len(waiting) - len(failed))
    show_rows(written, study.name, OWN_JUDGE, study.references, study.table, progress)
    return written


def show_rows(
    done: Finished, study: str, judge: str, references: Mapping[str, str], table: str, progress: Progress
) -> None:
    """Write the rows and the table of what has come of a study, and show it and what has failed."""
    if any(done.results.values()):
        progress.stage("intervals")
        rows = rows_of(done.results, study, judge, references)
        write_rows(rows, done.folder / ROWS)
        tables = [table, "thesis III"] if table == "thesis II" else [table]
        texts = [table_of(f"{each} {study} {judge}", rows) for each in tables]
        write_text(done.folder / "table.md", "\n".join(each.markdown() for each in texts))
        progress.show(drawn(texts[0]))
    for failure in done.failed:
        progress.say(f"failed: {failure}")
    progress.say(f"{done.done} new results; rows, table and results: {done.folder}")


def _run_arm(task: _ArmTask) -> dict[str, Any]:
    """Do a task, write its result, and return the result without its history."""
    gc.collect()  # what the last task has recorded on a GPU hangs together in circles
    began = time.perf_counter()
    result = _gradients(task) if task.arm.method == GRADIENTS else _rig(task)
    result["seconds"]["total"] = time.perf_counter() - began
    result = {
        "schema": SCHEMA,
        "arm": task.arm.name,
        "seed": task.config.run.seed,
        "made_with": task.made_with,
        "commit": git_commit(),
        **result,
    }
    write_json(task.file, result)
    return {name: value for name, value in result.items() if name not in ("history", "rig")}


def _placement(config: Config) -> Placement:
    networks, probability = load_networks(config), needed_fit(config, NullProgress())
    return placement_on(traffic_of_process(config, NullProgress()), config, networks, probability)


def _rig(task: _ArmTask) -> dict[str, Any]:
    began = time.perf_counter()
    evaluation = _placement(task.arm.evaluation_config(task.config))
    placement = _placement(task.arm.search_config(task.config)) if task.arm.search_overrides else evaluation
    loaded = time.perf_counter()
    found = find_rig_of(task.arm, placement, task.camera_renders_max)
    if placement.config.camera != evaluation.config.camera:  # all arms are judged with images of one size
        found = replace(found, rig=resized(found.rig, evaluation.config))
    if found.mount_pose is not None and placement.mount.is_symmetric != evaluation.mount.is_symmetric:
        found = replace(found, mount_pose=evaluation.mount.mount_pose_of_rig(found.rig))
    searched = time.perf_counter()
    scenes = evaluation.assigned(evaluation.test, found.pairing_rig)
    counts = [assigned.scene.vehicle_count for assigned in evaluation.test]
    tested: dict[str, Any]
    if task.judge != "objective":
        attainable = None
        if evaluation.limits is not None:  # then what is attainable is compared, and weighs its scene
            drawing = Drawing(cache=user_cache_folder("pools"))
            attainable = attainable_objects(evaluation.objective, evaluation.test, drawing=drawing)
        counts = counts if attainable is None else [int(each.sum()) for each in attainable]
        seen = observe_scenes(found.rig, scenes, evaluation.objective)
        rate = found.notes.get("false_alarms_per_image")
        metrics = metrics_of(seen, evaluation.objective, attainable=attainable, false_alarms_per_image=rate)
        tested = {"metrics": metrics.to_json()}
    else:
        tested = {
            "test_objective_of_scene": _objective_of_scene(evaluation, found, scenes),
            "constraint_violation_m": evaluation.objective.constraints.violation_m(found.rig),
        }
    if evaluation.objective.is_by_single_cameras:
        ruled = evaluation.with_config(load_config(evaluation.config, ["optimiser.search=pool", "rules=default"]))
        margins = {each.rule: each for each in (rule_margins({"rig": found.rig}, ruled) or {})["rig"]}
        tested["rules_broken"] = [name for name, each in margins.items() if not each.is_kept]
        tested["near_ground_m"] = margins["near_ground"].value
    if evaluation.limits is not None:
        tested["cost"] = evaluation.limits.cost([camera.module for camera in found.rig.cameras])
    for required in requirements_of({"rig": found.rig}, evaluation).values():
        tested["required_share"] = float(required.is_point_met.mean())
    rig_file = task.file.with_suffix(".yaml")
    write_rig(found.rig, rig_file)
    return {
        **tested,
        "objects_of_scene": counts,
        "method": task.arm.method,
        "overrides": list(task.arm.overrides),
        "search_overrides": list(task.arm.search_overrides),
        "training_objective": found.training_objective,
        # on all scenes that it was chosen on
        "objective_seen": _objective_on(
            evaluation, found, evaluation.assigned(evaluation.validation, found.pairing_rig)
        ),
        "constraint_loss": None
        if found.mount_pose is None or evaluation.mount.is_mixed
        else constraint_loss(evaluation, found.mount_pose),
        **found.notes,
        "camera_renders": found.camera_renders,
        "seconds": {"load": loaded - began, "search": searched - loaded, "evaluate": time.perf_counter() - searched},
        "rig": yaml.safe_load(rig_file.read_text(encoding="utf-8")),
        "history": found.history,
    }


def _objective_of_scene(evaluation: Placement, found: FoundRig, scenes: Sequence[AssignedScene]) -> list[float | None]:
    """The objective of a rig in each test scene; None in those without objects, and for cameras of other lenses."""

    def weighs(each: AssignedScene) -> bool:
        weight = evaluation.objective.object_weight([each])
        return each.scene.vehicle_count > 0 and (weight is None or bool(weight.any()))

    return [_objective_on(evaluation, found, [each]) if weighs(each) else None for each in scenes]


def _objective_on(evaluation: Placement, found: FoundRig, scenes: Sequence[AssignedScene]) -> float | None:
    """The objective of a rig on scenes together; None for cameras of other lenses."""
    if found.mount_pose is None:
        return None
    return next(iter(rig_values_of(evaluation.objective, scenes)(np.asarray(found.mount_pose, np.float32)[None])))


def _gradients(task: _ArmTask) -> dict[str, Any]:
    config = task.arm.evaluation_config(task.config)
    began = time.perf_counter()
    placement = _placement(config)
    loaded = time.perf_counter()
    magnitudes = measure_gradient_magnitudes(
        placement.objective,
        placement.train,
        placement.segregation.yaw_rad,
        settings=config.optimiser,
        iterations=config.run.iterations,
        batch_size=config.run.batch_size,
        seed=config.run.seed,
    )
    return {
        "gradients": magnitudes,
        "camera_renders": config.rig.cameras * config.run.iterations * config.run.batch_size,
        "seconds": {"load": loaded - began, "search": time.perf_counter() - loaded},
    }


def _tasks(
    study: Study,
    arms: Sequence[Arm],
    config: Config,
    runs_of: Mapping[str, int],
    camera_renders_max: int | None,
    folder: Path,
) -> list[_ArmTask]:
    config = with_absolute_paths(config)
    tasks = []
    for arm in arms:
        made_with = digest(
            SCHEMA,
            arm.method,
            camera_renders_max,
            unseeded(arm.evaluation_config(config)),
            unseeded(arm.search_config(config)),
            study.judge,
        )
        for k in range(runs_of[arm.name] if arm.is_seeded else 1):
            seeded = load_config(config, [f"run.seed={config.run.seed + k}"])
            file = folder / f"{arm.name}_{seeded.run.seed}.json"
            tasks.append(_ArmTask(arm, seeded, camera_renders_max, file, made_with, study.judge))
    return tasks


def _try_networks(arms: Sequence[Arm], config: Config, progress: Progress) -> None:
    """Let what is wrong with a detector show before the tasks begin; what several would fit, fit once."""
    for each in _distinct(
        arms,
        config,
        lambda each: (
            each.detector,
            each.camera,
            each.losses.weights["expected_miss_rate"] > 0.0,
            each.losses.weights["detector_gradient"] > 0.0,
        ),
    ):
        load_networks(each)
        needed_fit(each, progress)


def _distinct(arms: Iterable[Arm], config: Config, needs_of: Callable[[Config], Any]) -> Iterator[Config]:
    """The configurations of arms that differ in what they need."""
    tried: list[Any] = []
    for arm in arms:
        for each in (arm.evaluation_config(config), arm.search_config(config)):
            needs = needs_of(each)
            if needs not in tried:
                tried.append(needs)
                yield each


def make_scenes_ready(config: Config, progress: Progress) -> Mesh:
    """Let what is wrong with the scenes show before the tasks begin; what several would make, make once."""
    seeds = (*config.scenes.train_seeds, *(config.scenes.validation_seeds or ()), *config.scenes.test_seeds)
    if config.executor.name == "serial":
        return traffic_of_process(config, progress).ego
    if config.executor.name == "process":
        prepare_scenes(config, progress)
    elif config.scenes.source == "captured":
        # one scene at a time is held; all carry the same vehicle
        return [scene.ego for scene in progress.steps("scenes", load_scenes(config, seeds), count=len(seeds))].pop()
    return next(load_scenes(config, seeds)).ego


def _check_places(arms: Sequence[Arm], config: Config, ego: Mesh) -> None:
    """See that the cameras of every arm fit on the mount surface."""
    placed = (arm for arm in arms if not arm.is_preset)
    for each in _distinct(placed, config, lambda each: (each.rig, each.mount, each.camera, each.method)):
        constraints = constraints_of(each, camera_mount(each, ego).surface)
        rows = each.rig.cameras if constraints.module is None else len(constraints.module)
        highest_mount_pose(constraints, rows)


def outcomes(
    function: Callable[[_Task], dict[str, Any]], tasks: Sequence[_Task], config: Config, folder: Path
) -> Iterator[Outcome[_Task, dict[str, Any]]]:
    """Run tasks with the configured executor; yields their outcomes as they finish."""
    of = config.executor
    jobs = folder / "slurm_jobs"
    return Executor(of.name, of.workers, of.address, of.options, jobs, config.shared_gpu_count).map(function, tasks)


def _line(outcome: Outcome[_ArmTask, dict[str, Any]]) -> str:
    name = f"{outcome.task.arm.name}, run seed {outcome.task.config.run.seed}"
    if outcome.error is not None or outcome.result is None:
        return f"{name}: failed: {outcome.error}"
    result = outcome.result
    took = f"{result['seconds']['total']:.0f} s"
    if "objects_of_scene" not in result:
        return f"{name}: {took}"
    metrics = result.get("metrics", {})
    numbers = (
        ("recall", metrics.get("tp_detection_rate")),
        ("mAP50", metrics.get("map50_average")),
        ("objective", objective_on_tests(result)),
    )
    shown = "  ".join(f"{label} {value:.4f}" for label, value in numbers if value is not None)
    return f"{name}: {shown}  {result['camera_renders']} camera renders  {took}"
