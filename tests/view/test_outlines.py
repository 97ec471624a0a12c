"""Outlines: frustums and sectors against their closed forms, silhouettes of blocks, holes and a disc."""

import math

import numpy as np
import pytest

from tests.view.stand_ins import block, ego
from warpav.raster.beams import Beams
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh, merge
from warpav.rig import RigCamera
from warpav.view._outlines import (
    STEP_M,
    beam_lines,
    bearing_sector_rad,
    frustum_points,
    image_corners,
    sector_polygon_m,
    silhouette_m,
    view_edges,
)
from warpav.view._picture import ground_rings_m


def camera(*, yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0, fov_deg=90.0, width_px=320, height_px=200, **lens):
    model = CameraModel(width_px=width_px, height_px=height_px, fov_rad=math.radians(fov_deg), **lens)
    angles = (math.radians(angle) for angle in (yaw_deg, pitch_deg, roll_deg))
    return RigCamera("cam", np.array([1.5, 0.4, 1.7]), *angles, model)


@pytest.mark.parametrize("fov_deg", [20.0, 90.0, 150.0])
@pytest.mark.parametrize("depth_m", [0.5, 3.0])
def test_half_width_and_half_height_are_the_closed_form(fov_deg, depth_m):
    model = camera(fov_deg=fov_deg).model
    half_width = depth_m * math.tan(math.radians(fov_deg) / 2)
    half_height = half_width * 200 / 320
    expected = [[-1, -1], [1, -1], [1, 1], [-1, 1]] * np.array([half_width, half_height])
    corner = image_corners(model, depth_m=depth_m)
    np.testing.assert_allclose(corner[:, :2], expected, rtol=1e-12)
    np.testing.assert_allclose(corner[:, 2], depth_m, rtol=1e-12)


def test_frustum_of_a_camera_that_looks_left_opens_to_the_left():
    point = frustum_points(camera(yaw_deg=90.0), depth_m=2.0)
    np.testing.assert_allclose(point[0], [1.5, 0.4, 1.7])
    # Top left of an image taken looking left lies ahead of the vehicle's middle: image left is x forward... backward.
    np.testing.assert_allclose(point[1], [1.5 - 2.0, 0.4 + 2.0, 1.7 + 1.25], atol=1e-12)
    np.testing.assert_allclose(point[3], [1.5 + 2.0, 0.4 + 2.0, 1.7 - 1.25], atol=1e-12)


@pytest.mark.parametrize(("yaw_deg", "fov_deg"), [(0.0, 90.0), (170.0, 60.0), (-170.0, 120.0), (45.0, 20.0)])
def test_sector_of_a_level_camera_is_its_yaw_and_field_of_view(yaw_deg, fov_deg):
    right_rad, left_rad = bearing_sector_rad(camera(yaw_deg=yaw_deg, fov_deg=fov_deg))
    assert left_rad - right_rad == pytest.approx(math.radians(fov_deg))
    middle = (left_rad + right_rad) / 2 - math.radians(yaw_deg)
    assert math.remainder(middle, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)


def test_what_a_lidar_sees_lies_between_its_beams():
    """In its own axes: 40 degrees to either side, 10 up and 30 down; rings on the ground are at h / tan(down)."""
    beams = Beams(tuple(np.radians([-30.0, -20.0, 10.0])), 0.01, (math.radians(-40.0), math.radians(40.0)))
    low, high = beam_lines(beams, depth_m=2.0)
    for line, up_deg in ((low, -30.0), (high, 10.0)):
        np.testing.assert_allclose(np.linalg.norm(line, axis=1), 2.0)
        np.testing.assert_allclose(-line[:, 1] / 2.0, math.sin(math.radians(up_deg)))
        end_deg = np.degrees(np.arctan2(-line[[0, -1], 0], line[[0, -1], 2]))
        np.testing.assert_allclose(end_deg, [-40.0, 40.0])
    lidar = RigCamera("lidar", np.array([1.0, 0.2, 2.0]), 0.5, model=CameraModel.of_beams(beams, 0.4))
    assert len(view_edges(lidar.model, depth_m=1.0)) == 4 + 2
    all_round = CameraModel.of_beams(Beams(beams.elevation_rad, 0.01), 0.4)
    assert len(view_edges(all_round, depth_m=1.0)) == 2
    rings = ground_rings_m(lidar)
    for ring, down_deg in zip(rings, (30.0, 20.0), strict=True):
        radius_m = np.linalg.norm(ring[:, :2] - [1.0, 0.2], axis=1)
        np.testing.assert_allclose(radius_m, 2.0 / math.tan(math.radians(down_deg)))
        np.testing.assert_allclose(ring[:, 2], 0.02, atol=1e-9)
    assert ground_rings_m(camera()) == []


@pytest.mark.parametrize(("lens", "fov_deg"), [("fisheye", 200.0), ("panorama", 300.0), ("panorama", 360.0)])
def test_sector_of_a_wide_lens_reaches_behind_the_camera(lens, fov_deg):
    right_rad, left_rad = bearing_sector_rad(camera(yaw_deg=20.0, lens=lens, fov_deg=fov_deg))
    half = math.radians(fov_deg) / 2
    assert (right_rad, left_rad) == pytest.approx((math.radians(20.0) - half, math.radians(20.0) + half), abs=1e-6)


def test_sector_of_a_lens_whose_image_is_a_small_circle_ends_at_the_circle():
    # t (1 + k1 t^2) grows up to 1 / sqrt(0.6), so the image ends at two thirds of that, times 50 pixels
    model = CameraModel(320, 200, lens="fisheye", focal_px=(50.0, 50.0), distortion=(-0.2, 0.0, 0.0, 0.0))
    small = RigCamera("cam", np.zeros(3), 0.0, 0.0, 0.0, model)
    right_rad, left_rad = bearing_sector_rad(small)
    assert left_rad == pytest.approx(1.0 / math.sqrt(0.6), abs=0.15)
    assert right_rad == pytest.approx(-left_rad)
    corner = image_corners(model, depth_m=3.0)
    np.testing.assert_allclose(np.linalg.norm(corner, axis=1), 3.0)
    assert (np.sign(corner[:, :2]) == [[-1, -1], [1, -1], [1, 1], [-1, 1]]).all()


def test_sector_widens_when_the_camera_looks_down():
    right_rad, left_rad = bearing_sector_rad(camera(pitch_deg=40.0))
    assert (left_rad - right_rad) / 2 == pytest.approx(math.atan(1.0 / math.cos(math.radians(40.0))))


def test_sector_polygon_has_the_area_of_a_sector():
    polygon = sector_polygon_m(camera(yaw_deg=30.0, fov_deg=80.0), radius_m=3.0)
    x, y = polygon.T
    area = 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)  # positive: counter-clockwise
    assert area == pytest.approx(0.5 * math.radians(80.0) * 3.0**2, rel=1e-3)
    np.testing.assert_allclose(polygon[0], [1.5, 0.4])


X, Y, Z = np.eye(3)


def area_m2(line):
    x, y = line.T
    return 0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))


@pytest.mark.parametrize(("right", "up"), [(X, Z), (-X, Z), (Y, Z), (-X, -Y)])
def test_a_block_is_its_rectangle_from_every_side(right, up):
    [line] = silhouette_m(ego(), right, up)
    corner = ego().vertex_m @ np.stack([right, up], axis=1)
    assert len(line) == 4
    np.testing.assert_allclose(line.min(axis=0), corner.min(axis=0), atol=STEP_M)
    np.testing.assert_allclose(line.max(axis=0), corner.max(axis=0), atol=STEP_M)


def test_a_gap_between_two_posts_is_a_hole_only_where_it_is_closed():
    posts = [block((0, 0, 0), (0.2, 1, 1), (9, 9, 9)), block((0.8, 0, 0), (1, 1, 1), (9, 9, 9))]
    lintel = block((0, 0, 0.8), (1, 1, 1), (9, 9, 9))
    sill = block((0, 0, 0), (1, 1, 0.2), (9, 9, 9))
    assert len(silhouette_m(merge(posts), X, Z)) == 2
    [gate] = silhouette_m(merge([*posts, lintel]), X, Z)
    assert area_m2(gate) == pytest.approx(1.0 - 0.6 * 0.8, abs=0.01)
    outer, hole = silhouette_m(merge([*posts, lintel, sill]), X, Z)
    assert area_m2(outer) == pytest.approx(1.0, abs=0.01)
    assert area_m2(hole) == pytest.approx(0.36, abs=0.01)


def test_a_disc_is_round_within_two_steps():
    turn = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    rim = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    fan = [[200, k, (k + 1) % 200] for k in range(200)]
    [line] = silhouette_m(Mesh.create(np.vstack([rim, [[0, 0, 0]]]), fan, (9, 9, 9)), X, Y)
    assert np.abs(np.linalg.norm(line, axis=1) - 1.0).max() < 2.0 * STEP_M  # worst seen 0.0016
