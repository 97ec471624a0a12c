"""Every taped kernel: its adjoint against finite differences of itself; outputs are NaN before the launch."""

import importlib
import math
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from warp.autograd import gradcheck

from tests.architecture.kernel_style import read_modules
from tests.driving_scene import random_poses, roof
from warpav_kernels import placement_losses

KERNELS = {
    kernel.name: f"warpav_kernels.{Path(module.path).stem}"
    for module in read_modules(Path(__file__).parents[2] / "kernels" / "warpav_kernels")
    for kernel in module.functions
    if kernel.kind == "kernel" and kernel.is_differentiable(module.enable_backward)
}
CASES = {}
VIEWS, VEHICLES = 4, 3
ROTATION_STEP_RAD = 0.5 * math.pi


def case(make):
    """Register what a kernel is checked with: ``make(number)`` gives dim, inputs and outputs."""
    CASES[f"{make.__name__}_kernel"] = make
    return make


class Numbers:
    """Random arrays on a device."""

    def __init__(self, device):
        self._rng = np.random.default_rng(0)
        self.device = device

    def given(self, values, dtype=float, *, slope=True):
        """An array of these values; ``slope`` says whether its gradient is checked."""
        return wp.array(np.asarray(values), dtype=dtype, device=self.device, requires_grad=slope)

    def between(self, low, high, shape, dtype=float, *, slope=True):
        """Uniformly random."""
        return self.given(self._rng.uniform(low, high, shape).astype(np.float32), dtype, slope=slope)

    def empty(self, shape, dtype=float, *, value=math.nan):
        """An output."""
        return wp.full(shape, value, dtype=dtype, device=self.device, requires_grad=True)


@case
def place_level_cameras(number):
    views = [number.empty(4 * VIEWS, wp.vec3), number.empty(4 * VIEWS, wp.mat33)]
    return (VIEWS, 4), [number.between(-2, 2, (VIEWS, 3), wp.vec3), number.between(1, 3, VIEWS)], views


@case
def sum_target_areas(number):
    weight = number.between(-1, 1, VEHICLES, slope=False)
    return VIEWS, [number.between(0, 2, (VIEWS, VEHICLES, 1)), weight], [number.empty(VIEWS)]


@case
def out_of_bounds_loss(number):
    low, high = wp.vec2(-0.8, -0.6), wp.vec2(0.7, 0.9)  # some cameras inside, some beyond
    return 1, [number.between(-2, 2, (6, 5)), low, high], [number.empty(2, value=0.0)]


@case
def camera_spacing_loss(number):
    return 1, [number.between(0, 1, (8, 3), wp.vec3), 2, 1.0], [number.empty(2, value=0.0)]


@case
def lagrangian(number):
    inputs = [number.between(0.2, 2, size) for size in (2, 2, 3, 3, 3)]
    return 1, [*inputs, 2.0, 0.7], [number.empty(1)]


@case
def linearise_measures(number):
    rotation = random_poses(np.random.default_rng(1), 2 * VIEWS)[:, :3, :3].astype(np.float32)
    shape = (VIEWS, VEHICLES, 2)
    inputs = [
        number.between(-1, 1, (VIEWS, 3), wp.vec3),
        number.given(rotation[:VIEWS], wp.mat33),
        number.between(-1, 1, (VIEWS, 3), wp.vec3, slope=False),
        number.given(rotation[VIEWS:], wp.mat33, slope=False),
        number.between(-0.3, 0.3, VIEWS),
        number.between(0, 1, shape, slope=False),
        number.between(-1, 1, (*shape, 3), wp.vec3, slope=False),
        number.between(-1, 1, (*shape, 3), wp.vec3, slope=False),
        number.between(-1, 1, shape, slope=False),
    ]
    return VIEWS, inputs, [number.empty(shape)]


@case
def place_on_surface(number):
    # away from the lines between cells, where the slope jumps
    cell = np.random.default_rng(2).integers([10, 10], [90, 60], (VIEWS, 2)) + 0.5
    pose = np.c_[roof().origin_m + cell * roof().cell_m, np.random.default_rng(3).uniform(-1, 1, (VIEWS, 3))]
    inputs = [
        number.given(pose.astype(np.float32)),
        number.given(roof().height_m, slope=False),
        wp.vec2(*roof().origin_m),
        roof().cell_m,
        0.1,
        4,
        ROTATION_STEP_RAD,
    ]
    return VIEWS, inputs, [number.empty(4 * VIEWS, wp.vec3), number.empty(4 * VIEWS, wp.mat33)]


def assigned(number):
    """Cameras of vehicles: two share one, one has none."""
    return number.given([1, 0, -1, 1], wp.int32, slope=False)


@case
def in_frame_rotation_loss(number):
    sight = [placement_losses.IN_FRAME, placement_losses.SEEN_OUT_OF_FRAME, placement_losses.IN_FRAME, 0]
    inputs = [
        number.between(-3, 3, (2, 5)),
        assigned(number),
        number.between(-3, 3, (4, 2), wp.vec2, slope=False),
        number.given([int(s) for s in sight], wp.int32, slope=False),
        0.3,
    ]
    return 2, inputs, [number.empty((2, 4), value=0.0)]


@case
def sum_area_around(number):
    return 4, [number.between(1, 2, (8, 4, 7)), assigned(number), 4, 1], [number.empty(4)]


@case
def detected_area_loss(number):
    measure, around = number.between(1, 2, (8, 4, 7)), number.between(4, 8, 4)
    return 4, [measure, around, assigned(number), 4, 0.9, 0.1], [number.empty((2, 4), value=0.0)]


@case
def mean_vehicle_loss(number):
    return 2, [number.between(0, 1, (2, 5)), 3], [number.empty(2)]


@pytest.mark.parametrize("name", KERNELS)
def test_adjoint_matches_finite_differences(device, name):
    assert name in CASES, f"say with what numbers {name} is checked"
    dim, inputs, outputs = CASES[name](Numbers(device))
    kernel = getattr(importlib.import_module(KERNELS[name]), name)
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device)
    written = [output.numpy() for output in outputs]
    assert all(np.isfinite(values).all() and values.any() for values in written)
    # worst seen 2.2e-4: float32 over the steps
    assert gradcheck(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device, eps=5e-3, atol=1e-3, rtol=1e-3)
