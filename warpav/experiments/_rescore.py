"""Rescoring of a study's rigs by other judges: another detector, several, another image size or source of scenes.

``<folder>/rescored_<name>/`` holds what the folder of an experiment holds. The rigs stay as they are; the same command
again does what is missing.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warpav.core.cache import digest
from warpav.core.errors import ArgumentError, InputError
from warpav.core.files import write_json
from warpav.core.progress import NullProgress, Progress
from warpav.core.warp_setup import device_name
from warpav.experiments._arms import resized
from warpav.experiments._experiment import Finished, make_scenes_ready, outcomes, show_rows, traffic_of_process
from warpav.experiments._result_folder import DESCRIPTION, RESULTS, read_description, read_json, results_in, unseeded
from warpav.experiments._rows import ROWS, read_rows
from warpav.optimisation import LOSSES, metrics_of, observe_scenes
from warpav.rig import read_rig
from warpav.runs import environment, git_commit, load_networks, networks_in, placement_on
from warpav.runs.config import Config, load_config, overridden_option, with_absolute_paths

_SCHEMA = 2
_RESCORED_SECTIONS = ("detector", "scenes", "capture", "reconstruction", "visibility", "device", "executor")
"""Sections of options that affect the evaluation of rigs."""

_RESCORED_OPTIONS = ("camera.width_px", "camera.height_px", "camera.supersampling")  # such options of other sections

_REFERENCE = "default"


@dataclass(frozen=True)
class _RescoreTask:
    name: str
    config: Config
    source: Path
    folder: Path
    made_with: str

    @property
    def file(self) -> Path:
        return self.folder / RESULTS / f"{self.name}.json"

    def is_done(self) -> bool:
        """Whether the rig has been rescored with the same options; other results are replaced."""
        result = read_json(self.file) if self.file.is_file() else None
        return isinstance(result, dict) and result.get("made_with") == self.made_with


def config_file(folder: Path) -> Path:
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
        if option.partition(".")[0] not in _RESCORED_SECTIONS and option not in _RESCORED_OPTIONS:
            raise InputError(
                f"command line ({override}): {option}: expected an evaluation option: of "
                f"{', '.join(_RESCORED_SECTIONS)}, or {', '.join(_RESCORED_OPTIONS)}; rigs stay as they are"
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


@dataclass(frozen=True)
class _Rescoring:
    """All rigs of an experiment, to be rescored by one evaluation."""

    described: Mapping[str, Any]
    before: Mapping[str, Sequence[Mapping[str, Any]]]
    judge: str
    config: Config
    out: Path
    tasks: Sequence[_RescoreTask]

    @property
    def waiting(self) -> list[_RescoreTask]:
        return [task for task in self.tasks if not task.is_done()]


def plan_rescore(folder: Path, config: Config, *, name: str, judge: str | None = None) -> _Rescoring:
    """What there is to do to rescore all rigs of an experiment."""
    described = read_description(folder)
    before = _read_rigs(folder)
    unused = next(seed for seed in config.scenes.train_seeds if seed not in config.scenes.test_seeds)
    without_training = (
        f"scenes.train_seeds=[{unused}]",
        "scenes.validation_seeds=null",
        "scenes.mirror=false",
        "run.batch_size=1",
        *(f"losses.{name}={float(name == 'angular_coverage')}" for name in LOSSES),  # which needs no fit
    )
    config = with_absolute_paths(load_config(config, without_training))
    out = (folder / f"rescored_{name}").absolute()
    # a file may be another network by now
    network = () if config.detector.model == "builtin" else (digest(Path(config.detector.model).read_bytes()),)
    tasks = []
    for run in (run for runs in before.values() for run in runs):
        made_with = digest(_SCHEMA, run["made_with"], json.dumps(run["rig"]), unseeded(config), *network)
        named = f"{run['arm']}_{run['seed']}"
        tasks.append(_RescoreTask(named, config, folder.absolute(), out, made_with))
    return _Rescoring(described, before, judge or name, config, out, tasks)


def run_rescores(planned: Sequence[_Rescoring], *, progress: Progress) -> list[Finished]:
    """Rescore the rigs of a study by one or several judges; show the table of each.

    All are rescored by one set of processes, which keep the scenes from one evaluation to the next.
    """
    for each in planned:
        load_networks(each.config)  # what is wrong with the detector shows before anything else begins
    waiting = [task for each in planned for task in each.waiting]
    if waiting:
        make_scenes_ready(planned[0].config, progress)  # and likewise what is wrong with the scenes
    for each in planned:
        (each.out / RESULTS).mkdir(parents=True, exist_ok=True)
        options = json.loads(unseeded(each.config))
        write_json(each.out / DESCRIPTION, {**each.described, "options": options, "judge": each.judge})
        write_json(each.out / "env.json", environment(each.config, device_name(each.config.device)))
        there = len(each.tasks) - len(each.waiting)
        if there:
            progress.say(f"{there} of {len(each.tasks)} results are in {each.out} already")
    asked = {each.out: len(each.waiting) for each in planned}
    failed: dict[Path, list[str]] = {each.out: [] for each in planned}
    done = outcomes(_rescore_rig, waiting, planned[0].config, planned[0].out)
    for outcome in progress.steps("rigs", done, count=len(waiting)) if waiting else ():
        if outcome.error is not None:
            failed[outcome.task.folder].append(f"{outcome.task.name}: {outcome.error}")
    finished = []
    for each in planned:
        results: dict[str, list[dict[str, Any]]] = {arm: [] for arm in each.before}
        for task in each.tasks:
            if task.is_done():  # results of other evaluation options do not count
                result = read_json(task.file)
                results[result["arm"]].append(result)
        wrong = failed[each.out]
        finished.append(Finished(each.out, results, wrong, asked[each.out] - len(wrong)))
        references = {arm: _REFERENCE for arm in results if arm != _REFERENCE}
        show_rows(finished[-1], each.described["experiment"], each.judge, references, "arms", progress)
    return finished


def plan_panel(folder: Path, config: Config, panel: Path, *, name: str, progress: Progress) -> list[_Rescoring]:
    """What there is to do to let every network of a folder judge the rigs of a study, at its own image size."""
    planned = []
    for network, judged in networks_in(panel, config).items():
        progress.say(f"{network} judges images of {judged.camera.width_px} x {judged.camera.height_px} px")
        planned.append(plan_rescore(folder, judged, name=f"{name}_{network}", judge=network))
    return planned


def _read_rigs(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """All results of an experiment that have rigs, by arm in the order of its summary, and by run seed."""
    file = folder / ROWS
    order = dict.fromkeys(row["arm"] for row in read_rows(file)) if file.is_file() else {}
    found = {
        arm: [run for run in runs if "metrics" in run and "rig" in run]
        for arm, runs in results_in(folder, list(order)).items()
    }
    if not any(found.values()):
        raise InputError(f"{folder / RESULTS}: expected rigs, got none; run the experiment first")
    return found


def _rescore_rig(task: _RescoreTask) -> dict[str, Any]:
    """Evaluate a rig, write the new result and return it."""
    began = time.perf_counter()
    config = task.config
    traffic = traffic_of_process(config, NullProgress())
    placement = placement_on(traffic, config, load_networks(config), None)
    rig = resized(read_rig(task.source / RESULTS / f"{task.name}.yaml"), config)
    seen = observe_scenes(rig, placement.test, placement.objective, with_objective=False)
    old = read_json(task.source / RESULTS / f"{task.name}.json")
    metrics = metrics_of(seen, placement.objective).to_json()
    for name in ("constraint_violation", "min_camera_distance_m"):  # of the rig, independent of the evaluation
        metrics[name] = old["metrics"][name]
    result = {
        "schema": _SCHEMA,
        "made_with": task.made_with,
        "commit": git_commit(),
        **{name: old.get(name) for name in ("arm", "seed", "camera_renders", "rig")},
        "method": old.get("method"),
        "overrides": old.get("overrides", []),
        "search_overrides": old.get("search_overrides", []),
        "metrics": metrics,
        "objects_of_scene": [assigned.scene.vehicle_count for assigned in placement.test],
        "seconds": {"search": old["seconds"]["search"], "rescore": time.perf_counter() - began},
    }
    write_json(task.file, result)
    return result
