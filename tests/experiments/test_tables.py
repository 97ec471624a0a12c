"""Tables in the thesis's layout, arms against each other, and the command that makes them."""

import json

import numpy as np
import pytest

from tests.experiments.small_experiment import complaint, overrides
from warpav.cli.app import main
from warpav.experiments import arms, thesis_experiments
from warpav.experiments.tables import Cell, compare_results, result_table
from warpav.experiments.thesis_experiments import EXPERIMENTS, TABLES_OF, loss_overrides
from warpav.optimisation.losses.registry import LOSSES
from warpav.thesis.tables import WARNING, thesis_table

pytestmark = pytest.mark.usefixtures("working_directory")

METRICS = (
    "map50_average",
    "map50_min_camera",
    "map50_max_camera",
    "tp_detection_rate",
    "tp_in_frame_rate",
    "detection_confidence",
    "objective",
)


def result(number, **more):
    """A run all of whose numbers are the same."""
    metrics = {**dict.fromkeys(METRICS, number), "min_camera_distance_m": 2.0 * number}
    return {"metrics": metrics, "constraint_loss": 0.0, **more}


# ------------------------------------------------------------------------------------------------ layout


@pytest.mark.parametrize("number", ["II", "IV"])
def test_tables_have_the_rows_and_columns_of_the_thesis(number):
    name = {"II": "table2", "IV": "table4"}[number]
    results = {arm.name: [result(0.25), result(0.75)] for arm in EXPERIMENTS[name].arms}
    table = result_table(number, results, thesis_experiments._labels(number))
    printed = thesis_table(number)["rows"]
    assert [row.labels for row in table.rows][: len(printed)] == [(row["method"], row["loss"]) for row in printed]
    for row, thesis in zip(table.rows, printed, strict=False):
        assert {"method", "loss", *row.thesis} == set(thesis)
        for key, cell in row.thesis.items():
            assert (cell.mean, cell.std) == (thesis[key]["mean"], thesis[key]["std"])
            assert row.ours[key] == Cell(0.5, pytest.approx(np.std([0.25, 0.75], ddof=1)))
    if number == "IV":  # announced, not printed
        assert (table.rows[-1].labels, table.rows[-1].thesis) == (("SGD", "IFR+DOA+SB+OV"), {})
    lines = table.markdown().splitlines()
    assert lines[0] == f"**Table {number}. {thesis_table(number)['caption']}**"
    assert lines[2].count("|") == lines[4].count("|") == len(METRICS) + 5
    assert lines[4].startswith(f"| {printed[0]['method']} | {printed[0]['loss']} | ours | 2 | 0.500 ±0.354 |")
    assert lines[5].startswith("|  |  | thesis |  | 0.")
    assert lines[-1] == WARNING


def test_rows_with_the_same_rigs_are_said_to_be_one_measurement():
    rigs = [{"seed": seed, "rig": {"cameras": [{"position_m": [seed, 0.0, 1.0]}]}} for seed in range(3)]
    results = {
        "random_ifr_doa": [result(0.5, **rig) for rig in rigs[:2]],
        "random_ifr_10doa": [result(0.5, **rig) for rig in rigs[:2]],
        "sgd_ifr": [result(0.5, **rig) for rig in rigs[1:]],
    }
    table = result_table("II", results, thesis_experiments._labels("II"))
    told = "Ours hold the same rigs, so they are one measurement: Random IFR+DOA and Random IFR+10*DOA."
    assert table.notes[-1] == told
    del results["random_ifr_10doa"]
    assert told not in result_table("II", results, thesis_experiments._labels("II")).notes


def test_constraints_are_those_of_the_last_iterate():
    results = {
        "sgd_ifr": [result(0.3, unprojected_constraint_loss=0.5), result(0.3, unprojected_constraint_loss=1.5)],
        "highest_ifr_doa": [result(0.1)],
        "sobol": [],
    }
    table = result_table("III", results, thesis_experiments._labels("III"))
    assert table.caption == "Constraint results"
    one, other, third = table.rows
    assert (one.ours["constraint_loss"].mean, str(one.thesis["min_pair_distance_m"])) == (1.0, "0.382 ±0.204")
    assert str(one.ours["min_pair_distance_m"]) == "0.600 ±0.000"
    assert (other.labels, str(other.ours["min_pair_distance_m"])) == (("Highest", "IFR+DOA"), "0.200")
    assert (third.labels, third.runs, str(third.ours["constraint_loss"])) == (("sobol", "as configured"), 0, "-")
    assert third.thesis == {}


def test_gradients_are_pooled_and_stand_beside_the_thesis():
    def magnitude(mean, share):
        return {"positional": mean, "rotational": 0.0, "positional_share": share, "rotational_share": 0.0}

    runs = [{"gradients": {"out_of_bounds": magnitude(*each)}} for each in ((1.0, 0.1), (2.0, 0.3))]
    table = result_table("I", {"gradients": runs}, {})
    assert [row.labels[0] for row in table.rows] == ["OOB", "CD", "IFR", "DOA"]
    assert str(table.rows[0].ours["positional"]) == "1.750 ±0.707"
    assert str(table.rows[3].ours["positional"]) == "-"
    assert str(table.rows[3].thesis["rotational"]) == "0.016"


def test_losses_are_read_as_the_thesis_writes_them():
    weights = dict(override.removeprefix("losses.").split("=") for override in loss_overrides("IFR+10*DOA"))
    assert weights.pop("in_frame_rotation") == "1.0"
    assert weights.pop("detected_area") == "10.0"
    assert set(weights) == {*LOSSES} - {"in_frame_rotation", "detected_area"}
    assert set(weights.values()) == {"0.0"}
    assert loss_overrides("IFR+DOA*") == loss_overrides("DOA+IFR")
    with pytest.raises(ValueError, match=r"got 'CD' in 'IFR\+CD'"):
        loss_overrides("IFR+CD")


def test_every_experiment_has_the_runs_of_the_thesis():
    assert [EXPERIMENTS[name].runs for name in sorted(EXPERIMENTS)] == [10, 5, 5, 5, 10]
    assert [arm.name for arm in EXPERIMENTS["table2"].arms] == [
        "sgd_ifr",
        "sgd_doa",
        "sgd_ifr_doa",
        "sgd_ifr_10doa",
        "random_ifr_doa",
        "random_ifr_10doa",
        "highest_ifr_doa",
    ]
    assert EXPERIMENTS["table3"] == EXPERIMENTS["table2"]
    assert sorted(TABLES_OF) == sorted(EXPERIMENTS)


# ------------------------------------------------------------------------------------------------ arms


def arm_result(recall, objects):
    """A run by its recall in every scene."""
    return {
        "objects_of_scene": objects,
        "metrics": {
            "tp_detection_rate": float(np.average(recall, weights=objects)),
            "per_scene": {"tp_detection_rate": list(recall)},
        },
    }


def test_arms_are_compared_scene_by_scene(rng):
    objects = rng.integers(1, 9, 30).tolist()
    base = rng.uniform(0.2, 0.6, 30)
    results = {
        "ours": [arm_result(base + 0.2 + rng.normal(0.0, 0.02, 30), objects) for _ in range(3)],
        "much worse": [arm_result(base, objects)],
        "alike": [arm_result(base + 0.2 + rng.normal(0.0, 0.02, 30), objects) for _ in range(2)],
        "never ran": [],
    }
    table = compare_results(results, "ours", metrics=["tp_detection_rate"], resamples=999)
    difference = table.differences["tp_detection_rate"]
    assert difference["much worse"].low > 0.15
    assert difference["much worse"].p_holm < 0.05
    assert difference["alike"].low < 0.0 < difference["alike"].high
    # the difference is that of the recalls of all objects together
    recalls = table.numbers["tp_detection_rate"]
    assert difference["alike"].mean == pytest.approx(recalls["ours"].mean - recalls["alike"].mean, abs=1e-12)
    text = table.markdown().splitlines()
    assert text[2].startswith("| ours | 3 | 0.")
    assert text[3].startswith("|  |  | [0.")
    assert text[6].startswith("|  |  | +0.")
    assert text[6].endswith("* |  |  |  |")
    assert " p=0.0" in text[6]
    low, high = (getattr(table.intervals["tp_detection_rate"]["ours"], end) for end in ("low", "high"))
    assert low < recalls["ours"].mean < high
    assert "- No result: never ran." in text
    with pytest.raises(ValueError, match="got 'never ran'"):
        compare_results(results, "never ran")


# ------------------------------------------------------------------------------------------------ command


def test_table1_measures_and_writes(working_directory, scenes, capsys):
    words = ["experiment", "table1", *overrides(scenes)]
    words = [word for word in words if "batch_size" not in word]
    assert main([*words, "--runs", "2"]) == 0
    shown = capsys.readouterr().out
    assert WARNING in shown
    assert "OOB" in shown
    folder = working_directory / "runs" / "table1"
    written = json.loads((folder / "table1.json").read_text())
    assert [row["labels"] for row in written["rows"]] == [["OOB"], ["CD"], ["IFR"], ["DOA"]]
    assert [row["runs"] for row in written["rows"]] == [2] * 4
    assert written["rows"][0]["thesis"]["positional"] == {"mean": 0.977, "std": None}
    found = json.loads((folder / "results" / "gradients_1.json").read_text())
    assert found["camera_renders"] == 4  # two iterations of one scene in two cameras
    assert (folder / "table1.md").read_text().startswith("**Table I.")
    page = working_directory / "results.md"
    assert main(["experiment", "results", str(folder), "--out", str(page)]) == 0
    assert "**Table I." in page.read_text()
    published = json.loads((working_directory / "results" / "table1.json").read_text())
    assert [run["gradients"] for run in published["runs"]] == [
        json.loads((folder / "results" / f"gradients_{seed}.json").read_text())["gradients"] for seed in (0, 1)
    ]


def test_table2_and_table3_share_their_runs(working_directory, scenes, capsys):
    words = [*overrides(scenes), "--runs", "1", "--arms", "highest_ifr_doa,start", "--quick"]
    assert main(["experiment", "table2", *words]) == 0
    folder = working_directory / "runs" / "table2_quick"
    assert "2 new results" in capsys.readouterr().out
    assert main(["experiment", "table3", *words]) == 0
    shown = capsys.readouterr().out
    assert "2 of 2 results are in" in shown
    assert "Table III. Constraint results" in shown
    rows = json.loads((folder / "table2.json").read_text())["rows"]
    assert [row["labels"] for row in rows] == [["Highest", "IFR+DOA*"], ["start", "as configured"]]
    assert rows[0]["ours"]["optimisable_loss"]["mean"] > 0.0
    assert rows[1]["thesis"] == {}
    page = working_directory / "results.md"
    assert main(["experiment", "results", str(folder), "--out", str(page)]) == 0
    assert "**Table II." in page.read_text()
    assert "**Table III." in page.read_text()


def test_a_failed_arm_ends_the_command_with_1(working_directory, scenes, monkeypatch, capsys):
    def fail(problem, camera_renders_max):
        raise ValueError("no luck")

    monkeypatch.setitem(arms.METHODS, "fails", fail)
    words = [*overrides(scenes), "--runs", "1", "--arms", "fails,highest_ifr_doa"]
    assert main(["experiment", "table2", *words]) == 1
    shown = capsys.readouterr().out
    assert "failed: fails_0: ValueError: no luck" in shown
    assert "1 new results" in shown
    assert (working_directory / "runs" / "table2" / "results" / "highest_ifr_doa_0.json").is_file()


def test_bad_words_are_told_in_one_line(working_directory, scenes, capsys):
    given = overrides(scenes)

    def line(*words):
        return complaint(capsys, "experiment", *words)

    assert line("table2", *given, "--arms", "sgd_irf").endswith("got 'sgd_irf'; did you mean sgd_ifr?")
    assert line("table2", *given, "--budget", "0") == "command line (--budget): expected at least 1, got 0"
    assert line("table2", *given, "--runs", "0") == "command line (--runs): expected at least 1, got 0"
    assert line("table2", *given, "--budget", "5").startswith(
        "arm sgd_ifr: --budget: expected at least 12 camera renders"
    )
    assert line("table1", *given[:3], "--arms", "cma").startswith(
        "command line (--arms): expected nothing, as table1 measures gradients"
    )
    assert "losses.detected_area: expected an option that the arms of table2 leave alone" in line(
        "table2", "losses.detected_area=3"
    )
    assert "executor.workers: expected a whole number from 1" in line("table2", *given, "--workers", "0")
    assert line("table2", *given, "detector.model=gone.onnx").startswith("command line (detector.model=gone.onnx)")
    assert line("table2", *given, "scenes.test_seeds=[2, 9]", "--runs", "1").startswith(
        f"command line (scenes.folder={scenes})"
    )
    assert "table6" in line("table6")
    assert not list((working_directory / "runs" / "table2" / "results").iterdir())


def test_an_address_where_nobody_answers_ends_with_2(working_directory, scenes, capsys):
    pytest.importorskip("ray")
    words = [*overrides(scenes), "--executor", "ray", "--address", "127.0.0.1:1", "--runs", "1"]
    told = complaint(capsys, "experiment", "table2", *words)
    assert told.startswith("command line (executor.address=127.0.0.1:1): executor.address: expected a Ray cluster")
