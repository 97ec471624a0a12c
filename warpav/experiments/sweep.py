"""When placement matters: what a search gains over cameras around the highest point, one circumstance at a time.

Around a middle, the configuration, each factor takes several values while the others stay: the number of cameras, their
field of view, their height above the roof, the traffic. The default method searches in each of them, and both rigs are
measured by what they are expected to miss in the same unseen scenes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from warpav.core.errors import ArgumentError
from warpav.core.files import write_json, write_text
from warpav.core.progress import Progress
from warpav.evaluation.statistics import (
    RESAMPLES,
    Difference,
    holm,
    mean_over_scenes,
    paired_difference,
    relative_reduction,
)
from warpav.experiments.arms import Arm
from warpav.experiments.experiment import Experiment, Finished, merged_results, run_experiment, say_failures
from warpav.experiments.miss_table import number_text
from warpav.experiments.result_folder import objective_of_tests
from warpav.experiments.summary import write_summary
from warpav.experiments.tables import Results
from warpav.runs.config import Config
from warpav.runs.terminal import TextTable
from warpav.scene.town.levels import LEVELS

NAME = "sweep"
OPTIONS = (
    "scenes.level=urban",
    "scenes.train_seeds=0..59",
    "scenes.validation_seeds=null",
    "scenes.test_seeds=1000..1059",
    "optimiser.pool_cameras=96",
    "optimiser.pool_rounds=1",
)
"""The middle, on top of the configuration ``default``."""
QUICK = ("scenes.train_seeds=0..15", "scenes.test_seeds=1000..1015", "optimiser.pool_cameras=32")
RUNS = 2
"""Run seeds of every search."""
RECORDED = "sind"
"""The traffic that ships as a recording."""
MIDDLE = "middle"

Value = int | float | str


@dataclass(frozen=True)
class Factor:
    """What varies."""

    text: str
    values: tuple[Value, ...]
    quick: tuple[Value, ...]
    read: Callable[[str], Value]
    overrides: Callable[[Value], tuple[str, ...]]
    middle: Callable[[Config], Value]


def _traffic(text: str) -> str:
    if text not in (*LEVELS, RECORDED):
        raise ValueError(text)
    return text


def _traffic_overrides(value: Value) -> tuple[str, ...]:
    if value == RECORDED:
        return ("scenes.source=traffic", "scenes.level=null")
    return (
        "scenes.source=town",
        f"scenes.level={value}",
        "scenes.recordings=null",
        "scenes.test_recordings=null",
    )


FACTORS = {
    "cameras": Factor(
        "number of cameras",
        (1, 2, 4, 6, 8),
        (2, 6),
        int,
        lambda value: (f"rig.cameras={value}",),
        lambda config: config.rig.cameras,
    ),
    "fov": Factor(
        "field of view [deg]",
        (45.0, 60.0, 90.0, 120.0),
        (60.0, 120.0),
        float,
        lambda value: (f"camera.fov_deg={value}",),
        lambda config: config.camera.fov_deg,
    ),
    "height": Factor(
        "height over roof [m]",
        (0.02, 0.1, 0.25, 0.75, 1.5),
        (0.05, 1.0),
        float,
        lambda value: (f"rig.height_offset_m={value}",),
        lambda config: config.rig.height_offset_m,
    ),
    "traffic": Factor(
        "traffic",
        LEVELS,
        ("easy", "dense"),
        _traffic,
        _traffic_overrides,
        lambda config: RECORDED if config.scenes.source == "traffic" else config.scenes.level or LEVELS[0],
    ),
}
"""By name; the traffic comes last, as other scenes have to be loaded for it."""


@dataclass(frozen=True)
class Point:
    """A circumstance."""

    factor: str
    value: Value
    is_middle: bool

    @property
    def name(self) -> str:
        """What its arms are called by."""
        return MIDDLE if self.is_middle else f"{self.factor}_{self.label}"

    @property
    def label(self) -> str:
        """The value as a text."""
        return self.value if isinstance(self.value, str) else f"{self.value:g}"


@dataclass(frozen=True)
class Gain:
    """What the default method gains in a circumstance."""

    point: Point
    road_users: float
    runs: int
    highest: float
    default: float
    gain: Difference
    reduction: Difference


def factors_of(vary: Sequence[str] | None, *, quick: bool) -> dict[str, tuple[Value, ...]]:
    """The factors that vary, and their values."""
    usual = {name: each.quick if quick else each.values for name, each in FACTORS.items()}
    if not vary:
        return usual
    found: dict[str, tuple[Value, ...]] = {}
    for each in vary:
        name, equals, text = each.partition("=")
        if name not in FACTORS:
            raise ArgumentError("vary", f"expected a factor out of {', '.join(FACTORS)}, got {name!r}")
        try:
            values = tuple(FACTORS[name].read(word.strip()) for word in text.split(",")) if equals else usual[name]
        except ValueError:
            kind = f"out of {', '.join((*LEVELS, RECORDED))}" if name == "traffic" else "numbers"
            raise ArgumentError("vary", f"expected values of {name} with commas, {kind}, got {text!r}") from None
        found[name] = tuple(dict.fromkeys(values))
    return {name: found[name] for name in FACTORS if name in found}


def points_of(config: Config, factors: dict[str, tuple[Value, ...]]) -> list[Point]:
    """The circumstances, factor by factor, values ascending, each factor with the middle among them."""
    points = []
    for name, values in factors.items():
        middle = FACTORS[name].middle(config)
        every = [value for value in values if value != middle] + [middle]
        every.sort(key=lambda value: (*LEVELS, RECORDED).index(value) if isinstance(value, str) else value)
        points += [Point(name, value, value == middle) for value in every]
    return points


def run_sweep(
    config: Config,
    *,
    vary: Sequence[str] | None = None,
    runs: int | None = None,
    camera_renders_max: int | None = None,
    out: Path | None = None,
    quick: bool = False,
    resamples: int = RESAMPLES,
    progress: Progress,
) -> Finished:
    """Do what is missing of a sweep; show its table, and write it with a figure."""
    points = points_of(config, factors_of(vary, quick=quick))
    experiment = Experiment(
        f"{NAME}_quick" if quick else NAME,
        "default",
        tuple(arm for point in {point.name: point for point in points}.values() for arm in _arms(point)),
        1 if quick else RUNS,
        objectives={"configured": ()},
        is_judged=False,
    )
    done = run_experiment(
        experiment, config, runs=runs, camera_renders_max=camera_renders_max, out=out, progress=progress
    )
    done = merged_results(done, experiment)
    gains = gains_of(points, done.results, resamples=resamples)
    if gains:
        progress.stage("intervals")
        table = sweep_table(gains)
        figure = draw_gains(gains, done.folder / f"{NAME}.png")
        text = f"{table.markdown()}\n![What a search gains]({figure.name})\n"
        write_text(done.folder / f"{NAME}.md", text)
        write_json(done.folder / f"{NAME}.json", {"gains": [asdict(each) for each in gains]})
        write_summary(done.folder, done.results, text, ())
        progress.show(table.terminal())
    say_failures(done, progress)
    progress.say(f"{done.done} new results; table, figure and results: {done.folder}")
    return done


def _arms(point: Point) -> tuple[Arm, Arm]:
    overrides = () if point.is_middle else FACTORS[point.factor].overrides(point.value)
    search = ("optimiser.search=pool",)
    name = point.name.replace(".", "_")
    return (
        Arm(f"default_{name}", "optimiser", overrides, search),
        Arm(f"highest_{name}", "highest", overrides),
    )


def gains_of(points: Sequence[Point], results: Results, *, resamples: int = RESAMPLES) -> list[Gain]:
    """The gains of the circumstances that have results of both arms."""
    gains: list[Gain] = []
    for point in points:
        ours, theirs = (results.get(arm.name, ()) for arm in _arms(point))
        if not ours or not theirs:
            continue
        weight = ours[0]["objects_of_scene"]
        tables = [100.0 * np.array([objective_of_tests(run) for run in runs], np.float64) for runs in (theirs, ours)]
        highest, default = (mean_over_scenes(table, weight) for table in tables)
        if not math.isfinite(highest + default):
            continue
        gains.append(
            Gain(
                point,
                float(np.mean(weight)),
                len(ours),
                highest,
                default,
                paired_difference(*tables, weight=weight, resamples=resamples),
                relative_reduction(*tables[::-1], weight=weight, resamples=resamples),
            )
        )
    # the middle is one circumstance, however many factors share it
    by_name = {each.point.name: each.gain.p_value for each in gains if each.gain.p_value is not None}
    corrected = holm({name: value for name, value in by_name.items() if value is not None})
    return [replace(each, gain=replace(each.gain, p_holm=corrected.get(each.point.name))) for each in gains]


def sweep_table(gains: Sequence[Gain]) -> TextTable:
    """The gains as a table."""
    lines = []
    for each in gains:
        lines.append(
            [
                f"{FACTORS[each.point.factor].text}: {each.point.label}{' (middle)' if each.point.is_middle else ''}",
                f"{each.road_users:.1f}",
                f"{each.highest:.2f}",
                f"{each.default:.2f}",
                number_text(each.gain, 1.0, "+.2f", with_p=True),
                number_text(each.reduction, 100.0, "+.1f"),
            ]
        )
    return TextTable(
        "What a search gains over cameras around the highest point",
        ["one changed at a time", "road users a scene", "highest", "default", "gain", "% fewer misses"],
        lines,
        "Expected misses per 100 road users in unseen scenes; gain: those of highest less those of default. Brackets: "
        "95 % interval, BCa over scenes and runs; p: of no gain, corrected by Holm's method for the circumstances, * "
        "below 0.05.",
    )


def draw_gains(gains: Sequence[Gain], path: Path) -> Path:
    """A figure with a panel for every factor: expected misses of both rigs above, the gain with its interval below."""
    from warpav.view.figures.statistics import GainMark, gains_by_factor

    panels: dict[str, list[GainMark]] = {}
    for each in gains:
        label = each.point.label
        if each.point.factor == "traffic":
            label += f"\n({each.road_users:.0f})"
        gain = each.gain
        title = FACTORS[each.point.factor].text + (" (targets)" if each.point.factor == "traffic" else "")
        marks = panels.setdefault(title, [])
        marks.append(GainMark(label, gain.mean, gain.low, gain.high, each.highest, each.default, each.point.is_middle))
    return gains_by_factor(panels, path)
