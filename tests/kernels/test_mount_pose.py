"""The pose kernel against the NumPy frames and height map."""

import math

import numpy as np
import pytest
import warp as wp

from tests.driving_scene import roof
from tests.oracle import thesis
from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll
from warpav.optimisation import CameraMount
from warpav.raster.camera import CameraModel, rotational_additions

MODEL = CameraModel(64, 64, math.pi / 2)
OFFSET_M = 0.25


def placed(pose, device, *, surface=None, model=MODEL, gradient_of=None):
    """Centres and rotations as NumPy, and the gradient of ``sum(weight * [centre, rotation])`` to the pose."""
    mount = CameraMount(surface or roof(), camera=model, height_offset_m=OFFSET_M, device=device)
    array = wp.array(np.asarray(pose, np.float32), dtype=float, device=device, requires_grad=True)
    tape = wp.Tape()
    with tape:
        views = mount.place(array)
    gradient = None
    if gradient_of is not None:
        to_centre, to_rotation = gradient_of
        tape.backward(
            grads={
                views.position_ego_m: wp.array(to_centre, dtype=wp.vec3, device=device),
                views.camera_from_ego: wp.array(to_rotation, dtype=wp.mat33, device=device),
            }
        )
        gradient = array.grad.numpy()
    return views.position_ego_m.numpy(), views.camera_from_ego.numpy(), gradient


def oracle(pose, surface, model):
    """Centres and rotations in double precision; Eq. 3 adds a multiple of the closest divisor to the yaw."""
    count, step = rotational_additions(model.fov_rad)
    centre, rotation = [], []
    for x, y, yaw, pitch, roll, rise, _ in np.asarray(pose, float):
        for a in range(count):
            centre.append([x, y, surface.height_at_m(np.array([x, y])) + OFFSET_M + rise])
            rotation.append((rotation_from_yaw_pitch_roll(yaw + a * step, pitch, roll) @ FLU_FROM_RDF).T)
    return np.array(centre), np.array(rotation)


def random_pose(rng, count):
    low, high = roof().bounds_m
    return np.c_[
        rng.uniform(low, high, (count, 2)),
        rng.uniform(-4, 4, count),
        rng.uniform(-1.4, 1.4, (count, 2)),
        rng.uniform(-0.2, 0.3, (count, 2)),
    ].astype(np.float32)


@pytest.mark.equation(3)
@pytest.mark.parametrize("fov_deg", [60.0, 85.0, 90.0, 120.0])
def test_views_stand_on_the_surface_and_turn_all_round(device, rng, fov_deg):
    model = CameraModel(64, 64, math.radians(fov_deg))
    pose = random_pose(rng, 20)
    centre, rotation, _ = placed(pose, device, model=model)
    expected_centre, expected_rotation = oracle(pose, roof(), model)
    # worst seen 2e-7 m: float32
    np.testing.assert_allclose(centre, expected_centre, atol=2e-6)
    np.testing.assert_allclose(rotation, expected_rotation, atol=2e-6)


def test_height_beyond_the_border_is_the_borders(device):
    low, high = roof().bounds_m
    outside = [low - 1.0, high + 1.0, [low[0] - 3.0, 0.0], [1.0, high[1] + 0.005], low, high]
    pose = np.c_[np.array(outside), np.zeros((6, 5))].astype(np.float32)
    centre, _, _ = placed(pose, device)
    np.testing.assert_allclose(centre, oracle(pose, roof(), MODEL)[0], atol=2e-6)


def test_gradient_to_the_six_numbers_of_the_pose_matches_differences(device, rng):
    pose = random_pose(rng, 12)
    # stay off the lines between cells, where the slope jumps
    origin, cell = roof().origin_m, roof().cell_m
    pose[:, :2] = origin + (np.floor((pose[:, :2] - origin) / cell) + rng.uniform(0.2, 0.8, (12, 2))) * cell
    to_centre = rng.normal(size=(48, 3)).astype(np.float32)
    to_rotation = rng.normal(size=(48, 3, 3)).astype(np.float32)
    _, _, gradient = placed(pose, device, gradient_of=(to_centre, to_rotation))

    def value(numbers):
        centre, rotation = oracle(numbers, roof(), MODEL)
        per_view = (to_centre * centre).sum(axis=1) + (to_rotation * rotation).sum(axis=(1, 2))
        return per_view.reshape(12, 4).sum(axis=1)

    step = 1e-4
    for i in range(6):
        high, low = pose.astype(float), pose.astype(float)
        high[:, i] += step
        low[:, i] -= step
        # worst seen 1e-3: the slope of a float32 height map
        np.testing.assert_allclose(gradient[:, i], (value(high) - value(low)) / (2 * step), atol=4e-3)
    # the slope of the roof is part of the gradient
    assert np.abs(gradient[:, :2] - to_centre.reshape(12, 4, 3)[:, :, :2].sum(axis=1)).max() > 0.02


def test_height_does_not_pull_beyond_the_border(device):
    low, high = roof().bounds_m
    pose = np.array([[low[0] - 0.5, 0.3, 0, 0, 0, 0, 0], [1.5, high[1] + 0.5, 0, 0, 0, 0, 0]], np.float32)
    up = np.zeros((8, 3), np.float32)
    up[:, 2] = 1.0
    _, _, gradient = placed(pose, device, gradient_of=(up, np.zeros((8, 3, 3), np.float32)))
    assert gradient[0, 0] == 0.0
    assert gradient[1, 1] == 0.0
    assert abs(gradient[0, 1]) > 0.1
    assert abs(gradient[1, 0]) > 0.1


@pytest.mark.equation(2)
@pytest.mark.parametrize(
    ("fov_deg", "count"),
    [(60, 6), (72, 5), (80, 4), (85, 4), (90, 4), (110, 3), (120, 3), (170, 2), (48, 8), (144, 2), (10, 36)],
)
def test_rotational_additions_cut_the_circle(fov_deg, count):
    # 80 (4.5), 48 (7.5) and 144 (2.5) are halves: they round to even
    assert rotational_additions(math.radians(fov_deg)) == (count, pytest.approx(2 * math.pi / count))
    assert rotational_additions(math.radians(fov_deg))[1] == pytest.approx(
        thesis.closest_field_of_view(math.radians(fov_deg))
    )
