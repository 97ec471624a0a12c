"""The command line: every verb's way in, exit statuses, one line per mistake, nothing half-written."""

import dataclasses
import json
import math
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image

from tests.view.stand_ins import needs_opengl
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.optimisation.descent import Descent
from warpav.rig.rig import rig_text
from warpav.runs.config import Config
from warpav.runs.inspect import inspector
from warpav.runs.rig_source import config_for
from warpav.runs.run_figures import OBJECT_EGO
from warpav.runs.run_folder import RunFolder
from warpav.runs.verdict import ARM_ROWS
from warpav.scene.glb import write_scene
from warpav.scene.town.town import town_scene
from warpav.view import Canvas, drawing_of

pytestmark = pytest.mark.usefixtures("working_directory")

SMALL = [
    "scenes.train_seeds=[0, 1]",
    "scenes.test_seeds=[1000, 1001]",
    "run.batch_size=2",
    "run.iterations=3",
    "rig.cameras=2",
    "camera.width_px=96",
    "camera.height_px=96",
    "baselines.random_samples=2",
    "optimiser.check_every=2",
    "optimiser.starts=2",
    # p(detected) would have to be fitted for so small a camera
    "losses={missed: 0, in_frame_rotation: 1, detected_area: 10}",
]


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """A small run from its command to its report."""
    out = tmp_path_factory.mktemp("main") / "run"
    assert main(["optimise", *SMALL, f"run.out={out}"]) == 0
    return RunFolder.open(out)


def _numbers(metrics):
    """The metrics of an arm that are shown, those without a value left out."""
    return {field: metrics[field] for field in ARM_ROWS if metrics[field] is not None}


def _complaint(capsys, *argv):
    """Run a command that must end with status 2, and return the one line that it leaves."""
    assert main(list(argv)) == 2
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    return lines[0]


# ------------------------------------------------------------------------------------------------ configurations


def test_config_show_prints_what_config_check_accepts(working_directory, capsys):
    assert main(["config", "show", "thesis", "rig.cameras=6"]) == 0
    text = capsys.readouterr().out
    assert yaml.safe_load(text)["rig"]["cameras"] == 6
    (working_directory / "mine.yaml").write_text(text)
    assert main(["config", "check", "mine.yaml"]) == 0
    assert main(["config", "diff", "thesis", "mine.yaml"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "rig.cameras: 4 -> 6"


def test_config_show_takes_overrides_without_a_file(capsys):
    assert main(["config", "show", "rig.cameras=7"]) == 0
    assert yaml.safe_load(capsys.readouterr().out)["rig"]["cameras"] == 7


def test_config_schema_covers_every_section(capsys):
    assert main(["config", "schema"]) == 0
    assert set(json.loads(capsys.readouterr().out)["properties"]) == {*Config.model_fields, "extends"}


def test_config_copy_keeps_the_comments_and_overwrites_nothing(working_directory, capsys):
    assert main(["config", "copy", "thesis", "mine.yaml"]) == 0
    assert "appendix XI" in (working_directory / "mine.yaml").read_text()
    assert "expected a file that does not exist yet" in _complaint(capsys, "config", "copy", "quick", "mine.yaml")
    assert "expected an existing folder" in _complaint(capsys, "config", "copy", "quick", "none/mine.yaml")


def test_rig_presets_are_listed(capsys):
    assert main(["rig", "presets"]) == 0
    assert "nuscenes: 6 cameras" in capsys.readouterr().out


# ------------------------------------------------------------------------------------------------ bad input


BAD_INPUT = [
    (["optimse"], 'command line: Unknown command "optimse". Did you mean "optimise"?'),
    (["config", "check", "--loud"], "command line: Unknown option: --loud"),
    (
        ["optimise", "--cameras", "6"],
        "command line: Unknown option: --cameras; options of a run are key=value, such as rig.cameras=6;",
    ),
    (["evaluate"], 'command line: Command "evaluate" parameter RIG requires an argument'),
    (["optimise", "rig.camera=3"], "command line (rig.camera=3): rig.camera: expected one of cameras,"),
    (
        ["optimise", "rig.cameras=many"],
        "command line (rig.cameras=many): rig.cameras: expected a whole number from 2 to",
    ),
    (["optimise", "nowhere.yaml"], "nowhere.yaml: config: expected a YAML file or a shipped name"),
    (["optimise", "quick", "device=cuda:99"], "command line (device=cuda:99): device: expected one of cpu"),
    (["render", "3", "--rig", "highest", "--out", "o", "device=cuda:99"], "command line (device=cuda:99): device: "),
    (["optimise", "run.iterations=0"], "command line (run.iterations=0): run.iterations: expected a whole number from"),
    (
        ["optimise", "detector.model=no.onnx"],
        "command line (detector.model=no.onnx): detector.model: expected builtin or",
    ),
    (["optimise", "detector.model=garbage.onnx"], "garbage.onnx: "),
    (["optimise", "rig.start=garbage.onnx"], "garbage.onnx:1: expected"),
    (
        ["optimise", "run.out=garbage.onnx"],
        "command line (run.out=garbage.onnx): run.out: expected a folder to write to, got 'garbage.onnx', which is a",
    ),
    (
        ["optimise", "scenes.source=folder", "scenes.folder=empty"],
        "command line (scenes.folder=empty): scenes.folder: expected scene_0.glb in 'empty', got",
    ),
    (["evaluate", "nuscene"], "nuscene: rig: expected a rig YAML, a run folder, a preset (argoverse2, edgar,"),
    (["evaluate", "empty"], "empty: run folder: expected a folder written by warpav optimise, got one without"),
    (["evaluate", "highest", "--json", "none/x.json"], "none/x.json: --json: expected an existing folder"),
    (["render", "garbage.onnx", "--rig", "highest", "--out", "o"], "garbage.onnx: "),
    (
        ["render", "none.glb", "--rig", "highest", "--out", "o"],
        "none.glb: scene: expected a GLB file or the seed of an",
    ),
    (["render", "3", "--rig", "none.yaml", "--out", "o"], "none.yaml: rig: expected a rig YAML,"),
    (
        ["render", "3", "--rig", "highest", "--out", "garbage.onnx"],
        "garbage.onnx: --out: expected a folder to write to",
    ),
    (["inspect", "none"], "none: rig: expected a rig YAML,"),
    (["report", "none"], "none: run folder: expected an existing folder"),
    (["scenes", "make", "--seeds", "9..3", "--out", "o"], "command line (--seeds): expected a range whose end is not"),
    (["scenes", "make", "--seeds", "3", "--out", "garbage.onnx"], "garbage.onnx: --out: expected a folder to write to"),
    (["doctor", "--json", "none/x.json"], "none/x.json: --json: expected an existing folder"),
]


@pytest.mark.parametrize(
    ("argv", "end"),
    [
        (["optimse"], ", optimize, ...; see warpav --help"),
        (["rig", "send"], " Available commands: presets, import, export, check; see warpav rig --help"),
        (["rig", "export", "nuscenes", "--out", "x"], " --format requires an argument; see warpav rig export --help"),
        (["optimise", "--cameras", "6"], "such as rig.cameras=6; see warpav optimise --help"),
    ],
)
def test_wrong_words_lead_to_the_help_of_their_command(capsys, argv, end):
    assert _complaint(capsys, *argv).endswith(end)


@pytest.mark.parametrize(("argv", "message"), BAD_INPUT, ids=[" ".join(argv) for argv, _ in BAD_INPUT])
def test_bad_input_is_one_line_and_leaves_nothing(working_directory, capsys, argv, message):
    (working_directory / "garbage.onnx").write_text("this is neither ONNX nor GLB nor a rig\n")
    (working_directory / "empty").mkdir()
    assert _complaint(capsys, *argv).startswith(message)
    assert sorted(os.listdir(working_directory)) == ["empty", "garbage.onnx"]
    assert os.listdir(working_directory / "empty") == []


def test_a_start_with_another_number_of_cameras_is_refused(working_directory, capsys):
    folder = working_directory / "rigs"
    folder.mkdir()
    camera = "{name: %s, position_m: [1, 0, 2], yaw_deg: 0, pitch_deg: 0, roll_deg: 0, fov_deg: 90, %s}"
    size = "width_px: 64, height_px: 64"
    (folder / "three.yaml").write_text(
        "frame: ego\ncameras:\n" + "".join(f"  - {camera % (name, size)}\n" for name in ("a", "b", "c"))
    )
    message = _complaint(capsys, "optimise", "rig.start=rigs/three.yaml")
    assert message == "rigs/three.yaml: cameras: expected 4 as rig.cameras says, got 3; set rig.cameras=3"


def test_more_cameras_than_fit_are_refused(working_directory, capsys):
    assert main(["optimise", *SMALL, "rig.cameras=8", "rig.min_spacing_m=3"]) == 2
    message = capsys.readouterr().err.strip()
    assert message.startswith("command line (rig.cameras=8): rig.cameras: expected a number that fits on the mount")
    assert message.endswith("got 8; lower one of the two")
    assert os.listdir(working_directory) == []
    (working_directory / "mine.yaml").write_text("run:\n  batch_size: 2\nrig:\n  cameras: 8\n  min_spacing_m: 3\n")
    overrides = [option for option in SMALL if not option.startswith("rig.cameras")]
    assert main(["optimise", "mine.yaml", *overrides]) == 2
    assert capsys.readouterr().err.startswith("mine.yaml:4: rig.cameras: expected a number that fits")


def test_an_existing_run_is_refused_before_any_work(run_folder, capsys):
    before = sorted(run_folder.path.rglob("*"))
    message = _complaint(capsys, "optimise", *SMALL, f"run.out={run_folder.path}")
    assert message.startswith(f"command line (run.out={run_folder.path}): run.out: expected a folder that does not")
    assert sorted(run_folder.path.rglob("*")) == before


def test_debug_shows_where(working_directory):
    with pytest.raises(ValueError, match="nowhere"):
        main(["optimise", "nowhere.yaml", "--debug"])


def test_an_unexpected_failure_is_one_line_with_status_1(monkeypatch, capsys):
    def fail(*_):
        raise RuntimeError("the roof\nis gone")

    monkeypatch.setattr("warpav.runs.config.load_config", fail)
    assert main(["config", "show"]) == 1
    assert capsys.readouterr().err == "failed: RuntimeError: the roof is gone; run again with --debug to see where\n"


def test_the_exit_status_reaches_the_shell(tmp_path):
    code = "import sys; from warpav.cli.app import main; sys.exit(main())"
    result = subprocess.run(
        [sys.executable, "-c", code, "config", "check", "rig.cameras=0"], capture_output=True, text=True, cwd=tmp_path
    )
    assert result.returncode == 2
    assert result.stderr.startswith("command line (rig.cameras=0): rig.cameras: expected a whole number")
    assert "Traceback" not in result.stderr


# ------------------------------------------------------------------------------------------------ the main job


def test_the_run_folder_is_complete(run_folder):
    found = {file.relative_to(run_folder.path).as_posix() for file in run_folder.path.rglob("*") if file.is_file()}
    assert found >= {
        "config.yaml",
        "env.json",
        "events.jsonl",
        "metrics.csv",
        "rig_initial.yaml",
        "rig_best.yaml",
        "rig_final.yaml",
        "evaluation.json",
        "checkpoints/last.npz",
        "report.html",
        "figures/loss_curves.png",
        "figures/rig_top_view.png",
        "figures/detections.png",
        "figures/ground.npz",
        "figures/views.json",
        "figures/views/0_start_camera_0.webp",
    }
    assert not [name for name in found if "draft" in name]


def test_the_events_have_the_documented_fields(run_folder):
    events = run_folder.events()
    assert [event["iteration"] for event in events] == [0, 1, 2]
    for event in events:
        assert set(event["gradient_norm"]) == {"position", "rotation"}
        assert set(event["seconds"]) == {"render", "detect", "backward", "total"}
        assert np.shape(event["positions_m"]) == (2, 3)
        assert np.shape(event["yaw_deg"]) == (2,)
        assert event["terms"]
        assert event["multipliers"]


def test_the_evaluation_has_the_documented_fields(run_folder):
    evaluation = run_folder.evaluation()
    assert (evaluation["schema"], evaluation["scenes"]) == (1, {"test": 2})
    assert list(evaluation["arms"]) == ["optimised", "start", "highest", "random"]
    assert list(evaluation["paired"]) == ["start", "highest", "random"]
    for metrics in evaluation["arms"].values():
        size_aps = {f"ap50_95_{size}" for size in ("small", "medium", "large")}
        assert set(ARM_ROWS) | size_aps | {"rig_recall", "objects", "frames", "recall_by", "per_scene"} == set(metrics)
        assert all(len(values) == 2 for values in metrics["per_scene"].values())
        assert metrics["rig_recall"] == metrics["tp_detection_rate"]
        for by in ("distance_m", "sector", "category", "road_user"):
            assert sum(group["objects"] for group in metrics["recall_by"][by].values()) == metrics["objects"]
        assert metrics["constraint_violation"] == 0.0
    for arm, metrics in evaluation["arms"].items():
        told = [seen["outcome"][arm] for seen in evaluation["outcomes"]]
        assert len(told) == metrics["objects"]
        assert told.count("detected") == round(metrics["rig_recall"] * metrics["objects"])
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
    again = RunFolder.open("again")
    for role in ("initial", "best", "final"):
        name = f"rig_{role}.yaml"
        assert (again.path / name).read_bytes() == (run_folder.path / name).read_bytes()
    assert again.evaluation()["arms"] == run_folder.evaluation()["arms"]

    output = capsys.readouterr().out
    assert "\x1b" not in output
    lines = output.splitlines()
    assert [line.split()[1] for line in lines if line.startswith("iteration ")] == ["1/3", "2/3", "3/3"]
    assert any(line.startswith("constraints met") for line in lines)
    assert any(line.startswith("objective on the training scenes") for line in lines)


def test_evaluating_the_run_gives_its_own_metrics(run_folder, working_directory):
    assert main(["evaluate", str(run_folder.path), "--json", "m.json"]) == 0
    found = json.loads((working_directory / "m.json").read_text())
    assert found["scenes"] == {"test": 2}
    of_the_run = run_folder.evaluation()["arms"]["optimised"]
    assert _numbers(found["arms"]["optimised"]) == pytest.approx(_numbers(of_the_run), abs=1e-3)


def test_scenes_from_files_give_the_same_metrics(working_directory):
    seeds = ["scenes.train_seeds=[0]", "scenes.test_seeds=[1000]", "run.batch_size=1", "rig.cameras=2"]
    assert main(["scenes", "make", "--seeds", "[0, 1000]", "--out", "scenes"]) == 0
    assert main(["evaluate", "highest", *seeds, "--json", "town.json"]) == 0
    files = ["scenes.source=folder", "scenes.folder=scenes"]
    assert main(["evaluate", "highest", *seeds, *files, "--json", "files.json"]) == 0
    town, folder = (json.loads((working_directory / name).read_text()) for name in ("town.json", "files.json"))
    assert _numbers(folder["arms"]["highest"]) == pytest.approx(_numbers(town["arms"]["highest"]), rel=1e-5)
    assert folder["arms"]["highest"]["recall_by"] == town["arms"]["highest"]["recall_by"]


def test_targets_that_no_scene_holds_are_named(working_directory, capsys):
    # the detector's buses stand in for people, whatever labels it has for them
    folder = working_directory / "scenes"
    folder.mkdir()
    for seed in (0, 1000):
        write_scene(dataclasses.replace(town_scene(seed), others=()), folder / f"scene_{seed}.glb")
    options = [
        "scenes.source=folder", "scenes.folder=scenes", "scenes.train_seeds=[0]", "scenes.test_seeds=[1000]",
        "run.batch_size=1", "rig.cameras=2", "detector.classes.pedestrian=[bus]",
        "losses={missed: 0, detected_area: 1}",  # else the detection probability of these labels is fitted
    ]  # fmt: skip
    assert main(["evaluate", "highest", *options, "scenes.targets=[pedestrian]"]) == 2
    assert capsys.readouterr().err == (
        "command line (scenes.targets=[pedestrian]): scenes.targets: expected road users that the scenes hold, got no "
        "pedestrian in any of the 2 scenes; scenes made from images hold people as parts of the environment\n"
    )
    assert main(["evaluate", "highest", *options, "scenes.targets=[vehicle, pedestrian]"]) == 0
    assert "no pedestrian in any of the 2 scenes, so nothing is optimised or judged" in capsys.readouterr().out


def test_a_rig_of_other_cameras_is_evaluated_with_its_own(run_folder, working_directory):
    text = (run_folder.path / "rig_best.yaml").read_text().replace("width_px: 96", "width_px: 128")
    (working_directory / "wide.yaml").write_text(text)
    assert main(["evaluate", "wide.yaml", *SMALL, "--json", "m.json"]) == 0
    metrics = json.loads((working_directory / "m.json").read_text())["arms"]["wide"]
    assert metrics["objective"] is None
    assert metrics["tp_in_frame_rate"] > 0.0


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


def test_ctrl_c_after_the_last_step_tells_where_the_run_is(monkeypatch, capsys):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("warpav.runs.result.evaluate_on", interrupted)
    assert main(["optimise", *SMALL, "run.out=stopped"]) == 130
    assert "what was reached is in stopped" in capsys.readouterr().out
    assert RunFolder.open("stopped").rig("best").cameras


def test_a_start_that_stays_the_best_is_the_same_rig(capsys):
    # so small a step that the start is kept; half a turn's symmetry in the yaws must not let rounding pair anew
    steps = ["optimiser.learning_rate_position_m=1e-9", "optimiser.learning_rate_yaw_deg=1e-9", "rig.start=highest"]
    assert main(["optimise", *SMALL, *steps, "run.out=still"]) == 0
    folder = RunFolder.open("still")
    arms = folder.evaluation()["arms"]
    assert arms["optimised"] == arms["start"]
    assert (folder.path / "rig_best.yaml").read_bytes() == (folder.path / "rig_initial.yaml").read_bytes()
    assert main(["evaluate", "still", "--json", "m.json"]) == 0
    with open("m.json") as file:
        found = json.load(file)["arms"]["optimised"]
    assert found["objective"] == pytest.approx(arms["optimised"]["objective"], abs=1e-3)


def test_a_result_that_is_worse_than_its_start_is_never_the_rig_of_the_run(capsys):
    # steps of 2 m, and the last iterate counts
    steps = ["optimiser.learning_rate_position_m=2", "optimiser.keep=last", "optimiser.starts=1", "rig.start=highest"]
    assert main(["optimise", *SMALL, *steps, "run.iterations=4", "run.out=worse"]) == 0
    captured = capsys.readouterr()
    folder = RunFolder.open("worse")
    evaluation = folder.evaluation()
    training = evaluation["training_objective"]
    assert training["optimised"] > training["start"]
    assert evaluation["rig_of_run"] == "start"
    assert "WORSE THAN ITS START" in captured.out
    assert captured.err.startswith("warning: WORSE THAN ITS START: the optimised rig has objective")
    best, start, last = ((folder.path / f"rig_{role}.yaml").read_bytes() for role in ("best", "initial", "final"))
    assert best == start != last
    assert "Worse than its start, so the rig of this run is the start." in (folder.path / "report.html").read_text()
    assert main(["rig", "export", "worse", "--format", "opencv", "--out", "from_run"]) == 0
    assert main(["rig", "export", "worse/rig_initial.yaml", "--format", "opencv", "--out", "from_start"]) == 0
    exported = [sorted(file for file in Path(name).rglob("*") if file.is_file()) for name in ("from_run", "from_start")]
    assert exported[0]
    assert [file.read_bytes() for file in exported[0]] == [file.read_bytes() for file in exported[1]]


# ------------------------------------------------------------------------------------------------ scenes and images


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


def test_a_folder_with_a_presets_name_is_no_run_unless_it_holds_one(working_directory):
    (working_directory / "nuscenes").mkdir()
    assert main(["render", "5", "--rig", "nuscenes", "--out", "images", "camera.width_px=64"]) == 0
    assert len(json.loads((working_directory / "images" / "views.json").read_text())) == 6


def test_a_preset_keeps_its_cameras_unless_told_otherwise(working_directory):
    assert main(["render", "5", "--rig", "nuscenes", "--out", "images", "camera.width_px=64"]) == 0
    views = json.loads((working_directory / "images" / "views.json").read_text())
    assert {(view["width_px"], view["height_px"]) for view in views} == {(64, 900)}


CALIBRATED = """\
frame: ego
cameras:
  - {name: front, position_m: [1.7, 0, 1.6], yaw_deg: 0, pitch_deg: 0, roll_deg: 0, width_px: 640, height_px: 480,
     lens: %s, focal_px: [500, 510], centre_px: [330, 235], distortion: %s}
"""


def test_a_calibrated_camera_is_resized_as_a_whole(working_directory):
    (working_directory / "rig.yaml").write_text(CALIBRATED % ("pinhole", "[]"))
    argv = ["render", "5", "--rig", "rig.yaml", "--out", "images", "camera.width_px=64", "camera.height_px=48"]
    assert main(argv) == 0
    (view,) = json.loads((working_directory / "images" / "views.json").read_text())
    np.testing.assert_allclose(view["intrinsics"], [[50, 0, 33], [0, 51, 23.5], [0, 0, 1]])
    assert (view["lens"], view["distortion"]) == ("pinhole", [])


def test_wide_lenses_are_rendered_from_a_rig_file(working_directory):
    camera = (
        "  - {name: %s, position_m: [1.1, 0, 2.2], yaw_deg: 0, pitch_deg: %s, roll_deg: 0, lens: %s, fov_deg: %s, %s}"
    )
    size = "width_px: 96, height_px: 64"
    lines = (camera % row for row in (("fish", 90, "fisheye", 190, size), ("round", 0, "panorama", 360, size)))
    (working_directory / "rig.yaml").write_text("\n".join(["frame: ego", "cameras:", *lines]))
    assert main(["render", "5", "--rig", "rig.yaml", "--out", "images"]) == 0
    views = json.loads((working_directory / "images" / "views.json").read_text())
    assert [view["lens"] for view in views] == ["fisheye", "panorama"]
    # a fisheye that looks down sees the ground 2.2 m below it; a panorama at this height sees its own roof behind it
    depth_m, round_m = (np.load(f"images/{view['name']}_depth_m.npy") for view in views)
    assert np.isfinite(depth_m[32]).mean() > 0.8
    assert depth_m.min() < 2.2
    objects = cv2.imread("images/round_object.png", cv2.IMREAD_UNCHANGED)
    assert (objects[-1] == OBJECT_EGO).all()
    assert np.isfinite(round_m[-1]).all()


@pytest.mark.slow
def test_a_fisheye_rig_is_optimised(working_directory):
    wide = ["camera.lens=fisheye", "camera.fov_deg=200", "camera.distortion=[0.01, -0.002, 0.0, 0.0]"]
    small = [option for option in SMALL if not option.startswith("camera.")]
    argv = ["optimise", *small, *wide, "camera.width_px=48", "camera.height_px=48", "run.out=wide"]
    assert main(argv) == 0
    rig = RunFolder.open("wide").rig()
    assert {(camera.model.lens, camera.model.distortion) for camera in rig.cameras} == {
        ("fisheye", (0.01, -0.002, 0.0, 0.0))
    }


def test_a_field_of_view_beyond_the_lens_is_refused(working_directory, capsys):
    # t (1 + k1 t^2) stops growing at 1 / sqrt(1.8) rad
    (working_directory / "rig.yaml").write_text(CALIBRATED % ("fisheye", "[-0.6, 0.0, 0.0, 0.0]"))
    message = _complaint(capsys, "render", "5", "--rig", "rig.yaml", "--out", "images", "camera.fov_deg=100")
    assert message.startswith(
        "camera: expected numbers that camera 'front' can have, got: fov_rad must be at most 1.48"
    )
    assert os.listdir(working_directory) == ["rig.yaml"]


@needs_opengl
def test_inspect_draws_a_run(run_folder, working_directory, capsys):
    assert main(["inspect", str(run_folder.path), "--out", "rig.png"]) == 0
    assert cv2.imread("rig.png").std() > 5.0
    assert capsys.readouterr().out == "wrote rig.png\n"
    pictures = [cv2.imread("rig.png")]
    for shown in ("coverage", "outcomes", "visibility"):
        argv = ["inspect", str(run_folder.path), "--show", shown, "--out", f"{shown}.png"]
        assert main(argv) == 0
        pictures.append(cv2.imread(f"{shown}.png"))
    for k, one in enumerate(pictures):
        assert all((one != other).any() for other in pictures[:k])
    assert "--show" in _complaint(capsys, "inspect", "highest", "--show", "blind")


def test_a_window_begins_with_what_is_to_be_shown(working_directory, monkeypatch, capsys):
    opened = []
    monkeypatch.setattr("warpav.view.opengl.has_display", lambda: True)
    window = SimpleNamespace(plotter=SimpleNamespace(show=lambda: None))
    monkeypatch.setattr("warpav.view.inspector.Inspector", lambda state, **options: opened.append(options) or window)
    for shown in ("rig", "coverage", "outcomes", "visibility", "sight"):
        assert main(["inspect", "highest", "--show", shown]) == 0
        warning = "--show sight: is called --show visibility now; the old name goes in the next version\n"
        assert capsys.readouterr().err == (warning if shown == "sight" else "")
    assert [options["begin_with"] for options in opened] == ["coverage", "coverage", "outcomes", *2 * ["visibility"]]


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
        (lambda run: (run / "events.jsonl").write_text('{"a": 1}\n'), "copy/events.jsonl:1: expected an iteration of"),
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
    assert _complaint(capsys, "inspect", "copy", "--out", "x.png").startswith(message)
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
    assert _complaint(capsys, "inspect", "copy", "--out", "y.gif").startswith(
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


# ------------------------------------------------------------------------------------------------ cameras that stay


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


def test_a_run_and_a_preset_are_starts(working_directory, capsys, run_folder):
    for start, count in ((str(run_folder.path), len(run_folder.rig().cameras)), ("nuscenes", 6)):
        assert main(["config", "check", "quick", f"rig.start={start}", f"rig.cameras={count}"]) == 0
    message = _complaint(capsys, "optimise", "rig.start=nuscenes")
    assert message == "nuscenes: cameras: expected 4 as rig.cameras says, got 6; set rig.cameras=6"
    assert "did you mean nuscenes?" in _complaint(capsys, "config", "check", "quick", "rig.start=nuscene")


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
            "others, but for a pinhole's field of view, got front_bumper with 96 x 96 px (pinhole) beside 64 x 96 px "
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
    assert _complaint(capsys, "optimise", *SMALL, *start, *options, "run.out=run").startswith(message)
    assert not (working_directory / "run").exists()


def test_arms_that_place_all_cameras_refuse_frozen_ones(working_directory, capsys):
    start = _rig_file(working_directory)
    for arm in ("greedy_cover", "nuscenes", "random_batches"):
        words = ["experiment", "table2", "quick", *SMALL, "method=default", *start, "--arms", arm, "--out", "x"]
        message = _complaint(capsys, *words)
        assert f"arm {arm}: rig.freeze: expected none, since it places all cameras, got front_bumper" in message
