"""DriveWorks' rig.json: f-theta both ways, against its documented projection, older poses, what is refused."""

import copy
import json
import math

import numpy as np
import pytest

import warpav as wa
from tests.rig.formats.known_pose import DRIVEWORKS, QUATERNION_WXYZ
from warpav.core.errors import InputError
from warpav.rig import export_rig_with_notes, import_rig_with_notes

# of a public rig, with cx and cy beside the middle
BACKWARD = "0 0.0005385247479413695 2.356e-09 1.907e-12 1.204e-16"
FTHETA = {
    **{"Model": "ftheta", "width": "3848", "height": "2168", "cx": "1921.318705874846", "cy": "1076.978854184438"},
    **{"polynomial": BACKWARD, "polynomial-type": "pixeldistance-to-angle"},
}


def file_of(folder, properties=None, **changes):
    rig = copy.deepcopy(DRIVEWORKS)
    sensor = rig["rig"]["sensors"][0]
    sensor.update(changes)
    sensor["properties"] = properties or sensor["properties"]
    for key in [key for key, value in sensor.items() if value is None]:
        del sensor[key]
    (folder / "rig.json").write_text(json.dumps(rig))
    return folder / "rig.json"


def project(properties, ray):
    """Pixels of rays from the image's corner, by the four steps that DriveWorks documents."""
    series = np.polynomial.Polynomial([float(each) for each in properties["polynomial"].split()])
    theta = np.arctan2(np.hypot(ray[:, 0], ray[:, 1]), ray[:, 2])
    if properties["polynomial-type"] == "angle-to-pixeldistance":
        distance = series(theta)
    else:
        table = np.linspace(0.0, 4000.0, 400_001)
        distance = np.interp(theta, series(table), table)
    offset = ray[:, :2] / np.hypot(ray[:, 0], ray[:, 1])[:, None] * distance[:, None]
    c, d, e = (float(properties.get(f"linear-{key}", default)) for key, default in zip("cde", (1, 0, 0), strict=True))
    return offset @ np.array([[c, d], [e, 1.0]]).T + [float(properties[key]) + 0.5 for key in ("cx", "cy")]


def rays_over(model):
    columns, rows = np.meshgrid(np.linspace(1, model.width_px - 1, 21), np.linspace(1, model.height_px - 1, 16))
    pixel = np.stack([columns.ravel(), rows.ravel()], axis=1)
    return pixel, model.rays(pixel)


@pytest.mark.parametrize("keys", [{}, {"linear-c": "1.001", "linear-d": "0", "linear-e": "0"}, "bw-poly"])
def test_f_theta_is_read_as_driveworks_projects_it(tmp_path, keys):
    given = dict(FTHETA)
    if keys == "bw-poly":  # older files
        given = {key: value for key, value in FTHETA.items() if "poly" not in key} | {"bw-poly": BACKWARD}
        keys = {}
    rig, notes = import_rig_with_notes(file_of(tmp_path, given | keys), "driveworks")
    pixel, ray = rays_over(rig.cameras[0].model)
    found = project(FTHETA | keys, ray)
    (note,) = [note for note in notes if "off by at most" in note]
    off_px = float(note.split("at most ")[1].split()[0])
    assert off_px < 0.25
    assert np.abs(found - pixel).max() < 1.1 * off_px + 1e-3
    assert any("1 sensors that are no cameras" in note for note in notes)


FISHEYE = {"lens": "fisheye", "focal_px": (400.0, 401.0), "centre_px": (645.0, 470.0)}
MODELS = {
    "fisheye": wa.CameraModel(1280, 960, **FISHEYE, distortion=(0.02, -0.001, 0.0, 0.0)),
    "equidistant": wa.CameraModel(1280, 960, math.radians(190.0), lens="fisheye"),
    "barrel": wa.CameraModel(640, 480, 1.2, lens="brown_conrady", distortion=(-0.2, 0.1, 0.0, 0.0, 0.01)),
}


@pytest.mark.parametrize("name", MODELS)
def test_the_same_camera_comes_back_and_driveworks_sees_its_image(tmp_path, name):
    before = wa.Camera("camera_front", np.array([1.7, 0.5, 1.6]), 0.3, 0.1, 0.02, MODELS[name])
    (path,), _ = export_rig_with_notes(wa.Rig([before]), "driveworks", tmp_path / "rig.json")
    (after,) = import_rig_with_notes(path, "driveworks")[0].cameras
    np.testing.assert_allclose(after.ego_from_camera, before.ego_from_camera, rtol=0, atol=1e-12)
    np.testing.assert_allclose(after.model.intrinsics, before.model.intrinsics, rtol=1e-12)
    np.testing.assert_allclose(after.model.shape.coefficients, before.model.shape.coefficients, atol=1e-12)
    (sensor,) = json.loads(path.read_text())["rig"]["sensors"]
    if sensor["properties"]["Model"] == "ftheta":
        pixel, ray = rays_over(before.model)
        np.testing.assert_allclose(project(sensor["properties"], ray), pixel, atol=1e-6)


def test_a_lens_that_f_theta_only_comes_near_to_says_how_near(tmp_path):
    model = wa.CameraModel(1280, 960, **FISHEYE, distortion=(0.02, -0.01, 0.002, -0.0003))
    rig = wa.Rig([wa.Camera("a", np.array([1.0, 0, 1]), 0, 0, 0, model)])
    with pytest.raises(InputError, match=r"driveworks cannot represent a fisheye lens to better than .* px"):
        export_rig_with_notes(rig, "driveworks", tmp_path / "rig.json")
    ends = wa.CameraModel(1280, 960, **FISHEYE, distortion=(0.02, -0.01, 0.0, 0.0))  # DriveWorks reads no such file
    with pytest.raises(InputError, match="a lens that ends before the image's corners; choose another format"):
        wa.export_rig(wa.Rig([wa.Camera("a", np.zeros(3), 0, 0, 0, ends)]), "driveworks", tmp_path / "rig.json")
    (path,), notes = export_rig_with_notes(rig, "driveworks", tmp_path / "rig.json", approximate=True)
    off_px = float(next(note for note in notes if "better than" in note).split("better than ")[1].split()[0])
    pixel, ray = rays_over(model)
    properties = json.loads(path.read_text())["rig"]["sensors"][0]["properties"]
    assert 0.2 * off_px < np.abs(project(properties, ray) - pixel).max() < 1.1 * off_px


def test_older_files_state_the_pose_of_the_image(tmp_path):
    w, x, y, z = QUATERNION_WXYZ
    pose = {"quaternion": [x, y, z, w], "t": [1.7, 0.5, 1.6]}
    old = {"nominalSensor2Rig_FLU": None, "correction_sensor_R_FLU": None, "correction_rig_T": None}
    (camera,) = import_rig_with_notes(file_of(tmp_path, sensor2Rig=pose, **old), "driveworks")[0].cameras
    found = [math.degrees(each) for each in (camera.roll_rad, camera.pitch_rad, camera.yaw_rad)]
    assert found == pytest.approx([2.0, 5.0, 45.0], abs=1e-4)
    turned = {"correction_sensor_R_FLU": {"roll-pitch-yaw": [0.0, 0.0, 10.0]}}  # about the body's own axis
    flat = {"nominalSensor2Rig_FLU": {"roll-pitch-yaw": [0.0, 90.0, 0.0], "t": [1, 0, 1]}}
    (camera,) = import_rig_with_notes(file_of(tmp_path, **turned, **flat), "driveworks")[0].cameras
    forward, left = camera.ego_from_camera[:3, 2], -camera.ego_from_camera[:3, 0]
    s, c = math.sin(math.radians(10.0)), math.cos(math.radians(10.0))
    np.testing.assert_allclose([forward, left], [[0, s, -c], [0, c, s]], atol=1e-12)


@pytest.mark.parametrize(
    ("properties", "changes", "message"),
    [
        (FTHETA | {"Model": "ocam"}, {}, "properties.Model: expected one of ftheta, pinhole, got 'ocam'"),
        (FTHETA | {"polynomial": "0 a b"}, {}, "properties.polynomial: expected 2 to 6 finite numbers, got '0 a b'"),
        (FTHETA | {"polynomial": "1 0.0005"}, {}, "expected a polynomial that begins with 0"),
        (FTHETA | {"polynomial-type": "x"}, {}, "polynomial-type: expected one of pixeldistance-to-angle, angle-to"),
        (FTHETA | {"width": "3848.5"}, {}, "width: expected whole pixels"),
        (FTHETA | {"linear-c": "0", "linear-d": "1"}, {}, "linear-c: expected the proportions of a pixel"),
        (None, {"nominalSensor2Rig_FLU": None}, "nominalSensor2Rig_FLU: expected the pose of the camera"),
        (None, {"correction_rig_T": [0.0]}, "correction_rig_T: expected 3 finite number(s), got [0.0]"),
        (None, {"name": "lidar:a", "protocol": "lidar"}, "sensors: expected at least one camera, got 2 other sensors"),
    ],
)
def test_a_rig_that_is_none_is_refused(tmp_path, properties, changes, message):
    with pytest.raises(InputError) as refused:
        import_rig_with_notes(file_of(tmp_path, properties, **changes), "driveworks")
    assert message in str(refused.value)
