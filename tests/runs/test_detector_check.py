"""``warpav detector check``: what it says, what it draws, and what it refuses."""

import cv2
import numpy as np
import pytest

from tests.cli.small_run import complaint
from warpav.cli.app import main
from warpav.runs import _detector_check as detector_check
from warpav.runs import load_detector
from warpav.runs._networks import detector_use
from warpav.runs.config import load_config

pytest.importorskip("onnx")

from tests.detection.tiny_networks import BOX_BASE_PX, SIDE_PX, write_network

LABELS = "{0: 'car', 1: 'pedestrian', 2: 'tree'}"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working directory with a network and a grey picture of the network's own size."""
    monkeypatch.chdir(tmp_path)
    write_network(tmp_path / "mine.onnx", "ultralytics", metadata={"names": LABELS}, batch=1)
    write_network(tmp_path / "unnamed.onnx", "ultralytics-end2end")
    write_network(tmp_path / "broken.onnx", "ultralytics", metadata={"names": LABELS}, poison=np.nan)
    write_network(tmp_path / "trees.onnx", "ultralytics", metadata={"names": "['oak', 'elm', 'ash']"})
    cv2.imwrite(str(tmp_path / "picture.png"), np.full((SIDE_PX, SIDE_PX, 3), 128, np.uint8))
    (tmp_path / "text.png").write_text("no picture")
    data = (tmp_path / "picture.png").read_bytes()
    (tmp_path / "claims.png").write_bytes(data[:33] + b"\xed\x9f\x00\x24" + data[37:])  # a part of 4 GB
    (tmp_path / "empty.jpg").touch()
    (tmp_path / "text.onnx").write_text("no network")
    return tmp_path


def test_the_shipped_detector_is_described(capsys, monkeypatch):
    monkeypatch.setattr(detector_check, "BATCH", 2)  # 16 images of 640 px take seconds
    assert main(["detector", "check", "builtin"]) == 0
    text = capsys.readouterr().out
    for words in (
        "format      ultralytics: ",
        "images      RGB 0..1, centred, any size in steps of 32 px, any batch",
        "from the file's metadata: car, van, lorry, bus",
        "vehicle     car, van, lorry, bus",
        "runs on     CPUExecutionProvider (onnxruntime offers ",
        "an image of 256 x 256 px: ",
        "an image of 640 x 640 px: ",
        " in batches of 2",
    ):
        assert words in text


def test_metadata_that_are_not_read_are_named(folder, capsys):
    write_network(
        folder / "mine.onnx", "ultralytics", metadata={"names": LABELS, "mean": "0.5", "date": "today"}, batch=1
    )
    assert main(["detector", "check", "mine.onnx"]) == 0
    assert "metadata    not read: mean\n" in capsys.readouterr().out


def test_boxes_are_listed_and_drawn(folder, capsys):
    assert main(["detector", "check", "mine.onnx", "--image", "picture.png", "detector.nms_iou_max=1.0"]) == 0
    text = capsys.readouterr().out
    assert "images      RGB 0..1, centred, 64 x 64 px, 1 at a time" in text
    assert "input       images [1, 3, 64, 64] float32" in text
    assert "pedestrian  pedestrian" in text
    assert "cyclist     no label; detector.classes.cyclist can name some" in text
    assert "2 detections of confidence 0.4 and more" in text
    assert "  0.40     40.0    20.0    60.0    34.0  pedestrian (pedestrian)" in text
    assert "wrote picture_boxes.png" in text
    drawn = cv2.imread(str(folder / "picture_boxes.png")).astype(int)
    changed = np.abs(drawn - 128).max(axis=2) > 8
    x0, _, x1, y1 = BOX_BASE_PX[1].astype(int)
    assert changed[y1, x0 : x1 + 1].all()  # the foot of the pedestrian's box
    assert not changed[y1 + 4 :].any()


def test_overrides_name_the_file_s_meaning(folder, capsys):
    words = ["detector.format=ultralytics-end2end", "detector.labels=[car,person]", "detector.classes.cyclist=[person]"]
    assert main(["detector", "check", "unnamed.onnx", *words]) == 0
    text = capsys.readouterr().out
    assert "format      ultralytics-end2end: set by detector.format" in text
    assert "labels      2 from detector.labels: car, person" in text
    assert "cyclist     person" in text
    assert "pedestrian  no label" in text


def test_paths_may_begin_at_home(folder, capsys, monkeypatch):
    monkeypatch.setenv("HOME", str(folder))
    (folder / "labels.txt").write_text("tree\nvan\nperson\n")
    assert main(["detector", "check", "~/mine.onnx", "detector.labels=~/labels.txt"]) == 0
    assert "labels      3 from detector.labels: tree, van, person" in capsys.readouterr().out
    config = load_config("quick", ["detector.model=~/mine.onnx"])
    assert load_detector(config).file.path == detector_use(config).model == folder / "mine.onnx"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nothing.onnx"], "detector.model: no such file: nothing.onnx"),
        (["text.onnx"], "text.onnx: not an ONNX file"),
        (["unnamed.onnx"], "unnamed.onnx: its layout could be one of"),
        (["mine.onnx", "detector.format=rtdetr"], "mine.onnx: detector.format=rtdetr: expected inputs images and orig"),
        (
            ["mine.onnx", "detector.classes.vehicle=[cra]"],
            "command line (detector.classes.vehicle=[cra]): detector.classes.vehicle: expected labels of mine.onnx (",
        ),
        (["broken.onnx"], "broken.onnx: output output0 holds numbers that are not finite"),
        (["trees.onnx"], "trees.onnx: none of its labels (oak, elm, ash) means a vehicle"),
        (["mine.onnx", "scenes.targets=[vehicle,cyclist]"], "means a cyclist (cyclist, bicyclist, rider); name those"),
        (["mine.onnx", "scenes.targets=[cyclist]"], "means a cyclist (cyclist, bicyclist, rider); name those"),
        (["mine.onnx", "detector.input_px=320"], "fixes its input at 64 x 64 pixels"),
        (["mine.onnx", "--image", "nothing.png"], "nothing.png: --image: expected an image, got none"),
        (
            ["mine.onnx", "--image", "claims.png"],
            "claims.png: --image: expected an image such as PNG or JPEG, got",
        ),
        (
            ["mine.onnx", "--image", "text.png"],
            "text.png: --image: expected an image such as PNG or JPEG, got",
        ),
        (
            ["mine.onnx", "--image", "empty.jpg"],
            "empty.jpg: --image: expected an image such as PNG or JPEG, got",
        ),
        (["mine.onnx", "--out", "boxes.png"], "command line (--out): expected --image beside it"),
        (
            ["mine.onnx", "--image", "picture.png", "--out", "boxes.jpg"],
            "boxes.jpg: --out: expected a name that ends",
        ),
        (["mine.onnx", "--image", "picture.png", "--out", "no/boxes.png"], "no/boxes.png: --out: expected an existing"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(folder, capsys, words, message):
    assert message in complaint(capsys, "detector", "check", *words)
