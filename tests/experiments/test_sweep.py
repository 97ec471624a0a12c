"""The sweep: one circumstance at a time, gains that follow from the rigs, a figure; what is there is not done again."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.experiments.small_experiment import complaint, overrides
from warpav.cli.app import main
from warpav.core.errors import ArgumentError
from warpav.experiments import sweep
from warpav.experiments.sweep import FACTORS, OPTIONS, QUICK, Point, factors_of, gains_of, points_of, sweep_table
from warpav.runs.config import changed_config, load_config


@pytest.fixture(autouse=True)
def working_directory(working_directory, monkeypatch):
    """An empty working directory; and few resamples, for time."""
    monkeypatch.setitem(sweep.run_sweep.__kwdefaults__, "resamples", 99)
    return working_directory


def test_one_factor_changes_at_a_time_around_the_middle():
    for quick in (False, True):
        config = load_config("default", [*OPTIONS, *(QUICK if quick else ())])
        points = points_of(config, factors_of(None, quick=quick))
        names = [point.name for point in points]
        assert names.count("middle") == len(FACTORS)
        assert len(set(names)) == len(names) - len(FACTORS) + 1
        for point in points:
            changed = changed_config(config, FACTORS[point.factor].overrides(point.value))
            assert FACTORS[point.factor].middle(changed) == point.value
            for other in FACTORS.keys() - {point.factor}:
                assert FACTORS[other].middle(changed) == FACTORS[other].middle(config)
    assert [point.value for point in points if point.factor == "traffic"] == ["easy", "urban", "dense"]


def test_factors_and_values_are_chosen():
    assert factors_of(["traffic=sind,easy", "cameras=4,2,4"], quick=False) == {
        "cameras": (4, 2),
        "traffic": ("sind", "easy"),
    }
    assert factors_of(["fov"], quick=True) == {"fov": FACTORS["fov"].quick}
    for words, text in (
        (["size"], "expected a factor out of cameras, fov, height, traffic, got 'size'"),
        (["cameras=two"], "expected values of cameras with commas, numbers, got 'two'"),
        (["traffic=jam"], "expected values of traffic with commas, out of easy"),
    ):
        with pytest.raises(ArgumentError, match=text):
            factors_of(words, quick=False)


def test_bad_words_are_told_in_one_line(capsys):
    assert "it is an option of sweep" in complaint(capsys, "experiment", "open", "--vary", "fov")
    assert "with sweep" in complaint(capsys, "experiment", "sweep", "--setting", "4x90")
    assert "camera.fov_deg" in complaint(capsys, "experiment", "sweep", "--vary", "fov=900")


def made_run(seed, missed):
    return {"seed": seed, "objects_of_scene": [4, 0, 2], "test_objective_of_scene": [missed, None, 2.0 * missed]}


def test_gains_follow_from_the_runs():
    points = [
        Point("cameras", 2, False),
        Point("cameras", 4, True),
        Point("fov", 90.0, True),
        Point("fov", 60.0, False),
    ]
    results = {
        "default_middle": [made_run(0, 0.1), made_run(1, 0.12)],
        "highest_middle": [made_run(0, 0.2)],
        "default_cameras_2": [made_run(0, 0.3)],
        "highest_cameras_2": [made_run(0, 0.3)],
        "default_fov_60": [made_run(0, 0.3)],
    }
    gains = gains_of(points, results, resamples=99)
    assert [each.point for each in gains] == points[:3]
    middle = gains[1]
    # weighed by road users: (4 x 1 + 2 x 2) / 6 of the first scene's
    assert middle.highest == pytest.approx(100.0 * 0.2 * 8 / 6)
    assert middle.default == pytest.approx(100.0 * 0.11 * 8 / 6)
    assert middle.gain.mean == pytest.approx(middle.highest - middle.default)
    assert middle.reduction.mean == pytest.approx(0.45)
    assert (middle.road_users, middle.runs) == (2.0, 2)
    assert gains[2].gain == middle.gain
    assert gains[0].gain.mean == pytest.approx(0.0, abs=1e-12)
    text = sweep_table(gains).markdown()
    assert "| number of cameras: 4 (middle) | 2.0 | 26.67 | 14.67 |" in text


@pytest.mark.slow
def test_a_sweep_is_one_command_and_goes_on_where_it_was(scenes, working_directory, capsys):
    small = ("scenes.level=null", "optimiser.pool_cameras=16", "detector.confidence_min=0.25")  # the shipped fit
    words = ["experiment", "sweep", *overrides(scenes, *small), "--runs", "2", "--out", "found"]
    words += ["--vary", "cameras=1", "--vary", "height=0.5"]
    assert main(words) == 0
    data = json.loads(Path("found/sweep.json").read_text())
    assert [(each["point"]["factor"], each["point"]["value"]) for each in data["gains"]] == [
        *(("cameras", 1), ("cameras", 2), ("height", 0.25), ("height", 0.5)),
    ]
    for each in data["gains"]:
        name = {1: "cameras_1", 0.5: "height_0_5"}.get(each["point"]["value"], "middle")
        for arm in ("default", "highest"):
            runs = [json.loads(file.read_text()) for file in sorted(Path("found/results").glob(f"{arm}_{name}_?.json"))]
            assert len(runs) == (2 if arm == "default" else 1)
            of_scene = np.array([run["test_objective_of_scene"] for run in runs], float)
            weight = runs[0]["objects_of_scene"]
            assert each[arm] == pytest.approx(100.0 * np.average(of_scene.mean(axis=0), weights=weight))
            assert all(len(run["rig"]["cameras"]) == (1 if name == "cameras_1" else 2) for run in runs)
    raised, middle = (
        json.loads(Path(f"found/results/highest_{name}_0.json").read_text())["rig"]["cameras"][0]["position_m"][2]
        for name in ("height_0_5", "middle")
    )
    assert raised - middle == pytest.approx(0.25, abs=1e-3)
    assert Path("found/sweep.png").read_bytes().startswith(b"\x89PNG")
    capsys.readouterr()
    Path("found/results/default_cameras_1_1.json").unlink()
    assert main([*words, "--executor", "process", "--workers", "2"]) == 0
    assert "8 of 9 results are in" in capsys.readouterr().out
    assert json.loads(Path("found/sweep.json").read_text()) == data
    assert main(["experiment", "results", "found", "--out", "page.md"]) == 0
    assert "What a search gains over cameras around the highest point" in Path("page.md").read_text()
