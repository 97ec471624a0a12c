"""Thinning, normals, trimming, cleaning, decimation and the methods by name."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from warpav.raster.mesh import Mesh, merge
from warpav.scene import thin_out
from warpav.scene.reconstruction._surface import SURFACE_METHODS, cleaned, decimated, oriented_normals, trimmed


def directions(count, rng):
    direction = rng.normal(size=(count, 3))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def grid_mesh(count, size_m, colour, middle_m=(0.0, 0.0, 0.0), height=lambda x, y: 0.0 * x):
    """A square of ``2 count count`` triangles that face upwards; ``colour`` maps x, y [m] to rgb."""
    axis_m = np.linspace(-0.5 * size_m, 0.5 * size_m, count + 1)
    x, y = (values.ravel() for values in np.meshgrid(axis_m, axis_m, indexing="ij"))
    corner = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).ravel()
    triangle = np.concatenate(
        [
            np.stack([corner, corner + count + 1, corner + count + 2], axis=1),
            np.stack([corner, corner + count + 2, corner + 1], axis=1),
        ]
    )
    vertex_m = np.stack([x, y, height(x, y)], axis=1) + np.array(middle_m)
    return Mesh.create(vertex_m, triangle, colour(x, y))


def grey(x, y):
    return np.full((len(x), 3), 128)


# thin_out


@settings(max_examples=30)
@given(
    point_count=st.integers(1, 1500),
    share=st.floats(0.001, 1.2),
    flatness=st.sampled_from([1.0, 0.01, 0.0]),
    offset_m=st.sampled_from([0.0, 1e4]),
    seed=st.integers(0, 2**32 - 1),
)
def test_thinned_points_keep_apart_and_leave_no_room(point_count, share, flatness, offset_m, seed):
    point_m = np.random.default_rng(seed).random((point_count, 3)) * [1.0, 2.0, flatness] + offset_m
    count = max(1, int(share * point_count))
    index = thin_out(point_m, count, seed=seed)
    assert (np.diff(index) > 0).all()
    if point_count <= count:
        np.testing.assert_array_equal(index, np.arange(point_count))
        return
    assert abs(len(index) - count) <= max(0.1 * count, 1.0)
    if len(index) > 1:
        kept = KDTree(point_m[index])
        spacing_m = kept.query(point_m[index], 2)[0][:, 1].min()
        # every other point has a kept one within the spacing, up to rounding
        assert kept.query(point_m)[0].max() <= spacing_m * (1.0 + 1e-6) + 1e-9


@pytest.mark.parametrize(
    ("point_m", "count", "message"),
    [
        (np.zeros((5, 3)), 0, "count must be at least 1, got 0"),
        (np.full((5, 3), np.nan), 2, "finite numbers"),
        (np.zeros((5, 2)), 2, r"\[point, 3\], got \[5, 2\]"),
    ],
)
def test_thinning_refuses(point_m, count, message):
    with pytest.raises(ValueError, match=message):
        thin_out(point_m, count, seed=0)


# oriented_normals


@pytest.mark.parametrize(("sensor_radius_m", "sign"), [(10.0, 1.0), (0.3, -1.0)])
def test_normals_of_a_sphere_turn_towards_the_sensors(rng, sensor_radius_m, sign):
    direction = directions(6000, rng)
    sensor_m = sensor_radius_m * (direction + 0.8 * directions(6000, rng))
    normal = oriented_normals(2.0 * direction, sensor_m)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=5e-6)
    assert (sign * np.sum(normal * direction, axis=1)).min() > np.cos(np.radians(8.0))  # worst seen 3.2 degrees


@pytest.mark.parametrize(
    ("point_m", "sensor_m", "message"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3)), r"got \[0, 3\]"),
        (np.zeros((5, 3)), np.full((5, 3), np.nan), r"sensor_m\[0\] is"),
        (np.zeros((5, 3)), np.zeros((6, 3)), "sensor_m: expected one for each of 5 points, got 6"),
    ],
)
def test_normals_refuse(point_m, sensor_m, message):
    with pytest.raises(ValueError, match=message):
        oriented_normals(point_m, sensor_m)


# methods by name


@pytest.mark.parametrize(("method", "largest_m"), [("poisson", 0.004), ("signed_distance", 0.012)])
def test_methods_find_a_sphere(rng, method, largest_m):
    direction = directions(8000, rng)
    vertex_m, triangle = SURFACE_METHODS[method](0.5 * direction, direction, 5.0 * direction, 0.04)
    assert vertex_m.dtype == np.float32
    assert triangle.dtype == np.int32
    vertex_m, triangle = trimmed(vertex_m, triangle, 0.5 * direction, reach_m=0.06)
    assert np.abs(np.linalg.norm(vertex_m, axis=1) - 0.5).max() < largest_m  # worst seen 2.0 and 8.4 mm
    assert trimesh.Trimesh(vertex_m, triangle, process=False).volume > 0.9 * 4 / 3 * np.pi * 0.5**3


# trimmed


def body_with_extras(rng):
    """A body of 2 m, a mirror beside it, a speck, and a guessed wing; with the points that support the first two."""
    body = grid_mesh(60, 2.0, grey)
    mirror = grid_mesh(4, 0.16, grey, middle_m=(1.5, 0.0, 0.3))
    speck = grid_mesh(2, 0.04, grey, middle_m=(0.0, 0.0, 0.8))
    wing = grid_mesh(10, 1.0, grey, middle_m=(0.0, 2.5, 0.0))
    support_m = np.concatenate(
        [
            np.column_stack([rng.uniform(-1.0, 1.0, (10_000, 2)), rng.normal(0.0, 0.01, 10_000)]),
            np.array([1.5, 0.0, 0.3]) + np.column_stack([rng.uniform(-0.08, 0.08, (64, 2)), np.zeros(64)]),
            np.array([0.0, 0.0, 0.8]) + rng.uniform(-0.01, 0.01, (4, 3)),
        ]
    )
    whole = merge([body, mirror, speck, wing])
    return whole, support_m, len(body.triangle) + len(mirror.triangle)


def test_trimming_keeps_a_mirror_and_drops_a_speck(rng):
    whole, support_m, kept = body_with_extras(rng)
    vertex_m, triangle = trimmed(whole.vertex_m, whole.triangle, support_m, reach_m=0.06)
    assert len(triangle) == kept
    assert triangle.max() + 1 == len(vertex_m)
    assert (vertex_m[:, 0] > 1.4).any()
    assert vertex_m[:, 2].max() < 0.4


# cleaned


def test_cleaning_drops_what_is_not_seen():
    vertex_m = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [9, 9, 9], [2, 0, 0], [0, 0, 0]]
    rgb = [[9, 9, 9]] * 6 + [[8, 8, 8]]
    triangle = [
        [0, 1, 2],
        [1, 2, 3],  # the same, begun at another corner
        [2, 1, 0],  # its back
        [0, 1, 5],  # a line
        [0, 3, 2],  # a point twice
        [6, 1, 2],  # the same place, another colour
    ]
    mesh = cleaned(Mesh.create(vertex_m, triangle, rgb))
    np.testing.assert_array_equal(mesh.vertex_m, [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0]])
    np.testing.assert_array_equal(mesh.vertex_rgb, [[9, 9, 9]] * 3 + [[8, 8, 8]])
    np.testing.assert_array_equal(mesh.triangle, [[0, 1, 2], [2, 1, 0], [3, 1, 2]])


# decimated


def colour_from_above(mesh, place):
    """The mesh's colours at x, y [point, 2], seen from above."""
    body = trimesh.Trimesh(mesh.vertex_m, mesh.triangle, process=False)
    origin_m = np.column_stack([place, np.full(len(place), 5.0)])
    hit_m, ray, triangle = body.ray.intersects_location(
        origin_m, np.tile([0, 0, -1], (len(place), 1)), multiple_hits=False
    )
    assert len(ray) == len(place)
    share = trimesh.triangles.points_to_barycentric(body.triangles[triangle], hit_m)
    rgb = np.empty((len(place), 3))
    rgb[ray] = np.einsum("pc,pcx->px", share, mesh.vertex_rgb[mesh.triangle[triangle]].astype(float))
    return rgb


@pytest.mark.parametrize("height", [lambda x, y: 0.0 * x, lambda x, y: 0.2 * np.cos(2.0 * x) * np.cos(y)])
def test_decimation_keeps_the_border_between_two_colours(rng, height):
    """A dark window of 1 m x .6 m in a light sheet of 2 m x 2 m."""

    def window(x, y):
        inside = (np.abs(x - 0.1) < 0.5) & (np.abs(y + 0.15) < 0.3)
        return np.where(inside[:, None], [40, 45, 50], [200, 190, 60])

    dense = grid_mesh(140, 2.0, window, height=height)
    coarse = decimated(dense, 500)
    assert 300 < len(coarse.triangle) <= 500
    place = rng.uniform(-0.99, 0.99, (3000, 2))
    to_border_m = np.abs(np.maximum(np.abs(place[:, 0] - 0.1) - 0.5, np.abs(place[:, 1] + 0.15) - 0.3))
    error = np.abs(colour_from_above(coarse, place) - window(*place.T)).max(axis=1)
    away = to_border_m > 0.03  # two cells of the dense sheet; the coarse triangles are 13 cm long
    assert (error[away] > 40).mean() < 0.003
    assert error[away].mean() < 2.0
    assert KDTree(dense.vertex_m).query(coarse.vertex_m)[0].max() < 0.02
