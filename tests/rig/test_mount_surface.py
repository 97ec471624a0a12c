import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warpav.core.errors import InputError
from warpav.raster.mesh import Mesh, merge
from warpav.rig import MountSurface, mount_surface_from_mesh
from warpav.scene import ego_vehicle
from warpav.scene.town._vehicle_shapes import ego_glass

QUAD = np.array([[0, 1, 2], [0, 2, 3]])


def quad(corner_m):
    """Two triangles over four corners, counter-clockwise from above."""
    return Mesh.create(corner_m, QUAD, [128, 128, 128])


def plate(x0, x1, y0, y1, height=lambda x, y: 1.0):
    return quad([[x, y, height(x, y)] for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))])


def dome(radius_m=1.0, curvature_radius_m=4.0, count=60):
    """A shallow paraboloid cap over a square, 1.5 m high in the middle."""
    x, y = np.meshgrid(*(np.linspace(-radius_m, radius_m, count + 1),) * 2, indexing="ij")
    vertex = np.stack([x, y, 1.5 - (x**2 + y**2) / (2 * curvature_radius_m)], axis=-1).reshape(-1, 3)
    first = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).ravel()
    square = first[:, None] + [0, count + 1, count + 2, 1]
    return Mesh.create(vertex, np.concatenate([square[:, [0, 1, 2]], square[:, [0, 2, 3]]]), [128, 128, 128])


def car():
    """Bonnet at 1 m, roof at 1.5 m, a steep windscreen between them with a seat below it, two mirrors and a sill."""
    return merge(
        [
            plate(1.0, 2.0, -0.8, 0.8),
            plate(-1.5, 0.5, -0.6, 0.6, lambda x, y: 1.5),
            plate(0.5, 1.0, -0.7, 0.7, lambda x, y: 2.0 - x),  # 45 degrees
            plate(0.0, 0.9, -0.5, 0.5, lambda x, y: 0.6),
            plate(0.9, 1.0, 0.9, 1.1, lambda x, y: 0.95),
            plate(0.9, 1.0, -1.1, -0.9, lambda x, y: 0.95),
            plate(-1.0, 1.0, 0.8, 0.83, lambda x, y: 0.9),
        ]
    )


def test_dome_is_followed_and_its_top_is_the_highest_point():
    surface = mount_surface_from_mesh(dome(), cell_m=0.02)
    position = np.random.default_rng(0).uniform(-0.9, 0.9, (500, 2))
    truth = 1.5 - (position**2).sum(axis=1) / 8
    np.testing.assert_allclose(surface.height_at_m(position), truth, atol=0.005)  # slope <= 0.32 over half a cell
    np.testing.assert_allclose(surface.highest_point_m(), [0.0, 0.0, 1.5], atol=0.02)


def test_hole_is_filled_smoothly_from_its_rim():
    """A frame around a hole of 1 x 0.6 m, on a slope: the fill continues the slope."""
    rim = [(-1.0, -0.5, -0.5, 0.5), (0.5, 1.0, -0.5, 0.5), (-0.5, 0.5, -0.5, -0.3), (-0.5, 0.5, 0.3, 0.5)]
    mesh = merge([plate(*side, lambda x, y: 1.0 + 0.2 * x) for side in rim])
    surface = mount_surface_from_mesh(mesh, cell_m=0.02)
    inside = np.random.default_rng(0).uniform([-0.5, -0.3], [0.5, 0.3], (500, 2))
    height = surface.height_at_m(inside)
    assert height.min() >= 0.9 - 0.005
    assert height.max() <= 1.1 + 0.005
    np.testing.assert_allclose(height, 1.001 + 0.2 * inside[:, 0], atol=0.003)  # worst seen 0.0016


def test_glass_and_what_lies_below_it_are_filled_from_bonnet_and_roof():
    surface = mount_surface_from_mesh(car(), cell_m=0.02)
    over_windscreen = surface.height_at_m(np.stack([np.linspace(0.5, 1.0, 26), np.zeros(26)], axis=-1))
    assert np.all(np.diff(over_windscreen) <= 0.0)
    assert over_windscreen.min() >= 1.0
    assert over_windscreen.max() <= 1.5
    assert surface.height_m.min() >= 1.0  # neither the seat nor the mirrors nor the sill
    np.testing.assert_allclose(surface.bounds_m, [[-1.49, -0.79], [1.99, 0.79]], atol=0.011)


def test_lower_points_are_left_out_on_request():
    surface = mount_surface_from_mesh(car(), min_height_m=1.2)
    np.testing.assert_allclose(surface.bounds_m, [[-1.49, -0.59], [0.49, 0.59]], atol=0.021)


@settings(max_examples=25)
@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(0, 2))
def test_surface_moves_with_the_mesh(x, y, z):
    mesh, shift = dome(count=12), np.array([x, y, z])
    surface = mount_surface_from_mesh(mesh, cell_m=0.1)
    moved = mount_surface_from_mesh(mesh.transformed(np.eye(3), shift), cell_m=0.1)
    assert moved.height_m.shape == surface.height_m.shape
    np.testing.assert_allclose(moved.height_m, surface.height_m + z, atol=1e-5)
    np.testing.assert_allclose(moved.bounds_m, surface.bounds_m + shift[:2], atol=1e-5)


def test_lookup_reproduces_a_bilinear_function_and_clamps_at_the_border():
    x, y = np.meshgrid(np.arange(5) * 0.5 - 1.0, np.arange(4) * 0.5 + 2.0, indexing="ij")

    def truth(x, y):
        return 1.0 + 0.5 * x - 0.25 * y + 0.125 * x * y

    surface = MountSurface(truth(x, y).astype(np.float32), np.array([-1.0, 2.0]), 0.5)
    np.testing.assert_array_equal(surface.bounds_m, [[-1.0, 2.0], [1.0, 3.5]])
    position = np.random.default_rng(1).uniform([-2.0, 1.0], [2.0, 4.5], (200, 2))
    inside = np.clip(position, *surface.bounds_m)
    np.testing.assert_allclose(surface.height_at_m(position), truth(inside[:, 0], inside[:, 1]), atol=1e-6)
    assert surface.height_at_m(np.array([1.0, 3.5])) == truth(1.0, 3.5)


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (plate(0.0, 0.5, 0.0, 1.0, lambda x, y: 2.0 * x), "faces that point upwards .* none among 2; check that z"),
        (quad([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]]), "faces that point upwards"),
        (plate(-2000.0, 2500.0, -900.0, 900.0), r"vehicle in metres, got 4500 x 1800"),
    ],
)
def test_mount_surface_rejects_a_mesh_that_offers_no_place(mesh, message):
    with pytest.raises(InputError, match=message):
        mount_surface_from_mesh(mesh)


# --- the mountable zone ----------------------------------------------------------------------------------------------


def distance_to_edges(is_inside):
    """Oracle: from every cell's centre to the nearest edge between inside and outside, in cells, positive inside."""
    around = np.pad(is_inside, 1)
    edges = []
    for i, j in np.argwhere(around):
        for step in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            if not around[i + step[0], j + step[1]]:
                middle = np.array([i, j]) - 1 + 0.5 * np.array(step)
                along = 0.5 * np.array(step[::-1])
                edges.append((middle - along, middle + along))
    start, end = np.moveaxis(np.array(edges), 1, 0)
    centre = np.stack(np.indices(is_inside.shape), axis=-1)[:, :, None, :]
    share = np.clip(((centre - start) * (end - start)).sum(axis=-1), 0.0, 1.0)  # edges are one cell long
    distance = np.linalg.norm(start + share[..., None] * (end - start) - centre, axis=-1).min(axis=-1)
    return np.where(is_inside, distance, -distance)


@settings(max_examples=30, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.floats(0.1, 1.0))
def test_border_runs_along_the_edges_of_the_cells(seed, share):
    rng = np.random.default_rng(seed)
    is_mountable = rng.random((9, 7)) < share
    is_mountable[rng.integers(9), rng.integers(7)] = True
    surface = MountSurface(np.ones((9, 7), np.float32), np.zeros(2), 0.5, is_mountable)
    row, column = np.indices(is_mountable.shape)
    to_rectangle = np.min([row, 8 - row, column, 6 - column], axis=0)
    expected = 0.5 * np.minimum(distance_to_edges(is_mountable), to_rectangle)
    np.testing.assert_allclose(surface.border_distance_m, expected, atol=1e-6)


def test_without_a_zone_it_is_the_whole_rectangle():
    surface = MountSurface(np.ones((21, 11), np.float32), np.array([-1.0, 2.0]), 0.1)
    low, high = surface.bounds_m
    place = np.random.default_rng(0).uniform(low - 0.5, high + 0.5, (500, 2))
    beyond = np.maximum(np.maximum(low - place, place - high), 0.0)
    inside = np.minimum(place - low, high - place).min(axis=1)
    distance = surface.zone_distance_m(place)
    is_inside = inside >= 0.0
    np.testing.assert_allclose(distance[~is_inside], -np.linalg.norm(beyond, axis=1)[~is_inside], atol=1e-6)
    assert (distance[is_inside] >= -1e-6).all()
    # bilinear over the ridges: worst seen 0.024
    np.testing.assert_allclose(distance[is_inside], inside[is_inside], atol=0.25 * surface.cell_m)
    assert surface.zone_distance_m(np.array([0.0, 2.5])) == pytest.approx(0.5)


def test_zone_is_roof_and_bonnet_without_glass_and_corners():
    surface = mount_surface_from_mesh(car(), min_upward_normal=0.6)
    assert surface.height_at_m(np.array([0.75, 0.0])) == pytest.approx(1.25, abs=0.02)  # the map has the windscreen
    inside = {(-0.5, 0.0): 0.6, (1.5, 0.0): 0.5, (-1.4, 0.0): 0.1, (1.5, 0.7): 0.1}
    outside = {(0.75, 0.0): -0.25, (-0.5, 0.7): -0.1, (-1.5, 0.8): -0.2, (0.52, 0.0): -0.02}
    for place, distance in {**inside, **outside}.items():
        assert surface.zone_distance_m(np.array(place)) == pytest.approx(distance, abs=0.021), place


GAPS = [(0.02, 0.0, False), (0.04, 0.0, False), (0.08, 0.0, True), (0.4, 0.0, True)]
GAPS += [(0.02, 0.2, False), (0.02, 0.7, True)]


@pytest.mark.parametrize(("gap_m", "step_m", "is_border"), GAPS)
def test_creases_are_no_border_and_walls_are(gap_m, step_m, is_border):
    upper = plate(gap_m, 1.0 + gap_m, -0.5, 0.5, lambda x, y: 1.0 + step_m)
    mesh = merge([plate(-1.0, 0.0, -0.5, 0.5), upper])
    distance = mount_surface_from_mesh(mesh, cell_m=0.02).zone_distance_m(np.array([0.5 * gap_m, 0.0]))
    assert (distance < 0.0) == is_border


def test_the_embedded_vehicle_carries_no_camera_on_its_glass():
    mesh, is_glass = ego_vehicle(), ego_glass()
    surface = mount_surface_from_mesh(mesh, min_upward_normal=0.8)
    middle = mesh.vertex_m[mesh.triangle[is_glass]].mean(axis=1)
    bonnet_m = surface.height_at_m(np.array([2.4, 0.0]))  # the windscreen goes on below it
    above = middle[middle[:, 2] > bonnet_m]
    assert len(above) > 200
    assert surface.zone_distance_m(above[:, :2]).max() < -0.015  # worst seen -0.019
    assert surface.zone_distance_m(np.array([2.05, 0.0])) < -0.2
    assert (surface.zone_distance_m(np.array([[0.6, 0.0], [2.9, 0.0]])) > 0.4).all()
    # the rectangle's rear corners, beside the roof
    low, high = surface.bounds_m
    assert (surface.zone_distance_m(np.array([low, [low[0], high[1]]])) < -0.1).all()


def test_what_is_too_steep_everywhere_is_refused():
    with pytest.raises(InputError, match=r"expected faces that can carry a camera .* at least 0\.99"):
        mount_surface_from_mesh(plate(-1.0, 1.0, -0.5, 0.5, lambda x, y: 1.0 + 0.3 * x), min_zone_normal=0.99)


def test_a_sill_beside_the_roof_is_no_part_of_the_zone_and_a_step_of_the_roof_is():
    roof = plate(-1.0, 1.0, -0.5, 0.5, lambda x, y: 1.5)
    for below_m, is_part in ((0.6, False), (0.2, True)):
        sill = plate(-1.0, 1.0, 0.5, 0.54, lambda x, y, below_m=below_m: 1.5 - below_m)
        surface = mount_surface_from_mesh(merge([roof, sill]), cell_m=0.02)
        mountable = np.ones(surface.height_m.shape, bool) if surface.is_mountable is None else surface.is_mountable
        lowest_m = surface.height_m[mountable].min()
        assert lowest_m == pytest.approx(1.5 - below_m if is_part else 1.5, abs=1e-5)
