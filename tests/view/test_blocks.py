"""Rigs, scenes and runs as pyvista blocks, there and back; and what warpav adds to pyvista's datasets."""

import dataclasses
import math
import tomllib
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from tests.view.stand_ins import block, ego, rig, scene, vehicle
from warpav.core.errors import InputError
from warpav.rig import Rig
from warpav.scene import Box, Sky, Vehicle
from warpav.view import _blocks as blocks

pyvista = pytest.importorskip("pyvista")


def test_a_rig_becomes_a_block_for_each_camera():
    whole = rig(3)
    made = whole.to_pyvista(depth_m=2.0)
    assert list(made.keys()) == ["cam_0", "cam_1", "cam_2"]
    for camera in whole.cameras:
        part = made[camera.name]
        assert list(part.keys()) == ["body", "frustum", "axis"]
        np.testing.assert_allclose(part["frustum"].points[0], camera.position_m, atol=1e-6)
        ahead = [math.cos(camera.yaw_rad), math.sin(camera.yaw_rad), 0.0]
        np.testing.assert_allclose(part["axis"].points[1], camera.position_m + 2.0 * np.array(ahead), atol=1e-6)
        # a level pinhole camera of 80 degrees: half of the image plane's width at 2 m
        corner = np.asarray(part["frustum"].points[1:], float) - camera.position_m
        across = np.abs(corner @ [-ahead[1], ahead[0], 0.0])
        np.testing.assert_allclose(across, 2.0 * math.tan(math.radians(40.0)), rtol=1e-6)
        assert np.linalg.norm(np.asarray(part["body"].center) - camera.position_m) < 0.1
        about = part.field_data
        assert about["name"][0] == camera.name
        assert about["lens"][0] == "pinhole"
        assert about["fov_deg"][0] == pytest.approx(80.0)
        np.testing.assert_allclose(about["position_m"], camera.position_m)


def street():
    bus = Vehicle(7, "bus", block((-20, 2, 0), (-9, 5, 3), (200, 30, 30)), Box(np.array([-14.5, 3.5, 1.5]), np.array([11.0, 3.0, 3.0]), 0.4))  # fmt: skip  # noqa: E501
    person = Vehicle(3, "pedestrian", block((5, 4, 0), (5.5, 4.5, 1.7), (9, 8, 7)), Box(np.array([5.25, 4.25, 0.85]), np.array([0.5, 0.5, 1.7]), 0.0))  # fmt: skip  # noqa: E501
    sky = Sky(np.array([10, 20, 30], np.uint8), np.array([40, 50, 60], np.uint8))
    return dataclasses.replace(scene(vehicle(1, 9.0, 2.5), bus), others=(person,), sky=sky, source="by hand")


def assert_same_mesh(ours, theirs):
    np.testing.assert_array_equal(ours.vertex_m, theirs.vertex_m)
    np.testing.assert_array_equal(ours.triangle, theirs.triangle)
    np.testing.assert_array_equal(ours.vertex_rgb, theirs.vertex_rgb)


def assert_same_scene(ours, theirs):
    assert (ours.name, ours.source) == (theirs.name, theirs.source)
    assert_same_mesh(ours.environment, theirs.environment)
    assert_same_mesh(ours.ego, theirs.ego)
    np.testing.assert_array_equal(ours.sky.horizon_rgb, theirs.sky.horizon_rgb)
    np.testing.assert_array_equal(ours.sky.zenith_rgb, theirs.sky.zenith_rgb)
    for one, other in ((ours.vehicles, theirs.vehicles), (ours.others, theirs.others)):
        assert [(user.instance_id, user.category) for user in one] == [
            (user.instance_id, user.category) for user in other
        ]
        for user, same in zip(one, other, strict=True):
            assert_same_mesh(user.mesh, same.mesh)
            np.testing.assert_allclose(user.box.center_m, same.box.center_m)
            np.testing.assert_allclose(user.box.size_m, same.box.size_m)
            assert user.box.yaw_rad == pytest.approx(same.box.yaw_rad)


def test_a_scene_comes_back(tmp_path):
    made = street().to_pyvista()
    assert list(made.keys()) == ["environment", "ego", "vehicle_1", "vehicle_3", "vehicle_7"]
    assert made["vehicle_7"].field_data["class"][0] == "bus"
    assert made["ego"].point_data["RGB"].dtype == np.uint8
    assert_same_scene(blocks.scene_from_pyvista(made), street())
    made.save(tmp_path / "street.vtm")  # through pyvista's own file
    assert_same_scene(blocks.scene_from_pyvista(pyvista.read(tmp_path / "street.vtm")), street())


def test_blocks_that_are_no_scene_are_refused():
    with pytest.raises(InputError, match="expected one of the name 'ego', got environment"):
        blocks.scene_from_pyvista(pyvista.MultiBlock({"environment": pyvista.Plane()}))
    with pytest.raises(InputError, match=r"ego: expected a surface \(pyvista.PolyData\), got ImageData"):
        blocks.scene_from_pyvista(pyvista.MultiBlock({"environment": pyvista.Plane(), "ego": pyvista.ImageData()}))
    with pytest.raises(InputError, match="mesh: expected a surface with faces, got none"):
        blocks.mesh_from_pyvista(pyvista.PolyData(np.eye(3)))


def test_a_plain_vehicle_gets_a_box_and_a_colour():
    made = pyvista.MultiBlock(
        {"environment": pyvista.Plane(), "ego": pyvista.Cube(), "vehicle_4": pyvista.Cube(center=(8, 1, 1), x_length=4)}
    )
    (car,) = blocks.scene_from_pyvista(made, name="mine").vehicles
    assert (car.instance_id, car.category) == (4, "car")
    np.testing.assert_allclose(car.box.center_m, [8.0, 1.0, 1.0])
    np.testing.assert_allclose(car.box.size_m, [4.0, 1.0, 1.0])
    assert len(car.mesh.triangle) == 12


def test_a_run_is_start_path_end_and_scene():
    frames = [
        Rig(
            [
                dataclasses.replace(camera, position_m=camera.position_m + np.array([0.1 * k, 0, 0]))
                for camera in rig(2).cameras
            ]
        )
        for k in range(4)
    ]
    made = blocks.run_to_pyvista(frames, start=frames[0], end=frames[-1], scene=street())
    assert list(made.keys()) == ["start", "path", "end", "scene"]
    line = made["path"]["cam_1"]
    assert line.n_lines == 1
    assert line.length == pytest.approx(0.3)
    np.testing.assert_array_equal(line.point_data["iteration"], [0, 1, 2, 3])
    np.testing.assert_allclose(line.point_data["yaw_deg"], 180.0)
    np.testing.assert_allclose(line.points[-1], frames[-1].cameras[1].position_m, atol=1e-6)
    alone = blocks.run_to_pyvista(frames[:1], start=frames[0], end=frames[0], scene=street())
    assert alone["path"]["cam_0"].n_points == 1
    assert blocks.run_to_pyvista([], start=frames[0], end=frames[0], scene=street())["path"]["cam_0"].n_points == 0


# ------------------------------------------------------------------------------------------------ accessor


def test_the_entry_point_is_the_accessor():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    (name,) = project["entry-points"]["pyvista.accessors"]
    import_module(project["entry-points"]["pyvista.accessors"][name])
    found = {(each.name, each.target) for each in pyvista.registered_accessors()}
    assert {(name, pyvista.PolyData), (name, pyvista.MultiBlock)} <= found


def test_the_accessor_measures_and_converts():
    import_module("warpav.view.accessor")
    car = blocks.mesh_to_pyvista(ego())
    assert_same_mesh(car.warpav.as_mesh(), ego())
    zone = car.warpav.mount_surface(cell_m=0.1)
    # a box of 4.5 m x 1.8 m whose top is 1.5 m high
    assert zone.area == pytest.approx(4.5 * 1.8, rel=0.1)
    np.testing.assert_allclose(zone.cell_data["height_m"], 1.5, atol=1e-6)
    assert 0.0 < zone.cell_data["border_distance_m"].max() <= 0.9
    assert_same_scene(street().to_pyvista().warpav.as_scene(), street())
    with pytest.raises(InputError):
        pyvista.Plane(direction=(1, 0, 0)).warpav.mount_surface()
