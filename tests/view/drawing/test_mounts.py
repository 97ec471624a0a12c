"""Mounts: stand-offs of known places, the table read back by csv, the model read back by trimesh."""

import csv
import io
import math

import numpy as np
import pytest
import trimesh

from tests.view.stand_ins import ego
from warpav.raster.camera import CameraModel
from warpav.rig import Rig, RigCamera, builtin_modules
from warpav.scene._glb import GLTF_FROM_EGO
from warpav.view.drawing._mounts import COLUMNS, FRUSTUM_DEPTH_M, mount_csv, mount_glb, mounts

MODULE = builtin_modules()["side_2mp_100"]


def model_of(*cameras):
    data = mount_glb(mounts(Rig(cameras), ego()), ego(), builtin_modules())
    assert data == mount_glb(mounts(Rig(cameras), ego()), ego(), builtin_modules())
    return trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False)


def part(model, name):
    matrix, geometry = model.graph.get(name)
    mesh = model.geometry[geometry].copy()
    mesh.apply_transform(np.linalg.inv(GLTF_FROM_EGO) @ matrix)
    return mesh


def test_parts_are_there_and_where_the_cameras_are():
    left = RigCamera("left", np.array([1.0, 1.0, 0.9]), math.pi / 2, 0.0, 0.0, MODULE.camera_model(), MODULE.name)
    plain = RigCamera("plain", np.array([2.0, 0.0, 1.6]), 0.0, 0.0, 0.0, CameraModel(200, 100, math.radians(90.0)))
    model = model_of(left, plain)
    nodes = set(model.graph.nodes_geometry)
    assert nodes == {"vehicle", "left/frustum", "left/housing", "plain/frustum"}
    np.testing.assert_allclose(part(model, "vehicle").bounds, ego().bounds_m(), atol=1e-6)
    housing = part(model, "left/housing")
    width_m, height_m, depth_m = MODULE.housing.size_m
    np.testing.assert_allclose(housing.extents, [width_m, depth_m, height_m], atol=1e-6)  # it looks to the left
    offset = np.array(MODULE.housing.offset_m)  # right, down, forward
    middle_m = left.position_m + offset[[0, 2, 1]] * (1.0, 1.0, -1.0)
    np.testing.assert_allclose(housing.bounds.mean(axis=0), middle_m, atol=1e-6)
    frustum = part(model, "plain/frustum")
    d = FRUSTUM_DEPTH_M
    np.testing.assert_allclose(frustum.bounds, [[2.0, -d, 1.6 - d / 2], [2.0 + d, d, 1.6 + d / 2]], atol=1e-6)
    for name in ("left/housing", "plain/frustum", "left/frustum"):
        assert part(model, name).is_watertight
        assert part(model, name).volume > 0.0  # wound outwards
    assert part(model, "left/housing").volume == pytest.approx(width_m * height_m * depth_m, rel=1e-5)


def test_a_frustum_carries_the_numbers_of_its_camera():
    model = model_of(RigCamera("cam", np.array([1.0, 0.0, 1.6]), math.radians(30.0), math.radians(5.0)))
    [extras] = [
        data["metadata"] for (_, name), data in model.graph.transforms.edge_data.items() if name == "cam/frustum"
    ]
    assert extras["position_m"] == [1.0, 0.0, 1.6]
    assert extras["yaw_deg"] == pytest.approx(30.0)
    assert extras["pitch_deg"] == pytest.approx(5.0)


WIDE = CameraModel(640, 480, math.radians(190.0), lens="fisheye")


def rig_of(*places_m, yaw_deg=0.0):
    return Rig(
        RigCamera(f"cam_{i}", np.array(place), math.radians(yaw_deg), math.radians(-0.001), 0.1, WIDE)
        for i, place in enumerate(places_m)
    )


@pytest.mark.parametrize(
    ("place_m", "off_m", "normal"),
    [
        ((1.0, 0.2, 1.55), 0.05, (0, 0, 1)),
        ((1.0, 0.98, 0.7), 0.08, (0, 1, 0)),
        ((3.7, 0.1, 0.7), 0.1, (1, 0, 0)),
        ((1.0, 0.2, 1.4), 0.1, (0, 0, -1)),  # inside, where the roof is above the camera
    ],
)
def test_stand_off_and_normal_are_those_of_the_nearest_point(place_m, off_m, normal):
    [mount] = mounts(rig_of(place_m), ego())
    assert mount.stand_off_m == pytest.approx(off_m, abs=1e-6)
    np.testing.assert_allclose(mount.normal, normal, atol=1e-6)


def test_beyond_an_edge_the_distance_is_to_the_edge():
    [mount] = mounts(rig_of((1.0, 0.9 + 0.03, 1.5 + 0.04)), ego())
    assert mount.stand_off_m == pytest.approx(0.05, abs=1e-6)
    np.testing.assert_allclose(mount.normal, (0, 0, 1), atol=1e-6)  # the face that looks at it most


def test_csv_is_read_back():
    rig = rig_of((1.0, 0.2, 1.55), (1.0, 0.98, 0.7), yaw_deg=190.0)
    head, *rows = csv.reader(io.StringIO(mount_csv(mounts(rig, ego())), newline=""))
    assert tuple(head) == COLUMNS
    first, second = (dict(zip(head, row, strict=True)) for row in rows)
    assert first | {"roll_deg": "5.73"} == {
        **{"name": "cam_0", "module": "", "x_mm": "1000.0", "y_mm": "200.0", "z_mm": "1550.0"},
        **{"yaw_deg": "-170.00", "pitch_deg": "0.00", "roll_deg": "5.73", "fov_deg": "190.00"},
        **{"width_px": "640", "height_px": "480", "lens": "fisheye", "stand_off_mm": "50.0"},
        **{"normal_x": "0.0000", "normal_y": "0.0000", "normal_z": "1.0000"},
    }
    assert second["normal_y"] == "1.0000"


def test_without_a_vehicle_these_are_empty():
    [row] = csv.DictReader(io.StringIO(mount_csv(mounts(rig_of((1.0, 0.2, 1.55)), None)), newline=""))
    assert [row["stand_off_mm"], row["normal_x"]] == ["", ""]
