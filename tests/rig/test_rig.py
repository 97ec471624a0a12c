import math
import os
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from warpav.core.errors import InputError
from warpav.raster.camera import CameraModel
from warpav.rig import Rig, RigCamera, read_rig, write_rig

GOOD = """\
frame: ego
cameras:
  - name: front
    position_m: [1.7, 0.5, 1.6]
    yaw_deg: 45
    pitch_deg: 5.0
    roll_deg: 2
    fov_deg: 90
    width_px: 640
    height_px: 480
"""


PANE = "panes:\n  screen: {{normal: [1, 0, 0], outline_m: {}, reach_m: {}}}"


def camera(name="front", position_m=(1.0, 0.0, 1.5), yaw_rad=0.0, pitch_rad=0.0, roll_rad=0.0, **model):
    return RigCamera(name, np.array(position_m), yaw_rad, pitch_rad, roll_rad, CameraModel(**model))


def written(text, folder):
    file = folder / "rig.yaml"
    file.write_text(text, encoding="utf-8")
    return file


def test_pose_of_the_known_camera(tmp_path):
    """The pose of tests/core/test_frames.py, through the file."""
    (front,) = read_rig(written(GOOD, tmp_path)).cameras
    camera_from_ego = np.linalg.inv(front.ego_from_camera)
    expected = [
        [0.704525, -0.708827, -0.034767, -0.787653],
        [-0.086269, -0.036913, -0.995588, 1.758054],
        [0.704416, 0.704416, -0.087156, -1.410266],
        [0.0, 0.0, 0.0, 1.0],
    ]
    np.testing.assert_allclose(camera_from_ego, expected, atol=1e-6)
    assert (front.model.width_px, front.model.height_px) == (640, 480)
    assert front.model.fov_rad == pytest.approx(math.pi / 2)


def test_written_rig_follows_the_contract(tmp_path):
    rig = Rig([camera("front", (1.25, -0.0, 1.5), -math.pi), camera("rear", yaw_rad=math.radians(30.0))])
    write_rig(rig, tmp_path / "rig.yaml")
    data = yaml.safe_load((tmp_path / "rig.yaml").read_text())
    assert data["frame"] == "ego"
    assert data["cameras"][0] == {
        "name": "front",
        "position_m": [1.25, 0.0, 1.5],
        "yaw_deg": 180.0,
        "pitch_deg": 0.0,
        "roll_deg": 0.0,
        "fov_deg": 90.0,
        "width_px": 256,
        "height_px": 256,
    }
    assert data["cameras"][1]["yaw_deg"] == 30.0
    assert "-0.0" not in (tmp_path / "rig.yaml").read_text()


@settings(max_examples=60)
@given(
    st.lists(
        st.tuples(
            st.tuples(*(st.floats(-20, 20),) * 3),
            *(st.floats(-10, 10),) * 3,
            st.floats(1.0, 179.0),
            st.integers(8, 4096),
            st.integers(8, 4096),
        ),
        min_size=1,
        max_size=6,
    )
)
def test_rig_survives_the_file_and_gives_the_same_bytes_again(tmp_path_factory, numbers):
    folder = tmp_path_factory.mktemp("rig")
    rig = Rig(
        RigCamera(f"camera_{i}", np.array(position), yaw, pitch, roll, CameraModel(width, height, math.radians(fov)))
        for i, (position, yaw, pitch, roll, fov, width, height) in enumerate(numbers)
    )
    write_rig(rig, folder / "a.yaml")
    back = read_rig(folder / "a.yaml")
    write_rig(back, folder / "b.yaml")
    assert (folder / "a.yaml").read_bytes() == (folder / "b.yaml").read_bytes()
    for before, after in zip(rig.cameras, back.cameras, strict=True):
        assert after.name == before.name
        np.testing.assert_allclose(after.position_m, before.position_m, atol=1e-6)
        for field in ("yaw_rad", "pitch_rad", "roll_rad"):
            difference_rad = math.remainder(getattr(after, field) - getattr(before, field), 2 * math.pi)
            assert abs(math.degrees(difference_rad)) < 1e-6
        assert math.degrees(after.model.fov_rad) == pytest.approx(math.degrees(before.model.fov_rad), abs=1e-6)
        assert (after.model.width_px, after.model.height_px) == (before.model.width_px, before.model.height_px)


LENSES = (
    {"lens": "fisheye", "fov_rad": math.radians(200.0)},
    {"lens": "fisheye", "focal_px": (310.25, 305.5), "distortion": (-0.013, 1.0 / 300.0, -4e-8, 1e-17)},
    {"lens": "panorama", "fov_rad": 2.0 * math.pi},
    {"lens": "brown_conrady", "focal_px": (500.0, 501.125), "centre_px": (90.5, -3.0), "distortion": (0.1,) * 8},
    {"focal_px": (500.0, 501.125), "centre_px": (90.5, 60.25)},
    {"lens": "brown_conrady", "fov_rad": math.radians(70.0), "distortion": (-0.31, 0.11, 0.0, 0.0)},
)


def test_lenses_survive_the_file(tmp_path):
    rig = Rig(camera(f"camera_{i}", width_px=200, height_px=120, **lens) for i, lens in enumerate(LENSES))
    write_rig(rig, tmp_path / "a.yaml")
    back = read_rig(tmp_path / "a.yaml")
    for before, after in zip(rig.cameras, back.cameras, strict=True):
        assert after.model == before.model
    write_rig(back, tmp_path / "b.yaml")
    assert (tmp_path / "a.yaml").read_bytes() == (tmp_path / "b.yaml").read_bytes()
    # other readers take the same numbers from it
    data = yaml.safe_load((tmp_path / "a.yaml").read_text())["cameras"]
    assert [tuple(item.get("distortion", ())) for item in data] == [lens.get("distortion", ()) for lens in LENSES]
    assert [item.get("lens", "pinhole") for item in data] == [camera.model.lens for camera in rig.cameras]
    assert "fov_deg" not in data[1]


@pytest.mark.parametrize("name", ["no", "On", "1", "1e3", "null", "2026-01-01", "0x1F", "007", "_1", "1_000", "a.b-c"])
def test_names_that_yaml_would_misread_stay_text(tmp_path, name):
    write_rig(Rig([camera(name)]), tmp_path / "rig.yaml")
    assert read_rig(tmp_path / "rig.yaml").cameras[0].name == name
    assert yaml.safe_load((tmp_path / "rig.yaml").read_text())["cameras"][0]["name"] == name


def test_writing_replaces_the_file_in_one_step(tmp_path, monkeypatch):
    file = tmp_path / "rig.yaml"
    write_rig(Rig([camera("old")]), file)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match=r"rig\.yaml: expected a place to write to.*No space left"):
        write_rig(Rig([camera("new")]), file)
    assert read_rig(file).cameras[0].name == "old"
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("frame: ego", "frame: vehicle", r"rig.yaml:1: frame: expected ego .*, got 'vehicle'"),
        ("yaw_deg: 45", "yaw: 45", r":5: cameras\[0\]\.yaw: expected one of .*, got 'yaw'; did you mean yaw_deg\?"),
        ("roll_deg: 2", "roll_deg: two", r":7: cameras\[0\]\.roll_deg: expected a finite number .*, got 'two'"),
        ("roll_deg: 2", "roll_deg: true", r"roll_deg: expected a finite number .*, got True"),
        ("    roll_deg: 2\n", "", r":3: cameras\[0\]\.roll_deg: expected a finite number .*, got nothing"),
        ("[1.7, 0.5, 1.6]", "[1.7, 0.5]", r":4: cameras\[0\]\.position_m: expected three .*, got \[1\.7, 0\.5\]"),
        ("fov_deg: 90", "fov_deg: 180", r":8: cameras\[0\]\.fov_deg: expected .* between 0 and 180.*, got 180"),
        ("width_px: 640", "width_px: 640.5", r"width_px: expected a whole number of pixels from 8 .*, got 640\.5"),
        ("fov_deg: 90", "fov_deg: 361\n    lens: panorama", r":8: .*fov_deg: .* up to 360 .*, got 361"),
        (
            "fov_deg: 90",
            "fov_deg: 90\n    lens: fish_eye",
            r":9: cameras\[0\]\.lens: expected one of pinhole, .*, got \'fish_eye\'; did you mean fisheye\?",
        ),
        ("fov_deg: 90", "fov_deg: 90\n    lens:", r":9: cameras\[0\]\.lens: expected one of pinhole, .*, got nothing"),
        (
            "fov_deg: 90",
            "focal_px: [400, -1]",
            r":8: cameras\[0\]\.focal_px: expected two positive .*, got \[400, -1\]",
        ),
        ("fov_deg: 90", "fov_deg: 90\n    distortion: [.nan]", r":9: .*distortion: expected a list .*, got \[\.nan\]"),
        (
            "fov_deg: 90",
            "fov_deg: 90\n    lens: fisheye\n    distortion: [0.1, 0.0]",
            r":3: cameras\[0\]: expected valid camera parameters, got: a fisheye lens has 0 or 4 .*, got 2",
        ),
        ("fov_deg: 90", "fov_deg: 90\n    focal_px: [400, 400]", r":3: cameras\[0\]: .* got: fov_rad .* contradicts"),
        ("name: front", "name: ../front", r":3: cameras\[0\]\.name: expected a name of letters.*, got '\.\./front'"),
        (
            "frame: ego",
            "frame: ego\n" + PANE.format("[[0, 1]]", "[0, 1]"),
            r":3: panes\.screen\.outline_m: expected a list of corners, each \[x, y, z\] in metres, got \[\[0, 1\]\]",
        ),
        (
            "frame: ego",
            "frame: ego\n" + PANE.format("[]", "[0]"),
            r":3: panes\.screen\.reach_m: expected 2 .*, got \[0\]",
        ),
        ("cameras:\n", "cameras: []\nrest:\n", r"cameras: expected a list of at least one camera, got \[\]"),
        ("frame: ego", "frame: ego\nframe: ego", r"rig.yaml:2: frame: expected every key once"),
        ("frame: ego\n", "", r"rig.yaml:1: frame: expected ego .*, got nothing; add frame$"),
        (
            GOOD,
            "- 1\n",
            r"rig.yaml:1: expected a mapping .*, got \[1\]; files of other tools are read by warpav rig import",
        ),
        (
            GOOD,
            "objects: []\nversion: 1\n",
            r"^[^\n]*rig.yaml:1: expected .*, got \{objects: [^\n]*; files of other tools .* --format NAME$",
        ),
        (
            GOOD,
            "run: {seed: 1}\nrig: {cameras: 4}\n",
            r"^[^\n]*rig.yaml:1: expected .*; this is a configuration: of a run, give the folder instead$",
        ),
    ],
)
def test_reading_rejects_a_mistake_with_its_place(tmp_path, old, new, message):
    assert old in GOOD
    with pytest.raises(InputError, match=message):
        read_rig(written(GOOD.replace(old, new), tmp_path))


def test_reading_reports_every_mistake_on_a_line_of_its_own(tmp_path):
    text = GOOD.replace("yaw_deg: 45", "yaw: 45").replace("fov_deg: 90", "fov_deg: -1")
    with pytest.raises(InputError) as caught:
        read_rig(written(text, tmp_path))
    lines = str(caught.value).splitlines()
    assert len(lines) == 2  # the unknown yaw, which is the missing yaw_deg, and the field of view
    assert all(line.startswith(str(tmp_path / "rig.yaml") + ":") for line in lines)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ([], "rig: expected at least one camera, got none"),
        (["a", "b", "A"], r"cameras\[2\]\.name: expected every name once, .*cameras\[0\]"),
    ],
)
def test_rig_rejects_cameras_that_do_not_make_one(names, message):
    with pytest.raises(InputError, match=message):
        Rig(camera(name) for name in names)
    with pytest.raises(TypeError, match="cameras: expected cameras of a rig, got str"):
        Rig(["front"])


def test_a_notebook_shows_the_cameras_as_a_table():
    left = camera("left", (0.5, 0.91, 1.234), math.pi / 2, math.radians(-5.0), width_px=640, height_px=480)
    page = Rig([camera(), left])._repr_html_()
    assert "Rig of 2 cameras" in page
    rows = [
        re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row)
        for row in re.findall(r"<tr>(.*?)</tr>", page.partition("tbody")[2])
    ]
    assert rows[1] == ["left", "0.500", "0.910", "1.234", "90.0", "-5.0", "0.0", "90.0", "640 x 480", "pinhole"]
    assert [row[0] for row in rows] == ["front", "left"]


def test_the_rig_files_of_the_reference_can_be_read(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "reference" / "files.md").read_text(encoding="utf-8")
    examples = re.findall(r"^```yaml\n(frame: ego\n.*?)^```", page, re.DOTALL | re.MULTILINE)
    rigs = []
    for number, text in enumerate(examples):
        (tmp_path / f"rig_{number}.yaml").write_text(text, encoding="utf-8")
        rigs.append(read_rig(tmp_path / f"rig_{number}.yaml"))
    assert [[camera.name for camera in rig.cameras] for rig in rigs] == [["front", "rear"], ["front"]]
    pane = rigs[1].cameras[0].behind_glass
    assert pane is not None
    assert pane.name == "windscreen"
    assert pane.area_m2 == pytest.approx(0.5 * 1.2)


def test_a_rig_is_a_table_of_pandas():
    pytest.importorskip("pandas")
    model = CameraModel(640, 480, math.radians(190.0), lens="fisheye")
    frame = Rig([RigCamera("front", np.array([1.5, 0.0, 1.6])), RigCamera("left", np.ones(3), 1.0, 0.5, 0.25, model)])
    frame = frame.to_pandas()
    assert list(frame.index) == ["front", "left"]
    assert frame.loc["front", ["x_m", "y_m", "z_m", "fov_deg"]].tolist() == [1.5, 0.0, 1.6, 90.0]
    assert frame.loc["left", "yaw_deg":"roll_deg"].tolist() == pytest.approx(np.degrees([1.0, 0.5, 0.25]))
    assert frame.loc["left", "lens"] == "fisheye"
    assert frame["module"].isna().all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": "front left"}, "name: expected a name of letters"),
        ({"name": ""}, "name: expected a name of letters"),
        ({"module": "a b"}, "module: expected a name of letters"),
        ({"position_m": [0.0, 1.0]}, "position_m: expected three finite numbers"),
        ({"yaw_rad": math.inf}, "yaw_rad: expected a finite number, got inf"),
    ],
)
def test_a_camera_that_is_none_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        RigCamera(**{"name": "camera", "position_m": [0.0, 0.0, 1.0]} | options)
