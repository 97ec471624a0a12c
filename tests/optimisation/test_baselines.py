"""The rigs to compare with."""

import itertools
import math

import numpy as np
import pytest

from tests.driving_scene import flat_surface, roof
from tests.thesis.test_descent import MODEL
from warpav.core.errors import InputError
from warpav.optimisation import X_M, Y_M, YAW_RAD, CameraMount, edge_mount_pose, highest_mount_pose, random_mount_pose
from warpav.thesis import BoundsAndSpacing


def mount_on(surface):
    return CameraMount(surface, camera=MODEL, height_offset_m=0.25)


@pytest.mark.parametrize("camera_count", [1, 2, 3, 4, 6])
def test_highest_cameras_stand_round_the_top(camera_count):
    mount = mount_on(roof())
    pose = highest_mount_pose(BoundsAndSpacing(mount.surface), camera_count)
    np.testing.assert_allclose(pose[:, YAW_RAD], 2 * math.pi * np.arange(camera_count) / camera_count)
    assert not pose[:, 3:].any()
    top = roof().highest_point_m()[:2]
    place = pose[:, [X_M, Y_M]]
    if camera_count == 1:
        np.testing.assert_allclose(place[0], top, atol=1e-6)
    else:
        distances = [math.dist(a, b) for a, b in itertools.combinations(place, 2)]
        assert 0.2 <= min(distances) < 0.2001
        # every camera stands on the side that it faces
        outward = place - top
        facing = np.stack([np.cos(pose[:, YAW_RAD]), np.sin(pose[:, YAW_RAD])], axis=1)
        np.testing.assert_allclose(outward / np.linalg.norm(outward, axis=1, keepdims=True), facing, atol=1e-3)
    assert BoundsAndSpacing(roof()).violation_m(mount.rig(pose.astype(np.float32))) == 0.0


def test_highest_cameras_at_the_edge_are_pushed_in():
    slope = flat_surface([0.0, -0.5], [2.0, 0.5])
    slope.height_m[:] += np.linspace(0.0, 1.0, len(slope.height_m))[:, None]
    pose = highest_mount_pose(BoundsAndSpacing(slope), 4)
    assert BoundsAndSpacing(slope).violation_m(mount_on(slope).rig(pose.astype(np.float32))) == 0.0
    assert pose[:, X_M].min() > 1.5


@pytest.mark.parametrize("camera_count", [1, 4])
def test_cameras_at_the_edge_face_outwards_from_it(camera_count):
    surface = flat_surface([3.0, 1.5], [5.0, 2.5])
    pose = edge_mount_pose(BoundsAndSpacing(surface), camera_count)
    yaw = 2 * math.pi * np.arange(camera_count) / camera_count
    np.testing.assert_allclose(pose[:, YAW_RAD], yaw)
    edge = np.array([[5.0, 2.0], [4.0, 2.5], [3.0, 2.0], [4.0, 1.5]])[:camera_count]
    np.testing.assert_allclose(pose[:, [X_M, Y_M]], edge, atol=surface.cell_m)


def test_cameras_that_do_not_fit_are_refused(rng):
    small = mount_on(flat_surface([0.0, 0.0], [0.2, 0.2]))
    with pytest.raises(InputError, match=r"rig\.cameras: expected a number that fits"):
        highest_mount_pose(BoundsAndSpacing(small.surface, min_spacing_m=0.5), 4)
    with pytest.raises(InputError, match=r"rig\.cameras: expected a number that fits"):
        random_mount_pose(BoundsAndSpacing(small.surface, min_spacing_m=0.5), np.zeros(4), rng=rng)


def test_random_cameras_are_feasible_and_spread(rng):
    mount = mount_on(roof())
    yaw = np.array([0.0, 1.5, 3.5, 5.5])
    poses = np.stack([random_mount_pose(BoundsAndSpacing(mount.surface), yaw, rng=rng) for _ in range(100)])
    for pose in poses:
        assert BoundsAndSpacing(roof()).violation_m(mount.rig(pose)) == 0.0
        np.testing.assert_allclose(np.exp(1j * pose[:, YAW_RAD]), np.exp(1j * yaw))
        assert (np.abs(pose[:, YAW_RAD]) <= math.pi).all()
    low, high = roof().bounds_m
    spread = poses[:, :, :2].reshape(-1, 2)
    np.testing.assert_allclose(spread.mean(axis=0), 0.5 * (low + high), atol=0.12)
    np.testing.assert_allclose(spread.std(axis=0), (high - low) / math.sqrt(12), rtol=0.15)
