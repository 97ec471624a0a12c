"""What is published follows from the numbers that are published with it."""

import json
import re
import tarfile
from pathlib import Path

import numpy as np
import pytest

from warpav.experiments.experiment import _tasks, overrides_of
from warpav.experiments.miss_table import PRACTICE
from warpav.experiments.protocol import seal_of, unknown_code
from warpav.experiments.result_folder import unseeded
from warpav.experiments.rival_settings import RIVAL_ARMS, SETTINGS
from warpav.experiments.summary import with_history, write_results_page
from warpav.runs import environment as commit_module
from warpav.runs.config import load_config
from warpav.runs.environment import code_of, has_history, history

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "results.md"
SUMMARIES = {json.loads(file.read_text())["experiment"]: file for file in PAGE.with_suffix("").glob("*.json")}
SETTING_OF = {
    "four cameras of 90°": "4x90",
    "four of 90° on a bus": "bus",
    "eight of 90°": "8x90",
    "six of 60°, pitch and height free": "6x60",
    "one of 120°": "1x120",
    "two of 60°": "2x60",
}
"""Rows of the table of searches on easy traffic."""
PROTOCOL = tuple(SETTING_OF.values())
"""Settings that the protocol names."""


BEFORE_THE_PROTOCOL = {
    "ablations",
    "ablations_quick",
    "correlation",
    "open",
    "open rescored captured",
    "open rescored yolox_nano_640",
    "table1",
    "table2",
    "table4",
    "table5",
}
"""Published experiments without a commit, made before there was a protocol; none may be added."""

needs_history = pytest.mark.skipif(not has_history(), reason="there is no history, or a shallow one")


def test_only_old_results_lack_a_commit():
    without = {name for name, file in SUMMARIES.items() if not json.loads(file.read_text()).get("commits")}
    assert without == BEFORE_THE_PROTOCOL, "take those that were made again off the list"


@pytest.mark.parametrize("setting", PROTOCOL)
def test_the_settings_of_the_published_runs_are_what_they_were(setting, tmp_path):
    """So the same command goes on from their folders."""
    summary = json.loads(SUMMARIES[f"rivals_{setting}"].read_text())
    seeds, experiment = summary["options"]["scenes.test_seeds"], SETTINGS[setting]
    given = [f"device={summary['options']['device']}", "requirements=null", f"scenes.test_seeds={seeds}"]
    config = load_config("default", overrides_of(experiment, given, quick=False))
    assert {**json.loads(unseeded(config)), "scenes.ego": None} == {**summary["options"], "scenes.ego": None}
    assert experiment.camera_renders_max == summary["camera_renders_max"]
    assert experiment.name == f"rivals_{setting}"
    if setting != "bus":  # whose mesh is not published
        with tarfile.open(PAGE.with_suffix("") / "rivals_runs.tar.xz") as archive:
            made = {
                Path(member.name).stem: json.load(archive.extractfile(member))["made_with"]
                for member in archive
                if f"rv/{setting}/results/" in member.name and member.name.endswith("_0.json")
            }
        tasks = _tasks(
            experiment, experiment.arms, config, dict.fromkeys(RIVAL_ARMS, 1), experiment.camera_renders_max, tmp_path
        )
        assert len(made) >= 11
        assert {task.name: task.made_with for task in tasks if task.name in made} == made


@needs_history
@pytest.mark.parametrize("name", sorted(set(SUMMARIES) - BEFORE_THE_PROTOCOL))
def test_published_results_are_of_code_that_the_history_holds(name):
    summary = json.loads(SUMMARIES[name].read_text())
    assert unknown_code(summary["commits"]) == []
    if summary.get("sealed_by"):
        assert summary["sealed_by"] in history()
        assert seal_of(summary["options"]["scenes.test_seeds"]) in (summary["sealed_by"], None)  # None: older protocol


@needs_history
def test_results_of_unknown_code_would_be_refused(tmp_path, monkeypatch):
    """The same check, on a summary that is published as the others are."""
    summary = json.loads(SUMMARIES["table1"].read_text())
    assert unknown_code(summary.get("commits", [])) == ["no commit of the code that made them"]
    commit = history()[0]
    recent = history()[:20]  # what is not there would be looked for in all of it
    monkeypatch.setattr(commit_module, "history", lambda: recent)
    good = {"hash": commit, "is_clean": True, "code": code_of(commit)}
    copy = {"hash": None, "is_clean": None, "code": code_of(commit)}
    package = {"hash": None, "is_clean": None, "code": "f" * 64}
    changed = {"hash": commit, "is_clean": False, "code": "f" * 64}
    for made_by, told, count in (
        (good, f"- Code: commit {commit}\n", 0),
        (copy, f"- Code: commit {commit}\n", 0),
        (package, "- Code: no commit: an installed package or a copy without history\n", 1),
        (changed, f"- Code: commit {commit} with changes\n", 1),
    ):
        (tmp_path / "summary.json").write_text(json.dumps({**summary, "commits": [made_by]}))
        page = write_results_page([tmp_path], tmp_path / "results.md").read_text(encoding="utf-8")
        assert told in page
        published = json.loads((tmp_path / "results" / "table1.json").read_text())
        assert len(unknown_code(published["commits"])) == count
        assert with_history(published) == published


@needs_history
def test_sealed_results_name_their_seal(tmp_path, monkeypatch):
    summary = json.loads(SUMMARIES["table1"].read_text())
    summary["options"]["scenes.test_seeds"] = [20_000_001, 20_000_000]
    monkeypatch.setattr("warpav.experiments.summary.seal_of", lambda seeds: history()[5])
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    page = write_results_page([tmp_path], tmp_path / "results.md").read_text(encoding="utf-8")
    assert "test 2 sealed ones;" in page
    assert f"- Test scenes sealed by commit {history()[5]}; code and configurations changed since: nothing\n" in page


def test_the_page_is_what_the_command_writes(tmp_path):
    names = re.findall(r"^## (.+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(names) == sorted(SUMMARIES)
    folders = []
    for k, name in enumerate(names):
        folders.append(tmp_path / str(k))
        folders[-1].mkdir()
        (folders[-1] / "summary.json").write_bytes(SUMMARIES[name].read_bytes())
    written = write_results_page(folders, tmp_path / "results.md")
    assert written.read_text(encoding="utf-8") == PAGE.read_text(encoding="utf-8")


TRAFFIC_SETTING_OF = {
    "dense streets: body": "dense_4_body",
    "dense streets: roof": "dense_4_roof",
    "dense streets: rack of 25 cm": "dense_4_rack",
    "dense streets: body, six cameras": "dense_6_body",
    "dense streets: body, all road users": "dense_4_body_all",
    "dense streets: body of a bus": "dense_4_body_bus",
    "recorded motorway and streets: body": "ngsim_4_body",
    "recorded motorway and streets: rack": "ngsim_4_rack",
    "recorded crossing: body": "sind_4_body",
    "recorded crossing: roof": "sind_4_roof",
    "recorded crossing: rack": "sind_4_rack",
    "recorded crossing: body, six cameras": "sind_6_body",
}
"""Rows of README's table of searches."""
TRAFFIC_RIVALS = ("highest", "roof_edge", "random_selected", "cma")
"""Its columns, after the default method."""


@pytest.mark.parametrize("label", TRAFFIC_SETTING_OF)
def test_readme_quotes_the_runs_on_hard_and_recorded_traffic(label):
    assert _traffic_row(label) in (ROOT / "README.md").read_text(encoding="utf-8").splitlines()


def _cells(line):
    return [cell.strip() for cell in line.strip("| ").split(" | ")]


def _traffic_row(label):
    """A row of README's table, from the tables that are published."""
    name = f"rivals_{TRAFFIC_SETTING_OF[label]}"
    summary = json.loads(SUMMARIES[name].read_text())
    judged = summary["table"].split("**Misses by the detector of the search**")[1]
    missed = {
        arm: np.mean([run["misses_per_100"] for run in summary["runs"] if run["arm"] == arm])
        for arm in ("default", *TRAFFIC_RIVALS)
    }
    headings, _, *lines = (_cells(line) for line in judged.split("\n\n", 2)[1].splitlines())
    kept = (0, 1, 2, 3, 4, -3, -2, -1)  # two headings between these are alike
    cells_of = {cells[0]: {headings[place]: cells[place] for place in kept} for cells in lines}
    panels = [file for found, file in SUMMARIES.items() if found.startswith(f"{name} before the panel")]
    goals = [goal for panel in panels for goal in json.loads(panel.read_text())["goals"]]
    ours = cells_of["default"]
    row = [label, f"**{missed['default']:.1f}**"]
    for arm in TRAFFIC_RIVALS:
        low, high = (float(end) for end in re.search(r"\[(\S+), (\S+)\]", cells_of[arm]["less default"]).groups())
        outside = [
            goal["numbers"]
            for goal in goals
            if goal["text"].startswith(f"fewer misses than {arm},") and "outside networks" in goal["text"]
        ]
        lows = [float(number) for number in re.findall(r"\[([-+.\d]+), [-+.\d]+\]", " ".join(outside))]
        agreed = f" {sum(each > 0.0 for each in lows)}/{len(lows)}" if lows else ""
        mark = "✓" if low > 0.0 else "✗" if high < 0.0 else "≈"
        row.append(f"{missed[arm]:.1f} {mark}{agreed}")
    for arm in PRACTICE:
        share, low, high = map(float, re.findall(r"[-+.\d]+", ours[f"% fewer attainable than {arm}"]))
        row.append(f"{'≈ ' if low < 0.0 < high else ''}{share:.1f} %")
    return "| " + " | ".join(row) + " |"


def test_descents_of_the_thesis_fail_where_a_camera_looks_at_its_own_vehicle():
    """What docs/method.md says of tables II and IV."""
    low, high, with_blockage = [], [], []
    for name in ("table2", "table4"):
        for run in json.loads(SUMMARIES[name].read_text())["runs"]:
            if run["arm"].startswith("sgd"):
                blocked = any(each["position_m"][0] > 1.9 and abs(each["yaw_deg"]) > 120.0 for each in run["cameras"])
                (low if run["tp_detection_rate"] < 0.75 else high).append((run["tp_detection_rate"], blocked))
                if run["arm"].endswith(("_sb", "_sb_ac")):
                    with_blockage.append(blocked)
    assert (len(low), len(high)) == (11, 24)
    assert all(blocked for _, blocked in low)
    assert not any(blocked for _, blocked in high)
    assert [round(end(rate for rate, _ in high), 2) for end in (min, max)] == [0.8, 0.94]
    assert len(with_blockage) == 10
    assert not any(with_blockage)


def test_the_random_rows_of_table_two_are_one_measurement():
    runs = json.loads(SUMMARIES["table2"].read_text())["runs"]
    one, other = ([run["cameras"] for run in runs if run["arm"] == f"random_ifr_{loss}"] for loss in ("doa", "10doa"))
    assert len(one) == 5
    assert one == other
