"""``warpav optimise`` and ``evaluate``: the run folder, its documented fields, interrupted runs."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.cli.small_run import SMALL
from warpav.cli.app import main
from warpav.optimisation import OPTIONAL_METRICS
from warpav.runs import RunFolder
from warpav.runs._rig_evaluation import TABLE_ROWS
from warpav.thesis import Descent

pytestmark = pytest.mark.usefixtures("working_directory")


def _numbers(metrics):
    """The metrics of an arm that are shown, those without a value left out."""
    return {field: metrics[field] for field in TABLE_ROWS if metrics.get(field) is not None}


def test_the_run_folder_is_complete(run_folder):
    found = {file.relative_to(run_folder.path).as_posix() for file in run_folder.path.rglob("*") if file.is_file()}
    assert found >= {"report.html", *(f"figures/{name}.png" for name in ("loss_curves", "ground", "detections"))}
    assert len([name for name in found if name.startswith("figures/")]) <= 6
    assert not [name for name in found if "draft" in name]
    assert run_folder.path.joinpath("report.html").read_text(encoding="utf-8").count("<img") <= 6


def test_the_evaluation_has_the_documented_fields(run_folder):
    evaluation = run_folder.evaluation()
    assert (evaluation["schema"], evaluation["scenes"]) == (1, {"test": 2})
    assert list(evaluation["arms"]) == ["optimised", "start", "highest", "random"]
    assert list(evaluation["paired"]) == ["start", "highest", "random"]
    for metrics in evaluation["arms"].values():
        assert set(metrics) >= set(TABLE_ROWS) - set(OPTIONAL_METRICS) | {
            *("map50_min_camera", "map50_max_camera", "tp_detection_rate", "tp_in_frame_rate", "detection_confidence"),
            *("constraint_violation", "objects", "frames", "recall_by", "per_scene", "body_share", "redundant_rate"),
            *("confidence_at_equal_false_alarms", "recall_at_equal_false_alarms"),
        }
        assert all(len(values) == 2 for values in metrics["per_scene"].values())
        for by in ("distance_m", "sector", "category", "road_user"):
            assert sum(group["objects"] for group in metrics["recall_by"][by].values()) == metrics["objects"]
        assert metrics["constraint_violation"] == 0.0
        assert len(metrics["body_share"]) == 2
        assert 0.0 <= metrics["body_share_max"] == max(metrics["body_share"].values()) < 1.0
    for arm, metrics in evaluation["arms"].items():
        told = [seen["outcome"][arm] for seen in evaluation["outcomes"]]
        assert len(told) == metrics["objects"]
        assert told.count("detected") == round(metrics["recall_at_equal_false_alarms"] * metrics["objects"])
        assert told.count("out of frame") == round((1.0 - metrics["tp_in_frame_rate"]) * metrics["objects"])
        assert np.shape(evaluation["ground"]["blind"][arm]) == np.shape(evaluation["ground"]["cells"]) == (2, 8, 5)
        distances = [each["value_m"] for each in evaluation["constraints"][arm] if each["kind"] == "spacing"]
        assert min(distances) == pytest.approx(metrics["min_camera_distance_m"])
    by_distance = evaluation["arms"]["optimised"]["recall_by"]["distance_m"]
    assert sum(seen["distance_m"] < 10.0 for seen in evaluation["outcomes"]) == by_distance["0-10"]["objects"]
    assert evaluation["descent"] | {"kept": 0} == {"iterations": 3, "planned": 3, "ended": None, "kept": 0}
    assert evaluation["seconds"]["total"] == pytest.approx(sum(evaluation["seconds"].values()) / 2.0)
    training = evaluation["training_objective"]
    assert training["optimised"] <= training["start"]  # the best iterate is kept, and the start is one of them


def test_a_run_repeats_itself_and_prints_whole_lines_when_piped(run_folder, capsys):
    assert main(["optimise", *SMALL, "run.out=again"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 25
    assert [line.split()[4] for line in lines if "] iteration " in line] == ["1/3", "2/3", "3/3"]
    assert main(["optimise", *SMALL, "run.out=told", "--verbose"]) == 0
    again = RunFolder.open("again")
    for role in ("initial", "best", "final"):
        name = f"rig_{role}.yaml"
        assert (again.path / name).read_bytes() == (run_folder.path / name).read_bytes()
    assert again.evaluation()["arms"] == run_folder.evaluation()["arms"]

    output = capsys.readouterr().out
    assert "\x1b" not in output
    lines = output.splitlines()
    assert len(lines) > 25
    assert any(line.startswith("Constraints: All ") for line in lines)
    assert any(line.startswith("Objective: ") for line in lines)


def test_evaluating_the_run_gives_its_own_metrics(run_folder, working_directory):
    assert main(["evaluate", str(run_folder.path), "--json", "m.json"]) == 0
    found = json.loads((working_directory / "m.json").read_text())
    assert found["scenes"] == {"test": 2}
    of_the_run = run_folder.evaluation()["arms"]["optimised"]
    assert _numbers(found["arms"]["optimised"]) == pytest.approx(_numbers(of_the_run), abs=1e-3)
    margins, expected = (each["constraints"]["optimised"] for each in (found, run_folder.evaluation()))
    assert [margin["cameras"] for margin in margins] == [margin["cameras"] for margin in expected]


def test_rigs_beside_the_first_are_measured_on_the_same_scenes(run_folder, working_directory, capsys):
    few = ["scenes.train_seeds=[0]", "scenes.test_seeds=[1000]", "run.batch_size=1", "rig.cameras=2"]
    (working_directory / "a").mkdir()
    shutil.copy(run_folder.rig_file(), "mine.yaml")
    shutil.copy(run_folder.rig_file(), "a/mine.yaml")
    beside = ["--beside", "mine.yaml", "--beside", "nuscenes", "--beside", "a/mine.yaml"]
    assert main(["evaluate", "highest", *few, *beside, "--json", "m.json"]) == 0
    assert main(["evaluate", "nuscenes", *few, "--json", "alone.json"]) == 0
    found, alone = (json.loads((working_directory / name).read_text()) for name in ("m.json", "alone.json"))
    assert list(found["arms"]) == ["highest", "mine", "nuscenes", "a/mine.yaml"]
    assert found["arms"]["mine"] == found["arms"]["a/mine.yaml"]
    assert found["arms"]["mine"]["objective"] is not None  # of other cameras than the configuration's
    assert found["camera_outage"]["mine"] is not None
    assert _numbers(found["arms"]["nuscenes"]) == pytest.approx(_numbers(alone["arms"]["nuscenes"]), abs=1e-6)
    assert set(found["paired"]) == {"mine", "nuscenes", "a/mine.yaml"}
    assert list(found["constraints"]) == ["highest"]
    assert "no interval can exclude 0" in capsys.readouterr().out


def test_compare_says_who_misses_least_and_that_a_rig_is_no_better_than_itself(run_folder, working_directory, capsys):
    few = ["scenes.train_seeds=[0]", "scenes.test_seeds=1000..1005", "run.batch_size=1", "run.pictures=none"]
    rig = yaml.safe_load(run_folder.rig_file().read_text())
    Path("mine.yaml").write_text(yaml.safe_dump(rig))
    Path("same.yaml").write_text(yaml.safe_dump(rig))
    for camera in rig["cameras"]:
        camera["pitch_deg"] = -80.0  # it sees the sky
    Path("up.yaml").write_text(yaml.safe_dump(rig))
    assert main(["compare", "mine.yaml", "same.yaml", "up.yaml", *few, "--out", "page.html"]) == 0
    page = Path("page.html").read_text()
    headline = re.search(r'class="headline[^>]*>(.*?)</p>', page, re.DOTALL)[1]
    assert re.match(r"mine misses fewest, .* in 6 unseen scenes", headline)
    of_itself, of_up = re.findall(r"(\S+ \[\S+, \S+\] fewer than \w+ \([^)]*)\)", headline)
    assert of_itself == "+0.0 [+0.0, +0.0] fewer than same (not told apart, as the 95\xa0% interval includes 0"
    assert of_up.endswith("than up (told apart")
    assert not re.search(r"(?:src|href)=.https?:", page)
    assert len(page) < 8e6
    capsys.readouterr()
    for words in (["mine.yaml", "mine.yaml"], ["mine.yaml", "run.batch_size=1"], [*("abcd")]):
        assert main(["compare", *words, "--out", "no.html"]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert main(["compare", "mine.yaml", "up.yaml", "--out", "no.png"]) == 2
    seen = ["scenes.train_seeds=[5]", "scenes.test_seeds=[1]", "run.batch_size=1"]
    assert main(["compare", "up.yaml", str(run_folder.path), *seen, "--out", "no.html"]) == 2
    assert "expected scenes that no run has searched on, got 1 of" in capsys.readouterr().err
    assert main(["compare", "up.yaml", str(run_folder.path), *few, "scenes.ego=bus", "--out", "no.html"]) == 2
    assert "scenes.ego: expected none, the vehicle of" in capsys.readouterr().err
    assert not list(Path().glob("no.*"))


@pytest.mark.parametrize(
    ("height_m", "pitch_deg", "rule", "found"),
    [
        (1.8, 0.0, "Horizon below", r"50% \(front\).*\+40%"),
        (1.8, 60.0, "Horizon below", r"-100% \(front\).*-110%"),
        (1.2, 0.0, "Cameras on the body", r"0\.\d\d m inside \(front\).*-0\.\d\d m"),
    ],
)
def test_check_fails_what_an_engineer_would_not_mount(height_m, pitch_deg, rule, found, working_directory, capsys):
    """Half of a level camera's image is above the horizon; one that looks down by more than half its view has none."""
    place = {"position_m": [1.2, 0.0, height_m], "yaw_deg": 0.0, "roll_deg": 0.0}
    camera = {"name": "front", **place, "pitch_deg": pitch_deg, "fov_deg": 60.0, "width_px": 64, "height_px": 64}
    Path("one.yaml").write_text(yaml.safe_dump({"frame": "ego", "cameras": [camera]}))
    is_good = height_m > 1.5 and pitch_deg == 0.0
    assert main(["check", "one.yaml", "--out", "check.html"]) == (not is_good)
    row = re.search(rf"<tr>(?:(?!</tr>).)*{rule}.*?</tr>", Path("check.html").read_text(), re.DOTALL)[0]
    assert ("FAIL" in row, "pass" in row) == (not is_good, is_good)
    assert re.search(found, row, re.DOTALL)
    assert (f"FAIL {rule}" in capsys.readouterr().out) == (not is_good)
    assert main(["check", "one.yaml", "--requirements", "nothing", "--out", "no.html"]) == 2
    assert not Path("no.html").exists()


def test_evaluating_says_what_dirt_and_loads_cost(working_directory, capsys):
    few = ["scenes.train_seeds=[0]", "scenes.test_seeds=[1000]", "run.batch_size=1", "rig.cameras=2"]
    asked = ["--soiling", "rows", "0.5", "0.5", "1", "--load", "-1", "-0.05", "--load", "0", "0"]
    assert main(["evaluate", "highest", *few, *asked, "--json", "m.json"]) == 0
    found = json.loads((working_directory / "m.json").read_text())
    outage = found["camera_outage"]["highest"]
    # an image that is covered all over is a camera that is lost
    for soiled, lost in zip(found["soiling"]["cameras"], outage["cameras"], strict=True):
        assert soiled["expected_misses_per_100"] == pytest.approx(lost["expected_misses_per_100"], abs=1e-3)
    laden, none = found["load_states"]["states"]
    assert laden["state"] == {"pitch_deg": -1.0, "height_m": -0.05}
    assert abs(laden["difference_per_100"]) > 1e-3 > abs(none["difference_per_100"])
    printed = capsys.readouterr().out
    assert "Soiled in one camera: a band of rows" in printed
    assert re.search(r"load 1 .*-1\.0 .*-0\.050", printed)
    assert main(["evaluate", "highest", *few, "--json", "plain.json"]) == 0
    assert not {"soiling", "load_states"} & set(json.loads((working_directory / "plain.json").read_text()))


def test_ctrl_c_leaves_a_usable_run_folder(working_directory, monkeypatch, capsys):
    step = Descent.step

    def interrupted(self):
        if self.iteration == 2:
            raise KeyboardInterrupt
        return step(self)

    monkeypatch.setattr(Descent, "step", interrupted)
    assert main(["optimise", *SMALL, "run.out=stopped"]) == 130
    captured = capsys.readouterr()
    assert captured.err == "interrupted\n"
    assert "what was reached is in stopped" in captured.out
    folder = RunFolder.open("stopped")
    assert [event["iteration"] for event in folder.events()] == [0, 1]
    assert len(folder.rig().cameras) == 2
    assert folder.evaluation() is None
    with np.load(folder.path / "checkpoints" / "last.npz", allow_pickle=False) as state:
        assert state["iteration"] == 2
    assert main(["report", "stopped"]) == 0
    assert (working_directory / "stopped" / "report.html").is_file()


def test_a_result_that_is_worse_than_its_start_is_never_the_rig_of_the_run(capsys):
    # steps of 4 m, and the last iterate counts
    steps = ["optimiser.search=descent", "optimiser.learning_rate_position_m=4", "optimiser.keep=last"]
    steps += ["optimiser.starts=1", "rig.start=corners", "rig.free.pitch_deg=null"]
    assert main(["optimise", *SMALL, *steps, "run.iterations=4", "run.out=worse"]) == 0
    captured = capsys.readouterr()
    folder = RunFolder.open("worse")
    evaluation = folder.evaluation()
    training = evaluation["training_objective"]
    assert training["optimised"] > training["start"]
    assert evaluation["rig_of_run"] == "start"
    verdict = "WORSE THAN ITS START: the rig that was found has objective"
    shown = captured.out.splitlines()
    [first] = (k for k, line in enumerate(shown) if line.startswith(verdict))
    assert shown[first + 1].startswith("2 unseen scenes")  # the verdict, then the table
    assert (captured.out + captured.err).lower().count("worse than") == 1
    said, listed, _ = re.split(r"(?<=rig_best.yaml\)):\n|(?=\n!)", captured.out, maxsplit=2)
    assert said.endswith("The rig at the start, which is the rig of this run (rig_best.yaml)")
    assert [line.split()[0] for line in listed.splitlines()] == [each.name for each in folder.rig("initial").cameras]
    best, start, last = ((folder.path / f"rig_{role}.yaml").read_bytes() for role in ("best", "initial", "final"))
    assert best == start != last
    assert (folder.path / "report.html").read_text().count(verdict) == 1
