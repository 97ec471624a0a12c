"""The experiments of our own.

All methods at one budget of camera renders; the descent with one option changed at a time; whether the objective of
the default method ranks rigs as the detector does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from warpav.core.files import write_json, write_text
from warpav.core.progress import Progress
from warpav.evaluation.statistics import RESAMPLES
from warpav.experiments.arms import AS_BUILT, Arm, common_arms, default_like, odd_fields, thesis_method
from warpav.experiments.correlation import RANDOM_GROUPS, correlate, correlation_goal
from warpav.experiments.experiment import Experiment, Finished, merged_results, run_experiment, say_failures
from warpav.experiments.goals import Goal, goals_of, goals_text
from warpav.experiments.rival_settings import RIVAL_ARMS, RUNS, SELECTION_SCENES
from warpav.experiments.summary import write_summary
from warpav.experiments.tables import compare_results
from warpav.runs.config import Config

REFERENCE = "default"
"""The default method, with which all others are compared."""

CONFIGURED = "configured"
"""Name of the objective that the arms are evaluated with."""

PRESETS = ("nuscenes", "argoverse2")
"""Presets that are compared with the default method of as many cameras."""

PIXELS = 256 * 256
"""Pixels of an image of the configuration ``default``, which presets as they are built have as well."""

_QUICK = (
    "scenes.train_seeds=0..29",
    "scenes.validation_seeds=150..161",
    "scenes.test_seeds=1000..1023",
    "run.iterations=30",
    "run.batch_size=8",
    "optimiser.starts=8",
)
_RIVALS = (
    "thesis_gradient",
    "thesis_as_printed",
    *(arm for arm in RIVAL_ARMS if arm != REFERENCE),
    "cma_then_gradient",
)
_CHANGES = {
    "panorama": ("optimiser.panorama_until=0.3",),
    "random_start": ("rig.start=random", "optimiser.starts=1"),
    "random_start_panorama": ("rig.start=random", "optimiser.starts=1", "optimiser.panorama_until=0.3"),
    "best_camera": ("losses.combine=best",),
    "visible_share": ("losses.probability=visible_share",),
    "in_frame_share": ("losses.probability=in_frame_share",),
    "undamped": ("optimiser.multiplier_damping=0",),
    "steps_16cm_8deg": ("optimiser.learning_rate_position_m=0.16", "optimiser.learning_rate_yaw_deg=8"),
    "steps_1cm_half_deg": ("optimiser.learning_rate_position_m=0.01", "optimiser.learning_rate_yaw_deg=0.5"),
    "one_start": ("optimiser.starts=1",),
    "two_descents": ("optimiser.descents=2",),
    "detector_30": ("losses.detector_share=0.3",),
    "detector_60": ("losses.detector_share=0.6",),
}
"""Search options of each ablation; all arms are evaluated with the unchanged configuration."""


def _experiments() -> dict[str, Experiment]:
    common = common_arms()
    reference = common[REFERENCE]
    like = tuple(default_like(preset, pixels=pixels) for pixels in (None, PIXELS) for preset in PRESETS)
    rivals = tuple(common[name] for name in _RIVALS)
    presets = tuple(common[f"{name}{ending}"] for ending in ("", AS_BUILT) for name in PRESETS)
    changed = tuple(Arm(name, "optimiser", search_overrides=overrides) for name, overrides in _CHANGES.items())
    drawn = (
        Arm("random_rig", "random_rig"),
        Arm("random_place", "start", search_overrides=("rig.start=random",)),
    )
    own: dict[str, tuple[str, ...]] = {CONFIGURED: ()}
    return {
        "open": Experiment(
            "open",
            "default",
            (reference, *rivals, *like, *presets),
            RUNS,
            options=SELECTION_SCENES,
            quick=_QUICK,
            quick_arms=(REFERENCE, *_RIVALS, "default_as_nuscenes", "nuscenes"),
            reference=REFERENCE,
            objectives=own,
            camera_renders_max=45_000,
            quick_camera_renders_max=9_000,
        ),
        "ablations": Experiment(
            "ablations",
            "default",
            (common["descent"], *changed),
            RUNS,
            options=("optimiser.search=descent",),
            quick=_QUICK,
            reference="descent",
            objectives=own,
        ),
        "correlation": Experiment(
            "correlation",
            "default",
            (*drawn, common["highest"], reference),
            runs=3,
            quick=_QUICK,
            quick_runs=1,
            runs_of=dict.fromkeys(RANDOM_GROUPS, 60),
            quick_runs_of=dict.fromkeys(RANDOM_GROUPS, 15),
            objectives={**own, "thesis": thesis_method()},
        ),
    }


EXPERIMENTS = _experiments()
"""By the name of the command."""


def run_open(
    name: str,
    config: Config,
    *,
    arms: Sequence[Arm] | None = None,
    runs: int | None = None,
    camera_renders_max: int | None = None,
    out: Path | None = None,
    quick: bool = False,
    resamples: int = RESAMPLES,
    progress: Progress,
) -> Finished:
    """Do what is missing of an experiment of our own; show its table and its goals, and write them."""
    experiment = EXPERIMENTS[name]
    if quick:
        experiment = experiment.made_quick()
    done = run_experiment(
        experiment,
        config,
        arms=arms,
        runs=runs,
        camera_renders_max=camera_renders_max,
        out=out,
        progress=progress,
    )
    done = merged_results(done, experiment)
    progress.stage("intervals")
    if name == "correlation":
        table: Any = correlate(done.results, done.folder / "correlation.png", resamples=resamples)
        goals = [correlation_goal(table)]
    else:
        there = [arm for arm, found in done.results.items() if found]
        if not there:
            say_failures(done, progress)
            return done
        reference = experiment.reference if experiment.reference in there else there[0]
        table = compare_results(done.results, reference, resamples=resamples)
        # the goals apply to the default method only
        has_goals = name == "open" and reference == experiment.reference
        goals = goals_of(done.results, table, PRESETS, resamples=resamples) if has_goals else []
        odd = [odd_fields(preset) for preset in PRESETS if default_like(preset).name in there]
        table = replace(table, remarks=(*_remarks(name, config), *odd))
    _write(done, name, table, goals)
    progress.show(table.terminal())
    if goals:
        for line in ("", "Goals", *(f"- {goal}" for goal in goals)):
            progress.say(line)
    say_failures(done, progress)
    progress.say(f"{done.done} new results; tables and results: {done.folder}")
    return done


def _write(done: Finished, name: str, table: Any, goals: Sequence[Goal]) -> None:  # noqa: ANN401 (either table)
    text = table.markdown() + (f"\n{goals_text(goals)}" if goals else "")
    write_text(done.folder / f"{name}.md", text)
    write_json(done.folder / f"{name}.json", {**table.data(), "goals": [goal.data() for goal in goals]})
    write_summary(done.folder, done.results, text, goals)


def _remarks(name: str, config: Config) -> tuple[str, ...]:
    if name == "ablations":
        return ("All arms are evaluated with the unchanged configuration; each arm searches with one option changed.",)
    count = len(config.scenes.train_seeds) * (1 + config.scenes.mirror)
    return (
        f"All searches compare rigs on the same {count} training scenes, each camera render in the budget.",
        "thesis_gradient: the thesis's losses, optimiser and bounding rectangle with this configuration's batch size, "
        "start and detector thresholds. thesis_as_printed: the shipped configuration thesis in full, with its own "
        "number of steps whatever the budget.",
        "Presets and default_as_ arms have their own number of cameras.",
        "_as_built: presets on the body, where their makers put them, with images in their own proportions, and their "
        "counterparts; as many pixels as all others. Without it: on the roof, with the images of all others.",
    )
