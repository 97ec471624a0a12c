"""The taped kernels of the benchmark against NumPy and against differences."""

import math

import numpy as np
import pytest
import warp as wp
from warp.autograd import gradcheck

from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll
from warpav_kernels.experiments import benchmark


def arrays(device, rng, camera_count=5):
    pose = np.c_[rng.uniform(-2, 2, (camera_count, 2)), rng.uniform(-4, 4, camera_count)].astype(np.float32)
    height = rng.uniform(1, 3, camera_count).astype(np.float32)
    on_device = (
        wp.array(pose, dtype=wp.vec3, device=device, requires_grad=True),
        wp.array(height, dtype=float, device=device, requires_grad=True),
    )
    # what a kernel has not written is NaN
    position = wp.full(4 * camera_count, wp.vec3(math.nan), dtype=wp.vec3, device=device, requires_grad=True)
    rotation = wp.full(4 * camera_count, wp.mat33(math.nan), dtype=wp.mat33, device=device, requires_grad=True)
    return pose, height, on_device, (position, rotation)


def test_cameras_look_along_the_workloads_axes(device, rng):
    pose, height, inputs, outputs = arrays(device, rng)
    wp.launch(
        benchmark.place_level_cameras_kernel, dim=(5, 4), inputs=list(inputs), outputs=list(outputs), device=device
    )
    position, rotation = (array.numpy() for array in outputs)
    for camera, (x, z, yaw) in enumerate(pose.astype(float)):
        for k in range(4):
            np.testing.assert_allclose(position[4 * camera + k], [z, x, height[camera]], rtol=1e-6)
            expected = (rotation_from_yaw_pitch_roll(yaw + 0.5 * k * math.pi, 0.0, 0.0) @ FLU_FROM_RDF).T
            np.testing.assert_allclose(rotation[4 * camera + k], expected, atol=2e-6)  # worst seen 4e-7


def test_gradient_of_the_views_matches_differences(device, rng):
    _, _, inputs, outputs = arrays(device, rng, camera_count=2)
    assert gradcheck(
        benchmark.place_level_cameras_kernel,
        dim=(2, 4),
        inputs=list(inputs),
        outputs=list(outputs),
        device=device,
        eps=1e-2,
        atol=1e-3,
        rtol=1e-2,
    )


@pytest.mark.parametrize("vehicle_count", [0, 1, 40])
def test_loss_is_the_weighted_sum_and_its_gradient_the_weights(device, rng, vehicle_count):
    area = rng.uniform(0, 100, (6, vehicle_count, 1)).astype(np.float32)
    weight = rng.normal(size=vehicle_count).astype(np.float32)
    on_device = wp.array(area, dtype=float, device=device, requires_grad=True)
    loss = wp.full(6, math.nan, dtype=float, device=device, requires_grad=True)
    tape = wp.Tape()
    with tape:
        wp.launch(
            benchmark.sum_target_areas_kernel,
            dim=6,
            inputs=[on_device, wp.array(weight, dtype=float, device=device)],
            outputs=[loss],
            device=device,
        )
    np.testing.assert_allclose(loss.numpy(), area[:, :, 0] @ weight, rtol=1e-5, atol=1e-3)
    upstream = rng.normal(size=6).astype(np.float32)
    tape.backward(grads={loss: wp.array(upstream, dtype=float, device=device)})
    np.testing.assert_allclose(on_device.grad.numpy()[:, :, 0], np.outer(upstream, weight), rtol=1e-6)
