"""Commands about scenes: built, captured, checked, reconstructed, and the main job on what went through images."""

import json
import os
import shutil

import numpy as np
import pytest

from tests.scene.test_files import bytes_of, content, remove, shorten
from warpav.cli.app import main
from warpav.raster.mesh import Mesh
from warpav.runs import Placement, RunDisplay, RunFolder, load_scenes
from warpav.runs.config import load_config
from warpav.scene import Box, Scene, Vehicle

pytestmark = pytest.mark.usefixtures("working_directory")

CAPTURE = [
    "capture.width_px=96",
    "capture.height_px=72",
    "capture.vehicles=1",
    "capture.rotations=3",
    "capture.scene_heights_m=[20]",
]
RECONSTRUCTION = [
    "reconstruction.vehicle_points=2000",
    "reconstruction.vehicle_cell_m=0.1",
    "reconstruction.vehicle_triangles=400",
    "reconstruction.environment_points=4000",
    "reconstruction.environment_cell_m=1.0",
    "reconstruction.environment_triangles=800",
]
SEEDS = (3, 4)


@pytest.fixture(scope="module")
def collection(tmp_path_factory):
    """A folder with ``captures`` and ``scenes`` of two situations, from the commands."""
    folder = tmp_path_factory.mktemp("collection")
    assert main(["scenes", "capture", *CAPTURE, "--seeds", "3..4", "--out", str(folder / "captures")]) == 0
    argv = ["scenes", "reconstruct", str(folder / "captures"), *RECONSTRUCTION, "--out", str(folder / "scenes")]
    assert main(argv) == 0
    return folder


@pytest.fixture
def captures(collection, working_directory):
    """A copy of the captures that a test may spoil."""
    return shutil.copytree(collection / "captures", working_directory / "captures")


def small_scene(seed):
    """A scene of three tetrahedra."""

    def tetrahedron(x_m):
        corner_m = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) + np.array([x_m, 0.0, 0.0])
        return Mesh.create(corner_m, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], (seed, 2, 3))

    box = Box(np.array([9.5, 0.5, 0.5]), np.ones(3), 0.0)
    return Scene(f"small_{seed}", tetrahedron(5.0), tetrahedron(0.0), (Vehicle(1, "van", tetrahedron(9.0), box),))


# ------------------------------------------------------------------------------------------------ make


def test_made_scenes_stay_and_are_split(working_directory, monkeypatch, capsys):
    monkeypatch.setattr(
        "warpav.scene._files.built_scenes", lambda sources: [small_scene(source.seed) for source in sources]
    )
    assert main(["scenes", "make", "--count", "2", "--out", "scenes"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["building scenes: 2", "scenes/scene_0.glb", "scenes/scene_1.glb"]
    before = content(working_directory / "scenes")
    assert main(["scenes", "make", "--count", "10", "--out", "scenes"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1:3] == [f"scenes/scene_{seed}.glb is there already" for seed in (0, 1)]
    assert lines[3] == "scenes/scene_2.glb"
    assert lines[-1].endswith("scenes.folder=scenes scenes.train_seeds=0..5 scenes.test_seeds=8..9")
    after = content(working_directory / "scenes")
    assert all(after[name] == before[name] for name in before if name.endswith(".glb"))
    assert len(json.loads((working_directory / "scenes" / "collection.json").read_text())["scenes"]) == 10


def test_a_scene_that_fails_is_told_and_the_others_are_made(monkeypatch, capsys):
    def failing(seed):
        if seed == 1:
            raise RuntimeError("the street\nis closed")
        return small_scene(seed)

    monkeypatch.setattr(
        "warpav.scene._files.built_scenes", lambda sources: [failing(source.seed) for source in sources]
    )
    assert main(["scenes", "make", "--count", "3", "--out", "scenes"]) == 2
    lines = capsys.readouterr().out.splitlines()
    assert lines[-2:] == ["2 of 3 done; rejected:", "scenes/scene_1.glb: RuntimeError: the street is closed"]
    assert sorted(os.listdir("scenes")) == ["collection.json", "scene_0.glb", "scene_2.glb"]
    # the split is of those that are there
    assert main(["scenes", "make", "--count", "7", "--out", "scenes"]) == 2
    assert capsys.readouterr().out.splitlines()[-1].endswith("scenes.train_seeds=[0,2,3,4] scenes.test_seeds=6..6")


# ------------------------------------------------------------------------------------------------ capture, check


def test_check_names_every_trouble(captures, capsys):
    assert main(["scenes", "check", "captures"]) == 0
    assert capsys.readouterr().out.splitlines() == ["2 of 2 captures are valid"]
    remove("ego_top_rgb.png")(captures / "scene_3")
    shorten("rotation_0_depth.png", 0.5)(captures / "scene_3")
    assert main(["scenes", "check", "captures"]) == 2
    captured = capsys.readouterr()
    assert captured.out.splitlines() == ["1 of 2 captures are valid"]
    assert captured.err.splitlines() == [
        "captures/scene_3/images/ego_top_rgb.png: expected an image, got no such file; take or copy it again",
        "captures/scene_3/images/rotation_0_depth.png: expected a PNG image, got a file that is truncated or no image",
    ]
    assert main(["scenes", "check", "captures/scene_4"]) == 0


# ------------------------------------------------------------------------------------------------ reconstruct


BAD_INPUT = [
    (["make", "--out", "o"], "command line: expected either --seeds or --count, got both or none"),
    (["make", "--out", "o", "--seeds", "3", "--count", "3"], "command line: expected either --seeds or --count, got"),
    (["make", "--out", "o", "--count", "0"], "command line (--count): expected at least 1, got 0"),
    (["capture", "--count", "1", "--out", "file"], "file: --out: expected a folder to write to, got a file"),
    (
        ["capture", "--count", "1", "--out", "o", "capture.width_px=8"],
        "command line (capture.width_px=8): capture.width_px: expected a whole number from 32 to 4096, got 8",
    ),
    (["check", "none"], "none: expected a capture (a folder with capture.json) or a folder of captures, got neither"),
    (["reconstruct", "file", "--out", "o"], "file: expected a capture (a folder with capture.json) or a folder of"),
    (
        ["reconstruct", "captures", "--out", "o", "reconstruction.method=guess"],
        "command line (reconstruction.method=guess): reconstruction.method: expected poisson, signed_distance or nksr",
    ),
    (
        ["reconstruct", "captures", "--out", "o", "reconstruction.method=nksr"],
        "command line (reconstruction.method=nksr): reconstruction.method: expected an installed surface method, got",
    ),
]


@pytest.mark.parametrize(("argv", "message"), BAD_INPUT, ids=[" ".join(argv) for argv, _ in BAD_INPUT])
def test_bad_input_is_one_line_and_leaves_nothing(working_directory, captures, capsys, argv, message):
    (working_directory / "file").write_text("this is no folder\n")
    assert main(["scenes", *argv]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(message)
    assert sorted(os.listdir(working_directory)) == ["captures", "file"]


# ------------------------------------------------------------------------------------------------ training on them


def captured_config(folder):
    return [
        "scenes.source=captured",
        f"scenes.folder={folder}",
        "scenes.train_seeds=[3]",
        "scenes.test_seeds=[4]",
        "run.batch_size=1",
        *CAPTURE,
        *RECONSTRUCTION,
    ]


def test_captured_scenes_are_made_once(collection, working_directory):
    config = load_config("quick", captured_config("kept"))
    (made,) = load_scenes(config, [3])
    folder = working_directory / "kept"
    assert bytes_of(folder / "captures" / "scene_3") == bytes_of(collection / "captures" / "scene_3")
    assert (folder / "scene_3.glb").read_bytes() == (collection / "scenes" / "scene_3.glb").read_bytes()
    before = content(folder)
    (again,) = load_scenes(config, [3])
    assert content(folder) == before
    np.testing.assert_array_equal(made.environment.vertex_m, again.environment.vertex_m)


def problem(folder, *overrides):
    """What a run loads: training on scene 3, a test on scene 4 of a folder."""
    seeds = ["scenes.train_seeds=[3]", "scenes.test_seeds=[4]", "run.batch_size=1", "thesis.rotations=4"]
    cameras = ["rig.cameras=2", "camera.width_px=32", "camera.height_px=32", "method=thesis"]
    files = ["scenes.source=folder", f"scenes.folder={folder}"]
    with RunDisplay() as display:
        return Placement.from_config(load_config("quick", [*files, *seeds, *cameras, *overrides])).prepare(display)


def test_training_scenes_are_mirrored_and_test_scenes_are_not(collection):
    plain = problem(collection / "scenes")
    both = problem(collection / "scenes", "scenes.mirror=true")
    assert [one.scene.name for one in plain.train] == ["town_0003"]
    assert [one.scene.name for one in both.train] == ["town_0003", "town_0003_mirrored"]
    assert [one.scene.name for one in both.test] == [one.scene.name for one in plain.test] == ["town_0004"]
    original, mirrored = (one.scene.raster.layer_bounds_world_m.numpy() for one in both.train)
    expected = (original * [1.0, -1.0, 1.0])[:, ::-1]
    np.testing.assert_allclose(mirrored[0, :, [0, 2]], original[0, :, [0, 2]], atol=1e-5)
    np.testing.assert_allclose(mirrored[0, :, 1], expected[0, :, 1], atol=1e-5)
    np.testing.assert_allclose(mirrored[1], original[1], atol=1e-5)  # the ego vehicle


@pytest.mark.slow
def test_the_main_job_runs_on_captured_scenes(collection, capsys):
    argv = ["run.iterations=1", "rig.cameras=2", "camera.width_px=96", "camera.height_px=96", "method=thesis"]
    argv += ["baselines.random_samples=1", "run.out=run", *captured_config("kept")]
    assert main(["optimise", *argv]) == 0
    folder = RunFolder.open("run")
    assert folder.evaluation()["scenes"] == {"test": 1}
    assert folder.evaluation()["arms"]["optimised"]["objects"] == 1
    assert sorted(os.listdir("kept")) == ["captures", "collection.json", "scene_3.glb", "scene_4.glb"]
