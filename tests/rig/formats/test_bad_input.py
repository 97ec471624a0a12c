"""What cannot be used is refused in one line with file and field; what is missing is asked for by its option."""

import importlib
import json
import math
import os
from pathlib import Path

import numpy as np
import pytest

from tests.rig.formats.known_pose import NUSCENES, URDF, write_sample
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.raster.camera import CameraModel
from warpav.rig import (
    EXPORTED_ONLY,
    RIG_FORMATS,
    ImportOptions,
    Rig,
    RigCamera,
    export_rig_with_notes,
    import_rig_with_notes,
    read_rig,
    write_rig,
)
from warpav.rig.formats._convert import find_format

SIZED = ImportOptions(width_px=640, height_px=480)


def refusal(path, name, options=SIZED):
    with pytest.raises(InputError) as caught:
        import_rig_with_notes(path, name, options)
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith((str(path), str(path.parent), "command line", "fov_deg: ", "part: "))
    return text


def spoilt(name, folder, old, new):
    """The sample of a format with one text replaced in the first of its files that has it."""
    path = write_sample(name, folder)
    for file in [path, *sorted(folder.rglob("*"))]:
        if file.is_file() and old in (text := file.read_text()):
            file.write_text(text.replace(old, new, 1))
            return path
    raise AssertionError(f"{old!r} is not in the sample of {name}")


CORRUPT = {
    "nuscenes": [
        ('"translation": [1.7', '"translation": [true', "[1].translation: expected a list of 3 finite numbers, got"),
        ('"rotation": [0.62', '"rotation": [1.62', "[1].rotation: expected a quaternion of length 1, got [1.62"),
        ("[[320.0, 0.0,", "[[320.0, 2.0,", "[1].camera_intrinsic: expected a camera matrix [[fx, 0, cx]"),
        ('"token": "lidar0", ', '"token": "lidar0", "', "calibrated_sensor.json:1: expected valid JSON"),
    ],
    "urdf": [
        ("<robot", "<robt", "syntax error"),
        ('xyz="0.7 0.5 0.1"', 'xyz="0.7 0.5"', "'camera_joint': xyz: expected three finite numbers, got '0.7 0.5'"),
        ('rpy="0.0', 'rpy="nan', "joint 'camera_joint': rpy: expected three finite numbers, got 'nan"),
        ('name="camera_joint" type="fixed"', 'name="camera_joint" type="revolute"', "expected a fixed joint"),
        ('<parent link="roof"/><child link="front', '<child link="front', "joint 'camera_joint': expected <parent"),
        ('<parent link="base_link"/>', '<parent link="front_left/camera_link"/>', "got a circle through"),
        ("camera_optical_link", "lens", "xx"),
    ],
    "autoware": [
        ("    pitch: ", "    pitched: ", "kit_base_link.front_left/camera_link.pitch: expected a finite"),
        ("base_link:\n", "bass_link:\n", "sensor_kit_bass_link: expected where it lies, for front_left/camera_link"),
        ("data: [320.,", "data: [-320.,", "camera_matrix.data: expected positive focal lengths"),
        ("image_width: 640", "image_width: 3", "width_px: expected from 8 to 16384 pixels, got 3"),
    ],
    "carla-ros-bridge": [
        ('"x": 1.7', '"x": "1.7"', "objects[1].sensors[1].spawn_point.x: expected a finite number, got '1.7'"),
        ('"fov": 90.0', '"fov": 190.0', "sensors[1].fov: expected a field of view between 0 and 180 degrees, got 190"),
        ("sensor.camera.rgb", "sensor.camera.depth", "expected cameras, got LiDARs without beams, lidar; `lidar`"),
        ('"objects"', '"object"', "objects: expected the ros-bridge's list of objects"),
    ],
    "carla-python": [
        ("'x': 1.7", "'x': None", "[0].x: expected a finite number, got nothing"),
        ("'type'", "'type", "sensors.txt:2: expected valid JSON"),
        ("'fov': 90", "'fov': 90, 'lens_circle_multiplier': 3", "lens_circle_multiplier: expected 0"),
    ],
    "kitti": [
        ("R0_rect: 1 0 0", "R0_rect: 1.1 0 0", "R0_rect: expected a rotation, whose columns are ortho"),
        ("R0_rect: 1 0 0", "R0_rect: -1 0 0", "R0_rect: expected a rotation, got one with a mirror"),
        ("Tr_velo_to_cam", "Tr", "R0"),
        ("P0: ", "P0 - ", "000000.txt: P0: expected a 3 x 4 matrix of finite numbers, got"),
    ],
    "opencv": [
        ("R: ", "Q: ", "camera_from_ego: expected the camera's pose: camera_from_ego (4 x 4), or R and T"),
        ("rows: 5", "rows: 7", "distortion_coefficients: expected a list of 4 or 5 or 8 or 12 or 14 finite"),
        ("data: [ 320., ", "data: [ 320.; ", "camera_matrix: expected a 3 x 3 matrix of finite numbers, got {}"),
    ],
    "alpasim": [
        ("extra_cameras:", "extra_camera:", "yaml:2: extra_cameras: expected AlpaSim's list of cameras, got nothing"),
        ("rig_to_camera:", "camera_to_rig:", "rig_to_camera: expected translation_m and rotation_xyzw; without them"),
        ("rotation_xyzw: [-0.6", "rotation_xyzw: [-1.6", "rotation_xyzw: expected a quaternion of length 1, got [0.62"),
        (
            "      opencv_pinhole:",
            "      pinhole:",
            "intrinsics.opencv_pinhole: expected the parameters of opencv_pinh",
        ),
        ("focal_length: [320.0", "focal_length: [-320.0", "focal_length: expected two positive focal lengths, got [-3"),
        ("thin_prism: [0.0", "thin_prism: [0.1", "thin_prism: expected four zeros; warpav has no thin prism, got [0.1"),
        ("resolution_hw: [480, ", "resolution_hw: [480.5, ", "resolution_hw[0]: expected a whole number, got 480.5"),
        ("ROLLING_TOP_TO_BOTTOM", "ROLLING", "shutter_type: expected one of GLOBAL, ROLLING_TOP_TO_BOTTOM, ROLL"),
    ],
    "kalibr": [
        (
            "camera_model: pinhole",
            "camera_model: mei",
            "yaml:8: cam0.camera_model: expected one of pinhole, eucm,",
        ),
        ("cam1:", "cam2:", "expected cam0, cam1, ... without gaps, got cam0, cam2"),
        ("  - [0.0, 0.0, 0.0, 1.0]\n  cam", "  - [0.0, 0.0, 1.0, 1.0]\n  cam", "last row is 0, 0, 0, 1"),
        ("resolution: [640, 480]", "resolution: 640", "cam0.resolution: expected [width, height], got 640"),
        ("T_cn_cnm1:", "T_cn:", "cam1.T_cn_cnm1: expected a 4 x 4 matrix of finite numbers, got nothing"),
    ],
}


@pytest.mark.parametrize(
    ("name", "old", "new", "message"), [(name, *change) for name, changes in CORRUPT.items() for change in changes]
)
def test_a_mistake_in_a_file_is_named(tmp_path, name, old, new, message):
    if (name, new) == ("urdf", "lens"):  # the camera's link itself remains
        rig, _ = import_rig_with_notes(spoilt(name, tmp_path, old, new), name)
        assert rig.cameras[0].name == "front_left"
        return
    if (name, new) == ("kitti", "Tr"):  # odometry's files have no rectification
        assert len(import_rig_with_notes(spoilt(name, tmp_path, old, new), name, SIZED)[0].cameras) == 2
        return
    assert message in refusal(spoilt(name, tmp_path, old, new), name)


@pytest.mark.parametrize("name", [name for name in RIG_FORMATS if name not in (*EXPORTED_ONLY, "argoverse2")])
@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00", b"[[[[", b"{}", b"null", b"<robot/>", b"a: 1\n", b"P0: 1"])
def test_a_file_of_something_else_is_refused(tmp_path, name, content):
    file = tmp_path / "file.json"
    file.write_bytes(content)
    refusal(file, name)
    refusal(tmp_path / "nothing.json", name)
    (tmp_path / "folder").mkdir()
    refusal(tmp_path / "folder", name)


def test_argoverse2_without_its_package_names_the_extra(tmp_path, monkeypatch):
    import_module = importlib.import_module

    def without(name, *arguments):
        if name.startswith("pyarrow"):
            raise ModuleNotFoundError("No module named 'pyarrow'")
        return import_module(name, *arguments)

    monkeypatch.setattr(importlib, "import_module", without)
    with pytest.raises(InputError, match=r'pip install "warpav\[av2\]"'):
        import_rig_with_notes(tmp_path, "argoverse2")


def test_missing_sizes_and_lenses_are_asked_for(tmp_path):
    kitti = write_sample("kitti", tmp_path / "kitti")
    assert "give `width_px` and `height_px`" in refusal(kitti, "kitti", ImportOptions())
    urdf = write_sample("urdf", tmp_path / "urdf")
    (tmp_path / "urdf/camera_info/front_left.yaml").rename(tmp_path / "info.yaml")
    (tmp_path / "urdf/camera_info").rmdir()
    assert "give `width_px`, `height_px` and `fov_deg`, or `intrinsics`" in refusal(urdf, "urdf", ImportOptions())
    assert "fov_deg: expected a number" in refusal(urdf, "urdf", ImportOptions(None, (0, 0, 0), 640, 480, 200.0))
    given = ImportOptions(width_px=320, height_px=240, fov_deg=70.0)
    (camera,) = import_rig_with_notes(urdf, "urdf", given)[0].cameras
    assert (camera.model.width_px, math.degrees(camera.model.fov_rad)) == (320, pytest.approx(70.0))
    (camera,) = import_rig_with_notes(urdf, "urdf", ImportOptions(intrinsics=tmp_path / "info.yaml"))[0].cameras
    assert camera.model.width_px == 640
    assert "import the file that has them" in refusal(tmp_path / "info.yaml", "camera-info")


def test_nuscenes_with_many_calibrations_asks_for_a_scene(tmp_path):
    rows = NUSCENES["calibrated_sensor.json"]
    other = {**rows[1], "token": "other", "translation": [1.5, 0.5, 1.6]}
    file = write_sample("nuscenes", tmp_path)
    file.write_text(json.dumps([*rows, other]))
    assert "got 2 of front_left; `part` SCENE" in refusal(file, "nuscenes")
    (tmp_path / "scene.json").write_text(json.dumps([{"token": "t", "name": "scene-0061"}]))
    (tmp_path / "sample.json").write_text(json.dumps([{"token": "s", "scene_token": "t"}]))
    (camera,) = import_rig_with_notes(file, "nuscenes", ImportOptions(part="scene-0061"))[0].cameras
    assert camera.position_m[0] == 1.7
    assert "expected a scene named 'scene-1'" in refusal(file, "nuscenes", ImportOptions(part="scene-1"))
    assert "kitti files hold one rig" in refusal(write_sample("kitti", tmp_path), "kitti", ImportOptions(part="a"))


def test_large_tables_of_nuscenes_are_read_row_by_row(tmp_path):
    file = write_sample("nuscenes", tmp_path)
    other = {"token": "o", "sample_token": "o", "calibrated_sensor_token": "o", "width": 8, "height": 8}
    rows = [other] * 30_000 + NUSCENES["sample_data.json"]
    (tmp_path / "sample_data.json").write_text(json.dumps(rows, indent=0))  # 3 MB, in several parts
    (camera,) = import_rig_with_notes(file, "nuscenes")[0].cameras
    assert (camera.model.width_px, camera.model.height_px) == (640, 480)
    text = json.dumps(rows)
    for spoilt_text, message in (
        (text[:2000], "sample_data.json: expected valid JSON, got a mistake in or behind row"),
        ("{}", "sample_data.json: expected nuScenes's sample_data.json, a list of rows"),
        ("[3]", "sample_data.json: [0]: expected a row, got 3"),
    ):
        (tmp_path / "sample_data.json").write_text(spoilt_text)
        assert message in refusal(file, "nuscenes", ImportOptions())


def mirrored_file(folder):
    """A left-handed file read as a right-handed one."""
    file = write_sample("carla-python", folder)
    sensors = [{"type": "sensor.camera.rgb", "id": "front_left", "x": 1.0, "y": -0.5, "z": 1.5, "yaw": -55.0}]
    objects = {"objects": [{"type": "vehicle.a", "id": "ego", "sensors": []}]}
    for sensor in sensors:
        place = {key: sensor.pop(key) for key in ("x", "y", "z", "yaw")}
        objects["objects"][0]["sensors"].append({**sensor, "spawn_point": place})
    file = folder / "objects.json"
    file.write_text(json.dumps(objects))
    return file


def test_a_mirrored_rig_is_refused_with_the_dialect_to_try(tmp_path):
    file = mirrored_file(tmp_path)
    text = refusal(file, "carla-ros-bridge")
    assert "camera 'front_left': expected it on the left (y > 0) and pointing there, got y = -0.500 m" in text
    assert "`format_name` carla-python" in text
    assert "`accept_mirrored`" in text
    rig, notes = import_rig_with_notes(file, "carla-ros-bridge", ImportOptions(accept_mirrored=True))
    assert rig.cameras[0].position_m[1] == -0.5
    assert any("800 x 600 px, 90 deg" in note for note in notes)


def test_places_in_another_unit_are_refused(tmp_path):
    file = spoilt("nuscenes", tmp_path, "[1.7, 0.5, 1.6]", "[1700, 500, 1600]")
    assert "expected a position within 100 m of the rear axle" in refusal(file, "nuscenes")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("carla", "expected carla-ros-bridge .* or carla-python .*, got carla, which may be either"),
        ("nuscene", "expected one of nuscenes, .*, got 'nuscene'; did you mean nuscenes?"),
        ("autowear", "did you mean autoware"),
    ],
)
def test_an_unknown_format_is_refused_with_a_suggestion(name, message):
    with pytest.raises(InputError, match=message):
        find_format(name)


def test_xacro_is_refused_with_the_command_to_run(tmp_path):
    file = tmp_path / "rig.urdf.xacro"
    start = '<robot name="a" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="b"/>'
    file.write_text(URDF.replace('<robot name="shuttle">', start))
    assert "run: xacro rig.urdf.xacro > rig.urdf" in refusal(file, "urdf")


def plain_rig(*names):
    return Rig(
        RigCamera(name, np.array([1.0, 0.1 * i, 1.5]), 0.0, 0.0, 0.0, CameraModel(64, 48))
        for i, name in enumerate(names)
    )


def test_exports_replace_nothing_unless_told(tmp_path):
    file = tmp_path / "calibrated_sensor.json"
    file.write_text("mine")
    with pytest.raises(InputError, match=r"calibrated_sensor.json: expected a file that does not exist yet"):
        export_rig_with_notes(plain_rig("a"), "nuscenes", tmp_path)
    assert [each.name for each in tmp_path.iterdir()] == ["calibrated_sensor.json"]
    assert file.read_text() == "mine"
    export_rig_with_notes(plain_rig("a"), "nuscenes", tmp_path, overwrite=True)
    assert json.loads(file.read_text())
    (tmp_path / "wall").write_text("")
    for target in (tmp_path / "wall", tmp_path / "wall" / "deep"):
        with pytest.raises(InputError, match=r"wall: expected a folder to write to, got a file; choose another path$"):
            export_rig_with_notes(plain_rig("a"), "autoware", target, overwrite=True)
    with pytest.raises(InputError, match="expected a place to write to, got"):
        export_rig_with_notes(plain_rig("a"), "kitti", Path(os.devnull) / "deep")
    with pytest.raises(InputError, match="expected a folder for the files of 2 cameras"):
        export_rig_with_notes(plain_rig("a", "b"), "kitti", tmp_path / "a.txt")
    with pytest.raises(InputError, match=r"expected one of nuscenes, .*, alpasim, .*; kalibr is for import only"):
        export_rig_with_notes(plain_rig("a"), "kalibr", tmp_path / "a")


# ------------------------------------------------------------------------------------------------ the command line


def test_the_command_replaces_no_rig_unless_told(tmp_path, capsys):
    out = tmp_path / "rig.yaml"
    sample = str(write_sample("carla-python", tmp_path))
    words = ["rig", "import", sample, "--format", "carla-python", "--out", str(out)]
    out.write_text("mine")
    assert main(words) == 2
    assert "rig.yaml: expected a file that does not exist yet" in capsys.readouterr().err
    assert out.read_text() == "mine"
    assert main([*words, "--overwrite"]) == 0
    assert read_rig(out).cameras
    capsys.readouterr()
    for more in ([], ["--overwrite"]):
        assert main([*words[:-1], str(tmp_path), *more]) == 2
        assert capsys.readouterr().err == f"{tmp_path}: expected a file to write, got a folder; name a file in it\n"


def test_the_command_takes_origins_behind_the_axle(tmp_path, capsys):
    out = tmp_path / "objects.json"
    where = ["--origin-m", "-1.4", "0", "0.3"]
    assert main(["rig", "export", "nuscenes", "--format", "carla-ros-bridge", "--out", str(out), *where]) == 0
    (front, *_) = json.loads(out.read_text())["objects"][0]["sensors"]
    assert front["spawn_point"]["x"] == pytest.approx(1.701 + 1.4)
    rig = tmp_path / "rig.yaml"
    assert main(["rig", "import", str(out), "--format", "carla-ros-bridge", "--out", str(rig), *where]) == 0
    assert read_rig(rig).cameras[0].position_m == pytest.approx([1.701, 0.016, 1.511])
    assert "it lies at (-1.4, 0, 0.3) m" in capsys.readouterr().out


def test_the_command_checks_rigs(tmp_path, capsys):
    assert main(["rig", "check", "unidrive_6x60"]) == 0
    output = capsys.readouterr().out
    assert "FRONT: at 0.000 0.000 1.600 m, yaw 0.0 pitch 0.0 roll 0.0 deg, pinhole 60.0 deg, 1600 x 900 px" in output
    assert "odd: cameras 'FRONT' and 'FRONT_LEFT' share one position" in output
    assert "can be exported as nuscenes" in output
    mirrored = tmp_path / "rig.yaml"
    write_rig(
        import_rig_with_notes(mirrored_file(tmp_path), "carla-ros-bridge", ImportOptions(accept_mirrored=True))[0],
        mirrored,
    )
    assert main(["rig", "check", str(mirrored)]) == 2
    assert "expected it on the left" in capsys.readouterr().err
    assert main(["rig", "check", str(mirrored), "--accept-mirrored"]) == 0
