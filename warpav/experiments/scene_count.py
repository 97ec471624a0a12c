"""How many training scenes a search needs: the search by a pool on ever more of them, judged on scenes it never saw."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.cache import digest
from warpav.core.errors import ArgumentError, InputError, OptionError
from warpav.core.files import write_json, write_text
from warpav.core.progress import NullProgress, Progress
from warpav.core.warp_setup import device_name
from warpav.experiments.experiment import outcomes, traffic_of_process
from warpav.experiments.result_folder import RESULTS, read_json
from warpav.optimisation.baselines import highest_mount_pose
from warpav.optimisation.importance import Importance
from warpav.optimisation.losses.scene_on_tape import CameraProbability
from warpav.optimisation.miss_rate import expected_miss_rate, shares_of
from warpav.optimisation.pool_search import PoolSearch, PoolSearchSettings, PoolTask
from warpav.optimisation.single_cameras import SingleCameras
from warpav.raster.decide import Occlusion
from warpav.runs.config import AUTO, Config, changed_config, dump_config, with_absolute_paths
from warpav.runs.environment import environment
from warpav.runs.mounts import constraints_of
from warpav.runs.placement import needed_fit
from warpav.runs.run_folder import RUNS_FOLDER
from warpav.scene.device_scene import DeviceScene

NAME = "scene_count"
SCHEMA = "warpav-scene-count/1"
COUNTS = (50, 150, 500, 1500)
"""Numbers of training scenes, as far as there are so many; all that there are come last."""
RUNS = 3
"""Run seeds; each has its own pool, and its own training scenes among all."""
SAME_CAMERAS, SAME_RENDERS = "same_cameras", "same_renders"
ARMS = {
    SAME_CAMERAS: "as many cameras in the first pool",
    SAME_RENDERS: "as many camera renders in all, half of them for the first pool",
}
OPTIONS = (
    "optimiser.search=pool",
    "scenes.train_seeds=0..1499",
    "scenes.validation_seeds=null",
    "scenes.test_seeds=30000..30099",
)
QUICK = ("scenes.train_seeds=0..59", "scenes.test_seeds=30000..30029", "optimiser.pool_cameras=48")
QUICK_COUNTS = (15, 60)
BUDGET_SCENES = 150
"""Without a budget, searches at equal renders spend twice what the first pool takes on so many scenes."""
_COLUMNS = ("searches with", "training scenes", "pool", "camera renders", "seen", "bound", "unseen", "seconds")


@dataclass(frozen=True)
class _Search:
    """A task."""

    arm: str
    scene_count: int
    config: Config
    render_budget: int
    folder: Path

    @property
    def file(self) -> Path:
        """Where its result goes."""
        return self.folder / f"{self.arm}_{self.scene_count}_seed_{self.config.run.seed}.json"

    @property
    def made_with(self) -> str:
        """Hash of all that the result depends on."""
        config = changed_config(self.config, ["executor.name=serial"])
        return digest(SCHEMA, self.arm, self.scene_count, self.render_budget, dump_config(config))

    @property
    def pool_cameras(self) -> int:
        """Cameras of the first pool."""
        if self.arm == SAME_CAMERAS:
            return self.config.optimiser.pool_cameras
        return self.render_budget // (2 * self.scene_count)


def run_scene_count(
    config: Config,
    *,
    arms: str | None = None,
    scene_counts: str | None = None,
    runs: int | None = None,
    render_budget: int | None = None,
    out: Path | None = None,
    quick: bool = False,
    progress: Progress,
) -> list[str]:
    """Search on ever more training scenes, measure every rig on the test scenes, write table, numbers and figure."""
    if config.requirements == AUTO:  # searches are compared by what they are expected to miss
        config = changed_config(config, ["requirements=null"])
    name = f"{NAME}_quick" if quick else NAME
    folder = (out or config.run.out or RUNS_FOLDER / name).absolute()
    runs = (1 if quick else RUNS) if runs is None else runs
    counts = _counts(scene_counts, len(config.scenes.train_seeds), QUICK_COUNTS if quick else COUNTS)
    tasks = _tasks(config, arms, counts, runs, render_budget, folder / RESULTS)
    try:
        (folder / RESULTS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ArgumentError("out", f"expected a folder that can be made, got: {error.strerror}", place=folder) from None
    needed_fit(config, progress)
    waiting = [task for task in tasks if _result_of(task) is None]
    if waiting and config.executor.name == "serial":
        traffic_of_process(config, progress)
    failed = []
    done = outcomes(_run, waiting, config, folder)
    for outcome in progress.steps("searches", done, count=len(waiting)) if waiting else ():
        task = outcome.task
        label = f"{task.arm}, {task.scene_count} scenes, run seed {task.config.run.seed}"
        if outcome.error is not None or outcome.result is None:
            failed.append(f"{label}: {outcome.error}")
            progress.say(f"failed: {failed[-1]}")
        else:
            found = outcome.result
            progress.say(
                f"{label}: seen {found['seen']:.4f}, unseen {found['unseen']:.4f}, {found['camera_renders']} camera "
                f"renders, {found['seconds']:.0f} s"
            )
    results = [found for task in tasks if (found := _result_of(task)) is not None]
    if results:
        _write(folder, config, results)
        for line in (*_table(results).splitlines(), str(folder)):
            progress.say(line)
    return failed


def _counts(text: str | None, there: int, usual: Sequence[int]) -> list[int]:
    """Numbers of training scenes, ascending."""
    if text is None:
        return sorted({count for count in usual if count <= there} | {there})
    words = text.split(",")
    if not all(word.strip().isdecimal() and 1 <= int(word) <= there for word in words):
        raise ArgumentError(
            "scenes", f"expected numbers from 1 to the {there} scenes.train_seeds, such as 50,150, got {text!r}"
        )
    return sorted({int(word) for word in words})


def _tasks(
    config: Config, arms: str | None, counts: Sequence[int], runs: int, render_budget: int | None, folder: Path
) -> list[_Search]:
    if config.optimiser.search != "pool" or config.scenes.mirror:
        raise OptionError(
            "optimiser.search", "expected pool, without scenes.mirror, as this experiment is about the search by a pool"
        )
    chosen = list(ARMS) if arms is None else arms.split(",")
    unknown = [arm for arm in chosen if arm not in ARMS]
    if unknown:
        raise ArgumentError("arms", f"expected some of {', '.join(ARMS)}, got {unknown[0]!r}")
    for option, value in (("runs", runs), ("budget", render_budget)):
        if value is not None and value < 1:
            raise ArgumentError(option, f"expected at least 1, got {value}")
    budget = render_budget or 2 * BUDGET_SCENES * config.optimiser.pool_cameras
    config = with_absolute_paths(config)
    seeded = [changed_config(config, [f"run.seed={config.run.seed + k}"]) for k in range(runs)]
    tasks = [_Search(arm, count, each, budget, folder) for arm in chosen for count in counts for each in seeded]
    least = config.rig.cameras
    short = next((task for task in tasks if task.pool_cameras < least), None)
    if short is not None:
        raise ArgumentError(
            "budget",
            f"expected at least {2 * least * short.scene_count} camera renders, for {least} cameras in "
            f"{short.scene_count} scenes and as many again, got {budget}",
        )
    return tasks


def _run(task: _Search) -> dict[str, Any]:
    """Search, measure, write the result and return it."""
    config = task.config
    fitted = needed_fit(config, NullProgress())
    assert not isinstance(fitted, tuple), "experiments have equal cameras"
    probability = CameraProbability.of(config.losses, fitted)
    scenes = traffic_of_process(config, NullProgress())
    if probability is None:
        raise OptionError("losses.expected_miss_rate", "expected a weight above 0, as a pool knows this loss alone")
    cameras = SingleCameras(
        scenes.mount,
        probability,
        Occlusion(config.visibility.occlusion),
        config.camera.supersampling,
    )
    order = np.random.default_rng(config.run.seed).permutation(len(scenes.train))
    train = [scenes.train[k] for k in sorted(order[: task.scene_count])]
    constraints = constraints_of(config, scenes.mount.surface, scenes.mount.frozen)
    importance, optimiser = Importance.of(config.importance), config.optimiser

    def weight_of(scenes: Sequence[DeviceScene]) -> np.ndarray | None:
        return None if importance is None else importance.weights_of(scenes)

    settings = PoolSearchSettings(
        task.pool_cameras,
        optimiser.pool_rounds,
        gap=optimiser.pool_gap,
        refinements=optimiser.pool_refinements,
        selection_time_s=optimiser.selection_time_s,
        camera_renders_max=task.render_budget if task.arm == SAME_RENDERS else None,
    )
    began = time.perf_counter()
    states = list(
        PoolSearch(
            PoolTask(
                cameras,
                train,
                constraints,
                config.rig.cameras,
                start=highest_mount_pose(constraints, config.rig.cameras),
                object_weight=weight_of(train),
                robust=config.robust.objective,
                mount_errors=config.robust.mount_errors,
            ),
            settings,
            seed=config.run.seed,
        )
    )
    seconds = time.perf_counter() - began
    found = states[-1]
    unseen = np.concatenate([cameras.detection_probability(found.mount_pose, each) for each in scenes.test], axis=1)
    result = {
        "schema": SCHEMA,
        "made_with": task.made_with,
        "arm": task.arm,
        "training_scenes": task.scene_count,
        "training_objects": sum(each.vehicle_count for each in train),
        "unseen_scenes": len(scenes.test),
        "seed": config.run.seed,
        "pool_cameras": task.pool_cameras,
        "camera_renders": found.camera_renders,
        "seen": found.objective,
        "bound": max((state.bound for state in states if state.stage == "selection"), default=0.0),
        "unseen": expected_miss_rate(unseen, shares_of(weight_of(scenes.test))),
        "seconds": seconds,
        "mount_pose": found.mount_pose.astype(float).tolist(),
        "states": [
            {"stage": state.stage, "objective": state.objective, "bound": state.bound, "renders": state.camera_renders}
            for state in states
        ],
    }
    write_json(task.file, result)
    return result


def _result_of(task: _Search) -> dict[str, Any] | None:
    """The result of a task; None where there is none, or one that was made with something else."""
    try:
        found = read_json(task.file) if task.file.is_file() else None
    except InputError:
        return None
    return found if isinstance(found, dict) and found.get("made_with") == task.made_with else None


def _write(folder: Path, config: Config, results: Sequence[dict[str, Any]]) -> None:
    write_text(folder / "config.yaml", dump_config(config))
    write_json(folder / "env.json", environment(config, device_name(config.device)))
    write_json(folder / f"{NAME}.json", {"schema": SCHEMA, "arms": ARMS, "results": list(results)})
    figure = _draw(results, folder / f"{NAME}.png")
    unseen = results[0]["unseen_scenes"]
    notes = [
        f"Expected misses of {config.rig.cameras} cameras, on the training scenes (seen) and on {unseen} others "
        "(unseen); mean over run seeds, and the standard deviation of the unseen ones.",
        "Every run seed has its own pool and its own training scenes, drawn from all; fewer are among more.",
        "The bound is over the cameras of the pool and the scenes seen: the polish goes below it.",
        *(f"{arm}: {text}." for arm, text in ARMS.items()),
    ]
    write_text(
        folder / f"{NAME}.md",
        "\n".join(
            [_table(results), f"![Objective over training scenes]({figure.name})", "", *map("- {}".format, notes), ""]
        ),
    )


def _table(results: Sequence[dict[str, Any]]) -> str:
    """The table in Markdown."""
    lines = ["| " + " | ".join(_COLUMNS) + " |", "| --- |" + " ---: |" * (len(_COLUMNS) - 1)]
    for arm, count, found in _groups(results):
        mean = {name: float(np.mean([run[name] for run in found])) for name in ("seen", "bound", "unseen", "seconds")}
        spread = f" ± {np.std([run['unseen'] for run in found], ddof=1):.4f}" if len(found) > 1 else ""
        renders = float(np.mean([run["camera_renders"] for run in found]))
        cells = (
            arm.replace("_", " "),
            str(count),
            str(found[0]["pool_cameras"]),
            f"{renders:.0f}",
            f"{mean['seen']:.4f}",
            f"{mean['bound']:.4f}",
            f"{mean['unseen']:.4f}{spread}",
            f"{mean['seconds']:.0f}",
        )
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


def _groups(results: Sequence[dict[str, Any]]) -> list[tuple[str, int, list[dict[str, Any]]]]:
    """The results of every arm and number of scenes, in this order."""
    keys = dict.fromkeys((run["arm"], run["training_scenes"]) for run in results)
    return [
        (arm, count, [run for run in results if (run["arm"], run["training_scenes"]) == (arm, count)])
        for arm, count in keys
    ]


def _draw(results: Sequence[dict[str, Any]], path: Path) -> Path:
    from warpav.view.figures.statistics import seen_and_unseen

    return seen_and_unseen(results, path)
