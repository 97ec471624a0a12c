"""The published record of an experiment: metrics and seeds of every run, table, goals and command; no figures.

``<folder>/summary.json`` is small enough to be kept next to a page that quotes it; `write_results_page` writes such a
page from the summaries of several experiments.
"""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from warpav.core.errors import ArgumentError, InputError
from warpav.core.files import write_json, write_text
from warpav.experiments.goals import Goal
from warpav.experiments.protocol import code_since_seal, seal_of
from warpav.experiments.result_folder import DESCRIPTION, objective_on_tests, read_json
from warpav.experiments.tables import COMPARED, Results
from warpav.experiments.traffic_protocol import holds_traffic_protocol
from warpav.experiments.traffic_settings import is_traffic_setting
from warpav.runs.environment import command_line, commit_of_code, history

SCHEMA = 1
SUMMARY = "summary.json"
_METRICS = (*COMPARED, "map50_average", "rig_recall_visible", "confidence_at_equal_false_alarms")
_METRICS = (*_METRICS, "constraint_violation", "objects")
_VERSIONS = ("warpav", "git_commit", "python", "platform", "device", "packages")
_DIGITS = 5


def write_summary(folder: Path, results: Results, text: str, goals: Sequence[Goal]) -> None:
    """Write the published record of an experiment."""
    described, made = read_json(folder / DESCRIPTION), read_json(folder / "env.json")
    write_json(
        folder / SUMMARY,
        {
            "schema": SCHEMA,
            "experiment": described["experiment"],
            "command": shlex.join(map(_without_folders, shlex.split(command_line()))),
            "date": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            "versions": {key: made[key] for key in _VERSIONS},
            "camera_renders_max": described.get("camera_renders_max"),
            "options": {
                name: _without_folders(value) if isinstance(value, str) else value
                for name, value in described["options"].items()
            },
            "commits": _commits(results),
            "table": "\n".join(line for line in text.splitlines() if not line.startswith("![")),
            "goals": [goal.data() for goal in goals],
            "runs": [_gradients(run) if "gradients" in run else _run(run) for runs in results.values() for run in runs],
        },
    )


def _commits(results: Results) -> list[dict[str, Any]]:
    """The commits that made the runs, every one once."""
    made = [dict(run["commit"]) for runs in results.values() for run in runs if run.get("commit")]
    return [commit for k, commit in enumerate(made) if commit not in made[:k]]


def with_history(summary: dict[str, Any]) -> dict[str, Any]:
    """A summary with what the history says of it: commits of copies without history, and the seal of its test scenes.

    What it says already stays; without a history nothing changes.
    """
    if not history():
        return summary
    commits = [dict(commit) for commit in summary.get("commits", [])]
    for commit in commits:
        if commit["hash"] is None:
            commit["hash"] = commit_of_code(commit["code"])
            commit["is_clean"] = None if commit["hash"] is None else True
    summary = {**summary, "commits": commits} if commits else summary
    seeds = summary["options"].get("scenes.test_seeds")
    if not summary.get("sealed_by") and isinstance(seeds, list) and (seal := seal_of(seeds)):
        on_traffic = is_traffic_setting(summary["experiment"].removeprefix("rivals_"))
        if not on_traffic or holds_traffic_protocol(seal):
            summary = {**summary, "sealed_by": seal, "changed_since_seal": code_since_seal(seal, commits)}
    return summary


def _without_folders(word: str) -> str:
    """A word of a command, or a value, with an absolute path reduced to the file name."""
    key, equals, value = word.rpartition("=")
    return f"{key}{equals}{Path(value).name}" if value.startswith("/") else word


def _run(run: Mapping[str, Any]) -> dict[str, Any]:
    if "metrics" in run:
        metrics = run["metrics"]
        tested: dict[str, Any] = {name: _rounded(metrics.get(name)) for name in _METRICS}
        tested["recall_of_scene"] = [_rounded(value) for value in metrics["per_scene"]["tp_detection_rate"]]
        if metrics.get("attainable_rate") is not None:
            tested |= {name: _rounded(metrics[name]) for name in ("attainable_rate", "attainable_misses_per_100")}
    else:
        tested = {
            "objective": _rounded(objective_on_tests(run)),
            "constraint_violation": _rounded(run["constraint_violation_m"]),
            "objects": sum(run["objects_of_scene"]),
        }
    return {
        "arm": run["arm"],
        "seed": run["seed"],
        "overrides": run.get("overrides", []),
        **tested,
        "validation_objectives": {
            name: _rounded(value) for name, value in run.get("validation_objectives", {}).items()
        },
        "camera_renders": run.get("camera_renders"),
        "search_seconds": _rounded(run.get("seconds", {}).get("search")),
        "cameras": [
            {key: camera[key] for key in ("position_m", "yaw_deg", "pitch_deg", "fov_deg") if key in camera}
            for camera in run.get("rig", {}).get("cameras", [])
        ],
    }


def _gradients(run: Mapping[str, Any]) -> dict[str, Any]:
    """A run that measured gradients and found no rig."""
    return {name: run[name] for name in ("arm", "seed", "gradients", "camera_renders")}


def _rounded(value: float | None) -> float | None:
    return round(value, _DIGITS) if isinstance(value, float) else value


def read_summary(folder: Path) -> dict[str, Any]:
    """The summary of an experiment."""
    file = folder / SUMMARY
    if not file.is_file():
        raise InputError(
            f"{folder}: expected the folder of an experiment with a {SUMMARY}, got none; run warpav experiment open, "
            "ablations, correlation, rescore or a table first"
        )
    summary = read_json(file)
    if not isinstance(summary, dict) or summary.get("schema") != SCHEMA:
        found = summary.get("schema") if isinstance(summary, dict) else None
        raise InputError(f"{file}: schema: expected {SCHEMA}, got {found!r}; run the experiment's command again")
    return summary


def write_results_page(folders: Sequence[Path], page: Path) -> Path:
    """Write the results of experiments as a page, with a copy of every summary in a folder beside it."""
    if not folders:
        raise InputError("experiment results: expected folders of experiments such as runs/open, got none")
    summaries = [with_history(read_summary(folder)) for folder in folders]
    names = [summary["experiment"] for summary in summaries]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{page}: expected experiments of different names, got {name} twice")
    if page.suffix != ".md":
        raise ArgumentError(
            place=page, option="out", text=f"expected a Markdown file such as docs/results.md, got {page.name!r}"
        )
    parts = [_HEAD, _overview(summaries)]
    try:
        (page.parent / page.stem).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ArgumentError(
            place=page, option="out", text=f"expected a folder that can be made, got: {error.strerror}"
        ) from None
    for summary in summaries:
        file = page.parent / page.stem / f"{_file_stem(summary['experiment'])}.json"
        write_json(file, summary)
        parts.append(_section(summary, file.relative_to(page.parent)))
    write_text(page, "\n".join(parts))
    return page


_HEAD = """# Results

Results of `warpav experiment`, generated from the runs listed below without manual edits. Goals are reported whether
reached or not. `warpav experiment results FOLDER... --out PAGE` writes this page.
"""


def _overview(summaries: Sequence[Mapping[str, Any]]) -> str:
    lines = ["| experiment | runs | goals reached |", "| --- | ---: | ---: |"]
    for summary in summaries:
        goals = summary["goals"]
        reached = f"{sum(goal['reached'] is True for goal in goals)} of {len(goals)}" if goals else "-"
        lines.append(f"| {summary['experiment']} | {len(summary['runs'])} | {reached} |")
    return "\n".join([*lines, ""])


def _section(summary: Mapping[str, Any], file: Path) -> str:
    versions, options = summary["versions"], summary["options"]
    seeds = {name: _seeds_text(options.get(f"scenes.{name}_seeds")) for name in ("train", "validation", "test")}
    runs = sorted({run["seed"] for run in summary["runs"]})
    if summary.get("sealed_by"):
        seeds["test"] = f"{len(options['scenes.test_seeds'])} sealed ones"
    return "\n".join(
        [
            f"## {summary['experiment']}",
            "",
            f"- Command: `{summary['command']}`",
            f"- Date: {summary['date']}; warpav {versions['warpav']}, Python {versions['python']}, "
            f"{versions['platform']}, {versions['device']}",
            f"- Code: {_code_text(summary)}",
            f"- Scenes: {options.get('scenes.source')}; training seeds {seeds['train']}, validation "
            f"{seeds['validation']}, test {seeds['test']}; run seeds {_seeds_text(runs)}",
            *_seal_lines(summary),
            f"- All runs with metrics, seeds, cameras and options: [{file.as_posix()}]({file.as_posix()})",
            "",
            summary["table"].strip(),
            "",
        ]
    )


def _code_text(summary: Mapping[str, Any]) -> str:
    """Which code made the results, as far as is known."""
    commits, began_at = summary.get("commits", []), summary["versions"].get("git_commit")
    if not commits:
        return f"commit {began_at} at the beginning, not recorded run by run" if began_at else "commit not recorded"
    return ", ".join(
        "no commit: an installed package or a copy without history"
        if each["hash"] is None
        else f"commit {each['hash']}" + (" with changes" if each["is_clean"] is False else "")
        for each in commits
    )


def _seal_lines(summary: Mapping[str, Any]) -> list[str]:
    """By which commit the test scenes are sealed, and whether the code changed since; nothing where they are not."""
    if not summary.get("sealed_by"):
        return []
    changed = ", ".join(summary["changed_since_seal"]) or "nothing"
    return [f"- Test scenes sealed by commit {summary['sealed_by']}; code and configurations changed since: {changed}"]


def _seeds_text(seeds: Any) -> str:  # noqa: ANN401 (as configurations hold them)
    if isinstance(seeds, list):
        is_range = len(seeds) > 2 and seeds == list(range(seeds[0], seeds[0] + len(seeds)))
        return f"{seeds[0]}..{seeds[-1]}" if is_range else ", ".join(map(str, seeds))
    return "none" if seeds is None else str(seeds)


def _file_stem(name: str) -> str:
    return "_".join(name.replace(os.sep, " ").split())
