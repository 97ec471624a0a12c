"""``warpav optimise`` by a pool: interrupted runs, and what cannot be searched."""

import dataclasses
import re

import numpy as np
import pytest

from tests.cli.small_run import SMALL, complaint
from warpav.cli.app import main
from warpav.optimisation import PoolRun
from warpav.optimisation.selection._select import BranchAndBound
from warpav.runs import RunFolder
from warpav.scene import town_scene, write_scene

pytestmark = pytest.mark.usefixtures("working_directory")

POOL = [*SMALL[:-1], *("losses.probability=visible_share", "optimiser.pool_cameras=16", "optimiser.pool_rounds=0")]
"""A small search by a pool, by a model of detection probability that needs no fit."""


def interrupted(*_, **__):
    raise KeyboardInterrupt


@pytest.mark.parametrize("when", [pytest.param("step", marks=pytest.mark.nightly), "selection"])
def test_ctrl_c_during_a_search_by_a_pool_keeps_what_it_knows(working_directory, monkeypatch, capsys, when):
    step = PoolRun.step

    def interrupted_later(self):
        return interrupted() if self.iteration == 2 else step(self)

    if when == "step":
        monkeypatch.setattr(PoolRun, "step", interrupted_later)
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
