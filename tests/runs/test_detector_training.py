"""`warpav detector train` and `warpav detector evaluate`: what they refuse, and what an evaluation holds."""

import importlib.util
import json
import os

import pytest

from tests.cli.small_run import complaint
from warpav.cli.app import main
from warpav.detection.training import _data as data

SIDES_PX = {64: 2, 96: 1}


@pytest.fixture(autouse=True)
def working_directory(working_directory):
    """A working directory of its own, with a file in it."""
    (working_directory / "file").touch()
    return working_directory


@pytest.fixture(autouse=True)
def few_images(monkeypatch):
    few = {f"test_{level}": data.Subset(level, 3_000_000, 1, SIDES_PX) for level in ("easy", "urban")}
    monkeypatch.setattr("warpav.runs._detector_training.TEST_SUBSETS", few)
    monkeypatch.setattr(data, "TEST_SUBSETS", few)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--images", "0"], "(--images): expected at least 1, got 0"),
        (["--processes", "0"], "(--processes): expected at least 1, got 0"),
        (["--out", "file"], "(--out): expected a folder to write to, got 'file' (File exists)"),
        (["--out", "/dev/null/out"], "(--out): expected a folder to write to, got '/dev/null/out' (Not a directory)"),
        (["--image-folder", "file"], "(--image-folder): expected a folder to write to, got 'file' (File exists)"),
    ],
)
def test_an_evaluation_with_wrong_words_is_refused(capsys, words, expected):
    out = [] if "--out" in words else ["--out", "out"]
    assert complaint(capsys, "detector", "evaluate", *out, *words) == f"command line {expected}"


@pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="needs PyTorch")
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--steps", "0"], "(--steps): expected at least 1, got 0"),
        (["--batch-size", "-1"], "(--batch-size): expected at least 1, got -1"),
        (["--seed", "-1"], "(--seed): expected at least 0, got -1"),
        (["--device", "cuda:99"], "got 'cuda:99'"),
        (["--out", "file"], "(--out): expected a folder to write to, got 'file' (File exists)"),
    ],
)
def test_a_training_with_wrong_words_is_refused(capsys, words, expected):
    out = [] if "--out" in words else ["--out", "out"]
    line = complaint(capsys, "detector", "train", *out, *words)
    assert line.startswith("command line (")
    assert line.endswith(expected)
    assert os.listdir() == ["file"]


def test_training_without_pytorch_says_what_to_install(capsys, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "torch" else find(name))
    assert complaint(capsys, "detector", "train", "--out", "out").endswith(
        'got no such module; run: pip install "warpav[train]"'
    )


def test_an_evaluation_counts_and_uses_its_images_again(capsys, working_directory):
    words = ["detector", "evaluate", "--out", "out", "--processes", "1"]
    assert main([*words]) == 0
    capsys.readouterr()
    report = json.loads((working_directory / "out/evaluation.json").read_text())
    assert {kind: list(sides) for kind, sides in report.items()} == {
        "easy": ["64", "96"],
        "urban": ["64", "96"],
    }
    assert report["easy"]["64"]["images"] == 2
    labelled = data.load_images(working_directory / "out/images/test_easy")
    labels = labelled[64].labels
    is_vehicle = (labels.class_index >= 0) & (labels.class_index < 5) & ~labels.ignored
    assert report["easy"]["64"].get("vehicle", {"objects": 0})["objects"] == is_vehicle.sum()
    file = working_directory / "out/images/test_easy/images_64.npy"
    written = file.stat().st_mtime_ns
    assert main([*words, "--images", "1"]) == 0
    assert file.stat().st_mtime_ns == written
    report = json.loads((working_directory / "out/evaluation.json").read_text())
    assert report["easy"]["64"]["images"] == 1
