"""The command line: configurations, exit statuses, one line per mistake, nothing half-written."""

import json
import os
import shutil
import subprocess
import sys
from typing import get_args

import pytest
import yaml

from tests.cli.small_run import SMALL, complaint
from warpav.cli._scenes import SceneLevel
from warpav.cli.app import main
from warpav.runs.config import Config, described_options
from warpav.scene import LEVELS

pytestmark = pytest.mark.usefixtures("working_directory")


# ------------------------------------------------------------------------------------------------ configurations


def test_config_show_prints_what_config_check_accepts(working_directory, capsys):
    assert main(["config", "show", "thesis", "rig.cameras=6"]) == 0
    text = capsys.readouterr().out
    assert yaml.safe_load(text)["rig"]["cameras"] == 6
    (working_directory / "mine.yaml").write_text(text)
    assert main(["config", "check", "mine.yaml"]) == 0
    assert main(["config", "diff", "thesis", "mine.yaml"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "rig.cameras: 4 -> 6"


def test_config_show_names_every_option(capsys):
    assert main(["config", "show", "--all"]) == 0
    text = capsys.readouterr().out
    for option in described_options():
        assert f"{option.name.rpartition('.')[2]}:" in text, option
    assert main(["config", "show", "quick"]) == 0
    keys = [line for line in capsys.readouterr().out.splitlines() if not line.endswith(":") and line[:1] != "#"]
    assert len(keys) <= 35


def test_config_schema_covers_every_section(capsys):
    assert main(["config", "schema"]) == 0
    assert set(json.loads(capsys.readouterr().out)["properties"]) == {*Config.model_fields, "extends"}


def test_config_copy_keeps_the_comments_and_overwrites_nothing(working_directory, capsys):
    assert main(["config", "copy", "thesis", "mine.yaml"]) == 0
    assert "appendix XI" in (working_directory / "mine.yaml").read_text()
    assert "expected a file that does not exist yet" in complaint(capsys, "config", "copy", "quick", "mine.yaml")
    assert "expected an existing folder" in complaint(capsys, "config", "copy", "quick", "none/mine.yaml")


# ------------------------------------------------------------------------------------------------ bad input


BAD_INPUT = [
    (["optimse"], 'command line: Unknown command "optimse". Did you mean "optimise"?'),
    (["config", "check", "--loud"], "command line: Unknown option: --loud"),
    (
        ["optimise", "--cameras", "6"],
        "command line: Unknown option: --cameras; options of a run are key=value, such as rig.cameras=6;",
    ),
    (["evaluate"], "command line: RIG: expected a value, got none; see warpav evaluate --help"),
    (["render", "3", "--rig", "highest", "--out", "o", "device=cuda:99"], "command line (device=cuda:99): device: "),
    (
        ["optimise", "optimiser.selection_time_s=0"],
        "command line (optimiser.selection_time_s=0): optimiser.selection_time_s: expected a number above 0, got 0",
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
    (["evaluate", "empty"], "empty: run folder: expected a folder written by warpav optimise, got one without"),
    (["evaluate", "highest", "--json", "none/x.json"], "none/x.json: --json: expected an existing folder"),
    (
        ["evaluate", "highest", "--soiling", "disc", "0.5", "0.5", "3"],
        "command line (--soiling): expected a share of the image's area in (0, 1], got 3.0",
    ),
    (["evaluate", "highest", "--load", "40", "0"], "command line (--load): expected an angle within 30, got 40.0"),
    (["render", "garbage.onnx", "--rig", "highest", "--out", "o"], "garbage.onnx: "),
    (["render", "3", "--rig", "none.yaml", "--out", "o"], "none.yaml: rig: expected a rig YAML,"),
    (
        ["render", "3", "--rig", "highest", "--out", "garbage.onnx"],
        "garbage.onnx: --out: expected a folder to write to",
    ),
    (["inspect", "none"], "none: rig: expected a rig YAML,"),
    (["scenes", "make", "--seeds", "9..3", "--out", "o"], "command line (--seeds): expected a range whose end is not"),
    (["scenes", "make", "--seeds", "3", "--out", "garbage.onnx"], "garbage.onnx: --out: expected a folder to write to"),
    (["doctor", "--json", "none/x.json"], "none/x.json: --json: expected an existing folder"),
]


@pytest.mark.parametrize(
    ("argv", "end"),
    [
        (["optimse"], ", ...; see warpav --help"),
        (["rig", "send"], " export, check, requirements, drawing; see warpav rig --help"),
        (["rig", "export", "x", "--out", "y"], " --format: expected a value, got none; see warpav rig export --help"),
        (["optimise", "--cameras", "6"], "such as rig.cameras=6; see warpav optimise --help"),
    ],
)
def test_wrong_words_lead_to_the_help_of_their_command(capsys, argv, end):
    assert complaint(capsys, *argv).endswith(end)


@pytest.mark.parametrize(("argv", "message"), BAD_INPUT, ids=[" ".join(argv) for argv, _ in BAD_INPUT])
def test_bad_input_is_one_line_and_leaves_nothing(working_directory, capsys, argv, message):
    (working_directory / "garbage.onnx").write_text("this is neither ONNX nor GLB nor a rig\n")
    (working_directory / "empty").mkdir()
    assert complaint(capsys, *argv).startswith(message)
    assert sorted(os.listdir(working_directory)) == ["empty", "garbage.onnx"]
    assert os.listdir(working_directory / "empty") == []


def test_more_cameras_than_fit_are_refused(working_directory, capsys):
    message = complaint(capsys, "optimise", *SMALL, "rig.cameras=8", "rig.min_spacing_m=3")
    assert message.startswith("command line (rig.cameras=8): rig.cameras: expected a number that fits on the mount")
    assert message.endswith("got 8; lower one of the two")
    assert os.listdir(working_directory) == []
    (working_directory / "mine.yaml").write_text("run:\n  batch_size: 2\nrig:\n  cameras: 8\n  min_spacing_m: 3\n")
    overrides = [option for option in SMALL if not option.startswith("rig.cameras")]
    assert main(["optimise", "mine.yaml", *overrides]) == 2
    assert capsys.readouterr().err.startswith("mine.yaml:4: rig.cameras: expected a number that fits")


def test_debug_shows_where(working_directory):
    with pytest.raises(ValueError, match="nowhere"):
        main(["optimise", "nowhere.yaml", "--debug"])


def test_an_unexpected_failure_is_one_line_with_status_1(monkeypatch, capsys):
    def fail(*_):
        raise RuntimeError("the roof\nis gone")

    monkeypatch.setattr("warpav.runs.config.placed_config", fail)
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


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_completion_is_installed_and_completes(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("SHELL", shutil.which("bash"))
    assert main(["--install-completion"]) == 0
    [script] = [file for file in tmp_path.rglob("warpav*") if file.is_file()]
    assert str(script) in capsys.readouterr().out
    for typed, expected in (("rig dr", "drawing"), ("config schema --of zo", "zones")):
        words = f"warpav {typed}".split()
        ask = f"source {script}; COMP_WORDS=({' '.join(words)}); COMP_CWORD={len(words) - 1}; _warpav; echo $COMPREPLY"
        answer = subprocess.run(["bash", "-c", ask], capture_output=True, text=True, check=True)
        assert answer.stdout.split() == [expected]


def test_the_levels_of_the_command_line_are_those_of_the_town():
    assert get_args(get_args(SceneLevel)[0]) == tuple(LEVELS)
