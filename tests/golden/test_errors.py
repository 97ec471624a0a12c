"""Bad input ends with status 2 and one line that names place, field and what came; nothing is left behind."""

import pytest

CASES = {
    "unknown option": (["optimise", "rig.camera=6"], ["rig.camera", "rig.cameras"]),
    "wrong type": (["optimise", "rig.cameras=many"], ["rig.cameras", "many"]),
    "out of range": (["optimise", "rig.cameras=0"], ["rig.cameras", "0"]),
    "no field of view": (["optimise", "camera.fov_deg=400"], ["fov_deg", "400"]),
    "unknown unit": (["optimise", "camera.fov_deg=80 parsec"], ["camera.fov_deg", "parsec"]),
    "unknown method": (["optimise", "method=magic"], ["method", "magic", "thesis"]),
    "unknown loss": (["optimise", "losses.beauty=1"], ["losses", "beauty"]),
    "unknown source": (["optimise", "scenes.source=dreams"], ["scenes.source", "dreams", "town"]),
    "seeds of both": (["optimise", "scenes.train_seeds=[1]", "scenes.test_seeds=[1]"], ["test_seeds", "1"]),
    "no such configuration": (["optimise", "none.yaml"], ["none.yaml"]),
    "no such shipped one": (["optimise", "quickk"], ["quickk", "quick"]),
    "no such detector": (["optimise", "detector.model=none.onnx"], ["none.onnx"]),
    "no such device": (["optimise", "device=cuda:99"], ["device", "cuda:99", "cpu"]),
    "not an option": (["optimise", "cameras"], ["cameras"]),
    "no such rig": (["evaluate", "none.yaml"], ["none.yaml"]),
    "no such preset": (["evaluate", "nuscene"], ["nuscene", "nuscenes"]),
    "no such format": (["rig", "export", "nuscenes", "--format", "paper", "--out", "x"], ["paper", "urdf"]),
    "no such command": (["optimize_all"], ["optimize_all"]),
    "no such flag": (["rig", "check", "nuscenes", "--maybe"], ["--maybe"]),
    "no such run": (["report", "nowhere"], ["nowhere"]),
    "no such scene": (["render", "none.glb", "--rig", "nuscenes", "--out", "x"], ["none.glb"]),
    "no such vehicle": (["vehicle", "check", "none.stl"], ["none.stl"]),
    "no such catalogue": (["modules", "check", "none.yaml"], ["none.yaml"]),
    "no such requirement": (["rig", "requirements", "nuscenes", "--requirements", "r999"], ["r999", "near_field"]),
    "no such plot": (["plot", "nuscenes", "--kind", "poem"], ["poem", "plan"]),
}
CAMERA = (
    "  - {name: a, position_m: [1, 0, 2], yaw_deg: 0, pitch_deg: 0, roll_deg: 0, fov_deg: 90, width_px: 64, "
    "height_px: 64}\n"
)
FILES = {
    "unknown key": ("optimise", "rig:\n  cameras: 4\n  camers: 5\n", ["file.yaml:3", "camers"]),
    "not YAML": ("optimise", "rig: [1,\n", ["file.yaml:"]),
    "twice": ("optimise", "rig:\n  cameras: 4\n  cameras: 5\n", ["file.yaml:3", "cameras"]),
    "wrong value": ("optimise", "camera:\n  fov_deg: -3\n", ["file.yaml:2", "fov_deg", "-3"]),
    "rig without cameras": ("evaluate", "frame: ego\n", ["file.yaml", "cameras"]),
    "rig of another frame": ("evaluate", "frame: map\ncameras:\n" + CAMERA, ["file.yaml:1", "frame", "map"]),
    "camera without a place": (
        "evaluate",
        "frame: ego\ncameras:\n" + CAMERA.replace("position_m: [1, 0, 2], ", ""),
        ["file.yaml:3", "position_m"],
    ),
    "place that is no number": (
        "evaluate",
        "frame: ego\ncameras:\n" + CAMERA.replace("1, 0, 2", "1, x, 2"),
        ["file.yaml:3", "position_m", "x"],
    ),
}


def check_complaint(found, named, folder):
    status, _, err = found
    assert status == 2, err
    assert len(err.strip().splitlines()) == 1, err
    for each in named:
        assert each in err, err
    assert "Traceback" not in err
    assert not list(folder.glob("runs/*"))


@pytest.mark.parametrize("name", CASES)
def test_bad_arguments(warpav, working_directory, name):
    argv, named = CASES[name]
    check_complaint(warpav(*argv), named, working_directory)


@pytest.mark.parametrize("name", FILES)
def test_bad_files(warpav, working_directory, name):
    command, text, named = FILES[name]
    (working_directory / "file.yaml").write_text(text)
    check_complaint(warpav(command, "file.yaml"), named, working_directory)
