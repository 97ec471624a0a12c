"""Rig files that would crash or stall a parser, or of values where none of the kind belongs: one line, in time."""

import time

import cv2
import numpy as np
import pytest

from tests.core.test_bounded_files import refusal as refusal_of
from tests.rig.formats.known_pose import CAMERA_INFO, KALIBR, write_sample
from warpav.rig import ImportOptions, import_rig_with_notes

SIZED = ImportOptions(width_px=640, height_px=480, fov_deg=90.0)
DEEP = "expected at most 64 levels inside one another, got more"


def refusal(path, name):
    return refusal_of(import_rig_with_notes, path, name, SIZED)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("front.yaml", "%YAML:1.0\n---\na: " + "[" * 40_000),
        ("front.yaml", "%YAML:1.0\n---\na:\n   " + "- " * 40_000),
        ("front.yaml", "%YAML:1.0\n---\n" + "a:" * 40_000),
        ("front.yaml", "%YAML:1.0\n---\n" + "".join(" " * k + "a:\n" for k in range(100))),
        ("front.json", '{"a": ' + "[" * 40_000),
        ("front.xml", '<?xml version="1.0"?><opencv_storage>' + "<a>" * 40_000),
    ],
    ids=["brackets", "dashes", "colons", "indents", "json", "xml"],
)
def test_levels_that_overflow_opencvs_stack_are_refused(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    told = refusal(tmp_path / name, "opencv")
    assert DEEP in told or "mapping values are not allowed" in told  # colons without spaces are a text


@pytest.mark.parametrize("size", ["-1", "60000", "0", "[3]", "1e9"])
def test_a_matrix_is_as_large_as_it_says(tmp_path, size):
    for name, text in (
        (
            "front.yaml",
            f"%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n  rows: 3\n  cols: {size}\n  dt: d\n  data: [1.]\n",
        ),
        (
            "front.json",
            f'{{"camera_matrix": {{"type_id": "opencv-matrix", "rows": 3, "cols": {size}, "data": [1.0]}}}}',
        ),
        ("front.xml", f"<o><camera_matrix><rows>3</rows><cols>{size}</cols><data>1. 2.</data></camera_matrix></o>"),
    ):
        (tmp_path / name).write_text(text)
        assert "camera_matrix: expected a 3 x 3 matrix of finite numbers, got {}" in refusal(tmp_path / name, "opencv")


def chain(count, name):
    links = [name(i) for i in range(count)]
    joints = [
        f'<link name="{link}"/><joint name="j{i}" type="fixed"><parent link="{above}"/><child link="{link}"/>'
        '<origin xyz="0.001 0 0"/></joint>'
        for i, (above, link) in enumerate(zip(["base_link", *links], links, strict=False))
    ]
    return f'<?xml version="1.0"?><robot name="r"><link name="base_link"/>{"".join(joints)}</robot>'


@pytest.mark.parametrize("kind", ["camera_link", "camera_optical_link"])
def test_a_chain_of_4000_links_takes_no_time(tmp_path, kind):
    file = tmp_path / "chain.urdf"
    file.write_text(chain(4000, lambda i: f"l{i}/{kind}" if i % 400 == 399 else f"l{i}"))
    began = time.process_time()
    rig, _ = import_rig_with_notes(file, "urdf", SIZED)
    assert time.process_time() - began < 5.0
    assert [camera.position_m[0] for camera in rig.cameras] == pytest.approx([0.4 * (k + 1) for k in range(10)])


@pytest.mark.parametrize("attack", ["<!ENTITY a0 'lol'>", "<!ENTITY x SYSTEM 'file:///etc/hostname'>"])
def test_entities_are_refused(tmp_path, attack):
    file = tmp_path / "rig.urdf"
    file.write_text(f'<?xml version="1.0"?><!DOCTYPE r [{attack}]><robot name="r"><link name="a"/></robot>')
    assert "expected XML without a DOCTYPE" in refusal(file, "urdf")


@pytest.mark.parametrize("value", ["[a]", "{a: {b: [{}]}}", "[]"])
def test_lists_and_mappings_are_no_names(tmp_path, value):
    kalibr = tmp_path / "chain.yaml"
    kalibr.write_text(KALIBR.replace("distortion_model: radtan", f"distortion_model: {value}"))
    assert "distortion_model: expected one of none, radtan, equidistant" in refusal(kalibr, "kalibr")
    autoware = write_sample("autoware", tmp_path / "autoware")
    info = CAMERA_INFO.replace("distortion_model: plumb_bob", f"distortion_model: {value}")
    (autoware / "camera_info" / "front_left.yaml").write_text(info)
    assert "distortion_model: expected one of plumb_bob, rational" in refusal(autoware, "autoware")
    alpasim = write_sample("alpasim", tmp_path / "alpasim")
    text = alpasim.read_text()
    alpasim.write_text(text.replace("model: opencv_pinhole", f"model: {value}", 1))
    assert "intrinsics.model: expected one of opencv_pinhole" in refusal(alpasim, "alpasim")


def test_a_row_of_a_table_has_an_end(tmp_path):
    path = write_sample("nuscenes", tmp_path)
    (tmp_path / "sample_data.json").write_text("[" + '{"a": [' + "1, " * 10_000_000)
    assert "expected a row of at most 1 MiB" in refusal(path, "nuscenes")
    (tmp_path / "sample_data.json").write_text("[" + "[" * 100_000)
    assert DEEP in refusal(path, "nuscenes")


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, "[{'type': 1, 'id': " + "-" * 100_000 + "1}]", "[0x" + "f" * 5000 + "]", "[" + "{}," * 200_000],
)
def test_pythons_own_lists_keep_the_bounds(tmp_path, text):
    (tmp_path / "sensors.txt").write_text(text)
    refusal(tmp_path / "sensors.txt", "carla-python")


def test_damaged_texts_of_a_feather_file_are_told(tmp_path):
    pytest.importorskip("pyarrow")
    from tests.fuzz.kinds import RIG
    from warpav.rig import export_rig

    export_rig(RIG, "argoverse2", tmp_path)
    file = tmp_path / "calibration" / "egovehicle_SE3_sensor.feather"
    export_rig(RIG, "argoverse2", tmp_path / "plain")
    content = file.read_bytes()
    assert b"front" in content
    file.write_bytes(content.replace(b"front", b"fr\xdf\xffnt"[:5]))
    assert "expected Argoverse 2's feather file, got: " in refusal(tmp_path / "calibration", "argoverse2")


@pytest.mark.parametrize("suffix", [".yaml", ".xml", ".json"])
def test_what_opencv_writes_is_read(tmp_path, suffix):
    storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("camera_name", "front lens")
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.array([[320.5, 0.0, 319.5], [0.0, 321.25, 239.5], [0.0, 0.0, 1.0]]))
    storage.write("distortion_coefficients", np.array([[-0.1], [0.01], [1e-3], [-2e-4], [1e-5]]))
    storage.write("R", np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
    storage.write("T", np.array([[0.0], [1.5], [-1.0]]))
    (tmp_path / f"file{suffix}").write_text(storage.releaseAndGetString())
    rig, _ = import_rig_with_notes(tmp_path / f"file{suffix}", "opencv", ImportOptions())
    [camera] = rig.cameras
    assert camera.name == "front_lens"
    np.testing.assert_allclose(camera.position_m, [1.0, 0.0, 1.5], atol=1e-9)
    assert (camera.model.width_px, camera.model.height_px) == (640, 480)
    assert camera.model.focal_px == (320.5, 321.25)
    assert camera.model.distortion == pytest.approx((-0.1, 0.01, 1e-3, -2e-4, 1e-5))
