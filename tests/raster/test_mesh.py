import numpy as np
import pytest

from tests.scene.town.closed_surface import signed_volume_m3
from warpav import raster
from warpav.core.errors import InputError
from warpav.core.frames import rotation_from_yaw_pitch_roll
from warpav.raster import mesh as mesh_module
from warpav.raster.mesh import Mesh, merge

CORNER_M = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]


def triangle(offset_m=0.0, rgb=(10, 20, 30)):
    return Mesh.create(np.array(CORNER_M) + offset_m, [[0, 1, 2]], rgb)


def test_mesh_has_the_documented_types():
    mesh = triangle()
    assert (mesh.vertex_m.dtype, mesh.triangle.dtype, mesh.vertex_rgb.dtype) == (np.float32, np.int32, np.uint8)
    np.testing.assert_array_equal(mesh.vertex_rgb, [[10, 20, 30]] * 3)
    np.testing.assert_array_equal(mesh.bounds_m(), [[0, 0, 0], [1, 2, 0]])


@pytest.mark.parametrize("make", [raster.Mesh, raster.Mesh.create])
def test_a_mesh_without_colours_is_grey(make):
    mesh = make(np.add(CORNER_M, [0.0, 0.0, 5.0]), [[0, 2, 1]])
    np.testing.assert_array_equal(mesh.vertex_rgb, [[128, 128, 128]] * 3)
    cameras = raster.Cameras([[[20.0, 0, 16], [0, 20.0, 16], [0, 0, 1]]], width_px=32, height_px=32)
    frame = raster.render(raster.Scene({"triangle": mesh}), cameras, np.eye(4)[None])
    seen = frame.object_id.numpy() == 0
    assert seen.any()
    np.testing.assert_allclose(frame.rgb.numpy()[seen].max(axis=0), 128 / 255, atol=1e-6)


def test_transformed_mesh_turns_then_moves():
    moved = triangle().transformed(rotation_from_yaw_pitch_roll(np.pi / 2, 0.0, 0.0), np.array([0.0, 0.0, 3.0]))
    np.testing.assert_allclose(moved.vertex_m, [[0, 0, 3], [0, 1, 3], [-2, 0, 3]], atol=1e-6)


@pytest.mark.parametrize(
    ("vertex_m", "index", "message"),
    [
        ([[0, 0]], [[0, 0, 0]], r"ego: expected vertices of shape \[n, 3\], got \[1, 2\]"),
        (CORNER_M, np.zeros((0, 3)), "ego: expected at least one triangle"),
        (CORNER_M, [[0, 1]], "ego: expected at least one triangle of three indices"),
        (
            [*CORNER_M[:2], [0, 0, np.nan]],
            [[0, 1, 2]],
            r"ego: 1 of 3 vertices are NaN or infinite; repair the mesh first: vertex_m\[2\] is \[0.0, 0.0, nan\]",
        ),
        ([*CORNER_M[:2], [1e39, 0, 0]], [[0, 1, 2]], r"vertex_m\[2\] is \[inf, 0.0, 0.0\]"),
        (
            CORNER_M,
            [[0, 1, 2], [0, 1, 3]],
            r"ego: triangle indices must be 0\.\.2, got 0\.\.3: triangle\[1\] is \[0, 1, 3\]",
        ),
        (CORNER_M, [[-1, 1, 2]], r"ego: triangle indices must be 0\.\.2, got -1\.\.2: triangle\[0\]"),
        (CORNER_M, [[0, 1, 2**32 + 2]], r"triangle\[0\] is \[0, 1, 4294967298\]"),  # not the index 2
        (CORNER_M, [[0, 1, 1.5]], r"ego: triangle indices must be whole: triangle\[0\] is \[0.0, 1.0, 1.5\]"),
        (CORNER_M, [[0, 1, np.nan]], r"triangle\[0\] is \[0.0, 1.0, nan\]"),
    ],
)
def test_mesh_rejects_what_cannot_be_drawn(vertex_m, index, message):
    with pytest.raises(InputError, match=message):
        Mesh.create(vertex_m, index, (0, 0, 0), name="ego")


@pytest.mark.parametrize(
    ("rgb", "message"),
    [
        ([0, 0, 300], r"ego: colours must be 0\.\.255: vertex_rgb\[0\] is \[0, 0, 300\]"),
        ([[0, 0, 0], [0, -1, 0], [0, 0, 0]], r"vertex_rgb\[1\] is \[0, -1, 0\]"),
        ([[0, 0, 0]] * 2, r"ego: expected colours of shape \[3, 3\], got \[2, 3\]"),
    ],
)
def test_mesh_rejects_colours(rgb, message):
    with pytest.raises(InputError, match=message):
        Mesh.create(CORNER_M, [[0, 1, 2]], rgb, name="ego")


def test_meshes_with_more_vertices_than_indices_do_not_merge(monkeypatch):
    assert np.iinfo(np.int32).max == mesh_module.MAX_COUNT
    monkeypatch.setattr(mesh_module, "MAX_COUNT", 5)
    with pytest.raises(ValueError, match="2 meshes have 6 vertices together, more than 5"):
        merge([triangle(), triangle()])


def test_a_mirrored_mesh_faces_outwards_and_mirrored_twice_is_itself():
    # a tetrahedron, counter-clockwise seen from outside
    corner_m = [[5, 1, -4], [6, 1, -4], [5, 3, -4], [5, 1, -1]]
    rgb = [[1, 2, 3], [4, 5, 6], [7, 8, 9], [0, 1, 2]]
    body = Mesh.create(corner_m, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], rgb)
    mirrored = body.mirrored()
    assert signed_volume_m3(body) == pytest.approx(1.0)
    assert signed_volume_m3(mirrored) == pytest.approx(1.0)
    np.testing.assert_allclose(mirrored.bounds_m(), [[5, -3, -4], [6, -1, -1]])
    np.testing.assert_array_equal(mirrored.vertex_rgb, body.vertex_rgb)
    assert (mirrored.vertex_m.dtype, mirrored.triangle.dtype) == (np.float32, np.int32)
    np.testing.assert_array_equal(body.vertex_m, np.float32(corner_m))  # mirroring leaves the original alone
    twice = mirrored.mirrored()
    np.testing.assert_array_equal(twice.vertex_m, body.vertex_m)
    np.testing.assert_array_equal(twice.triangle, body.triangle)
