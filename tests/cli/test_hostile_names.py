"""Names in files that a terminal or rich would obey are printed as what they are, by whatever command."""

import os
import pty
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import pytest
import yaml

from warpav.cli.app import main

pytestmark = pytest.mark.usefixtures("working_directory")

NAME = "e\x1b[31mvil\r\nEVIL [bold]x [|] \x07"
VISIBLE = "e\\x1b[31mvil\\r\\nEVIL [bold]x [|] \\x07"
MARKUP, MARKUP_VISIBLE = (each.replace("[|]", "[link=a] [/]") for each in (NAME, VISIBLE))
CAMERA = {
    **{"name": "front", "position_m": [1.0, 0.0, 1.9], "yaw_deg": 0, "pitch_deg": 0, "roll_deg": 0, "fov_deg": 90},
    **{"width_px": 96, "height_px": 96},
}
REQUIREMENT = {"area": {"around_m": [0.0, 2.0]}, "grid_m": 2.0, "object": "post", "pixels": 10, "visible_share": 0.5}
EVALUATE = ["scenes.train_seeds=[0]", "scenes.test_seeds=[1000]", "losses.probability=visible_share"]


def _write(name, data):
    with open(name, "w") as stream:
        yaml.safe_dump(data, stream)
    return name


MODULE = {
    "sensor_px": [64, 48],
    "fov_deg": 90.0,
    "housing": {"size_m": [0.05, 0.05, 0.05]},
    "price": {"value": 1.0, "unit": "relative"},
    "power_w": None,
    "source": "made up",
}


def _rig(name="rig.yaml", *, camera="front"):
    return _write(name, {"frame": "ego", "cameras": [{**CAMERA, "name": camera}]})


def _detector():
    onnx = pytest.importorskip("onnx")
    model = onnx.load(str(next(Path(str(files("warpav"))).glob("detection/models/*.onnx"))))
    entries = {each.key: each for each in model.metadata_props}
    labels = list(yaml.safe_load(entries["names"].value).values())
    entries["names"].value = str(dict(enumerate([*labels[:-1], MARKUP])))
    onnx.save(model, "evil.onnx")
    return "evil.onnx"


CASES = {
    "a file that is not there": (2, lambda: ["evaluate", f"{NAME}.yaml"], VISIBLE),
    "a folder that is not there": (2, lambda: ["report", NAME], VISIBLE),
    "an option": (2, lambda: ["config", "check", f"rig.start={NAME}"], VISIBLE),
    "a scene": (2, lambda: ["render", f"{NAME}.glb", "--rig", "highest", "--out", "o"], VISIBLE),
    "a camera": (2, lambda: ["rig", "check", _rig(camera=MARKUP)], MARKUP_VISIBLE),
    "a module": (
        2,
        lambda: ["modules", "check", _write("m.yaml", {"modules": [{**MODULE, "name": MARKUP}]})],
        MARKUP_VISIBLE,
    ),
    "a catalogue": (
        2,
        lambda: ["rig", "check", _write("rig.yaml", {"frame": "ego", "modules": NAME, "cameras": [CAMERA]})],
        VISIBLE,
    ),
    "several mistakes": (
        2,
        lambda: ["rig", "check", _write(f"{NAME}.yaml", {"frame": "ego", "cameras": [{}, {"name": MARKUP}]})],
        VISIBLE,
    ),
    "a zone": (
        2,
        lambda: [
            *(
                "optimise",
                "requirements=null",
                "losses.probability=visible_share",
                "scenes.train_seeds=[0]",
                "run.batch_size=1",
            ),
            f"mount.zones={_write('z.yaml', {'zones': {MARKUP: {'normal': 'up', 'box_m': [[90, 0, 0], [91, 1, 1]]}}})}",
        ],
        MARKUP_VISIBLE,
    ),
    "what is written": (0, lambda: ["config", "copy", "quick", f"{NAME}.yaml"], f"wrote {VISIBLE}.yaml"),
    "a label": (0, lambda: ["detector", "check", _detector()], MARKUP_VISIBLE),
    "a requirement in a table of text": (
        0,
        lambda: [
            *("rig", "requirements", _rig(), "--requirements"),
            _write("r.yaml", {"requirements": {MARKUP: REQUIREMENT}}),
        ],
        f"\n{MARKUP_VISIBLE}  ",
    ),
    "an arm and a requirement": (
        0,
        lambda: [
            *("evaluate", _rig(f"{NAME}.yaml"), *EVALUATE),
            f"requirements={_write('r.yaml', {'requirements': {MARKUP: REQUIREMENT}})}",
        ],
        f"  {VISIBLE}\n---",
    ),
}


def _require_harmless(text):
    assert not [each for each in text if not each.isprintable() and each not in "\n\t"]
    assert not [line for line in text.split("\n") if line.startswith(("EVIL", "vil"))]


@pytest.mark.parametrize(("status", "argv", "visible"), CASES.values(), ids=CASES)
def test_names_are_printed_as_they_are(capsys, status, argv, visible):
    assert main(argv()) == status
    captured = capsys.readouterr()
    text = captured.out + captured.err
    _require_harmless(text)
    assert visible in text


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals there")
def test_in_a_terminal_with_colours_nothing_of_a_name_is_obeyed():
    rig = _rig(f"{NAME}.yaml")
    ours, theirs = pty.openpty()
    environment = os.environ | {"TERM": "xterm-256color", "COLUMNS": "200", "LINES": "50"}
    command = [sys.executable, "-m", "warpav.cli.app", "evaluate", rig, *EVALUATE, "--json", f"{NAME}.json"]
    with subprocess.Popen(command, stdout=theirs, stderr=theirs, env=environment) as process:
        os.close(theirs)
        parts = []
        while True:
            try:
                part = os.read(ours, 65536)
            except OSError:  # how Linux tells that nobody writes any longer
                break
            if not part:
                break
            parts.append(part)
    os.close(ours)
    text = b"".join(parts).decode()
    assert process.returncode == 0, text
    assert "\x1b[" in text  # it is a terminal
    assert "\x1b[31mvil" not in text
    assert not set(text) & {"\x07"}
    assert "\x1b]" not in text
    assert f"wrote {VISIBLE}.json" in text
    assert VISIBLE in text.partition("1 scene")[2]
