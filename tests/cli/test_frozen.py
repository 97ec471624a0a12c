"""Rigs to start from, and cameras of theirs that stay."""

import json

import numpy as np
import pytest

from tests.cli.small_run import SMALL, complaint
from warpav.cli.app import main
from warpav.rig import read_rig
from warpav.runs import RunFolder

pytestmark = pytest.mark.usefixtures("working_directory")


CAMERA = (
    "  - name: {name}\n    position_m: {place}\n    yaw_deg: {yaw}\n    pitch_deg: {pitch}\n    roll_deg: 0.0\n"
    "    fov_deg: {fov}\n    width_px: {px}\n    height_px: {px}\n"
)
BUMPER = CAMERA.format(name="front_bumper", place="[3.65, 0.123457, 0.6]", yaw=1.234567, pitch=-3.3, fov=90.0, px=96)


def _rig_file(working_directory, *, fov=90.0, px=96):
    roof = CAMERA.format(name="rear", place="[0.2, 0.1, 1.8]", yaw=179.0, pitch=0.0, fov=90.0, px=96)
    bumper = BUMPER.replace("fov_deg: 90.0", f"fov_deg: {fov}").replace("_px: 96", f"_px: {px}")
    (working_directory / "mine.yaml").write_text(f"frame: ego\ncameras:\n{roof}{bumper}")
    return ["rig.start=mine.yaml", "rig.freeze=front_bumper"]


def test_a_frozen_camera_stays_and_the_others_move(working_directory, capsys):
    start = _rig_file(working_directory)
    assert main(["optimise", *SMALL, *start, "optimiser.starts=4", "run.out=run"]) == 0
    folder = working_directory / "run"
    for role in ("initial", "best", "final"):
        text = (folder / f"rig_{role}.yaml").read_text()
        assert text.endswith(BUMPER)
        assert "name: rear" in text
    arms = RunFolder.open("run").evaluation()["arms"]
    assert {arm["constraint_violation"] for arm in arms.values()} == {0.0}
    names = RunFolder.open("run").events()[0]["multipliers"]
    assert list(names) == ["zone_0", "spacing_0_1"]
    for source, other in (("run", ["rig.start=run"]), ("mine.yaml", [])):
        assert main(["evaluate", source, "--config", "run/config.yaml", *other, "--json", "m.json"]) == 0
        with open("m.json") as file:
            (found,) = json.load(file)["arms"].values()
        assert found["objective"] is not None
        assert found["constraint_violation"] == 0.0


def test_cameras_that_a_start_lacks_are_added_around_those_that_stay(working_directory, capsys):
    (working_directory / "mine.yaml").write_text(f"frame: ego\ncameras:\n{BUMPER}")
    options = ["rig.start=mine.yaml", "rig.cameras=3"]
    message = complaint(capsys, "optimise", *SMALL, *options)
    assert message.startswith(
        "mine.yaml: cameras: expected 3 as rig.cameras says, got 1; set rig.cameras=1, or name in"
    )
    options += ["rig.freeze=front_bumper", "baselines.rigs=[mine.yaml]"]
    assert main(["optimise", *SMALL, *options, "run.out=run"]) == 0
    said = capsys.readouterr()
    assert "rig.start: has 1 of 3 cameras, and the run adds the others\n" in said.out + said.err
    run = RunFolder.open("run")
    for role in ("start", "initial", "final"):
        cameras = {camera.name: camera for camera in read_rig(run.path / f"rig_{role}.yaml").cameras}
        assert list(cameras) == ["front_bumper", "added_1", "added_2"]
        np.testing.assert_allclose(cameras["front_bumper"].position_m, [3.65, 0.123457, 0.6])
    assert {arm["constraint_violation"] for arm in run.evaluation()["arms"].values()} == {0.0}


def test_a_run_and_a_preset_are_starts(working_directory, capsys, at_once):
    run = at_once("descent")
    for start, count in ((str(run), len(RunFolder.open(run).rig().cameras)), ("nuscenes", 6)):
        assert main(["config", "check", "quick", f"rig.start={start}", f"rig.cameras={count}"]) == 0
    message = complaint(capsys, "optimise", "rig.start=nuscenes")
    assert message.startswith("nuscenes: cameras: expected 4 as rig.cameras says, got 6; set rig.cameras=6")
    assert "did you mean nuscenes?" in complaint(capsys, "config", "check", "quick", "rig.start=nuscene")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["rig.freeze=[frontbumper]"],
            "command line (rig.freeze=[frontbumper]): rig.freeze: expected names out of rear, front_bumper, the "
            "cameras of mine.yaml, got 'frontbumper'; did you mean front_bumper?",
        ),
        (
            ["rig.freeze=[rear, front_bumper]"],
            "command line (rig.freeze=[rear, front_bumper]): rig.freeze: expected fewer than the 2 of rig.cameras, so "
            "that one can move, got 2",
        ),
        (["rig.freeze=[rear, rear]"], "command line (rig.freeze=[rear, rear]): rig.freeze: expected every name once"),
        (
            ["rig.freeze=[7]"],
            "command line (rig.freeze=[7]): rig.freeze: expected a list of names of cameras of rig.start",
        ),
        (
            ["rig.start=highest"],
            "command line (rig.freeze=front_bumper): rig.freeze: expected none, for rig.start=highest has no cameras "
            "of these names, got [front_bumper]; set rig.start to the rig that has them",
        ),
        (
            ["method=thesis"],
            "command line (rig.freeze=front_bumper): rig.freeze: expected none, as the thesis moves all cameras",
        ),
        (
            ["camera.width_px=64"],
            "command line (rig.freeze=front_bumper): rig.freeze: expected cameras with the image and the lens of the "
            "others, but for the field of view, got front_bumper with 96 x 96 px (pinhole) beside 64 x 96 px "
            "(pinhole); set camera.width_px=96 camera.height_px=96 camera.lens=pinhole, or",
        ),
        (
            ["camera.fov_deg=70"],
            "command line (rig.freeze=front_bumper): rig.freeze: expected cameras of camera.fov_deg=70, as "
            "losses.in_frame_rotation takes one field of view for all, got front_bumper with 90",
        ),
    ],
)
def test_what_cannot_be_frozen_is_refused(working_directory, capsys, options, message):
    start = _rig_file(working_directory)
    assert complaint(capsys, "optimise", *SMALL, *start, *options, "run.out=run").startswith(message)
    assert not (working_directory / "run").exists()
