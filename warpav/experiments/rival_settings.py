"""The rivals at equal terms: settings in which all methods choose on the same scenes with as many camera renders.

`SETTINGS` are those of the frozen protocol, on the easy town; those of `warpav.experiments.traffic_settings` are on
hard and on recorded traffic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from warpav.core.errors import ArgumentError, InputError
from warpav.core.files import write_json, write_text
from warpav.core.progress import Progress
from warpav.evaluation.statistics import RESAMPLES
from warpav.experiments.arms import Arm, common_arms
from warpav.experiments.experiment import Experiment, Finished, merged_results, run_experiment, say_failures
from warpav.experiments.goals import goals_text
from warpav.experiments.miss_table import OWN_JUDGE, miss_goals, miss_table
from warpav.experiments.rival_table import rival_table
from warpav.experiments.summary import write_summary
from warpav.experiments.traffic_settings import find_traffic_setting, is_traffic_setting
from warpav.runs.config import Config

RUNS = 10
"""Run seeds of an arm."""

SELECTION_SCENES = ("scenes.train_seeds=0..149", "scenes.validation_seeds=null")
"""Scenes on which rigs are chosen: all searches see all of them."""

UNSEEN_SCENES = ("scenes.test_seeds=1000..1099",)

RIVAL_ARMS = (
    *("default", "pool_only", "descent_only", "descent"),
    *("highest", "random", "random_selected", "sobol", "sobol_selected"),
    *("cma", "differential_evolution", "greedy_cover"),
)
"""Names of the arms: ours first."""

CONFIGURED = "configured"
"""Name of the objective that the arms are evaluated with."""

_QUICK = ("scenes.train_seeds=0..19", "scenes.test_seeds=1000..1019", "optimiser.starts=8")
_LEVEL = ("rig.free.pitch_deg=null",)
_OPTIONS = {
    "4x90": (45_000, ("rig.cameras=4", "camera.fov_deg=90", *_LEVEL)),
    "2x60": (30_000, ("rig.cameras=2", "camera.fov_deg=60", *_LEVEL)),
    "1x120": (30_000, ("rig.cameras=1", "camera.fov_deg=120", *_LEVEL)),
    "6x60": (
        50_000,
        (
            *("rig.cameras=6", "camera.fov_deg=60", "rig.free.pitch_deg=[-15, 15]", "rig.free.height_m=[0.1, 0.4]"),
            "scenes.targets=[vehicle, pedestrian, cyclist]",
        ),
    ),
    "8x90": (50_000, ("rig.cameras=8", "camera.fov_deg=90", *_LEVEL)),
    "bus": (45_000, ("rig.cameras=4", "camera.fov_deg=90", *_LEVEL)),
}
"""Budget of a search [camera renders], and options, by setting: so many cameras of so many degrees."""


def _setting(name: str) -> Experiment:
    camera_renders_max, options = _OPTIONS[name]
    common = common_arms()
    return Experiment(
        f"rivals_{name}",
        "default",
        tuple(common[arm] for arm in RIVAL_ARMS),
        RUNS,
        options=(*options, *SELECTION_SCENES, *UNSEEN_SCENES),
        quick=_QUICK,
        reference="default",
        objectives={CONFIGURED: ()},
        camera_renders_max=camera_renders_max,
        quick_camera_renders_max=camera_renders_max * 20 // 150,
        is_judged=False,
    )


SETTINGS = {name: _setting(name) for name in _OPTIONS}
"""Experiments by the name of the setting."""


def find_setting(name: str | None) -> tuple[str, Experiment]:
    """A setting by its name, of either kind, and its experiment."""
    if name is not None and is_traffic_setting(name):
        return name, find_traffic_setting(name).experiment
    if name not in SETTINGS:
        raise ArgumentError(
            "setting",
            f"expected one of {', '.join(SETTINGS)}, or one on other traffic such as sind_4_rack, got {name or 'none'}",
        )
    return name, SETTINGS[name]


def run_rivals(
    setting: str,
    config: Config,
    *,
    arms: Sequence[Arm] | None = None,
    runs: int | None = None,
    camera_renders_max: int | None = None,
    out: Path | None = None,
    quick: bool = False,
    is_judged: bool = False,
    resamples: int = RESAMPLES,
    progress: Progress,
) -> Finished:
    """Do what is missing of a setting; show its table and its goals, and write them with a figure."""
    _, experiment = find_setting(setting)
    if setting == "bus" and config.scenes.ego is None:
        raise InputError(
            "experiment rivals --setting bus: scenes.ego: expected the mesh of a bus in the ego frame, got none; give "
            "one such as scenes.ego=bus_ego.glb, which warpav vehicle check writes"
        )
    if is_traffic_setting(setting):
        find_traffic_setting(setting).check(config)
    experiment = experiment.made_quick() if quick else experiment
    experiment = replace(experiment, is_judged=is_judged or experiment.knows_attainable)
    done = run_experiment(
        experiment, config, arms=arms, runs=runs, camera_renders_max=camera_renders_max, out=out, progress=progress
    )
    done = merged_results(done, experiment)
    if any(done.results.values()):
        progress.stage("intervals")
        pitch_is_free = config.rig.free.pitch_deg is not None
        table = rival_table(done.results, resamples=resamples, pitch_is_free=pitch_is_free)
        table = table.with_figure(done.results, done.folder / "objective_over_renders.png", title=experiment.name)
        missed = miss_table(OWN_JUDGE, done.results, resamples=resamples)
        goals = table.goals if missed is None else tuple(miss_goals(missed))
        parts = [table.markdown(), *([] if missed is None else [missed.text.markdown()]), goals_text(goals)]
        text = "\n".join(parts)
        write_text(done.folder / f"{experiment.name}.md", text)
        data = {**table.data(), "goals": [goal.data() for goal in goals]}
        write_json(done.folder / f"{experiment.name}.json", data if missed is None else {**data, "misses": missed})
        write_summary(done.folder, done.results, text, goals)
        progress.show(table.terminal())
        if missed is not None:
            progress.show(missed.text.terminal())
        for line in ("", "Goals", *(f"- {goal}" for goal in goals)):
            progress.say(line)
    say_failures(done, progress)
    progress.say(f"{done.done} new results; tables and results: {done.folder}")
    return done
