"""Every format reads and writes one known camera as others do."""

import importlib.util
import json
import math
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import yaml

from tests.rig.formats.known_pose import (
    BRIDGE,
    CAMERA_FROM_EGO,
    MATRIX,
    PITCH_DEG,
    PITCH_RAD,
    POSITION_M,
    QUATERNION_WXYZ,
    ROLL_DEG,
    ROLL_RAD,
    YAW_DEG,
    YAW_RAD,
    write_sample,
)
from warpav.raster.camera import CameraModel
from warpav.rig import ImportOptions, Rig, RigCamera, export_rig_with_notes, import_rig_with_notes

SIZED = ImportOptions(width_px=640, height_px=480)
RIG = Rig([RigCamera("front_left", np.array(POSITION_M), YAW_RAD, PITCH_RAD, ROLL_RAD, CameraModel(640, 480))])
EXACT = ["urdf", "autoware", "carla-ros-bridge", "carla-python"]
ROUNDED = ["nuscenes", "kitti", "opencv", "alpasim", "kalibr"]  # their samples hold six decimals


@pytest.mark.parametrize("name", [*EXACT, *ROUNDED])
def test_the_known_camera_is_read(tmp_path, name):
    rig, notes = import_rig_with_notes(write_sample(name, tmp_path), name, SIZED)
    camera = rig.cameras[0]
    tolerance = 1e-12 if name in EXACT else 3e-6
    expected = RIG.cameras[0].ego_from_camera if name in EXACT else np.linalg.inv(CAMERA_FROM_EGO)
    np.testing.assert_allclose(camera.ego_from_camera, expected, rtol=0, atol=tolerance)
    assert camera.position_m == pytest.approx(POSITION_M, abs=3e-6)
    assert math.degrees(camera.pitch_rad) == pytest.approx(PITCH_DEG, abs=1e-4)
    assert "handed" in notes[0]
    if name not in ("kalibr", "kitti"):
        assert [each.name for each in rig.cameras] == ["front_left"]
    if name != "kalibr":
        assert camera.model.focal_px is None  # square pixels around the middle are a field of view
        assert camera.model.fov_rad == pytest.approx(math.pi / 2, abs=1e-12)
        assert (camera.model.width_px, camera.model.height_px) == (640, 480)


def written(name, folder):
    files, _ = export_rig_with_notes(RIG, name, folder / "out")
    return {file.name: file for file in files}


def test_nuscenes_is_written_as_others_read_it(tmp_path):
    files = written("nuscenes", tmp_path)
    (row,) = json.loads(files["calibrated_sensor.json"].read_text())
    assert row["translation"] == pytest.approx(POSITION_M, abs=1e-12)
    assert row["rotation"] == pytest.approx(QUATERNION_WXYZ, abs=1e-6)
    np.testing.assert_allclose(row["camera_intrinsic"], MATRIX, atol=1e-9)
    (sensor,) = json.loads(files["sensor.json"].read_text())
    assert (sensor["token"], sensor["channel"]) == (row["sensor_token"], "front_left")


def test_urdf_is_written_as_others_read_it(tmp_path):
    root = ElementTree.parse(written("urdf", tmp_path)["rig.urdf"]).getroot()
    link, optical = root.findall("joint")
    assert [float(value) for value in link.find("origin").get("rpy").split()] == pytest.approx(
        [ROLL_RAD, PITCH_RAD, YAW_RAD]
    )
    assert [float(value) for value in link.find("origin").get("xyz").split()] == pytest.approx(POSITION_M)
    assert optical.find("origin").get("rpy") == "-1.5707963267948966 0.0 -1.5707963267948966"
    assert optical.find("child").get("link") == "front_left/camera_optical_link"


@pytest.mark.parametrize("package", ["yourdfpy", "urdf_parser_py"])
def test_urdf_is_read_by_other_parsers(tmp_path, package):
    file = written("urdf", tmp_path)["rig.urdf"]
    if package == "yourdfpy":
        robot = pytest.importorskip(package).URDF.load(str(file), load_meshes=False, build_scene_graph=True)
        transform = robot.get_transform("front_left/camera_optical_link", "base_link")
        np.testing.assert_allclose(np.linalg.inv(transform), CAMERA_FROM_EGO, atol=1e-6)
        return
    robot = pytest.importorskip("urdf_parser_py.urdf").URDF.from_xml_string(file.read_bytes())
    assert robot.get_root() == "base_link"
    chain = robot.get_chain("base_link", "front_left/camera_optical_link", links=False)
    assert [robot.joint_map[name].type for name in chain] == ["fixed", "fixed"]
    assert robot.joint_map[chain[0]].origin.rpy == pytest.approx([ROLL_RAD, PITCH_RAD, YAW_RAD])


def test_autoware_is_written_as_others_read_it(tmp_path):
    files = written("autoware", tmp_path)
    kit = yaml.safe_load(files["sensor_kit_calibration.yaml"].read_text())["sensor_kit_base_link"]
    x, y, z = POSITION_M
    expected = {"x": x, "y": y, "z": z, "roll": ROLL_RAD, "pitch": PITCH_RAD, "yaw": YAW_RAD}
    assert kit["front_left/camera_link"] == pytest.approx(expected)
    sensors = yaml.safe_load(files["sensors_calibration.yaml"].read_text())["base_link"]
    assert sensors["sensor_kit_base_link"] == dict.fromkeys(expected, 0.0)
    info = yaml.safe_load(files["front_left.yaml"].read_text())
    np.testing.assert_allclose(np.reshape(info["camera_matrix"]["data"], (3, 3)), MATRIX, atol=1e-9)
    assert info["distortion_model"] == "plumb_bob"


def test_both_dialects_of_carla_are_written_as_others_read_them(tmp_path):
    bridge = json.loads(written("carla-ros-bridge", tmp_path)["objects.json"].read_text())
    (sensor,) = bridge["objects"][0]["sensors"]
    expected = BRIDGE["objects"][1]["sensors"][1]
    assert sensor["spawn_point"] == pytest.approx(expected["spawn_point"])
    assert {key: sensor[key] for key in expected if key != "spawn_point"} == {
        key: pytest.approx(value) if key == "fov" else value for key, value in expected.items() if key != "spawn_point"
    }
    (sensor,) = json.loads(written("carla-python", tmp_path / "other")["sensors.json"].read_text())
    pose = {key: sensor[key] for key in ("x", "y", "z", "roll", "pitch", "yaw")}
    assert pose == pytest.approx(
        {"x": 1.7, "y": -0.5, "z": 1.6, "roll": ROLL_DEG, "pitch": -PITCH_DEG, "yaw": -YAW_DEG}
    )


def carla_matrix(carla, values):
    place = carla.Location(*(values[key] for key in "xyz"))
    turn = carla.Rotation(**{key: values[key] for key in ("pitch", "yaw", "roll")})
    return np.array(carla.Transform(place, turn).get_matrix())


@pytest.mark.parametrize("pose", [(YAW_DEG, PITCH_DEG, ROLL_DEG), (-160.0, -30.0, 75.0), (91.0, 60.0, -170.0)])
def test_carla_is_placed_where_its_own_client_places_it(tmp_path, pose):
    carla = pytest.importorskip("carla")
    angles = [math.radians(angle) for angle in pose]
    rig = Rig([RigCamera("front", np.array(POSITION_M), *angles, CameraModel(640, 480))])
    export_rig_with_notes(rig, "carla-python", tmp_path / "sensors.json")
    (sensor,) = json.loads((tmp_path / "sensors.json").read_text())
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    link_from_camera = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
    placed = mirror @ carla_matrix(carla, sensor) @ mirror @ link_from_camera
    # worst seen 2.4e-7: CARLA computes in single precision
    np.testing.assert_allclose(placed, rig.cameras[0].ego_from_camera, rtol=0, atol=1e-6)
    # the bridge turns its numbers into these: y, pitch and yaw change their sign
    export_rig_with_notes(rig, "carla-ros-bridge", tmp_path / "objects.json")
    point = json.loads((tmp_path / "objects.json").read_text())["objects"][0]["sensors"][0]["spawn_point"]
    bridged = {key: -value if key in ("y", "pitch", "yaw") else value for key, value in point.items()}
    np.testing.assert_allclose(carla_matrix(carla, bridged), carla_matrix(carla, sensor), rtol=0, atol=1e-6)


def test_kitti_is_written_as_others_read_it(tmp_path):
    lines = written("kitti", tmp_path)["front_left.txt"].read_text().splitlines()
    numbers = {key: np.array(rest.split(), float) for key, rest in (line.split(": ") for line in lines)}
    np.testing.assert_allclose(numbers["Tr_velo_to_cam"].reshape(3, 4), CAMERA_FROM_EGO[:3], atol=1e-6)
    np.testing.assert_allclose(numbers["P2"].reshape(3, 4)[:, :3], MATRIX, atol=1e-9)
    assert [line.split(":")[0] for line in lines[:7]] == [
        *("P0", "P1", "P2", "P3"),
        *("R0_rect", "Tr_velo_to_cam", "Tr_imu_to_velo"),
    ]


def test_opencv_is_written_as_its_own_reader_reads_it(tmp_path):
    file = written("opencv", tmp_path)["front_left.yaml"]
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    np.testing.assert_allclose(storage.getNode("camera_from_ego").mat(), CAMERA_FROM_EGO, atol=1e-6)
    np.testing.assert_allclose(storage.getNode("camera_matrix").mat(), MATRIX, atol=1e-9)
    # OpenCV puts a point where warpav does, but for the corner from which both count
    matrix, distortion = (storage.getNode(key).mat() for key in ("camera_matrix", "distortion_coefficients"))
    camera_from_ego = storage.getNode("camera_from_ego").mat()
    turn = cv2.Rodrigues(camera_from_ego[:3, :3])[0]
    point = np.array([[6.0, 4.5, 1.0], [12.0, 15.0, 0.0]])
    image = cv2.projectPoints(point, turn, camera_from_ego[:3, 3], matrix, distortion)[0][:, 0]
    camera = RIG.cameras[0]
    seen = np.c_[point, np.ones(2)] @ np.linalg.inv(camera.ego_from_camera).T
    np.testing.assert_allclose(camera.model.project(seen[:, :3]), image + 0.5, atol=1e-6)


def test_opencv_takes_a_rotation_vector(tmp_path):
    file = tmp_path / "front.yaml"
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    camera_from_ego = np.linalg.inv(RIG.cameras[0].ego_from_camera)
    storage.write("camera_matrix", np.array(MATRIX))
    storage.write("distortion_coefficients", np.array([[-0.3], [0.1], [1e-3], [0.0], [0.02]]))
    storage.write("rvec", cv2.Rodrigues(camera_from_ego[:3, :3])[0])
    storage.write("tvec", camera_from_ego[:3, 3:])
    storage.release()
    rig, _ = import_rig_with_notes(file, "opencv", SIZED)
    np.testing.assert_allclose(rig.cameras[0].ego_from_camera, RIG.cameras[0].ego_from_camera, atol=1e-12)
    assert rig.cameras[0].model.lens == "brown_conrady"
    assert rig.cameras[0].model.distortion == (-0.3, 0.1, 1e-3, 0.0, 0.02)


def test_kalibr_follows_its_chain_and_its_lenses(tmp_path):
    file = write_sample("kalibr", tmp_path)
    rig, notes = import_rig_with_notes(file, "kalibr")
    first, second = rig.cameras
    between = np.linalg.inv(first.ego_from_camera) @ second.ego_from_camera
    np.testing.assert_allclose(between[:3, 3], [0.2, 0.0, 0.0], atol=1e-6)
    assert (first.model.lens, second.model.lens) == ("brown_conrady", "fisheye")
    np.testing.assert_allclose(first.model.intrinsics, [[320.0, 0, 320.0], [0, 321.0, 240.0], [0, 0, 1.0]])
    assert "IMU" in notes[1]
    # without an IMU the first camera looks forward, and the user says from where
    lines = file.read_text().splitlines()
    file.write_text("\n".join([lines[0], *lines[6:]]))
    rig, notes = import_rig_with_notes(
        file, "kalibr", ImportOptions(origin_m=(1.0, 0.1, 1.5), origin_rpy_deg=(0.0, 0.0, 90.0))
    )
    assert rig.cameras[0].position_m == pytest.approx([1.0, 0.1, 1.5])
    assert math.degrees(rig.cameras[0].yaw_rad) == pytest.approx(90.0)
    assert rig.cameras[1].position_m == pytest.approx([1.2, 0.1, 1.5])  # to the right of a camera that looks left
    assert "cam0" in notes[1]


@pytest.mark.parametrize(
    ("model", "own", "lens"), [("eucm", (0.6, 1.1), "eucm"), ("ds", (-0.2, 0.58), "double_sphere")]
)
def test_kalibr_s_unified_models_begin_with_their_own_numbers(tmp_path, model, own, lens):
    file = write_sample("kalibr", tmp_path)
    text = file.read_text().replace("camera_model: pinhole", f"camera_model: {model}", 1)
    text = text.replace("distortion_coeffs: [-0.28, 0.07, 0.0002, 1.8e-05]", "distortion_coeffs: []")
    text = text.replace("distortion_model: radtan", "distortion_model: none")
    file.write_text(text.replace("intrinsics: [320.0, 321.0", f"intrinsics: [{own[0]}, {own[1]}, 320.0, 321.0"))
    found = import_rig_with_notes(file, "kalibr")[0].cameras[0].model
    assert (found.lens, found.distortion) == (lens, own)
    np.testing.assert_allclose(found.intrinsics, [[320.0, 0, 320.0], [0, 321.0, 240.0], [0, 0, 1.0]])


@pytest.mark.skipif(importlib.util.find_spec("pyarrow") is None, reason="needs pyarrow")
def test_argoverse2_reads_and_writes_the_known_camera(tmp_path):
    from pyarrow import feather

    files = written("argoverse2", tmp_path)
    (pose,) = feather.read_table(files["egovehicle_SE3_sensor.feather"]).to_pylist()
    assert [pose[key] for key in ("qw", "qx", "qy", "qz")] == pytest.approx(QUATERNION_WXYZ, abs=1e-6)
    assert [pose[key] for key in ("tx_m", "ty_m", "tz_m")] == pytest.approx(POSITION_M)
    table = feather.read_table(files["intrinsics.feather"])
    (lens,) = table.to_pylist()
    assert str(table.schema.field("width_px").type) == "uint16"
    assert [lens[key] for key in ("fx_px", "fy_px", "cx_px", "cy_px")] == pytest.approx([320.0, 320.0, 319.5, 239.5])
    # a lidar has a pose but no lens; distortion belongs to images before they were published
    poses = {key: [value] * 2 for key, value in pose.items()} | {"sensor_name": ["up_lidar", "front_left"]}
    import pyarrow

    feather.write_feather(pyarrow.table(poses), files["egovehicle_SE3_sensor.feather"])
    feather.write_feather(
        pyarrow.table({**{key: [value] for key, value in lens.items()}, "k1": [-0.24]}), files["intrinsics.feather"]
    )
    rig, notes = import_rig_with_notes(tmp_path / "out", "argoverse2", ImportOptions(origin_m=(0.0, 0.0, 0.33)))
    (camera,) = rig.cameras
    assert camera.position_m == pytest.approx([1.7, 0.5, 1.93])
    assert camera.model == CameraModel(640, 480, camera.model.fov_rad)
    assert any("undistorted" in note for note in notes)
