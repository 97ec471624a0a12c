"""Rigs of experiments before a panel of detectors: every network of a folder judges them on the same unseen scenes.

Every network rescores the rigs at its own image size (`warpav.experiments.rescore`). What the panel adds is the
comparison: recalls at equal false alarms, whether the networks put the arms in the same order, which pairs of arms they
rank differently, and what rigs that one network was used to find are worth to the others.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from warpav.core.cache import digest
from warpav.core.errors import InputError
from warpav.core.files import write_json, write_text, writing
from warpav.core.progress import Progress
from warpav.core.warp_setup import device_name
from warpav.detection.onnx_detector import BUILTIN_MODEL_PATH
from warpav.evaluation.metrics import confidence_at
from warpav.evaluation.statistics import (
    RESAMPLES,
    Difference,
    Estimate,
    mean_over_scenes,
    order_agreement,
    paired_difference,
)
from warpav.experiments.arms import Arm
from warpav.experiments.goals import Goal, goals_text
from warpav.experiments.miss_table import OWN_JUDGE, MissTable, miss_goals, miss_table
from warpav.experiments.rescore import RECORD, confidence_floor, planned_rescore, read_rigs, run_rescores
from warpav.experiments.result_folder import DESCRIPTION, read_description
from warpav.experiments.summary import write_summary
from warpav.runs.config import Config, overridden_option
from warpav.runs.environment import environment
from warpav.runs.networks import PanelNetwork, networks_in
from warpav.runs.scene_set import recordings_digest
from warpav.runs.terminal import Group, TextTable

SCHEMA = 1

_LEVEL = 1e-9
"""Means that differ by less are equal: sums in another order."""

Recalls = dict[str, list[np.ndarray]]
"""Recall by network: of every row, [run, scene], NaN in scenes without objects."""


@dataclass(frozen=True)
class Row:
    """The rigs of an arm."""

    label: str
    arm: str
    seeds: tuple[int, ...]
    searched_with: str | None
    method: str


@dataclass(frozen=True)
class Judge:
    """A network of the panel on the test scenes, over all rigs."""

    name: str
    width_px: int
    height_px: int
    false_alarms_per_image: float
    equal_confidence: float
    equal_false_alarms_per_image: float


@dataclass(frozen=True)
class Agreement:
    """Whether two networks put the arms in one order, by recall at the configured confidence and at equal false alarms.

    See `warpav.evaluation.statistics.order_agreement`.
    """

    one: str
    other: str
    kendall: Estimate
    spearman: Estimate
    kendall_at_equal_false_alarms: Estimate
    spearman_at_equal_false_alarms: Estimate


@dataclass(frozen=True)
class Disagreement:
    """Two arms that networks rank differently by recall at equal false alarms."""

    rows: tuple[str, str]
    differences: dict[str, Difference]

    @property
    def is_sure(self) -> bool:
        """Whether one network is sure that the first is better, and another that it is worse (95 % intervals)."""
        known = [each for each in self.differences.values() if each.low is not None and each.high is not None]
        return any(each.low > 0.0 for each in known) and any(each.high < 0.0 for each in known)  # type: ignore[operator]


@dataclass(frozen=True)
class Crossed:
    """Rigs that one method found with several detectors, before all networks."""

    method: str
    rows: dict[str, str]
    above_own: dict[str, dict[str, Difference]]


@dataclass(frozen=True)
class PanelTable:
    """What a panel says of rigs."""

    false_alarms_per_image: float
    judges: tuple[Judge, ...]
    rows: tuple[Row, ...]
    misses_per_100: dict[str, dict[str, Difference]]
    recall_at_equal_false_alarms: dict[str, dict[str, Difference]]
    agreements: tuple[Agreement, ...]
    disagreements: tuple[Disagreement, ...]
    crossed: tuple[Crossed, ...]
    failed: tuple[str, ...]
    misses: tuple[MissTable, ...] = ()
    outside: tuple[str, ...] = ()
    goals: tuple[Goal, ...] = ()

    def markdown(self) -> str:
        """All of it as Markdown."""
        tables = [table.markdown() for table in self._tables()]
        goals = [goals_text(self.goals)] if self.goals else []
        return "\n".join([*tables, *goals, *(f"- Failed: {each}" for each in self.failed)]).rstrip() + "\n"

    def terminal(self) -> Group:
        """All of it for the console."""
        return Group(*(table.terminal() for table in self._tables()))

    def _tables(self) -> list[TextTable]:
        names, many = [judge.name for judge in self.judges], f"{self.false_alarms_per_image:g}"
        tables = [
            TextTable(
                "Networks",
                ["network", "image px", "false alarms per image", f"confidence at {many}", "false alarms there"],
                [
                    [
                        judge.name,
                        f"{judge.width_px} x {judge.height_px}",
                        f"{judge.false_alarms_per_image:.3f}",
                        f"{judge.equal_confidence:.3f}",
                        f"{judge.equal_false_alarms_per_image:.3f}",
                    ]
                    for judge in self.judges
                ],
                "False alarms: over all rigs and test scenes, at the configured minimum confidence and at the one "
                "where recalls are compared. Fewer there than asked for: the network has no more to say.",
            ),
            TextTable(
                "Misses per 100",
                ["arm", "runs", *names],
                self._lines(self.misses_per_100, 1),
                "At the configured minimum confidence, [95 % interval over scenes and runs].",
            ),
            TextTable(
                f"Recall at {many} false alarms per image",
                ["arm", "runs", *names],
                self._lines(self.recall_at_equal_false_alarms, 3),
                "Each network at its own confidence, see above; in brackets its rank of the arm and the interval.",
            ),
        ]
        if self.agreements:
            tables.append(
                TextTable(
                    "Agreement of the orders of arms",
                    ["networks", "Kendall", "Spearman", f"Kendall at {many}", f"Spearman at {many}"],
                    [
                        [
                            f"{each.one} and {each.other}",
                            *(
                                _text(number.value, number.low, number.high, 2)
                                for number in (
                                    each.kendall,
                                    each.spearman,
                                    each.kendall_at_equal_false_alarms,
                                    each.spearman_at_equal_false_alarms,
                                )
                            ),
                        ]
                        for each in self.agreements
                    ],
                    "Rank correlations of the arms' recalls at the configured confidence and at equal false alarms; "
                    "95 % intervals resample scenes and runs, the arms stay.",
                )
            )
            pairs = len(self.rows) * (len(self.rows) - 1) // 2
            sure = sum(each.is_sure for each in self.disagreements)
            tables.append(
                TextTable(
                    f"Pairs of arms in another order: {len(self.disagreements)} of {pairs}, {sure} for sure",
                    ["arms", *names, "sure"],
                    [
                        [
                            " - ".join(each.rows),
                            *(_text(it.mean, it.low, it.high, 3, "+") for it in each.differences.values()),
                            "yes" if each.is_sure else "",
                        ]
                        for each in self.disagreements
                    ],
                    "Recall of the first less that of the second at equal false alarms. Sure: the intervals of two "
                    "networks lie on both sides of 0, without a correction for the number of pairs.",
                )
            )
        return [*tables, *self.crossed_tables(), *(each.text for each in self.misses)]

    def crossed_tables(self) -> list[TextTable]:
        """A table for each method whose rigs were found with several detectors."""
        names = [judge.name for judge in self.judges]
        return [
            TextTable(
                f"Searched with one network, judged by another: {each.method}",
                ["searched with", *names],
                [
                    [
                        name,
                        *(
                            self._crossed_text(each, name, judge, self.recall_at_equal_false_alarms[judge][label])
                            for judge in names
                        ),
                    ]
                    for name, label in each.rows.items()
                ],
                "Recall at equal false alarms; in brackets what it is above that of the rigs that the judge itself was "
                "searched with, and the interval of this.",
            )
            for each in self.crossed
        ]

    def _lines(self, numbers: Mapping[str, Mapping[str, Difference]], digits: int) -> list[list[str]]:
        lines = []
        for row in self.rows:
            cells = [row.label, str(len(row.seeds))]
            for judge in self.judges:
                of_rows = numbers[judge.name]
                cell = of_rows[row.label]
                rank = ""
                if digits == 3 and cell.mean is not None:
                    rank = f"({1 + sum((each.mean or 0.0) > cell.mean + _LEVEL for each in of_rows.values())}) "
                cells.append(_text(cell.mean, cell.low, cell.high, digits, rank=rank))
            lines.append(cells)
        return lines

    @staticmethod
    def _crossed_text(crossed: Crossed, name: str, judge: str, recall: Difference) -> str:
        text = _text(recall.mean, None, None, 3)
        above = crossed.above_own.get(name, {}).get(judge)
        if name == judge:
            return f"{text} (own)"
        return text if above is None else f"{text} ({_text(above.mean, above.low, above.high, 3, '+')})"


def run_panel(
    folders: Sequence[Path],
    config: Config,
    panel: Path,
    *,
    name: str,
    false_alarms_per_image: float,
    resamples: int = RESAMPLES,
    progress: Progress,
) -> PanelTable:
    """Let every network of a folder judge the rigs of experiments; show the comparison and write it.

    What is there already is not measured again.
    """
    if not false_alarms_per_image >= 0.0:
        raise InputError(f"--false-alarms: expected a number of at least 0, got {false_alarms_per_image}")
    if len({folder.resolve().name for folder in folders}) < len(folders):
        raise InputError(
            f"--also: expected folders of different names, got {', '.join(map(str, folders))}; rename or leave out one"
        )
    described = [read_description(folder)["options"] for folder in folders]
    for folder, options in zip(folders[1:], described[1:], strict=True):
        _check_same_task(folder, options, described[0], config)
    networks = networks_in(panel, config)
    planned = {}
    for network in networks:
        progress.say(f"{network.name} judges images of {network.width_px} x {network.height_px} px")
        for folder in folders:
            named = f"{name}_{network.name}"
            planned[network.name, folder] = planned_rescore(
                folder, network.config(config), name=named, keeps_objects=True
            )
    all_done = run_rescores(list(planned.values()), is_shown=False, resamples=resamples, progress=progress)
    failed, results = [], {}
    for (judge, folder), done in zip(planned, all_done, strict=True):
        failed += [f"{judge}, {each}" for each in done.failed]
        for arm, runs in done.results.items():
            results[judge, folder, arm] = {run["seed"]: run for run in runs}
    rows, runs_of = _rows(folders, described, networks, results)
    if not rows:
        raise InputError(f"{folders[0]}: expected a rig that all networks judge, got none: {failed[0]}")
    table = _table(networks, rows, runs_of, config, false_alarms_per_image, tuple(failed), resamples)
    judged = {network.name: _first_of(folders[0], network.name, results) for network in networks}
    used = {row.searched_with for row in table.rows}
    content = {network.name: digest(network.file.read_bytes()) for network in networks}
    outside = [name for name in content if content[name] not in {content.get(each or "") for each in used}]
    table = _with_misses(table, folders[0], judged, outside, resamples)
    out = folders[0] / f"panel_{name}"
    with writing(out):
        out.mkdir(exist_ok=True)
    write_json(out / "panel.json", {"schema": SCHEMA, **vars(table)})
    write_text(out / "panel.md", table.markdown())
    if table.misses:
        more = f" and {len(folders) - 1} more" if len(folders) > 1 else ""
        described_as = f"{read_description(folders[0])['experiment']}{more} before the panel {name}"
        write_json(out / DESCRIPTION, {**read_description(folders[0]), "experiment": described_as})
        write_json(out / "env.json", environment(config, device_name(config.device)))
        goals = [goals_text(table.goals)] if any(goal.reached is not None for goal in table.goals) else []
        tables = [*table.crossed_tables(), *(each.text for each in table.misses)]
        told = "\n".join([*(each.markdown() for each in tables), *goals])
        write_summary(out, _named_by_judge(results, folders), told, table.goals if goals else ())
    progress.show(table.terminal())
    for goal in table.goals:
        progress.say(f"- {goal}")
    for failure in failed:
        progress.say(f"failed: {failure}")
    progress.say(f"comparison: {out}")
    return table


_Judged = dict[str, dict[str, list[dict[str, Any]]]]
"""Results of the first experiment by network and arm."""


def _first_of(
    folder: Path, network: str, results: Mapping[tuple[str, Path, str], Mapping[int, dict[str, Any]]]
) -> dict[str, list[dict[str, Any]]]:
    """What a network says of the rigs of a folder, by arm."""
    return {
        arm: list(runs.values()) for (judge, place, arm), runs in results.items() if (judge, place) == (network, folder)
    }


def _with_misses(
    table: PanelTable, folder: Path, judged: _Judged, outside: Sequence[str], resamples: int
) -> PanelTable:
    """The same with what can be found, where the first experiment says it."""
    found = [miss_table(name, runs, resamples=resamples) for name, runs in judged.items()]
    tables = [each for each in found if each is not None]
    own = miss_table(OWN_JUDGE, read_rigs(folder), resamples=resamples) if tables else None
    if own is None:
        return table
    asked = [each for each in tables if each.judge in outside]
    goals = tuple(miss_goals(own, asked))
    return replace(table, misses=(own, *tables), outside=tuple(each.judge for each in asked), goals=goals)


def _named_by_judge(
    results: Mapping[tuple[str, Path, str], Mapping[int, dict[str, Any]]], folders: Sequence[Path]
) -> dict[str, list[dict[str, Any]]]:
    """Results by network, folder where there are several, and arm in one."""
    named = {}
    for (network, folder, arm), runs in results.items():
        name = "/".join([network, *([folder.name] if len(folders) > 1 else []), arm])
        named[name] = [{**run, "arm": name} for run in runs.values()]
    return named


def _check_same_task(folder: Path, options: Mapping[str, Any], first: Mapping[str, Any], config: Config) -> None:
    """Reject rigs of other vehicles, and those that were searched for on the test scenes."""
    for option in ("scenes.ego", "scenes.targets"):
        if options.get(option) != first.get(option):
            raise InputError(
                f"{folder}: {option}: expected that of the first experiment, {first.get(option)!r}, got "
                f"{options.get(option)!r}; its rigs answer another question"
            )
    if options.get("scenes.source") != config.scenes.source:
        return
    if options.get("scenes.recordings") != recordings_digest(config):
        raise InputError(
            f"{folder}: scenes.recordings: expected those of the first experiment, got others, of which some may be "
            "among the test scenes"
        )
    seen = {*options.get("scenes.train_seeds", []), *(options.get("scenes.validation_seeds") or [])}
    shared = sorted(seen & set(config.scenes.test_seeds))
    if shared:
        raise InputError(
            f"{folder}: expected rigs that have not been searched for on the test scenes, got {len(shared)} of these "
            f"in their training, such as {shared[0]}; choose others with scenes.test_seeds"
        )


_Runs = dict[tuple[str, str], list[dict[str, Any]]]
"""Results by network and label, in the order of the row's seeds."""


def _rows(
    folders: Sequence[Path],
    described: Sequence[Mapping[str, Any]],
    networks: Sequence[PanelNetwork],
    results: Mapping[tuple[str, Path, str], Mapping[int, dict[str, Any]]],
) -> tuple[list[Row], _Runs]:
    """The rigs that all networks judged."""
    rows: list[Row] = []
    runs_of: _Runs = {}
    name_of = {digest(network.file.read_bytes()): network.name for network in networks}
    options_of = dict(zip(folders, described, strict=True))
    for folder, arm in dict.fromkeys((folder, arm) for _, folder, arm in results):
        judged = [results.get((network.name, folder, arm), {}) for network in networks]
        seeds = tuple(sorted(set.intersection(*(set(runs) for runs in judged))))
        if not seeds:
            continue
        label = arm if len(folders) == 1 else f"{folder.resolve().name}/{arm}"
        some = judged[0][seeds[0]]
        rows.append(Row(label, arm, seeds, *_search_of(some, options_of[folder], name_of)))
        for network, runs in zip(networks, judged, strict=True):
            runs_of[network.name, label] = [runs[seed] for seed in seeds]
    return rows, runs_of


def _search_of(
    run: Mapping[str, Any], options: Mapping[str, Any], name_of: Mapping[str, str]
) -> tuple[str | None, str]:
    """``searched_with`` and ``method`` of a `Row`."""
    method = run.get("method") or run["arm"]
    if not Arm(run["arm"], method).is_seeded:
        return None, method
    model, others = options.get("detector.model", "builtin"), []
    for override in (*run.get("overrides", []), *run.get("search_overrides", [])):
        option = overridden_option(override)
        if option == "detector.model":
            model = yaml.safe_load(override.partition("=")[2])
        elif option.partition(".")[0] not in ("detector", "camera"):
            others.append(override)
    file = BUILTIN_MODEL_PATH if model == "builtin" else Path(model)
    known = name_of.get(digest(file.read_bytes())) if file.is_file() else None
    return known or file.stem, " ".join([method, *sorted(others)])


def _table(
    networks: Sequence[PanelNetwork],
    rows: Sequence[Row],
    runs_of: _Runs,
    config: Config,
    false_alarms_per_image: float,
    failed: tuple[str, ...],
    resamples: int,
) -> PanelTable:
    names = [network.name for network in networks]
    weight = runs_of[names[0], rows[0].label][0]["objects_of_scene"]
    judges, plain, equal = [], {}, {}
    for network in networks:
        of_rows = [runs_of[network.name, row.label] for row in rows]
        judge = _judge(
            network, [run for runs in of_rows for run in runs], network.config(config), false_alarms_per_image
        )
        judges.append(judge)
        plain[network.name] = [
            np.array([run["metrics"]["per_scene"]["tp_detection_rate"] for run in runs], np.float64) for runs in of_rows
        ]
        equal[network.name] = [
            np.array([recall_of_scenes(run[RECORD], judge.equal_confidence) for run in runs]) for runs in of_rows
        ]

    def compared(one: np.ndarray, other: np.ndarray) -> Difference:
        return paired_difference(one, other, weight=weight, resamples=resamples)

    nothing = np.zeros(len(weight))
    labels = [row.label for row in rows]
    agreements = []
    for one, other in itertools.combinations(names, 2):
        pairs = [
            order_agreement(table[one], table[other], weight=weight, resamples=resamples) for table in (plain, equal)
        ]
        agreements.append(
            Agreement(one, other, *(number for each in pairs for number in (each.kendall, each.spearman)))
        )
    disagreements = []
    for i, j in itertools.combinations(range(len(rows)), 2):
        signs = {
            np.sign(gap)
            for name in names
            if abs(gap := mean_over_scenes(equal[name][i], weight) - mean_over_scenes(equal[name][j], weight)) > _LEVEL
        }
        if len(signs) > 1:
            differences = {name: compared(equal[name][i], equal[name][j]) for name in names}
            disagreements.append(Disagreement((labels[i], labels[j]), differences))
    crossed = []
    for method in dict.fromkeys(row.method for row in rows):
        index = {row.searched_with: k for k, row in reversed(list(enumerate(rows))) if row.method == method}
        found = {name: index[name] for name in reversed(index) if name is not None}
        if len(found) > 1:
            above = {
                name: {
                    judge: compared(equal[judge][k], equal[judge][found[judge]])
                    for judge in names
                    if judge in found and judge != name
                }
                for name, k in found.items()
            }
            arms = dict.fromkeys(rows[k].arm for k in found.values())
            shown = next(iter(arms)) if len(arms) == 1 else method
            crossed.append(Crossed(shown, {name: labels[k] for name, k in found.items()}, above))
    return PanelTable(
        false_alarms_per_image,
        tuple(judges),
        tuple(rows),
        {
            name: {
                label: compared(100.0 * (1.0 - one), nothing) for label, one in zip(labels, plain[name], strict=True)
            }
            for name in names
        },
        {
            name: {label: compared(one, nothing) for label, one in zip(labels, equal[name], strict=True)}
            for name in names
        },
        tuple(agreements),
        tuple(disagreements),
        tuple(crossed),
        failed,
    )


def _judge(
    network: PanelNetwork, runs: Sequence[Mapping[str, Any]], config: Config, false_alarms_per_image: float
) -> Judge:
    records = [run[RECORD] for run in runs]
    images = sum(record["images"] for record in records)
    confidence = np.sort(np.concatenate([record["false_alarm_confidence"] for record in records]))[::-1]
    threshold = confidence_at(confidence, images, false_alarms_per_image, least=confidence_floor(config))
    return Judge(
        network.name,
        network.width_px,
        network.height_px,
        float((confidence >= config.detector.confidence_min).sum() / images),
        threshold,
        float((confidence >= threshold).sum() / images),
    )


def recall_of_scenes(record: Mapping[str, Any], confidence_min: float) -> np.ndarray:
    """Recall at a minimum confidence from an `object_record`, NaN without objects, [scene]."""
    found = [np.array(up_to, np.float64) >= confidence_min for up_to in record["detected_up_to"]]
    return np.array([each.mean() if len(each) else np.nan for each in found])


def _text(
    mean: float | None, low: float | None, high: float | None, digits: int, sign: str = "", *, rank: str = ""
) -> str:
    if mean is None:
        return "-"
    text = f"{mean:{sign}.{digits}f}"
    if low is None or high is None:
        return f"{text} {rank}".rstrip()
    return f"{text} {rank}[{low:{sign}.{digits}f}, {high:{sign}.{digits}f}]"
