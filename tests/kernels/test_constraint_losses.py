"""The inequality kernels against NumPy, into outputs that were filled with NaN."""

import itertools
import math

import numpy as np
import pytest
import warp as wp

from tests.driving_scene import flat_surface
from warpav.rig.mount_surface import MountSurface
from warpav_kernels.placement import constraint_losses

FLAT = flat_surface([-1.0, -0.6], [1.4, 0.6])
MARGIN_M = 0.03


def l_shaped():
    """A zone with an inner corner and a hole, on cells of 10 cm."""
    is_mountable = np.ones(FLAT.height_m.shape, bool)
    is_mountable[15:, :6] = False
    is_mountable[4:7, 3:8] = False
    return MountSurface(FLAT.height_m, FLAT.origin_m, FLAT.cell_m, is_mountable)


@pytest.mark.parametrize("surface", [FLAT, l_shaped()], ids=["rectangle", "l"])
def test_zone_excess_matches_numpy(device, rng, surface):
    count = 200
    pose = np.c_[rng.uniform(-2.5, 2.5, (count, 2)), rng.normal(size=(count, 3))].astype(np.float32)
    excess_m = wp.full(count, math.nan, dtype=float, device=device)
    inputs = [
        wp.array(pose, dtype=float, device=device),
        wp.array(surface.border_distance_m, dtype=float, device=device),
        wp.vec2(*surface.origin_m),
        surface.cell_m,
        MARGIN_M,
    ]
    wp.launch(constraint_losses.zone_excess_kernel, dim=count, inputs=inputs, outputs=[excess_m], device=device)
    expected = MARGIN_M - surface.zone_distance_m(pose[:, :2].astype(float))
    assert (expected > 0.0).any()
    assert (expected < 0.0).any()
    np.testing.assert_allclose(excess_m.numpy(), expected, atol=2e-6)  # worst seen 3e-7


@pytest.mark.parametrize("camera_count", [1, 2, 3, 6])
def test_spacing_excess_matches_numpy_and_leaves_the_zone_alone(device, rng, camera_count):
    position = rng.normal(size=(camera_count, 3)).astype(np.float32)
    pairs = list(itertools.combinations(range(camera_count), 2))
    excess_m = wp.full(camera_count + len(pairs), math.nan, dtype=float, device=device)
    inputs = [wp.array(np.repeat(position, 4, axis=0), dtype=wp.vec3, device=device), 4, 0.7]
    wp.launch(constraint_losses.spacing_excess_kernel, dim=1, inputs=inputs, outputs=[excess_m], device=device)
    found = excess_m.numpy()
    assert np.isnan(found[:camera_count]).all()
    expected = [0.7 - math.dist(position[i], position[j]) for i, j in pairs]
    np.testing.assert_allclose(found[camera_count:], expected, atol=2e-6)  # worst seen 4e-7


def test_kept_inequalities_are_copied_and_so_are_their_gradients(device, rng):
    excess = rng.normal(size=10).astype(np.float32)
    kept = np.array([7, 2, 3], np.int32)
    excess_m = wp.array(excess, dtype=float, device=device, requires_grad=True)
    kept_m = wp.full(len(kept), math.nan, dtype=float, device=device, requires_grad=True)
    with wp.Tape() as tape:
        wp.launch(
            constraint_losses.keep_excess_kernel,
            dim=len(kept),
            inputs=[excess_m, wp.array(kept, dtype=wp.int32, device=device)],
            outputs=[kept_m],
            device=device,
        )
    np.testing.assert_array_equal(kept_m.numpy(), excess[kept])
    tape.backward(grads={kept_m: wp.array([1.0, 2.0, 3.0], dtype=float, device=device)})
    expected = np.zeros(10)
    expected[kept] = [1.0, 2.0, 3.0]
    np.testing.assert_array_equal(excess_m.grad.numpy(), expected)
