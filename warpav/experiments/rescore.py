"""Rescoring of an experiment's rigs with another detector, image size or source of scenes.

``<folder>/rescored_<name>/`` holds what the folder of an experiment holds. The rigs stay as they are; the same command
again does what is missing.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.cache import digest
from warpav.core.errors import ArgumentError, InputError
from warpav.core.files import write_json, write_text
from warpav.core.progress import NullProgress, Progress
from warpav.core.warp_setup import device_name
from warpav.evaluation.metrics import SceneObservations, false_alarm_confidences, metrics_of, observe_scenes
from warpav.evaluation.statistics import RESAMPLES, rank_correlation
from warpav.experiments.arms import resized
from warpav.experiments.experiment import Finished, make_scenes_ready, outcomes, traffic_of_process
from warpav.experiments.goals import RIVALS, Goal
from warpav.experiments.result_folder import (
    ATTAINABLE,
    DESCRIPTION,
    RESULTS,
    read_description,
    read_json,
    results_in,
    unseeded,
)
from warpav.experiments.summary import SUMMARY, read_summary, write_summary
from warpav.experiments.tables import COMPARED, Results, compare_results
from warpav.optimisation.losses.registry import LOSSES
from warpav.optimisation.objective import RigObjective
from warpav.rig.rig import read_rig
from warpav.runs.config import Config, changed_config, overridden_option, with_absolute_paths
from warpav.runs.environment import environment, running_commit
from warpav.runs.networks import load_networks
from warpav.runs.placement import placement_on

SCHEMA = 2
RESCORED_SECTIONS = ("detector", "scenes", "capture", "reconstruction", "visibility", "device", "executor")
"""Sections of options that affect the evaluation of rigs."""

RESCORED_OPTIONS = ("camera.width_px", "camera.height_px", "camera.supersampling")
"""Such options of other sections."""

CONFIDENCE_FLOOR = 0.05
"""Minimum confidence down to which `object_record` knows what a detector finds; a lower configured one goes further."""

RECORD = "objects"
"""Key of `object_record` in a result."""

_REFERENCE = "default"
_RECALL = "tp_detection_rate"


@dataclass(frozen=True)
class RescoreTask:
    """One rig to rescore."""

    name: str
    config: Config
    source: Path
    folder: Path
    made_with: str
    keeps_objects: bool = False
    knows_attainable: bool = False

    @property
    def file(self) -> Path:
        """The new result."""
        return self.folder / RESULTS / f"{self.name}.json"


def config_file(folder: Path) -> Path:
    """The configuration of an experiment."""
    for name in (DESCRIPTION, "config.yaml"):
        if not (folder / name).is_file():
            raise InputError(f"{folder}: expected the folder of an experiment with a file {name}, got none")
    return folder / "config.yaml"


def check_rescored_options(overrides: Sequence[str], *, needs_some: bool = True) -> None:
    """Reject overrides that would change rigs, or, where there have to be some, none."""
    if needs_some and not overrides:
        raise InputError(
            "experiment rescore: expected evaluation options such as detector.model=FILE.onnx or "
            "scenes.source=captured, got none"
        )
    for override in overrides:
        option = overridden_option(override)
        if option.partition(".")[0] not in RESCORED_SECTIONS and option not in RESCORED_OPTIONS:
            raise InputError(
                f"command line ({override}): {option}: expected an evaluation option: of "
                f"{', '.join(RESCORED_SECTIONS)}, or {', '.join(RESCORED_OPTIONS)}; rigs stay as they are"
            )


def folder_name(name: str | None, overrides: Sequence[str]) -> str:
    """The name that a user gave, or one made of overrides, such as ``yolox_nano_coco_640_640``."""
    if name is not None:
        if not re.fullmatch(r"[a-z0-9_]+", name):
            raise ArgumentError("name", f"expected lower-case letters, digits and underscores, got {name!r}")
        return name
    values = [override.partition("=")[2] for override in overrides if not override.startswith(("executor.", "device="))]
    words = [Path(value).stem if value.endswith(".onnx") else value for value in values]
    made = re.sub(r"[^a-z0-9]+", "_", "_".join(words).lower()).strip("_")
    if not made:
        raise ArgumentError("name", f"expected a name, as {' '.join(overrides)} makes none, got none")
    return made


def light_overrides(config: Config) -> tuple[str, ...]:
    """Overrides that disable what rescoring does not need: training, validation, losses that need a fit."""
    return (
        f"scenes.train_seeds=[{_unused_seed(config)}]",
        "scenes.validation_seeds=null",
        "scenes.mirror=false",
        "run.batch_size=1",
        *(f"losses.{name}={float(name == 'angular_coverage')}" for name in LOSSES),
    )


def _unused_seed(config: Config) -> int:
    return next(seed for seed in config.scenes.train_seeds if seed not in config.scenes.test_seeds)


@dataclass(frozen=True)
class Rescoring:
    """All rigs of an experiment, to be rescored by one evaluation."""

    described: Mapping[str, Any]
    before: Results
    config: Config
    out: Path
    tasks: Sequence[RescoreTask]

    @property
    def waiting(self) -> list[RescoreTask]:
        """The tasks that have no result yet."""
        return [task for task in self.tasks if not _is_there(task)]


def planned_rescore(folder: Path, config: Config, *, name: str, keeps_objects: bool = False) -> Rescoring:
    """What there is to do to rescore all rigs of an experiment."""
    described = read_description(folder)
    before = read_rigs(folder)
    is_same = _same_test_scenes(described["options"], config)
    config = with_absolute_paths(changed_config(config, light_overrides(config)))
    out = (folder / f"rescored_{name}").absolute()
    tasks = [
        _task(run, config, folder, out, keeps_objects, is_same and ATTAINABLE in run)
        for runs in before.values()
        for run in runs
    ]
    return Rescoring(described, before, config, out, tasks)


def run_rescores(
    planned: Sequence[Rescoring],
    *,
    is_shown: bool = True,
    resamples: int = RESAMPLES,
    progress: Progress,
) -> list[Finished]:
    """Rescore the rigs of experiments; show the table of each, and report whether its arms keep their order.

    All are rescored by one set of processes, which keep the scenes from one evaluation to the next.
    """
    for each in planned:
        load_networks(each.config)  # what is wrong with the detector shows before anything else begins
    waiting_in = {each.out: each.waiting for each in planned}
    waiting = [task for tasks in waiting_in.values() for task in tasks]
    if waiting:
        make_scenes_ready(planned[0].config, progress)  # and likewise what is wrong with the scenes
    for each in planned:
        (each.out / RESULTS).mkdir(parents=True, exist_ok=True)
        title = f"{each.described['experiment']} rescored {each.out.name.removeprefix('rescored_')}"
        options = json.loads(unseeded(each.config))
        write_json(each.out / DESCRIPTION, {**each.described, "experiment": title, "options": options})
        write_json(each.out / "env.json", environment(each.config, device_name(each.config.device)))
        if len(each.waiting) < len(each.tasks):
            progress.say(
                f"{len(each.tasks) - len(each.waiting)} of {len(each.tasks)} results are in {each.out} already"
            )
    failed: dict[Path, list[str]] = {each.out: [] for each in planned}
    done = outcomes(rescore_rig, waiting, planned[0].config, planned[0].out)
    for outcome in progress.steps("rigs", done, count=len(waiting)) if waiting else ():
        if outcome.error is not None:
            failed[outcome.task.folder].append(f"{outcome.task.name}: {outcome.error}")
    return [
        _finished(
            each,
            failed[each.out],
            len(waiting_in[each.out]),
            is_shown=is_shown,
            resamples=resamples,
            progress=progress,
        )
        for each in planned
    ]


def _finished(
    rescoring: Rescoring, failed: list[str], asked: int, *, is_shown: bool, resamples: int, progress: Progress
) -> Finished:
    """Write the tables of an experiment whose rigs have been rescored."""
    out = rescoring.out
    after: dict[str, list[dict[str, Any]]] = {arm: [] for arm in rescoring.before}
    for task in rescoring.tasks:
        if _is_there(task):  # results of other evaluation options do not count
            result = read_json(task.file)
            after[result["arm"]].append(result)
    there = [arm for arm, runs in after.items() if runs]
    if there:
        reference = _REFERENCE if _REFERENCE in there else there[0]
        metrics = [metric for metric in COMPARED if metric != "objective"]
        table = compare_results(after, reference, metrics=metrics, resamples=resamples)
        goals = same_order(rescoring.before, after)
        text = table.markdown() + "\n" + "\n".join(f"- {goal}" for goal in goals) + "\n"
        write_text(out / "rescored.md", text)
        write_json(out / "rescored.json", {**table.data(), "goals": [goal.data() for goal in goals]})
        write_summary(out, after, text, goals)
        if is_shown:
            progress.show(table.terminal())
            for goal in goals:
                progress.say(str(goal))
    for failure in failed:
        progress.say(f"failed: {failure}")
    progress.say(f"{asked - len(failed)} new results; tables and results: {out}")
    return Finished(out, after, failed, asked - len(failed))


def read_rigs(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """All results of an experiment that have rigs, by arm in the order of its summary, and by run seed."""
    order: list[str] = []
    if (folder / SUMMARY).is_file():
        order = [run["arm"] for run in read_summary(folder)["runs"]]
    found = {
        arm: [run for run in runs if "metrics" in run and "rig" in run]
        for arm, runs in results_in(folder, order).items()
    }
    if not any(found.values()):
        raise InputError(f"{folder / RESULTS}: expected rigs, got none; run the experiment first")
    return found


def rescore_rig(task: RescoreTask) -> dict[str, Any]:
    """Evaluate a rig, write the new result and return it."""
    began = time.perf_counter()
    config = task.config
    traffic = traffic_of_process(config, NullProgress())
    said = config
    if task.keeps_objects:  # the detector says more; what counts stays
        said = changed_config(config, [f"detector.confidence_min={confidence_floor(config)}"])
    placement = placement_on(traffic, config, load_networks(said), None)
    rig = resized(read_rig(task.source / RESULTS / f"{task.name}.yaml"), config)
    seen = observe_scenes(rig, placement.test, placement.objective, with_objective=False)
    record = {RECORD: object_record(seen, placement.objective)} if task.keeps_objects else {}
    seen = seen.from_confidence(config.detector.confidence_min)
    old = read_json(task.source / RESULTS / f"{task.name}.json")
    known = {ATTAINABLE: old[ATTAINABLE]} if task.knows_attainable else {}
    attainable = [np.array(each, bool) for each in known[ATTAINABLE]] if known else None
    metrics = metrics_of(seen, placement.objective, attainable=attainable).to_json()
    for name in ("constraint_violation", "min_camera_distance_m"):  # of the rig, independent of the evaluation
        metrics[name] = old["metrics"][name]
    result = {
        "schema": SCHEMA,
        "made_with": task.made_with,
        "commit": asdict(running_commit()),
        **{name: old.get(name) for name in ("arm", "seed", "camera_renders", "rig")},
        "method": old.get("method"),
        "overrides": old.get("overrides", []),
        "search_overrides": old.get("search_overrides", []),
        "metrics": metrics,
        "objects_of_scene": [assigned.scene.vehicle_count for assigned in placement.test],
        **known,
        **record,
        "seconds": {"search": old["seconds"]["search"], "rescore": time.perf_counter() - began},
    }
    write_json(task.file, result)
    return result


def confidence_floor(config: Config) -> float:
    """The least confidence of which an `object_record` knows."""
    return min(CONFIDENCE_FLOOR, config.detector.confidence_min)


def object_record(seen: SceneObservations, objective: RigObjective) -> dict[str, Any]:
    """What a rig and a detector make of every object at any threshold, and all false alarms, for a JSON file."""
    return {
        "images": len(seen.scenes) * len(seen.rig.cameras),
        "false_alarm_confidence": false_alarm_confidences(seen, objective),
        "detected_up_to": [each.detected_up_to(objective.options.iou_min) for each in seen.observations],
    }


def same_order(before: Results, after: Results) -> list[Goal]:
    """Whether the arms keep their order by recall, and the default method stays ahead."""
    old, new = (_mean_recalls(results) for results in (before, after))
    arms = [arm for arm in old if arm in new]
    order = [sorted(arms, key=lambda arm: -values[arm]) for values in (old, new)]
    swapped = [
        f"{one} and {other}"
        for k, one in enumerate(order[0])
        for other in order[0][k + 1 :]
        if (old[one] - old[other]) * (new[one] - new[other]) < 0.0
    ]
    pairs = len(arms) * (len(arms) - 1) // 2
    rank = rank_correlation([old[arm] for arm in arms], [new[arm] for arm in arms]).value if len(arms) > 1 else None
    numbers = " > ".join(f"{arm} {new[arm]:.3f}" for arm in order[1])
    if swapped:
        numbers += f"; {len(swapped)} of {pairs} pairs swap ranks: {', '.join(swapped)}"
    if rank is not None:
        numbers += f"; rank correlation of the arms' means {rank:.3f}"
    goals = [Goal("the arms keep their order by recall", not swapped, numbers)]
    rivals = [arm for arm in RIVALS if arm in arms]
    if _REFERENCE in arms and rivals:
        numbers = f"{new[_REFERENCE]:.4f} against " + ", ".join(f"{arm} {new[arm]:.4f}" for arm in rivals)
        ahead = all(new[_REFERENCE] >= new[arm] for arm in rivals)
        goals.append(Goal(f"recall at least that of {', '.join(rivals)}", ahead, numbers))
    return goals


def _mean_recalls(results: Results) -> dict[str, float]:
    return {arm: float(np.mean([run["metrics"][_RECALL] for run in runs])) for arm, runs in results.items() if runs}


def _name(run: Mapping[str, Any]) -> str:
    return f"{run['arm']}_{run['seed']}"


def _same_test_scenes(options: Mapping[str, Any], config: Config) -> bool:
    """Whether rigs are judged on the very test scenes of their experiment, of which it says what can be found."""
    now = json.loads(unseeded(config))
    names = {name for name in (*options, *now) if name.startswith(("scenes.", "capture.", "reconstruction."))}
    names -= {"scenes.train_seeds", "scenes.validation_seeds", "scenes.mirror"}
    return all(options.get(name) == now.get(name) for name in names)


def _task(
    run: Mapping[str, Any], config: Config, folder: Path, out: Path, keeps_objects: bool, knows_attainable: bool
) -> RescoreTask:
    # a file may be another network by now
    network = () if config.detector.model == "builtin" else (digest(Path(config.detector.model).read_bytes()),)
    made_with = digest(SCHEMA, run["made_with"], json.dumps(run["rig"]), unseeded(config), *network)
    return RescoreTask(_name(run), config, folder.absolute(), out, made_with, keeps_objects, knows_attainable)


def _is_there(task: RescoreTask) -> bool:
    """Whether a rig has been rescored with the same options; other results are replaced."""
    if not task.file.is_file():
        return False
    result = read_json(task.file)
    if not isinstance(result, dict) or result.get("made_with") != task.made_with:
        return False
    return (RECORD in result or not task.keeps_objects) and (ATTAINABLE in result or not task.knows_attainable)
