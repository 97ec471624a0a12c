"""Colours of surfaces from images: the best view decides, what nobody sees takes the nearest, panes keep theirs."""

import math

import numpy as np
import pytest

from warpav.raster.camera import CameraModel
from warpav.scene import CapturedImage, ViewKind
from warpav.scene.capture._capture import CaptureView
from warpav.scene.reconstruction._point_cloud import seen_rgb

RED, GREEN, BLUE, GREY = (200, 10, 10), (10, 200, 10), (10, 10, 200), (90, 90, 90)
INSTANCE = 4
SIZE_PX = 40
X = np.array([1.0, 0.0, 0.0])


def looking_along_x(rgb, *, distance_m, turned_rad=0.0, depth_m=None, instance=INSTANCE, fov_rad=1.0):
    """An image of one colour, from a distance from the origin, whose camera looks at it, turned about z."""
    c, s = math.cos(turned_rad), math.sin(turned_rad)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    pose[:3, 3] = -distance_m * pose[:3, 2]
    shape = (SIZE_PX, SIZE_PX)
    model = CameraModel(SIZE_PX, SIZE_PX, fov_rad)
    depth = np.broadcast_to(np.float32(distance_m if depth_m is None else depth_m), shape)
    whose = np.broadcast_to(np.uint16(instance), shape)
    colour = np.broadcast_to(np.array(rgb, np.uint8), (*shape, 3))
    return CapturedImage(CaptureView("one", ViewKind.OTHER, pose, model), colour, depth, whose)


def colour_of_origin(*images, instance=INSTANCE):
    """The colour of a vertex at the origin whose surface faces the cameras at negative x."""
    return tuple(seen_rgb(np.zeros((1, 3)), -X[None], images, instance, tolerance_m=0.05)[0])


@pytest.mark.parametrize("worse", [{"distance_m": 5.0}, {"distance_m": 3.0, "turned_rad": 1.2}])
def test_the_nearer_or_squarer_view_gives_the_colour(worse):
    best, other = looking_along_x(RED, distance_m=3.0), looking_along_x(GREEN, **worse)
    assert colour_of_origin(best, other) == colour_of_origin(other, best) == RED


def test_a_hidden_vertex_takes_no_colour_of_what_hides_it():
    hidden = looking_along_x(GREEN, distance_m=3.0, depth_m=2.0)
    assert colour_of_origin(hidden, looking_along_x(RED, distance_m=9.0)) == RED
    # 5 cm and 1 % of the depth are allowed
    assert colour_of_origin(looking_along_x(GREEN, distance_m=3.0, depth_m=2.93)) == GREEN


def test_another_objects_pixel_gives_no_colour():
    other = looking_along_x(GREEN, distance_m=3.0, instance=INSTANCE + 1)
    assert colour_of_origin(other, looking_along_x(RED, distance_m=9.0)) == RED


def test_a_pane_of_a_vehicle_has_the_colour_of_what_it_shows():
    pane = looking_along_x(BLUE, distance_m=3.0, depth_m=8.0)
    assert colour_of_origin(pane, looking_along_x(RED, distance_m=9.0)) == BLUE
    # the environment has no panes: what lies beyond its surface shows another one
    pane, wall = (
        looking_along_x(BLUE, distance_m=3.0, depth_m=8.0, instance=0),
        looking_along_x(RED, distance_m=9.0, instance=0),
    )
    assert colour_of_origin(pane, wall, instance=0) == RED


def test_vertices_that_no_image_shows_take_the_nearest_colour():
    left, right = [0.0, 0.4, 0.0], [0.0, -0.4, 0.0]
    image = looking_along_x(RED, distance_m=4.0)
    colours = image.rgb.copy()
    colours[:, SIZE_PX // 2 :] = GREEN
    image = CapturedImage(image.view, colours, image.depth_m, image.instance)
    behind_left, behind_right = [0.3, 0.5, 0.0], [0.3, -0.5, 0.0]
    vertex_m = np.array([left, right, behind_right, behind_left, [0.0, 30.0, 0.0]])
    normal = np.stack([-X, -X, X, X, -X])
    rgb = seen_rgb(vertex_m, normal, [image], INSTANCE, tolerance_m=0.05)
    np.testing.assert_array_equal(rgb, [RED, GREEN, GREEN, RED, RED])
