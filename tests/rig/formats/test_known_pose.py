"""Every format reads and writes one known camera as others do."""

import importlib.util
import json
import math
import re
from dataclasses import replace
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from tests.rig.formats.known_pose import (
    BRIDGE,
    CAMERA_FROM_EGO,
    MATRIX,
    NUSCENES,
    PITCH_DEG,
    PITCH_RAD,
    POSITION_M,
    PYTHON_SENSORS,
    QUATERNION_WXYZ,
    ROLL_DEG,
    ROLL_RAD,
    URDF,
    YAW_DEG,
    YAW_RAD,
    write_sample,
)
from warpav.core.errors import InputError
from warpav.raster.beams import Beams
from warpav.raster.camera import CameraModel
from warpav.rig import ImportOptions, Rig, RigCamera, export_rig_with_notes, import_rig_with_notes

SIZED = ImportOptions(width_px=640, height_px=480)
RIG = Rig([RigCamera("front_left", np.array(POSITION_M), YAW_RAD, PITCH_RAD, ROLL_RAD, CameraModel(640, 480))])
EXACT = ["urdf", "autoware", "carla-ros-bridge", "carla-python", "driveworks"]
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
        pyarrow.table({**{key: [value] for key, value in lens.items()}, "k1": [-0.24], "skew": [1.0]}),
        files["intrinsics.feather"],
    )
    rig, notes = import_rig_with_notes(tmp_path / "out", "argoverse2", ImportOptions(origin_m=(0.0, 0.0, 0.33)))
    (camera,) = rig.cameras
    assert camera.position_m == pytest.approx([1.7, 0.5, 1.93])
    assert camera.model == CameraModel(640, 480, camera.model.fov_rad)
    assert any("undistorted" in note for note in notes)
    (lidar, _) = import_rig_with_notes(tmp_path / "out", "argoverse2", ImportOptions(lidar="lidar_32"))[0].cameras
    # its frame is not turned to look along z: the quaternion is that from x, y, z of the mount
    expected = Rotation.from_quat(np.roll(QUATERNION_WXYZ, -1)).as_matrix() @ RDF_IN_FLU
    np.testing.assert_allclose(lidar.ego_from_camera[:3, :3], expected, atol=1e-5)
    assert notes[2].endswith(": not read: skew")


# ------------------------------------------------------------------------------------- files as others have them

OPTICAL_RPY = "-1.5707963267948966 0 -1.5707963267948966"
SIZED_LENS = {"width_px": 800, "height_px": 400, "fov_deg": 74.5}


def robot(*parts):
    return f'<robot name="r"><link name="base_link"/>{"".join(parts)}</robot>'


def joint(child, parent, xyz="0 0 0", rpy="0 0 0"):
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}" rpy="{rpy}"/>'
    return f'<link name="{child}"/><joint name="{child}_j" type="fixed">{ends}</joint>'


def imported(folder, name, files, *, origin_m=(0.0, 0.0, 0.0), **options):
    """Cameras by name and notes of files, the first of which is named; of Autoware the folder."""
    for file, content in files.items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text(content if isinstance(content, str) else json.dumps(content))
    path = folder if name == "autoware" else folder / next(iter(files))
    rig, notes = import_rig_with_notes(path, name, ImportOptions(origin_m, **options))
    return {camera.name: camera for camera in rig.cameras}, "\n".join(notes[1:])


def place(camera):
    """Position [m], yaw, pitch and roll [deg]."""
    return [*camera.position_m.tolist(), *np.degrees([camera.yaw_rad, camera.pitch_rad, camera.roll_rad])]


def near(*numbers, within=1e-6):
    return pytest.approx(list(numbers), abs=within)


def test_the_distortion_of_nuscenes_kin_is_read(tmp_path):
    matrix = [[1000.0, 0.0, 960.0], [0.0, 1000.0, 540.0], [0.0, 0.0, 1.0]]
    pose = {"translation": [1.5, 0.0, 1.8], "rotation": [0.5, -0.5, 0.5, -0.5], "camera_intrinsic": matrix}
    row = {**NUSCENES["calibrated_sensor.json"][1], **pose}
    size = [{**NUSCENES["sample_data.json"][0], "width": 1920, "height": 1080}]
    numbers = [-0.3, 0.1, 0.001, -0.0005, -0.015]
    for more in ([], [0.0], [0.02]):  # nuImages has a sixth number
        rows = [{**row, "camera_distortion": numbers + more}]
        files = {"calibrated_sensor.json": rows, "sample_data.json": size}
        if any(more):
            with pytest.raises(InputError, match="a sixth number that is not 0 is no lens of warpav"):
                imported(tmp_path, "nuscenes", files)
            continue
        (camera,) = imported(tmp_path, "nuscenes", files)[0].values()
        point = np.array([[-3.0, 0.8, 10.0], [-8.0, 3.0, 10.0]])
        expected = cv2.projectPoints(point, np.zeros(3), np.zeros(3), np.array(matrix), np.array(numbers))[0][:, 0]
        np.testing.assert_allclose(camera.model.project(point), expected + 0.5, atol=1e-9)


def chain(**entries):
    entry = {"camera_model": "pinhole", "distortion_model": "none", "intrinsics": [460.0, 460.0, 320.0, 240.0]}
    return {"chain.yaml": "%YAML:1.0\n" + yaml.safe_dump({"cam0": {**entry, "resolution": [640, 480], **entries}})}


def test_kalibr_s_kin_turn_the_imu_s_transform_round(tmp_path):
    imu_from_camera = [[0.0, 0.0, 1.0, 1.2], [-1.0, 0.0, 0.0, 0.4], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]]
    for entry in ({"T_imu_cam": imu_from_camera}, {"T_cam_imu": np.linalg.inv(imu_from_camera).tolist()}):
        cameras, notes = imported(tmp_path, "kalibr", chain(**entry))
        assert place(cameras["cam0"]) == near(1.2, 0.4, 1.5, 0, 0, 0)
        assert "IMU" in notes


def test_omni_without_distortion_is_eucm(tmp_path):
    entries = {"camera_model": "omni", "intrinsics": [0.8, 830.0, 830.0, 370.0, 250.0], "distortion_coeffs": []}
    cameras, _ = imported(tmp_path, "kalibr", chain(**entries))
    point = np.array([[2.0, 0.5, 3.0], [-3.0, 1.0, 1.0]])
    sphere = point / np.linalg.norm(point, axis=1, keepdims=True)  # the model of Mei in closed form
    expected = 830.0 * sphere[:, :2] / (sphere[:, 2:] + 0.8) + [370.5, 250.5]
    np.testing.assert_allclose(cameras["cam0"].model.project(point), expected, atol=1e-9)
    with pytest.raises(InputError, match=r"cam0\.distortion_model: expected none beside omni"):
        imported(tmp_path, "kalibr", chain(**entries | {"distortion_model": "radtan"}))


MESSAGE = """\
header: {{stamp: {{sec: 17, nanosec: 0}}, frame_id: front}}
height: 800
width: 1280
distortion_model: {model}
{d}: {distortion}
{k}: [690.0, 0.0, 640.0, 0.0, 690.0, 400.0, 0.0, 0.0, 1.0]
binning_x: {binning}
binning_y: {binning}
roi: {{x_offset: {offset}, y_offset: 0, height: {height}, width: {width}, do_rectify: {rectify}}}
---
"""
BENT = [-0.0306, 0.0352, -0.000138, -0.000146, -0.01204]
WHOLE = {"binning": 0, "offset": 0, "height": 0, "width": 0, "rectify": "false"}
WHOLE |= {"d": "d", "k": "k", "model": "plumb_bob", "distortion": BENT}


def messaged(folder, **changes):
    info = MESSAGE.format(**{**WHOLE, **changes})
    files = {"rig.urdf": robot(joint("front/camera_link", "base_link")), "camera_info/front.yaml": info}
    cameras, notes = imported(folder, "urdf", files)
    return cameras["front"].model, notes


@pytest.mark.parametrize(
    ("changes", "matrix", "size"),
    [
        ({}, [690.0, 640.5, 400.5], (1280, 800)),
        ({"d": "D", "k": "K", "distortion": [*BENT, 0.0, 0.0, 0.0]}, [690.0, 640.5, 400.5], (1280, 800)),
        # REP 104: a region of the sensor, then pixels joined by twos; counted from the image's corner
        ({"binning": 2}, [345.0, 320.25, 200.25], (640, 400)),
        ({"binning": 2, "offset": 320, "width": 640, "height": 600}, [345.0, 160.25, 200.25], (320, 300)),
    ],
)
def test_camera_info_may_be_the_message_of_a_topic(tmp_path, changes, matrix, size):
    model, notes = messaged(tmp_path, **changes)
    assert (model.width_px, model.height_px) == size
    assert (model.lens, list(model.distortion)) == ("brown_conrady", BENT)
    assert [model.intrinsics[0, 0], *model.intrinsics[:2, 2]] == pytest.approx(matrix)
    assert "not read" not in notes
    with pytest.raises(InputError, match=r"roi\.do_rectify: expected false"):
        messaged(tmp_path, **changes, rectify="true")


def test_a_distortion_that_folds_is_told(tmp_path):
    k1, k2, p1, p2, k3, k4, k5, k6 = -13.238, -98.012, 0.00144, 0.00285, 1357.78, -13.0508, -102.363, 1383.06
    _, notes = messaged(tmp_path, model="rational_polynomial", distortion=[k1, k2, p1, p2, k3, k4, k5, k6])
    squared = np.linspace(0.0, 0.2, 200_001)  # where the radius stops growing
    growth = np.diff(np.sqrt(squared) * np.polyval([k3, k2, k1, 1.0], squared) / np.polyval([k6, k5, k4, 1.0], squared))
    fold_deg = math.degrees(math.atan(math.sqrt(squared[np.argmax(growth < 0.0)])))
    (told,) = re.findall(r"folds ([\d.]+) deg from the axis, before the corners", notes)
    assert float(told) == pytest.approx(fold_deg, abs=0.1)  # it ends a little before


def test_frames_of_other_sensors_are_no_cameras(tmp_path):
    kinds = ("depth", "infra1", "color", "accel", "gyro", "side")
    links = [joint("camera_link", "base_link", "1.01 0.02 0.91")]
    for kind in kinds:
        links.append(joint(f"camera_{kind}_frame", "camera_link", "0 0.015 0" if kind == "color" else "0 0 0"))
        links.append(joint(f"camera_{kind}_optical_frame", f"camera_{kind}_frame", rpy=OPTICAL_RPY))
    links.append('<gazebo reference="camera_side_frame"><sensor name="d" type="depth"/></gazebo>')
    lens = "<horizontal_fov>1.2043</horizontal_fov><image><width>1280</width><height>720</height></image>"
    sensor = '<gazebo reference="camera_color_frame"><sensor name="c" type="camera">{}</sensor></gazebo>'
    gazebo = sensor.format(f"<camera>{lens}</camera>")
    cameras, notes = imported(tmp_path, "urdf", {"rig.urdf": robot(*links, gazebo)})
    assert list(cameras) == ["camera_color"]
    assert place(cameras["camera_color"]) == near(1.01, 0.035, 0.91, 0, 0, 0)
    model = cameras["camera_color"].model
    assert (model.width_px, model.height_px, model.fov_rad) == (1280, 720, pytest.approx(1.2043))
    told = notes.partition(": taken for no cameras")[0].split(", ")
    assert told == [f"camera_{kind}_optical_frame" for kind in kinds if kind != "color"]
    assert list(imported(tmp_path, "urdf", {"b.urdf": robot(*links)}, **SIZED_LENS)[0]) == ["camera_color"]
    turned = robot(*links, sensor.format(f"<pose>0 0 0 0 0 1</pose><camera>{lens}</camera>"))
    with pytest.raises(InputError, match="pose: expected none beside that of the link, got '0 0 0 0 0 1'"):
        imported(tmp_path, "urdf", {"c.urdf": turned})


def autoware(folder, base, units, **options):
    """Cameras and notes of units, whose links are x, y, z, roll, pitch, yaw."""

    def links(numbers):
        keys = ("x", "y", "z", "roll", "pitch", "yaw")
        return {name: dict(zip(keys, map(float, each), strict=True)) for name, each in numbers.items()}

    files = {"sensors_calibration.yaml": {"base_link": links(base)}}
    files |= {f"{unit}_calibration.yaml": {f"{unit}_base_link": links(each)} for unit, each in units.items()}
    texts = {name: yaml.safe_dump(content) for name, content in files.items()}
    return imported(folder, "autoware", texts, **SIZED_LENS, **options)


def test_autoware_may_have_several_units(tmp_path):
    front, rear = {"c0/camera_link": (0.1, 0, 0.3, 0, 0.1, 0)}, {"c1/camera_link": (0.2, 0.1, 0.2, 0, 0, 0)}
    base = {"front_base_link": (5, 0, 0.6, 0, 0, 0), "rear_base_link": (-1.2, 0, 0.8, 0, 0, 3.0)}
    cameras, _ = autoware(tmp_path, base, {"front": front, "rear": rear})
    assert place(cameras["c0"]) == near(5.1, 0, 0.9, 0, math.degrees(0.1), 0)
    s, c = math.sin(3.0), math.cos(3.0)
    assert place(cameras["c1"]) == near(0.2 * c - 0.1 * s - 1.2, 0.2 * s + 0.1 * c, 1.0, math.degrees(3.0), 0, 0)


def test_optical_frames_of_autoware_are_known_by_their_angles(tmp_path):
    base = {"sensor_kit_base_link": (2, 0, 0.5, 0, 0, 0)}
    links = {
        "camera0/camera_link": (0, 0, 1.5, -1.8709, 0, -1.5708),
        "camera1/camera_link": (0, 0.9, 1.0, -1.5708, 0, 0.3840),
        "camera2/camera_link": (0, -0.9, 1.0, -1.5708, 0, 2.7576),
    }
    cameras, notes = autoware(tmp_path, base, {"sensor_kit": links})
    assert ", ".join(links) + ": x right, y down, z forward, as an optical frame, by its angles; it is read so" in notes
    assert place(cameras["camera0"]) == near(2, 0, 2, 0, 17.194, 0, within=2e-3)
    assert place(cameras["camera1"]) == near(2, 0.9, 1.5, 112.002, 0, 0, within=2e-3)
    cameras, notes = autoware(tmp_path, base, {"sensor_kit": {**links, "camera3/camera_link": (0, 0, 1.5, 0, 0, 0)}})
    assert ", ".join(links) in notes
    assert "it is not read so" in notes
    assert place(cameras["camera3"]) == near(2, 0, 2, 0, 0, 0)


def test_a_left_handed_file_can_be_turned_round(tmp_path):
    parts = {"sensor_kit_base_link": [0] * 6}, {"sensor_kit": {"LEFT/camera_link": (1.7, -0.5, 1.6, 0.1, 0.2, -0.96)}}
    cameras, _ = autoware(tmp_path, *parts, mirror_y=True)
    assert place(cameras["LEFT"]) == near(1.7, 0.5, 1.6, *np.degrees([0.96, 0.2, -0.1]))
    with pytest.raises(InputError, match="`mirror_y` turns it round"):
        autoware(tmp_path, *parts)


def test_kitti_s_tracking_and_raw_data_are_read(tmp_path):
    lines = [f"P{i}: 700 0 600 {px} 0 700 180 0 0 0 1 0" for i, px in enumerate((0.0, -378.0, 42.0, -336.0))]
    raw = ["calib_time: 09-Jan-2012 13:57:47", "S_00: 1392 512", "R_rect_00: 1 0 0 0 1 0 0 0 1"]
    raw += [line.replace("P", "P_rect_0", 1) for line in lines] + [f"S_rect_0{i}: 1242 375" for i in range(4)]
    lines += ["R_rect 1 0 0 0 1 0 0 0 1", "Tr_velo_cam 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27", "Tr_imu_velo 1 0 0 0"]
    lidar = {"calib_velo_to_cam.txt": "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 -0.08 -0.27"}
    raw = {"calib_cam_to_cam.txt": "\n".join(raw)}
    with pytest.raises(InputError, match=r"calib_cam_to_cam\.txt: expected calib_velo_to_cam\.txt beside it"):
        imported(tmp_path, "kitti", raw)
    for files in ({"0000.txt": "\n".join(lines)}, raw | lidar):
        sized = {} if lidar.keys() <= files.keys() else {"width_px": 1242, "height_px": 375}
        cameras, notes = imported(tmp_path, "kitti", files, origin_m=(0.0, 0.0, 1.73), **sized)
        for i, y in enumerate((0, -0.54, 0.06, -0.48)):
            assert place(cameras[f"image_{i}"]) == near(0.27, y, 1.65, 0, 0, 0)
        assert cameras["image_2"].model.width_px == 1242
        assert "not read" not in notes


def test_an_agent_s_module_gives_its_sensors(tmp_path):
    sensors = PYTHON_SENSORS.replace("'width': 640", "'width': '640'").replace("'fov': 90", "'fov': '90'")
    text = "import math\n\nclass Agent:\n    def sensors(self):\n        return " + sensors.replace("\n", "\n        ")
    cameras, _ = imported(tmp_path, "carla-python", {"agent.py": text})
    np.testing.assert_allclose(cameras["front_left"].ego_from_camera, RIG.cameras[0].ego_from_camera, atol=1e-12)
    assert cameras["front_left"].model == CameraModel(640, 480)


def test_a_lens_that_is_off_is_taken_when_asked(tmp_path):
    series = [0.0, 339.749, -31.988, 48.275, -7.201]  # of WoodScape
    ftheta = {"principal_point": [643.44, 478.9], "reference_poly": "angle_to_pixel", "angle_to_pixeldist": series}
    row = {
        "logical_id": "front",
        "rig_to_camera": {"translation_m": [3.7, 0.0, 0.65], "rotation_xyzw": [-0.5, 0.5, -0.5, 0.5]},
        "resolution_hw": [966, 1280],
        "intrinsics": {"model": "ftheta", "ftheta": {**ftheta, "max_angle": 1.7}},
    }
    files = {"rig.yaml": yaml.safe_dump({"extra_cameras": [row]})}
    with pytest.raises(InputError, match=r"off by 0\.44 px; `approximate` takes it"):
        imported(tmp_path, "alpasim", files)
    cameras, notes = imported(tmp_path, "alpasim", files, approximate=True)
    assert "off by at most 0.44 px" in notes
    angle = np.linspace(0.05, 1.4, 28)
    found = cameras["front"].model.project(np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], axis=1))[:, 0]
    assert np.abs(found - 643.94 - np.polyval(series[::-1], angle)).max() < 0.45


UNKNOWN = {
    "nuscenes": ('"translation": [1.7', '"lens_shift": 3, "translation": [1.7', "lens_shift"),
    "urdf": ('<link name="roof"/>', '<link name="roof"/><sensor name="a"/>', "<sensor>"),
    "autoware": (
        "  front_left/camera_link:\n",
        "  front_left/lens: {x: 1.0}\n  front_left/camera_link:\n",
        "_left/lens",
    ),
    "carla-ros-bridge": ('"fov": 90.0', '"fov": 90.0, "lens_kcube": 1.0', "objects.sensors.lens_kcube"),
    "carla-python": ("'fov': 90", "'fov': 90, 'lens_kcube': 1.0", "lens_kcube"),
    "kitti": ("R0_rect:", "D_rect: 1 2 3\nR0_rect:", "D_rect"),
    "opencv": ("image_width: 640", "image_width: 640\nxi: 0.8", "xi"),
    "alpasim": (
        "      model: opencv_pinhole",
        "      shift: 3\n      model: opencv_pinhole",
        "cameras.intrinsics.shift",
    ),
    "driveworks": ('"parameter"', '"shutter": 1, "parameter"', "rig.sensors.shutter"),
    "kalibr": ("  resolution: [640, 480]", "  resolution: [640, 480]\n  T_BS: [1.0]", "cam0.T_BS"),
    "camera-info": ("image_width: 640", "image_width: 640\nvignette: 3", "vignette"),
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_a_key_that_is_not_read_is_named(tmp_path, name):
    old, new, key = UNKNOWN[name]
    name = "urdf" if name == "camera-info" else name  # which lies beside
    for spoil in (False, True):
        path = write_sample(name, tmp_path)
        for file in sorted(tmp_path.rglob("*")) if spoil else ():
            if file.is_file() and old in (text := file.read_text()):
                file.write_text(text.replace(old, new, 1))
        _, notes = import_rig_with_notes(path, name, SIZED)
        told = [note for note in notes if ": not read: " in note and key in note]
        assert len(told) == spoil


# ------------------------------------------------------------------------------------------------------------ LiDARs

RDF_IN_FLU = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
RAY = """
  <gazebo reference="lidar_link">
    <sensor type="{type}" name="velodyne"><pose>0 0 0 0 0 0</pose><update_rate>20</update_rate>
      <{below}>
        <scan>
          <horizontal><samples>361</samples><resolution>1</resolution>
            <min_angle>-0.9</min_angle><max_angle>0.5</max_angle></horizontal>
          <vertical><samples>{lines}</samples><min_angle>-0.25</min_angle><max_angle>0.05</max_angle></vertical>
        </scan>
        <range><min>0.3</min><max>130.0</max><resolution>0.001</resolution></range>
      </{below}>
    </sensor>
  </gazebo>
</robot>"""


@pytest.mark.parametrize(("kind", "below"), [("ray", "ray"), ("gpu_ray", "ray"), ("gpu_lidar", "lidar")])
def test_gazebos_rays_are_the_shots(tmp_path, kind, below):
    file, options = tmp_path / "rig.urdf", ImportOptions(**SIZED_LENS)
    text = URDF.replace("</robot>", RAY)
    file.write_text(text.format(type=kind, below=below, lines=16))
    lidar, camera = import_rig_with_notes(file, "urdf", options)[0].cameras
    assert (lidar.name, camera.name) == ("lidar", "front_left")
    np.testing.assert_allclose(lidar.ego_from_camera[:3], np.c_[RDF_IN_FLU, [1.0, 0.0, 1.5]], atol=1e-12)
    beams, (shot, _, _) = lidar.model.beams, lidar.model.beams.shots()
    azimuth, up = np.linspace(0.5, -0.9, 361), np.linspace(-0.25, 0.05, 16)
    up, azimuth = (each.ravel() for each in np.meshgrid(up, azimuth, indexing="ij"))
    expected = np.stack([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)], axis=1)
    np.testing.assert_allclose(shot, expected, atol=2e-6)  # microdegrees of the step, 360 times
    assert (lidar.model.near_m, beams.range_m, beams.rate_hz) == (0.3, (130.0, 130.0), 20.0)
    turned = import_rig_with_notes(file, "urdf", replace(options, mirror_y=True, accept_mirrored=True))[0].cameras[0]
    assert turned.model.beams.azimuth_rad == (-beams.azimuth_rad[1], -beams.azimuth_rad[0])
    file.write_text(text.format(type=kind, below=below, lines=1))
    rig, notes = import_rig_with_notes(file, "urdf", options)
    assert [each.name for each in rig.cameras] == ["front_left"]
    assert notes[1].startswith("lidar: LiDARs whose beams the file does not hold, not read")
    file.write_text(text.format(type=kind, below=below, lines="many"))
    with pytest.raises(InputError, match=f"{below}/scan/vertical/samples: expected a number, got 'many'"):
        import_rig_with_notes(file, "urdf", options)


def test_carlas_beams_are_read(tmp_path):
    """A Velodyne HDL-64 as CARLA's examples have it, to the right of the middle."""
    sensor = {"type": "sensor.lidar.ray_cast", "id": "lidar_right", "x": 0.7, "y": 0.4, "z": 1.6, "yaw": -90.0}
    sensor |= {"channels": 64, "range": 100, "points_per_second": 1152000, "rotation_frequency": "10"}
    sensor |= {"upper_fov": 2.0, "lower_fov": -24.8, "noise_stddev": 0.1}
    file = tmp_path / "sensors.json"
    file.write_text(json.dumps([sensor]))
    rig, notes = import_rig_with_notes(file, "carla-python")
    (lidar,) = rig.cameras
    assert lidar.position_m == pytest.approx([0.7, -0.4, 1.6])
    assert math.degrees(lidar.yaw_rad) == pytest.approx(90.0)  # no mistake where it sees all round
    assert lidar.model.beams == Beams(
        tuple(np.radians(np.linspace(-24.8, 2.0, 64))), math.radians(0.2), range_m=(100, 100)
    )
    assert notes[1].endswith(": not read: noise_stddev")
    del sensor["upper_fov"], sensor["noise_stddev"]
    file.write_text(json.dumps([sensor]))
    rig, notes = import_rig_with_notes(file, "carla-python")
    assert math.degrees(rig.cameras[0].model.beams.elevation_rad[-1]) == pytest.approx(10.0)
    assert notes[1] == "lidar_right: CARLA's defaults, upper_fov 10"
    for key, value in (("points_per_second", 0), ("channels", 9000), ("lower_fov", 20.0), ("range", -1.0)):
        file.write_text(json.dumps([sensor | {key: value}]))
        with pytest.raises(
            InputError, match=r"sensors\.json: \[0\]: expected (positive channels|the beams of a LiDAR)"
        ):
            import_rig_with_notes(file, "carla-python")


@pytest.mark.parametrize(
    ("name", "found", "position_m", "yaw_deg"),
    [
        ("nuscenes", "LIDAR_TOP", (0.9, 0.0, 1.8), 0.0),  # whose y looks ahead
        ("autoware", "velodyne_top", (1.0, 0.2, 1.8), 180.24),
        ("carla-ros-bridge", "lidar", (0.0, 0.0, 2.4), 0.0),
        ("urdf", "lidar", (1.0, 0.0, 1.5), 0.0),
    ],
)
def test_frames_of_lidars_are_read(tmp_path, name, found, position_m, yaw_deg):
    rig, _ = import_rig_with_notes(write_sample(name, tmp_path), name, replace(SIZED, lidar="lidar_32"))
    lidar = next(camera for camera in rig.cameras if camera.name == found)
    assert lidar.position_m == pytest.approx(position_m, abs=1e-9)
    turn_deg = math.degrees(lidar.yaw_rad) - yaw_deg
    assert math.remainder(turn_deg, 360.0) == pytest.approx(0.0, abs=0.1 if name != "nuscenes" else 0.5)
    assert abs(lidar.pitch_rad) + abs(lidar.roll_rad) < math.radians(2.0)
    assert lidar.module == "lidar_32"
