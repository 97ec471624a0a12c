"""What is published follows from the numbers that are published with it."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from warpav.experiments.protocol import seal_of, unknown_code
from warpav.experiments.summary import with_history, write_results_page
from warpav.runs.commit import code_of, has_history, history

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "results.md"
SUMMARIES = {json.loads(file.read_text())["experiment"]: file for file in PAGE.with_suffix("").glob("*.json")}
ARM_OF = {
    "**warpav**": "default",
    "its pool and selection alone": "pool_only",
    "random cameras, our selection": "random_selected",
    "Sobol cameras, our selection": "sobol_selected",
    "its descent alone, from the highest point": "descent_only",
    "best Sobol rig": "sobol",
    "cameras around the highest point": "highest",
    "best random rig": "random",
    "greedy set cover": "greedy_cover",
    "CMA-ES": "cma",
    "differential evolution": "differential_evolution",
}
"""Rows of README's table of arms."""


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


@needs_history
@pytest.mark.parametrize("name", sorted(set(SUMMARIES) - BEFORE_THE_PROTOCOL))
def test_published_results_are_of_code_that_the_history_holds(name):
    summary = json.loads(SUMMARIES[name].read_text())
    assert unknown_code(summary["commits"]) == []
    if summary.get("sealed_by"):
        assert summary["sealed_by"] in history()
        assert seal_of(summary["options"]["scenes.test_seeds"]) in (summary["sealed_by"], None)  # None: older protocol


@needs_history
def test_results_of_unknown_code_would_be_refused(tmp_path):
    """The same check, on a summary that is published as the others are."""
    summary = json.loads(SUMMARIES["table1"].read_text())
    assert unknown_code(summary.get("commits", [])) == ["no commit of the code that made them"]
    commit = history()[0]
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


@pytest.mark.parametrize("label", ARM_OF)
def test_readme_quotes_the_runs(label):
    table = (ROOT / "README.md").read_text().split("| expected misses per 100 vehicles", 1)[1].split("\n\n", 1)[0]
    [row] = [line for line in table.splitlines() if line.startswith(f"| {label} |")]
    cells = [cell.strip(" *") for cell in row.split("|")[2:6]]
    for setting, value, ahead in (("4x90", *cells[:2]), ("2x60", *cells[2:])):
        misses = _misses(setting, ARM_OF[label])
        quoted = [float(number) for number in re.findall(r"[\d.]+", value)]
        assert quoted[0] == pytest.approx(np.mean(list(misses.values())), abs=6e-3)
        if len(misses) > 1:
            assert quoted[1] == pytest.approx(np.std(list(misses.values()), ddof=1), abs=6e-3)
        ours = _misses(setting, "default")
        won = sum(ours[seed] <= misses.get(seed, misses[0]) + 1e-4 for seed in ours)
        assert ahead == ("" if ARM_OF[label] == "default" else f"{won} of {len(ours)}")


def test_readme_quotes_the_recalls_of_before():
    text = " ".join((ROOT / "README.md").read_text().split())
    for arm, words in (
        ("gradient", "the descent found"),
        ("highest", "the highest rig"),
        ("thesis_gradient", "losses"),
    ):
        recall = [
            run["tp_detection_rate"] for run in json.loads(SUMMARIES["open"].read_text())["runs"] if run["arm"] == arm
        ]
        assert f"{words} {np.mean(recall):.3f}".replace("0.", ".") in text


def _misses(setting, arm):
    """Expected misses per 100 vehicles on unseen scenes, by run seed."""
    runs = json.loads(SUMMARIES[f"rivals_{setting}"].read_text())["runs"]
    return {run["seed"]: 100.0 * run["objective"] for run in runs if run["arm"] == arm}


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
