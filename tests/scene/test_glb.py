"""Scenes as GLB: exact, readable for others, refused in a line when they are not what they should be."""

import json
import struct

import numpy as np
import pytest
import trimesh

from tests.core.test_bounded_files import refusal
from warpav.core.errors import InputError
from warpav.raster.mesh import Mesh
from warpav.scene import Box, Scene, Sky, Vehicle, read_scene, read_vehicle_file, write_scene


def _tetrahedron(offset_m, colour):
    vertex = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32) + np.float32(offset_m)
    rgb = np.clip(np.array(colour) + np.arange(4)[:, None], 0, 255)
    return Mesh.create(vertex, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], rgb)


@pytest.fixture
def scene():
    vehicles = tuple(
        Vehicle(
            number,
            kind,
            _tetrahedron([10.0 * number, -1.5, 0.0], [10 * number, 200, 3]),
            Box(np.array([10.0 * number, -1.5, 0.7]), np.array([4.5, 1.8, 1.4]), 0.1 * number),
        )
        for number, kind in ((1, "saloon"), (2, "lorry"), (12, "bus"))
    )
    sky = Sky(np.array([200, 210, 220], np.uint8), np.array([100, 150, 255], np.uint8))
    ego = _tetrahedron([0, 0, 0], [1, 2, 3])
    return Scene("three_cars", _tetrahedron([0, 0, -9], [90, 90, 90]), ego, vehicles, sky, "made by hand")


def _assert_same_mesh(one, other):
    for name in ("vertex_m", "triangle", "vertex_rgb"):
        left, right = getattr(one, name), getattr(other, name)
        assert left.dtype == right.dtype
        np.testing.assert_array_equal(left, right)


def _rewritten(path, change):
    """Change the JSON of a GLB file in place; `change` gets and edits the dictionary."""
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + length])
    rest = data[20 + length :]
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + rest
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body)


def _node(document, name):
    return next(node for node in document["nodes"] if node.get("name") == name)


def test_round_trip_is_exact(scene, tmp_path):
    write_scene(scene, tmp_path / "scene.glb")
    again = read_scene(tmp_path / "scene.glb")
    assert (again.name, again.source) == ("three_cars", "made by hand")
    _assert_same_mesh(scene.environment, again.environment)
    _assert_same_mesh(scene.ego, again.ego)
    np.testing.assert_array_equal(scene.sky.horizon_rgb, again.sky.horizon_rgb)
    np.testing.assert_array_equal(scene.sky.zenith_rgb, again.sky.zenith_rgb)
    assert [vehicle.instance_id for vehicle in again.vehicles] == [1, 2, 12]
    for one, other in zip(scene.vehicles, again.vehicles, strict=True):
        assert one.category == other.category
        _assert_same_mesh(one.mesh, other.mesh)
        np.testing.assert_array_equal(one.box.center_m, other.box.center_m)
        np.testing.assert_array_equal(one.box.size_m, other.box.size_m)
        assert one.box.yaw_rad == pytest.approx(other.box.yaw_rad, abs=1e-14)


def test_what_is_not_read_is_named(scene, tmp_path, caplog):
    write_scene(scene, tmp_path / "scene.glb")
    read_scene(tmp_path / "scene.glb")
    assert caplog.text == ""

    def change(document):
        _node(document, "vehicle_1")["extras"]["velocity_m_s"] = [1.0, 0.0]
        _node(document, "vehicle_2")["name"] = "Vehicle_2"
        document["extensionsUsed"] = ["EXT_fog"]

    _rewritten(tmp_path / "scene.glb", change)
    read_scene(tmp_path / "scene.glb")
    assert "scene.glb: not read: node 'Vehicle_2', extras.velocity_m_s" in caplog.text
    assert "scene.glb: the extension EXT_fog is not read" in caplog.text


def test_other_programs_see_y_up_and_the_extras(scene, tmp_path):
    write_scene(scene, tmp_path / "scene.glb")
    file = trimesh.load_scene(tmp_path / "scene.glb", process=False)
    matrix, geometry = file.graph.get("vehicle_12")
    world = trimesh.transform_points(file.geometry[geometry].vertices, matrix)
    x, y, z = scene.vehicles[2].mesh.vertex_m.T
    np.testing.assert_allclose(world, np.stack([x, z, -y], axis=1), atol=1e-6)

    data = (tmp_path / "scene.glb").read_bytes()
    document = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])
    extras = _node(document, "vehicle_12")["extras"]
    assert extras["instance_id"] == 12
    assert extras["class"] == "bus"
    assert extras["box_center_m"] == [120.0, -1.5, 0.7]
    assert extras["box_yaw_deg"] == pytest.approx(np.degrees(1.2))
    root = document["nodes"][document["scenes"][0]["nodes"][0]]
    names = [document["nodes"][child]["name"] for child in root["children"]]
    assert names == ["environment", "ego", "vehicle_1", "vehicle_2", "vehicle_12"]


def test_a_node_may_carry_its_own_transform(scene, tmp_path):
    write_scene(scene, tmp_path / "scene.glb")
    _rewritten(tmp_path / "scene.glb", lambda d: _node(d, "vehicle_2").update(translation=[1.0, 2.0, 3.0]))
    moved = read_scene(tmp_path / "scene.glb").vehicles[1].mesh
    np.testing.assert_allclose(moved.vertex_m, scene.vehicles[1].mesh.vertex_m + np.float32([1, 2, 3]), atol=1e-6)


def test_truncated_file(scene, tmp_path):
    path = tmp_path / "scene.glb"
    write_scene(scene, path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(InputError, match=r"scene\.glb: ") as caught:
        read_scene(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: _node(d, "ego").update(name="car"), r"expected a mesh node named 'ego', got car, "),
        (lambda d: _node(d, "environment").update(name="road"), r"expected a mesh node named 'environment'"),
        (
            lambda d: _node(d, "vehicle_1")["extras"].pop("instance_id"),
            r"'vehicle_1': extras: instance_id: expected a value, got nothing",
        ),
        (
            lambda d: _node(d, "vehicle_1")["extras"].pop("class"),
            r"'vehicle_1': extras: class: expected a value, got nothing",
        ),
        (lambda d: _node(d, "vehicle_1")["extras"].update(instance_id=0), r"instance_id: expected at least 1, got 0"),
        (lambda d: _node(d, "vehicle_1")["extras"].update(instance_id=2), r"instance_id must be unique, got 2 2 times"),
        (
            lambda d: _node(d, "vehicle_2")["extras"].update(box_size_m=[1, 2]),
            r"box_size_m: expected at least 3 values, got",
        ),
        (lambda d: _node(d, "vehicle_2")["extras"].update(box_yaw_deg="x"), r"box_yaw_deg: expected a number, got 'x'"),
        (
            lambda d: d["scenes"][0]["extras"].update(sky_zenith_rgb=[0, 0, 300]),
            r"sky_zenith_rgb\[2\]: expected at most 255, got 300",
        ),
        (lambda d: _node(d, "vehicle_1").pop("extras"), r"instance_id: expected a value, got nothing"),
    ],
)
def test_bad_contents(scene, tmp_path, change, message):
    path = tmp_path / "scene.glb"
    write_scene(scene, path)
    _rewritten(path, change)
    with pytest.raises(InputError, match=message) as caught:
        read_scene(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_no_faces(scene, tmp_path):
    path = tmp_path / "scene.glb"
    write_scene(scene, path)

    def points_only(document):
        mesh = document["meshes"][_node(document, "vehicle_2")["mesh"]]
        mesh["primitives"][0].pop("indices")
        mesh["primitives"][0]["mode"] = 0

    _rewritten(path, points_only)
    with pytest.raises(InputError, match=r"vehicle_2': expected a mesh with triangles, got none"):
        read_scene(path)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.obj", "v 0 0 0\n" * 2_000_001),
        ("a.off", "OFF\n1 1 0\n" + "1 " * 600_000),
        ("a.gltf", "[" * 200_000),
        ("a.dae", "<a>" * 40_000),
        ("a.dae", "<!DOCTYPE a [<!ENTITY b 'c'>]><COLLADA>&b;</COLLADA>"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 999999999999\nproperty float x\nend_header\n1\n"),
        ("a.zip", "PK"),
        ("a.zae", "PK"),
    ],
)
def test_vehicles_keep_the_bounds(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    told = refusal(read_vehicle_file, tmp_path / name)
    assert told.startswith(f"{tmp_path / name}: vehicle: expected a ")
