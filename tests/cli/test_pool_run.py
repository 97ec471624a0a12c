"""``warpav optimise`` by a pool: interrupted runs, and what cannot be searched."""

import dataclasses
import re
import shutil

import numpy as np
import pytest

from tests.cli.small_run import SMALL, complaint
from warpav.cli.app import main
from warpav.optimisation import pool as pool_module
from warpav.optimisation.pool_descent import PoolDescent
from warpav.optimisation.selection.select import BranchAndBound
from warpav.runs.run_folder import RunFolder
from warpav.scene.glb import write_scene
from warpav.scene.town.town import town_scene

pytestmark = pytest.mark.usefixtures("working_directory", "short_polish")

POOL = [
    *SMALL[:-1],
    *("losses.probability=visible_share", "optimiser.pool_cameras=16", "optimiser.pool_rounds=0"),
]
"""A small search by a pool, by a model of detection probability that needs no fit."""


def interrupted(*_, **__):
    raise KeyboardInterrupt


@pytest.mark.parametrize("when", [pytest.param("step", marks=pytest.mark.nightly), "selection"])
def test_ctrl_c_during_a_search_by_a_pool_keeps_what_it_knows(working_directory, monkeypatch, capsys, when):
    step = PoolDescent.step

    def interrupted_later(self):
        return interrupted() if self.iteration == 2 else step(self)

    if when == "step":
        monkeypatch.setattr(PoolDescent, "step", interrupted_later)
    else:
        monkeypatch.setattr(BranchAndBound, "run", interrupted)
    assert main(["optimise", *POOL, "run.out=stopped"]) == 130
    captured = capsys.readouterr()
    assert captured.err == "interrupted\n"
    assert "what was reached is in stopped" in captured.out
    folder = RunFolder.open("stopped")
    events = folder.events()
    assert [event["stage"] for event in events] == ["start", "selection"]
    further = folder.further_cameras()
    # pool less the rig, and what stands too near to it; what was found is what one more camera is added to
    assert 0 < len(further.gain) <= events[-1]["pool_cameras"] - 2
    assert 0.0 < further.gain[0] < events[-1]["training_objective"]
    assert len(folder.rig().cameras) == 2
    assert folder.evaluation() is None
    assert main(["inspect", "stopped", "--show", "gain", "--out", "gain.png"]) == 0
    assert (working_directory / "gain.png").is_file()
    assert main(["report", "stopped"]) == 0


@pytest.mark.parametrize("scenes_drawn", [pytest.param(1, marks=pytest.mark.nightly), 3])
def test_ctrl_c_while_the_pool_is_drawn_leaves_the_start(working_directory, monkeypatch, capsys, scenes_drawn):
    """In the middle of the scenes of the start there is no state yet, in those of the pool there is."""
    draw, tasks = pool_module._draw, []

    def interrupted_later(task):
        tasks.append(task)
        return interrupted() if len(tasks) > scenes_drawn else draw(task)

    monkeypatch.setattr("warpav.runs.optimise.pool_cache_folder", lambda: working_directory / "cache")
    monkeypatch.setattr(pool_module, "_draw", interrupted_later)
    assert main(["optimise", *POOL, "run.out=stopped"]) == 130
    captured = capsys.readouterr()
    assert captured.err == "interrupted\n"
    folder, has_start = RunFolder.open("stopped"), scenes_drawn >= 2
    assert ("what was reached is in stopped, for warpav evaluate, inspect and report" in captured.out) == has_start
    assert ("the start is in stopped, for warpav evaluate and inspect" in captured.out) != has_start
    assert [event["stage"] for event in folder.events()] == (["start"] if has_start else [])
    assert ("done start" in captured.out) == has_start
    assert folder.rig_path("best").is_file() == has_start
    if has_start:
        # two cameras in two scenes, and the points near the vehicle as a third
        assert [event["camera_renders"] for event in folder.events()] == [2 * 3]
        with np.load(folder.path / "checkpoints" / "last.npz", allow_pickle=False) as state:
            assert state["iteration"] == 1
    written = [[camera.position_m for camera in rig.cameras] for rig in (folder.rig(), folder.rig("initial"))]
    np.testing.assert_allclose(*written, atol=1e-5)
    assert main(["evaluate", "stopped"]) == 0
    assert main(["inspect", "stopped", "--out", "rig.png"]) == 0
    if has_start:
        assert main(["report", "stopped"]) == 0
    assert folder.further_cameras() is None
    capsys.readouterr()
    message = complaint(capsys, "inspect", "stopped", "--show", "further", "--out", "further.png")
    assert "expected the folder of a run with optimiser.search=pool that has drawn its pool" in message


def below_the_ground(vehicle):
    down_m = np.array([0.0, 0.0, -50.0])
    box = dataclasses.replace(vehicle.box, center_m=vehicle.box.center_m + down_m)
    return dataclasses.replace(vehicle, mesh=vehicle.mesh.transformed(np.eye(3), down_m), box=box)


def test_a_pool_that_sees_nothing_is_one_line(working_directory, capsys):
    folder = working_directory / "scenes"
    folder.mkdir()
    for seed in (0, 1000):
        scene = town_scene(seed)
        hidden = tuple(below_the_ground(vehicle) for vehicle in scene.vehicles)
        write_scene(dataclasses.replace(scene, vehicles=hidden), folder / f"scene_{seed}.glb")
    seeds = ["scenes.train_seeds=[0]", "scenes.test_seeds=[1000]"]
    message = complaint(capsys, "optimise", *POOL, *seeds, "scenes.source=folder", "scenes.folder=scenes")
    assert re.fullmatch(
        r"pool: expected cameras that see something, got 18 of which none sees any of the \d+ objects of 1 scenes; "
        "check scenes.targets, and where the cameras stand",
        message,
    )


def drawn(monkeypatch, capsys, cache, *overrides):
    """The files of a run's pool, which is kept in a folder; the run itself is stopped at once."""
    with monkeypatch.context() as patch:
        patch.setattr("warpav.runs.optimise.pool_cache_folder", lambda: cache)
        patch.setattr(BranchAndBound, "run", interrupted)
        shutil.rmtree("drawn", ignore_errors=True)
        assert main(["optimise", *POOL, *overrides, "run.out=drawn"]) == 130
    capsys.readouterr()
    return sorted(cache.iterdir())


def test_a_pool_of_something_else_is_refused_by_its_content(working_directory, monkeypatch, capsys):
    cache = working_directory / "cache"
    own = drawn(monkeypatch, capsys, cache)
    whole = [file.read_bytes() for file in own]
    others = {
        "scenes": whole[::-1],
        "vehicle": ["rig.height_offset_m=0.2"],
        "camera": ["camera.fov_deg=80"],
        "detector": ["losses.probability=in_frame_share"],
    }
    for name, other in others.items():
        if name != "scenes":
            other = [file.read_bytes() for file in drawn(monkeypatch, capsys, working_directory / name, *other)]
        for file, content in zip(own, other, strict=True):
            file.write_bytes(content)
        monkeypatch.setattr("warpav.runs.optimise.pool_cache_folder", lambda: cache)
        message = complaint(capsys, "optimise", *POOL, "run.out=refused")
        assert re.fullmatch(
            rf"{re.escape(str(cache))}/pool_\w+\.npz: {name}: expected a pool of .*; remove it, and draw it again",
            message,
        )
        shutil.rmtree("refused")
