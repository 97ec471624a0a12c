"""Pictures of point clouds and meshes, looked at pixel by pixel."""

import math

import numpy as np
import pytest

from tests.view.stand_ins import block, needs_opengl
from warpav.scene import Box, PointCloud
from warpav.view._palette import camera_rgb
from warpav.view.figures._clouds import Viewpoint, cloud_image

pytestmark = needs_opengl

SIZE_PX = (300, 200)
RED, BLUE = (200, 30, 30), (30, 60, 200)


def points(point_m, rgb):
    point_m = np.asarray(point_m, np.float32)
    return PointCloud(point_m, np.tile(np.array(rgb, np.uint8), (len(point_m), 1)), np.zeros_like(point_m))


def pixels_of(image, rgb):
    return np.argwhere(np.linalg.norm(image.astype(float) - rgb, axis=-1) < 60.0)


def test_points_lie_where_the_closed_form_puts_them():
    viewpoint = Viewpoint(np.zeros(3), np.array([1.0, 0.0, 0.0]), height_rad=math.radians(60.0))
    image = cloud_image([points([[10.0, 2.0, 3.0]], RED)], viewpoint, size_px=SIZE_PX, point_px=5.0)
    assert image.shape == (200, 300, 3)
    focal_px = 100.0 / math.tan(math.radians(30.0))
    row, column = pixels_of(image, RED).mean(axis=0) + 0.5
    assert (row, column) == pytest.approx((100.0 - 0.3 * focal_px, 150.0 - 0.2 * focal_px), abs=1.0)


def test_without_perspective_lengths_are_those_of_the_height():
    viewpoint = Viewpoint(np.array([0.0, 0.0, 50.0]), np.zeros(3), up=(1.0, 0.0, 0.0), height_m=10.0)
    image = cloud_image([block((-2.0, -1.0, 0.0), (1.0, 3.0, 1.0), RED)], viewpoint, size_px=SIZE_PX)
    place = pixels_of(image, RED)
    assert place.min(axis=0) == pytest.approx([80.0, 90.0], abs=1.0)  # ahead is up, left is left
    assert place.max(axis=0) + 1 == pytest.approx([140.0, 170.0], abs=1.0)


def test_a_nearer_surface_hides_a_farther_one():
    viewpoint = Viewpoint(np.zeros(3), np.array([1.0, 0.0, 0.0]))
    wall = block((5.0, -3.0, -3.0), (5.5, 3.0, 3.0), BLUE)
    hidden = cloud_image([wall, points([[9.0, 0.0, 0.0]], RED)], viewpoint, size_px=SIZE_PX, point_px=5.0)
    shown = cloud_image([wall, points([[4.0, 0.0, 0.0]], RED)], viewpoint, size_px=SIZE_PX, point_px=5.0)
    assert not len(pixels_of(hidden, RED))
    assert len(pixels_of(shown, RED))


def test_points_that_cover_are_larger_where_they_are_near():
    grid = np.stack(np.meshgrid(np.arange(-3, 4), np.arange(-3, 4)), axis=-1).reshape(-1, 2) * 0.2
    walls = [
        np.insert(grid + np.array([side, 0.0]), 0, distance, axis=1) for distance, side in ((8.0, 1.0), (24.0, -3.0))
    ]
    viewpoint = Viewpoint(np.zeros(3), np.array([1.0, 0.0, 0.0]), height_rad=math.radians(40.0))
    shares = {}
    for cover in (0.0, 1.5):
        image = cloud_image([points(np.concatenate(walls), RED)], viewpoint, size_px=SIZE_PX, cover=cover)
        is_red = np.zeros(SIZE_PX[::-1], bool)
        is_red[tuple(pixels_of(image, RED).T)] = True
        focal_px = 100.0 / math.tan(math.radians(20.0))
        column, half = 150 - round(1.0 / 8.0 * focal_px), round(0.55 / 8.0 * focal_px)
        shares[cover] = is_red[100 - half : 100 + half, column - half : column + half].mean()
        counts = is_red[:, :150].sum(), is_red[:, 150:].sum()  # the near wall is on the left
    assert 5.0 < counts[0] / counts[1] < 13.0  # three times as large, up to steps in the size of points
    assert shares[0.0] < 0.3
    assert shares[1.5] == 1.0  # no gaps in the near wall


def test_boxes_are_wires():
    viewpoint = Viewpoint(np.array([0.0, 0.0, 50.0]), np.zeros(3), up=(1.0, 0.0, 0.0), height_m=10.0)
    box = Box(np.zeros(3), np.array([4.0, 2.0, 1.0]), 0.0)
    image = cloud_image([], viewpoint, size_px=SIZE_PX, boxes=[box])
    place = pixels_of(image, camera_rgb(1))
    assert place.min(axis=0) == pytest.approx([60.0, 130.0], abs=2.0)
    assert place.max(axis=0) + 1 == pytest.approx([140.0, 170.0], abs=2.0)
    assert not ((place > [66, 136]) & (place < [133, 163])).all(axis=1).any()  # nothing inside
