"""``warpav scenes``, ``render`` and ``inspect``: what is drawn of scenes, rigs and runs."""

import json
import math
import os
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.cli.small_run import complaint
from tests.view.stand_ins import needs_opengl
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.rig import rig_text
from warpav.runs import RunFolder, config_for
from warpav.runs._inspect import inspector
from warpav.scene import town_scene
from warpav.view import Canvas, drawing_of

pytestmark = pytest.mark.usefixtures("working_directory")


@needs_opengl
def test_scenes_are_made_shown_and_rendered(working_directory, capsys):
    assert main(["scenes", "make", "--seeds", "[5]", "--out", "scenes"]) == 0
    assert sorted(os.listdir("scenes")) == ["collection.json", "scene_5.glb"]
    assert main(["scenes", "show", "scenes/scene_5.glb", "--out", "scene.png"]) == 0
    assert cv2.imread("scene.png").std() > 5.0
    argv = ["render", "scenes/scene_5.glb", "--rig", "highest", "--out", "images", "rig.cameras=2"]
    assert main([*argv, "camera.width_px=120", "camera.height_px=80"]) == 0
    views = json.loads((working_directory / "images" / "views.json").read_text())
    assert len(views) == 2
    for view in views:
        stem = f"images/{view['name']}"
        assert (view["width_px"], view["height_px"]) == (120, 80)
        assert np.shape(view["intrinsics"]) == (3, 3)
        assert np.shape(view["ego_from_camera"]) == (4, 4)
        assert cv2.imread(f"{stem}_rgb.png").shape == (80, 120, 3)
        objects = cv2.imread(f"{stem}_object.png", cv2.IMREAD_UNCHANGED)
        assert objects.dtype == np.uint16
        depth_m = np.load(f"{stem}_depth_m.npy")
        assert depth_m.dtype == np.float32
        assert np.all(objects[~np.isfinite(depth_m)] == 0)
    assert not [name for name in os.listdir("images") if name.startswith(".")]


def test_a_preset_keeps_its_cameras_unless_told_otherwise(working_directory):
    assert main(["render", "5", "--rig", "nuscenes", "--out", "images", "camera.width_px=64"]) == 0
    views = json.loads((working_directory / "images" / "views.json").read_text())
    assert {(view["width_px"], view["height_px"]) for view in views} == {(64, 900)}


@needs_opengl
def test_inspect_draws_a_run(run_folder, working_directory, capsys):
    assert main(["inspect", str(run_folder.path), "--out", "rig.png"]) == 0
    assert cv2.imread("rig.png").std() > 5.0
    assert capsys.readouterr().out == "wrote rig.png\n"
    pictures = [cv2.imread("rig.png")]
    for shown in ("coverage", "redundancy", "outcomes", "visibility", "zones"):
        argv = ["inspect", str(run_folder.path), "--show", shown, "--out", f"{shown}.png"]
        assert main(argv) == 0
        pictures.append(cv2.imread(f"{shown}.png"))
    for k, one in enumerate(pictures):
        assert all((one != other).any() for other in pictures[:k])
    assert "--show" in complaint(capsys, "inspect", "highest", "--show", "blind")
    for source in (str(run_folder.path), "highest"):  # a descent, and no run at all
        for shown in ("further", "gain"):
            told = complaint(capsys, "inspect", source, "--show", shown, "--out", "further.png")
            words = f"expected the folder of a run with optimiser.search=pool that has drawn its pool for '{shown}'"
            assert f"--show): {words}" in told


@needs_opengl
def test_a_run_is_an_animation_a_plot_and_blocks(run_folder, working_directory, capsys):
    assert main(["inspect", str(run_folder.path), "--out", "run.gif"]) == 0
    assert os.path.getsize("run.gif") < 5e6
    with Image.open("run.gif") as film:
        assert film.n_frames == 4  # three iterations and the result
    scene = town_scene(3)
    first, last = (
        run_folder.plot(f"{k}.png", iteration=k, scene=scene, window_size=(320, 200), title=str(k)) for k in (0, -1)
    )
    assert (cv2.imread(str(first)) != cv2.imread(str(last))).any()
    message = f"{run_folder.path}: iteration: expected one of 3 from 0, got 3"
    with pytest.raises(InputError, match=re.escape(message)):
        run_folder.plot("x.png", iteration=3, scene=scene)
    canvas = Canvas(off_screen=True, window_size=(320, 200))
    plotter = drawing_of(run_folder, canvas, iteration=1, scene=scene)  # pyright: ignore[reportCallIssue]
    assert any(name.startswith("descent/") for name in plotter.actors)
    plotter.close()
    blocks = run_folder.to_pyvista(scene=scene)
    events = run_folder.events()
    for k, camera in enumerate(run_folder.rig().cameras):
        places_m = [event["positions_m"][k] for event in events]
        np.testing.assert_allclose(blocks["path"][camera.name].points, places_m, atol=1e-5)
    assert blocks["scene"].keys()[:2] == ["environment", "ego"]


def _corrupt(run_folder, change):
    shutil.copytree(run_folder.path, "copy")
    change(Path("copy"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda run: (run / "config.yaml").unlink(), "copy: run folder: expected a folder written by warpav optimise"),
        (lambda run: (run / "config.yaml").write_bytes(b"\xff\x00"), "copy/config.yaml: expected a readable YAML"),
        (lambda run: [file.unlink() for file in run.glob("rig_*.yaml")], "copy: run folder: expected rig_best.yaml"),
        (
            lambda run: (run / "events.jsonl").write_text('{"a": 1}\n'),
            "copy/events.jsonl:1: iteration: expected a value",
        ),
        (lambda run: (run / "events.jsonl").write_bytes(b"\xff\n\x00\n"), "copy/events.jsonl:1: expected one JSON"),
        (
            lambda run: (run / "events.jsonl").write_text(
                3 * '{"iteration": 0, "loss": 1, "positions_m": [[1, 0, 2]], "yaw_deg": [0]}\n'
            ),
            "copy: run folder: expected events.jsonl and the rig files of one run, got 1 cameras in the one and 2",
        ),
        (
            lambda run: (run / "events.jsonl").write_text((run / "events.jsonl").read_text()[:-100]),
            "copy/events.jsonl: expected the 3 iterations of a run that has ended, got 2; was it cut off?",
        ),
    ],
    ids=[
        "no config",
        "garbage config",
        "no rigs",
        "foreign events",
        "garbage events",
        "events of another run",
        "events cut off",
    ],
)
def test_a_corrupt_run_folder_is_one_line(run_folder, working_directory, capsys, change, message):
    _corrupt(run_folder, change)
    assert complaint(capsys, "inspect", "copy", "--out", "x.png").startswith(message)
    assert os.listdir(working_directory) == ["copy"]


@needs_opengl
def test_a_run_that_was_cut_off_can_be_inspected(run_folder, working_directory, capsys):
    def cut(run):
        text = (run / "events.jsonl").read_text()
        (run / "events.jsonl").write_text(text[: len(text) - 100])
        (run / "checkpoints" / "last.npz").write_bytes(b"garbage")
        (run / "evaluation.json").unlink()  # which ends a run

    _corrupt(run_folder, cut)
    assert len(RunFolder.open("copy").events()) == 2
    assert main(["inspect", "copy", "--out", "x.gif"]) == 0
    with Image.open("x.gif") as film:
        assert film.n_frames == 3
    (working_directory / "copy" / "events.jsonl").unlink()
    capsys.readouterr()
    assert complaint(capsys, "inspect", "copy", "--out", "y.gif").startswith(
        "copy: expected iterations to animate, got none"
    )
    assert main(["inspect", "copy", "--out", "y.png"]) == 0


@needs_opengl
def test_the_inspector_goes_through_a_run(run_folder):
    with config_for(str(run_folder.path), None, (), default="quick") as settings:
        opened = inspector(str(run_folder.path), settings, off_screen=True)
    try:
        events, frames = run_folder.events(), opened.state.frames
        assert len(frames) == len(events) + 1
        for event, frame in zip(events, frames, strict=False):
            for camera, place_m, yaw_deg in zip(frame.cameras, event["positions_m"], event["yaw_deg"], strict=True):
                np.testing.assert_allclose(camera.position_m, place_m)
                assert math.degrees(camera.yaw_rad) == pytest.approx(yaw_deg)
        assert rig_text(frames[-1]) == rig_text(run_folder.rig())
        assert opened.save_to == run_folder.path / "rig_inspected.yaml"
        drawn = {name.partition("/")[0] for name in opened.plotter.actors}
        assert {"trajectory", "descent"} <= drawn  # as in the picture of the run
    finally:
        opened.plotter.close()
