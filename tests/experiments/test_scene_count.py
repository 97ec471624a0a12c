"""The experiment of scene counts: its numbers are the objective's own, what is there is not done again."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.experiments.small_experiment import complaint
from warpav.cli.app import main
from warpav.experiments import scene_count as module
from warpav.experiments.scene_count import OPTIONS, run_scene_count
from warpav.runs.config import load_config
from warpav.runs.placement import Placement
from warpav.runs.progress import RunDisplay

SMALL = (
    "scenes.train_seeds=0..3",
    "scenes.test_seeds=[1000, 1001]",
    "rig.cameras=2",
    "run.batch_size=4",
    "optimiser.pool_cameras=24",
    "optimiser.pool_rounds=0",
)


@pytest.mark.slow
def test_an_experiment_measures_the_rigs_that_it_finds(working_directory, capsys):
    words = ["experiment", "scene_count", *SMALL, "--scenes", "2,4", "--runs", "2", "--budget", "300", "--out", "found"]
    assert main(words) == 0
    data = json.loads(Path("found/scene_count.json").read_text())
    keys = [(run["arm"], run["training_scenes"], run["seed"]) for run in data["results"]]
    assert keys == [(arm, count, seed) for arm in module.ARMS for count in (2, 4) for seed in (0, 1)]
    config = load_config("default", [*OPTIONS, *SMALL])
    placement = Placement.from_config(config).prepare()
    for run in data["results"]:
        pose = np.array(run["mount_pose"], np.float32)
        assert run["unseen"] == pytest.approx(placement.objective.evaluate(pose, placement.test).objective, abs=1e-6)
        assert 0.0 < run["bound"] < 1.0
        assert run["states"][-1]["objective"] == run["seen"] <= run["states"][0]["objective"]
        if run["training_scenes"] == 4:
            value = placement.objective.evaluate(pose, placement.train).objective
            assert run["seen"] == pytest.approx(value, abs=1e-6)
        if run["arm"] == "same_renders":
            assert run["pool_cameras"] == 300 // (2 * run["training_scenes"])
            assert run["camera_renders"] <= 300
        else:
            assert run["pool_cameras"] == 24
    shown = capsys.readouterr().out
    table = Path("found/scene_count.md").read_text()
    unseen = np.mean([run["unseen"] for run in data["results"] if run["arm"] == "same_renders"][2:])
    assert "| same renders | 4 | 37 | " in table
    assert f"| {unseen:.4f} ± " in table
    assert table.split("\n")[5] in shown
    assert Path("found/scene_count.png").stat().st_size > 5000
    # the same command does nothing; another option does it again
    times = {file: file.stat().st_mtime_ns for file in Path("found/results").iterdir()}
    assert main(words) == 0
    assert {file: file.stat().st_mtime_ns for file in Path("found/results").iterdir()} == times
    assert json.loads(Path("found/scene_count.json").read_text()) == data
    assert main([*words[:2], "optimiser.pool_gap=0.1", *words[2:], "--arms", "same_cameras"]) == 0
    changed = [file.name for file, time in times.items() if file.stat().st_mtime_ns != time]
    assert len(changed) == 4
    assert all(name.startswith("same_cameras") for name in changed)


def test_scenes_are_drawn_by_the_run_seed_and_fewer_are_among_more():
    config = load_config("default", [*OPTIONS, *SMALL])
    tasks = module._tasks(config, None, [2, 4], 3, None, Path("results"))
    assert len({task.file for task in tasks}) == len({task.made_with for task in tasks}) == 12
    assert {task.render_budget for task in tasks} == {2 * 150 * 24}
    assert module._counts(None, 500, module.COUNTS) == [50, 150, 500]
    assert module._counts(None, 700, module.COUNTS) == [50, 150, 500, 700]
    assert module._counts(None, 1500, module.COUNTS) == [50, 150, 500, 1500]


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (
            ["--scenes", "2,5"],
            "(--scenes): expected numbers from 1 to the 4 scenes.train_seeds, such as 50,150, got '2,5'",
        ),
        (["--scenes", "two"], "(--scenes): expected numbers from 1 to the 4"),
        (["--arms", "gradient"], "(--arms): expected some of same_cameras, same_renders, got 'gradient'"),
        (["--runs", "0"], "(--runs): expected at least 1, got 0"),
        (["--budget", "15"], "(--budget): expected at least 16 camera renders, for 2 cameras in 4 scenes"),
        (["optimiser.search=descent"], "optimiser.search: expected pool"),
    ],
)
def test_what_cannot_be_done_is_said_before_any_work(working_directory, capsys, words, text):
    assert text in complaint(capsys, "experiment", "scene_count", *SMALL, *words)
    assert not list(working_directory.iterdir())


def test_a_folder_that_cannot_be_made_is_refused(working_directory):
    Path("file").write_text("here")
    config = load_config("default", [*OPTIONS, *SMALL])
    with RunDisplay() as display, pytest.raises(Exception, match="expected a folder that can be made"):
        run_scene_count(config, out=Path("file"), progress=display)
