"""A user's own vehicle: files of every format, units and axes found by the shape, corrected, written and read again."""

import json
import struct

import numpy as np
import pytest
import trimesh

from warpav.core.errors import InputError
from warpav.rig import kinds_of_names
from warpav.runs._vehicle import part_names
from warpav.scene import Reading, ego_vehicle, examine, read_vehicle, read_vehicle_file, vehicle_mesh, write_vehicle
from warpav.scene._own_vehicle import AXES
from warpav.scene.town._vehicle_shapes import ego_glass, ego_mesh

TURNS = [(up, forward) for up in AXES for forward in AXES if up[-1] != forward[-1]]


@pytest.fixture(scope="module")
def car():
    return ego_vehicle()


def of_kind(kind):
    return vehicle_mesh(kind, np.array([200, 60, 50]), variant=0, scale=np.ones(3))


def save(mesh, path, *, reading=None, shift=(0.0, 0.0, 0.0)):
    """A file whose numbers mean ``mesh`` when they are read so."""
    reading = reading or Reading("y" if path.suffix == ".glb" else "z", "x")
    geometry = trimesh.Trimesh(mesh.vertex_m, mesh.triangle, vertex_colors=mesh.vertex_rgb, process=False)
    ego = mesh.vertex_m.astype(np.float64) + shift
    geometry.vertices = ego @ reading.ego_from_file / reading.scale
    geometry.export(path)
    return path


def checked(path, **options):
    file = read_vehicle_file(path)
    return examine(file, options.pop("reading", file.usual), **options)


@pytest.mark.parametrize("suffix", ["glb", "obj", "ply", "stl", "off"])
def test_every_format_gives_the_same_vehicle(car, tmp_path, suffix):
    found = checked(save(car, tmp_path / f"car.{suffix}"))
    assert found.problems == ()
    assert len(found.mesh.triangle) == len(car.triangle)
    corner, expected = (mesh.vertex_m[mesh.triangle].reshape(-1, 9) for mesh in (found.mesh, car))
    # worst seen 0 but for .obj and .off, which are text with 8 decimals
    np.testing.assert_allclose(np.sort(corner, axis=0), np.sort(expected, axis=0), atol=1e-6)


@pytest.mark.parametrize(("up", "forward"), TURNS)
def test_a_reading_is_a_rotation_that_puts_up_and_forward_in_their_places(up, forward):
    rotation = Reading(up, forward).ego_from_file
    assert np.linalg.det(rotation) == 1.0
    sign = {True: -1.0, False: 1.0}
    for axis, ego_axis in ((forward, 0), (up, 2)):
        np.testing.assert_array_equal(
            rotation @ np.eye(3)["xyz".index(axis[-1])] * sign[axis.startswith("-")], np.eye(3)[ego_axis]
        )


@pytest.mark.parametrize(
    ("up", "forward", "scale"),
    [
        pytest.param(*turn, scale, marks=() if (k % 3, k % 2) == (0, number) else pytest.mark.nightly)
        for k, turn in enumerate(TURNS)
        for number, scale in enumerate((0.01, 1.0))
    ],
)
def test_the_shape_tells_axes_and_units_and_what_it_suggests_mends_them(car, tmp_path, up, forward, scale):
    truth = Reading(up, forward, scale)
    path = save(car, tmp_path / "car.ply", reading=truth)
    found = checked(path)
    assert bool(found.problems) == (truth != Reading("z", "x"))
    remedy = {name: value for problem in found.problems for name, value in problem.remedy.items()}
    assert float(remedy.get("scale", 1.0)) == scale
    usual = read_vehicle_file(path).usual
    corrected = Reading(remedy.get("up", usual.up), remedy.get("forward", usual.forward), scale)
    if (up, forward) == ("z", "-x"):  # backwards is a hint, no more: pickups look like that
        assert any("`forward` -x" in hint for hint in found.hints)
        return
    assert (corrected.up, corrected.forward) == (up, forward)
    again = checked(path, reading=corrected)
    assert again.problems == ()
    np.testing.assert_allclose(again.mesh.vertex_m, car.vertex_m, atol=1e-5)


@pytest.mark.parametrize("shift", [(0.5, 0.0, 0.0), (0.0, 0.3, 0.0), (0.0, 0.0, -0.7), (400.0, -20.0, 3.0)])
def test_a_vehicle_that_stands_elsewhere_is_moved_to_its_rear_axle(car, tmp_path, shift):
    found = checked(save(car, tmp_path / "car.ply", shift=shift))
    assert found.problems
    assert all(problem.remedy == {} for problem in found.problems)
    # worst seen 4 mm: the axle is where points of the tyres touch the ground
    np.testing.assert_allclose(found.corrected.bounds_m(), car.bounds_m(), atol=0.01)


def test_a_mended_vehicle_can_be_used_and_stays_the_same_bit_for_bit(car, tmp_path):
    first = checked(save(of_kind("van"), tmp_path / "van.obj")).corrected
    write_vehicle(first, tmp_path / "van.glb", source="van.obj")
    file = read_vehicle_file(tmp_path / "van.glb")
    found = examine(file, file.usual)
    assert found.problems == ()
    np.testing.assert_array_equal(found.corrected.vertex_m, first.vertex_m)
    np.testing.assert_array_equal(found.corrected.triangle, first.triangle)
    np.testing.assert_array_equal(found.corrected.vertex_rgb, first.vertex_rgb)
    write_vehicle(found.corrected, tmp_path / "again.glb", source="van.obj")
    assert (tmp_path / "again.glb").read_bytes() == (tmp_path / "van.glb").read_bytes()


def test_parts_in_places_of_their_own_become_one_mesh(car, tmp_path):
    half = len(car.triangle) // 2
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(0.7, [0.2, 1.0, 0.4], [0.3, 0.1, 0.0])
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    for name, faces, matrix in (("a", car.triangle[:half], turn), ("b", car.triangle[half:], mirror)):
        part = trimesh.Trimesh(car.vertex_m, faces, process=False)
        part.apply_transform(np.linalg.inv(matrix))
        scene.add_geometry(part, node_name=name, transform=matrix)
    scene.export(tmp_path / "parts.glb")
    file = read_vehicle_file(tmp_path / "parts.glb")
    read = file.in_ego_frame(Reading("z", "x"))
    # the file holds single precision
    np.testing.assert_allclose(
        np.sort(read.vertex_m[read.triangle].reshape(-1, 3), axis=0),
        np.sort(car.vertex_m[car.triangle].reshape(-1, 3), axis=0),
        atol=2e-6,
    )
    assert examine(file, Reading("z", "x")).open_edge_count == 0


def glb(mesh, kind, *, changes=(), extension="KHR_mesh_quantization"):
    """A GLB by hand, y up; positions as integers of a kind, normalised, with the node that undoes it."""
    vertex = mesh.vertex_m[:, [0, 2, 1]].astype(float) * [1.0, 1.0, -1.0]
    least, most = np.iinfo(kind).min, np.iinfo(kind).max
    low, high = vertex.min(axis=0), vertex.max(axis=0)
    centre, half = (0.5 * (low + high), 0.5 * (high - low).max()) if least < 0 else (low, (high - low).max())
    stored = np.ascontiguousarray(np.round((vertex - centre) / half * most), kind)
    # rows are multiples of 4 bytes
    stored = np.pad(stored, ((0, 0), (0, -3 * stored.itemsize % 4 // stored.itemsize)))
    indices = mesh.triangle.astype("<u4").tobytes()
    code = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123}[np.dtype(kind).name]
    document = {
        "asset": {"version": "2.0"}, "extensionsUsed": [extension], "extensionsRequired": [extension],
        "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "scale": [half] * 3, "translation": centre.tolist()}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 1}, "indices": 0}]}],
        "buffers": [{"byteLength": len(indices) + stored.nbytes}],
        "bufferViews": [
            {"buffer": 0, "byteLength": len(indices)},
            {"buffer": 0, "byteOffset": len(indices), "byteLength": stored.nbytes, "byteStride": stored.strides[0]},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5125, "count": mesh.triangle.size, "type": "SCALAR"},
            {"bufferView": 1, "componentType": code, "count": len(vertex), "type": "VEC3", "normalized": True},
        ],
    }  # fmt: skip
    for *path, last, value in changes:
        place = document
        for key in path:
            place = place[key]
        place[last] = value
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = indices + stored.tobytes()
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


@pytest.mark.parametrize("kind", ["int8", "uint8", "int16", "uint16"])
def test_positions_may_be_normalised_integers(car, tmp_path, kind):
    (tmp_path / "car.glb").write_bytes(glb(car, kind))
    file = read_vehicle_file(tmp_path / "car.glb")
    step_m = 2.0 * np.ptp(car.vertex_m, axis=0).max() / np.iinfo(kind).max
    np.testing.assert_allclose(file.in_ego_frame(file.usual).vertex_m, car.vertex_m, atol=step_m)
    assert file.notes == ()


@pytest.mark.parametrize(
    ("changes", "extension", "message"),
    [
        ((), "KHR_draco_mesh_compression", "got: the extension KHR_draco_mesh_compression, which is not read"),
        ((), "EXT_meshopt_compression", "got: the extension EXT_meshopt_compression, which is not read"),
        ((), "EXT_unknown", "got: the extension EXT_unknown, which is not read"),
        ([("accessors", 1, "sparse", {"count": 1})], "KHR_mesh_quantization", "got: sparse accessors"),
        ([("buffers", 0, "uri", "a.bin")], "KHR_mesh_quantization", "normalised integers outside of a GLB"),
        ([("extensionsRequired", []), ("skins", [{}])], "EXT_other", "EXT_other is not read; skeletons are not appl"),
        ([("nodes", 0, "weights", [0.5])], "KHR_texture_transform", "texture_transform is not read; morph targets are"),
    ],
)
def test_what_of_a_glb_is_not_read_is_refused_or_named(car, tmp_path, changes, extension, message):
    (tmp_path / "car.glb").write_bytes(glb(car, "int16", changes=changes, extension=extension))
    try:
        found = "; ".join(read_vehicle_file(tmp_path / "car.glb").notes)
    except InputError as error:
        found = str(error)
        assert found.startswith(f"{tmp_path / 'car.glb'}: vehicle: ")
    assert message in found


def test_a_part_that_holds_the_vehicle_is_named(car, tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.Trimesh(car.vertex_m, car.triangle, process=False), node_name="car")
    scene.add_geometry(trimesh.creation.icosphere(radius=25.0), node_name="dome")
    scene.export(tmp_path / "car.glb")
    (problem,) = checked(tmp_path / "car.glb", reading=Reading("z", "x")).problems
    assert problem.remedy is None
    assert "the part 'dome' holds all others, which are 4.699 x 2.217 x 1.55 m; leave it out" in problem.text


def test_a_stated_scale_is_taken_for_a_robot(tmp_path):
    trimesh.creation.box((1.36, 0.7, 0.35)).export(tmp_path / "robot.stl")
    assert "expected a vehicle of 2 to 20 m, got 1.36 m" in checked(tmp_path / "robot.stl").problems[0].text
    found = checked(tmp_path / "robot.stl", stated=frozenset({"scale"}))
    assert [problem.remedy for problem in found.problems] == [{}]  # it is put on the ground
    assert any("got 1.36 m; accepted as stated" in hint for hint in found.hints)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("car.stl", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "run: git lfs pull"),
        ("none.glb", None, r"none\.glb: vehicle: expected a mesh file \(glb, .*\), got no such file"),
        ("car.docx", b"text", r"car\.docx: vehicle: expected a mesh file \(glb, .*\), got the suffix '\.docx'"),
        ("car.glb", b"", r"car\.glb: vehicle: expected a readable glb file, got: "),
        ("car.glb", b"glTF123", r"car\.glb: vehicle: expected a readable glb file, got: "),
        ("car.ply", b"junk", r"car\.ply: vehicle: expected a readable ply file, got: Not a ply file!"),
        ("car.obj", b"", r"car\.obj: vehicle: expected a mesh with triangles, got none"),
        ("car.obj", b"v 0 0 0\nv 1 0 0\n", r"car\.obj: vehicle: expected a mesh with triangles, got none"),
        ("car.stl", b"x" * 50, r"car\.stl: vehicle: expected a mesh with triangles, got none"),
        ("cloud.xyz", b"1 2 3\n4 5 6\n", r"cloud\.xyz: vehicle: expected a mesh file .*, got the suffix '\.xyz'"),
        ("car.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", r"expected triangles with an area, got none"),
        ("car.obj", b"v nan 0 0\nv 1 0 0\nv 2 1 0\nf 1 2 3\n", r"car\.obj: 1 of 3 vertices are NaN or infinite"),
    ],
)
def test_what_cannot_be_a_vehicle_is_refused_in_one_line(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message) as error:
        checked(tmp_path / name)
    assert "\n" not in str(error.value)


def test_glass_is_found_again_in_a_file_by_its_name(tmp_path):
    """The town's car in two nodes, y up as glTF is; its triangles come in another order."""
    car, is_glass = ego_mesh(), ego_glass()
    scene = trimesh.Scene()
    vertex_m = car.vertex_m[:, [1, 2, 0]].astype(float)  # x forward becomes z, z up becomes y
    for name, kept in (("window panes", is_glass), ("body", ~is_glass)):
        part = trimesh.Trimesh(vertex_m, car.triangle[kept], vertex_colors=car.vertex_rgb, process=False)
        scene.add_geometry(part, node_name=name, geom_name=name)
    scene.export(tmp_path / "car.glb")
    mesh = read_vehicle(tmp_path / "car.glb", forward="z")
    names = part_names(tmp_path / "car.glb", mesh, forward="z")
    found = kinds_of_names(names) == "glass"
    assert found.sum() == is_glass.sum()
    middle_m = [each.vertex_m[each.triangle].mean(axis=1) for each in (mesh, car)]
    kept = zip(middle_m, (found, is_glass), strict=True)
    first, second = (np.sort(np.round(middle[flag], 2), axis=0) for middle, flag in kept)
    np.testing.assert_allclose(first, second, atol=0.011)
