"""Point clouds of single objects: where points lie, whose they are, what window panes do."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from tests.scene.capture.town_capture import SEED, town_capture
from warpav.raster.camera import CameraModel
from warpav.scene import Box, Capture, CapturedImage, CloudSettings, ViewKind, fuse, town_scene, unproject
from warpav.scene.capture._capture import CapturedVehicle, CaptureView
from warpav.scene.reconstruction._point_cloud import is_outside

SETTINGS = CloudSettings()


@pytest.fixture(scope="module")
def clouds():
    capture = town_capture()
    return fuse(capture, list(capture.images), SETTINGS)


def surface_points(mesh, spacing_m=0.02):
    """Points on every triangle, no farther than the spacing from one another."""
    corner = mesh.vertex_m[mesh.triangle].astype(float)
    longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1)
    parts = []
    for steps in np.unique(np.ceil(longest / spacing_m).astype(int)):
        chosen = corner[np.ceil(longest / spacing_m).astype(int) == steps]
        u, v = np.meshgrid(np.arange(steps + 1), np.arange(steps + 1))
        inside = u + v <= steps
        u, v = u[inside] / steps, v[inside] / steps
        weight = np.stack([1.0 - u - v, u, v], axis=1)
        parts.append(np.einsum("sk,tkd->tsd", weight, chosen).reshape(-1, 3))
    return np.concatenate(parts)


def flat_image(depth_m, instance, *, pose=None):
    """An image of 8 x 8 pixels, 90 degrees wide, from the ego frame's origin along x unless told otherwise."""
    view = CaptureView("flat", ViewKind.OTHER, np.eye(4) if pose is None else pose, CameraModel(8, 8))
    shape = (8, 8)
    return CapturedImage(
        view,
        np.full((*shape, 3), 100, np.uint8),
        np.broadcast_to(np.float32(depth_m), shape).astype(np.float32),
        np.broadcast_to(np.uint16(instance), shape).astype(np.uint16),
    )


AHEAD = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.0], [0, 0, 0, 1]])


def test_points_lie_where_depth_and_pixel_say():
    cloud, instance, row, column = unproject(flat_image(4.0, 7, pose=AHEAD), far_depth_m=900.0)
    assert len(cloud) == 64
    np.testing.assert_array_equal(instance, 7)
    # the camera stands at (0, 0, 1): depth along x, pixels to the right lie at negative y
    np.testing.assert_allclose(cloud.point_m[:, 0], 4.0, atol=1e-6)
    np.testing.assert_allclose(cloud.point_m[:, 1], -4.0 * (column + 0.5 - 4.0) / 4.0, atol=1e-5)
    np.testing.assert_allclose(cloud.point_m[:, 2], 1.0 - 4.0 * (row + 0.5 - 4.0) / 4.0, atol=1e-5)
    np.testing.assert_allclose(cloud.sensor_m, [[0.0, 0.0, 1.0]] * 64)


def situation(image, box, instance_id=1):
    vehicle = CapturedVehicle(instance_id, "car", box, box.center_m, 0.0, np.zeros(3, np.uint8))
    ego = Box(np.array([0.0, 0.0, -50.0]), np.ones(3), 0.0)
    return Capture("flat", "", ego, (vehicle,), [image])


def fused(depth_m, instance, box_center_m):
    image = flat_image(depth_m, instance, pose=AHEAD)
    capture = situation(image, Box(np.array(box_center_m), np.array([2.0, 30.0, 30.0]), 0.0))
    return fuse(capture, [image], CloudSettings(environment_grid_m=1e-3, max_height_m=100.0))


def test_the_box_decides_whose_a_point_is():
    inside, beyond = fused(4.0, 1, [4.0, 0, 0]), fused(9.0, 1, [4.0, 0, 0])
    assert (len(inside.vehicles[0].cloud), len(inside.environment)) == (64, 0)
    # seen through the vehicle's panes: the environment's points, and rays through the panes
    assert (len(beyond.vehicles[0].cloud), len(beyond.environment)) == (0, 64)
    assert len(beyond.vehicles[0].ray_origin_m) == 64
    # points of the environment inside a box belong to nobody
    stray = fused(4.0, 0, [4.0, 0, 0])
    assert (len(stray.vehicles[0].cloud), len(stray.environment)) == (0, 0)


def test_what_is_far_becomes_a_sphere_and_what_is_high_goes():
    image = flat_image(100.0, 0, pose=AHEAD)
    capture = situation(image, Box(np.array([0.0, 0.0, -80.0]), np.ones(3), 0.0))
    settings = CloudSettings(radius_m=40.0, max_height_m=10.0, environment_grid_m=1e-3)
    clouds = fuse(capture, [image], settings)
    assert len(clouds.environment) == 0
    np.testing.assert_allclose(np.linalg.norm(clouds.sphere.point_m, axis=1), 40.0, rtol=1e-5)
    assert clouds.sphere.point_m[:, 2].max() <= 10.0
    # a point keeps its direction from the ego frame's origin
    original = unproject(image, far_depth_m=900.0)[0].point_m
    direction = original / np.linalg.norm(original, axis=1, keepdims=True)
    nearest = KDTree(direction).query(clouds.sphere.point_m / 40.0)[0]
    assert nearest.max() < 1e-5
    assert 0 < len(clouds.sphere) < 64


def test_points_of_vehicles_lie_on_their_surfaces(clouds):
    truth = {vehicle.instance_id: vehicle for vehicle in town_scene(SEED).vehicles}
    for vehicle, one in zip(town_capture().vehicles, clouds.vehicles, strict=True):
        surface = surface_points(truth[vehicle.instance_id].mesh)
        distance_m = KDTree(surface).query(one.cloud.point_m)[0]
        assert distance_m.max() < 0.02  # half the spacing of the truth's points, and float32
        assert vehicle.box.contains(one.cloud.point_m.astype(float), margin_m=0.02).all()


def test_no_point_was_seen_through_a_pane(clouds):
    """Points that are kept lie on the outside: the inside of the far panes' frames and of doors is gone."""
    truth = {vehicle.instance_id: vehicle for vehicle in town_scene(SEED).vehicles}
    for vehicle, one in zip(town_capture().vehicles, clouds.vehicles, strict=True):
        mesh = truth[vehicle.instance_id].mesh
        surface = surface_points(mesh, 0.05)
        # a point of the outside is met first by a ray from outside along at least one axis of the box
        local = vehicle.box.local_m(one.cloud.point_m.astype(float))
        shell = vehicle.box.local_m(surface)
        assert is_outside(local, vehicle.box.size_m).mean() > 0.97
        assert np.abs(local).max() <= np.abs(shell).max() + 0.03
        assert len(one.ray_origin_m) > 20


def test_pits_of_a_panes_size_are_bridged():
    half_m = np.array([2.0, 0.9, 0.7])
    walls = []
    for axis, sign in ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0), (2, 1.0)):
        sides = [
            np.arange(-0.5 * 0.03 * n, 0.5 * 0.03 * n, 0.03) for n in (2.0 * np.delete(half_m, axis) / 0.03).astype(int)
        ]
        across = np.stack([part.ravel() for part in np.meshgrid(*sides)], axis=1)
        walls.append(np.insert(across, axis, sign * half_m[axis], axis=1))
    point_m = np.concatenate(walls)
    is_pane = (point_m[:, 1] == 0.9) & (np.abs(point_m[:, 0] - 0.4) < 0.5) & (np.abs(point_m[:, 2] - 0.3) < 0.2)
    point_m[is_pane, 1] = -0.6  # through the pane: seats
    assert is_pane.sum() > 300
    np.testing.assert_array_equal(is_outside(point_m, 2.0 * half_m), ~is_pane)
