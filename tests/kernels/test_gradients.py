"""The gradient of every taped kernel to every array it reads, against differences of the kernel itself."""

import math
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from warp.autograd import gradcheck

from tests.architecture.kernel_style import read_modules
from warpav.raster.buffers import lens_of
from warpav.raster.camera import CameraModel
from warpav_kernels.detection import detection_probability, lidar_probability
from warpav_kernels.placement import benchmark, constraint_losses, expected_misses, lagrangian, mount_pose
from warpav_kernels.raster import FISHEYE, PANORAMA, PINHOLE, Lens, linearise
from warpav_kernels.raster import _measure as measure
from warpav_kernels.thesis import losses as thesis

VIEWS, CAMERAS, VEHICLES, ROTATIONS = 4, 2, 3, 2
ASSIGNED = (1, -1, 0)


class Arrays:
    """Arrays with gradients on a device, of random numbers unless values are given."""

    def __init__(self, device, rng):
        self.device, self.rng = device, rng

    def __call__(self, values=None, dtype=float, *, size=None, low=-1.0, high=1.0):
        values = self.rng.uniform(low, high, size) if values is None else values
        return wp.array(np.asarray(values, np.float32), dtype=dtype, device=self.device, requires_grad=True)

    def integers(self, values):
        return wp.array(np.asarray(values, np.int32), dtype=wp.int32, device=self.device)

    def rotations(self, count):
        """Anything near a rotation: the nine numbers are independent."""
        turn = np.linalg.qr(self.rng.normal(size=(count, 3, 3)))[0]
        return self(turn + self.rng.normal(0.0, 0.01, turn.shape), wp.mat33)


def linearise_measures(new):
    at, turned = new(size=(VIEWS, 3), dtype=wp.vec3), new.rotations(VIEWS)
    shape = (VIEWS, VEHICLES, 2)
    inputs = [at, turned, wp.clone(at, requires_grad=True), wp.clone(turned, requires_grad=True)]
    inputs += [new(size=VIEWS), new(size=VIEWS)]
    inputs += [new(size=shape), new(size=(*shape, 3), dtype=wp.vec3), new(size=(*shape, 3), dtype=wp.vec3)]
    return VIEWS, [*inputs, new(size=shape)], [new(np.zeros(shape))]


def split_pose(new):
    matrix = new(size=(VIEWS, 4, 4), dtype=wp.mat44)
    outputs = [new(np.zeros((VIEWS, 3)), dtype=wp.vec3), new(np.zeros((VIEWS, 3, 3)), dtype=wp.mat33)]
    return VIEWS, [matrix], outputs


def linearise_window(new):
    windows = [new(size=(VIEWS, 4), dtype=wp.vec4) for _ in range(2)]
    inputs = [*windows, new(size=(VIEWS, VEHICLES, 1)), new(size=(VIEWS, VEHICLES, 4), dtype=wp.vec4)]
    return VIEWS, inputs, [new(np.zeros((VIEWS, VEHICLES, 1)))]


def place_on_surface(new):
    # in the middle of cells of half a metre, because the slope jumps between them; and beyond the border
    place = np.array([[0.8, -0.2], [1.2, 4.0]])
    pose = new(np.c_[place, new.rng.uniform(-1.0, 1.0, (CAMERAS, 5))])
    zone_of_cell = wp.array(np.arange(20).reshape(5, 4) % 2, dtype=wp.int32, device=new.device)
    planes = [new(size=(2, 3), dtype=wp.vec3), new.rotations(2)]
    inputs = [pose, new(size=(5, 4)), wp.vec2(0.0, -1.0), 0.5, zone_of_cell, *planes, 0.2, ROTATIONS, math.pi]
    views = CAMERAS * ROTATIONS
    return (
        CAMERAS,
        inputs,
        [new(np.zeros((views, 3)), wp.vec3), new(np.zeros((views, 3, 3)), wp.mat33), new(np.zeros(views))],
    )


def place_windows(new):
    # near the axes of views that are turned by half a turn; neither straight ahead nor straight up
    views = CAMERAS * ROTATIONS
    fisheye = lens_of(CameraModel(64, 64, 2.0, lens="fisheye", distortion=(0.05, -0.01, 0.0, 0.0)))
    inputs = [new.rotations(views), new(size=views), ROTATIONS, fisheye, wp.vec2(1.0, 0.6)]
    return CAMERAS, inputs, [new(np.zeros((views, 4)), wp.vec4)]


def out_of_bounds_loss(new):
    # two cameras beyond different bounds, one inside
    pose = new(np.c_[[[-0.4, 0.5], [1.3, 1.6], [0.5, 0.4]], np.zeros((3, 5))])
    return 1, [pose, wp.vec2(0.0, 0.0), wp.vec2(1.0, 1.0)], [new(np.zeros(2))]


def camera_spacing_loss(new):
    # of three cameras two pairs are too close
    place = np.repeat([[0.0, 0.0, 0.0], [0.5, 0.2, 0.1], [0.9, -0.2, 0.4]], ROTATIONS, axis=0)
    return 1, [new(place, wp.vec3), ROTATIONS, 0.8], [new(np.zeros(2))]


def in_frame_rotation_loss(new):
    pose = new(size=(CAMERAS, 7), low=-0.3, high=0.3)
    bearing = new([[0.9, 0.5], [0.0, 0.0], [2.9, 2.4]], wp.vec2)
    bearing.requires_grad = False
    frame_state = new.integers([thesis.IN_FRAME, thesis.NEVER_SEEN, thesis.SEEN_OUT_OF_FRAME])
    return CAMERAS, [pose, new.integers(ASSIGNED), bearing, frame_state, 0.3], [new(np.zeros(VEHICLES))]


def measures(new):
    return new(size=(CAMERAS * ROTATIONS, VEHICLES, int(measure.MEASURE_COUNT)), low=0.5, high=2.0)


def sum_area_around(new):
    inputs = [measures(new), new.integers(ASSIGNED), ROTATIONS, int(measure.AMODAL_AREA)]
    return VEHICLES, inputs, [new(np.zeros(VEHICLES))]


def detected_area_loss(new):
    inputs = [measures(new), new(size=VEHICLES, low=4.0, high=6.0), new.integers(ASSIGNED), ROTATIONS, 0.8, 0.1]
    return VEHICLES, inputs, [new(np.zeros(VEHICLES))]


def object_visibility_loss(new):
    inputs = [measures(new), new(size=VEHICLES, low=4.0, high=6.0), new.integers(ASSIGNED), ROTATIONS, 0.8]
    return VEHICLES, inputs, [new(np.zeros(VEHICLES))]


def surface_blockage_loss(new):
    unblocked = new(size=(CAMERAS * ROTATIONS, VEHICLES, 1), low=0.1, high=0.4)
    inputs = [measures(new), unblocked, new.integers(ASSIGNED), new.integers([0, -1, 1]), ROTATIONS, 1.0]
    return VEHICLES, inputs, [new(np.zeros(VEHICLES))]


def angular_coverage_loss(new):
    # of three ranges of 1.5 rad one ends before the next, two overlap
    pose = new(np.c_[np.zeros((3, 2)), [3.0, 0.2, -1.0], np.zeros((3, 4))])
    return 1, [pose, new.integers([2, 0, 1]), new.integers([1, 0, 0]), 1.5], [new(np.zeros(1))]


def mean_vehicle_loss(new):
    return 1, [new(size=VEHICLES), 2], [new(np.zeros(1))]


def lagrangian_of_losses(new):
    sizes = (2, 2, 3, 3, 3)
    return 1, [*(new(size=size, low=0.5, high=2.0) for size in sizes), 2.0, 0.7], [new(np.zeros(1))]


def place_level_cameras(new):
    inputs = [new(size=(CAMERAS, 3), dtype=wp.vec3), new(size=CAMERAS)]
    views = CAMERAS * int(benchmark.ROTATION_COUNT)
    outputs = [new(np.zeros((views, 3)), wp.vec3), new(np.zeros((views, 3, 3)), wp.mat33)]
    return (CAMERAS, int(benchmark.ROTATION_COUNT)), inputs, outputs


def sum_target_areas(new):
    return VIEWS, [new(size=(VIEWS, VEHICLES, 1)), new(size=VEHICLES)], [new(np.zeros(VIEWS))]


def box_solid_angle(new):
    # from above, from beside, from below and off a corner; the boxes are turned
    place = new([[0.2, 0.3, 3.0], [2.5, 0.1, 0.3], [0.1, -0.4, -2.5], [-2.0, 2.2, 2.4]], wp.vec3)
    turn = np.linspace(0.2, 1.1, VEHICLES)
    middle = new(size=(VEHICLES, 3), dtype=wp.vec3, low=-0.2, high=0.2)
    half_size = new(size=(VEHICLES, 3), dtype=wp.vec3, low=0.5, high=1.0)
    along = new(np.stack([np.cos(turn), np.sin(turn)], axis=1), wp.vec2)
    return VIEWS, [place, middle, half_size, along], [new(np.zeros((VIEWS, VEHICLES)))]


def line_of_sight(new):
    lenses = np.zeros(VIEWS, Lens.numpy_dtype())
    lenses["kind"] = np.resize([PINHOLE, FISHEYE, PANORAMA], VIEWS)
    place, away = new(size=(VIEWS, 3), dtype=wp.vec3, low=-0.2, high=0.2), new.rng.normal(size=(VEHICLES, 3))
    turn = new(new.rng.normal(0.0, 0.1, (VIEWS, 3, 3)) + np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]]), wp.mat33)
    middle = new(away * [0.2, 0.3, 0.3] + [2.0, 0.0, 0.0], wp.vec3)
    lens = wp.array(lenses, dtype=Lens, device=new.device)
    return VIEWS, [place, turn, lens, middle], [new(np.zeros((VIEWS, VEHICLES))), new(np.zeros((VIEWS, VEHICLES)))]


def lidar_finds(new):
    points = new(size=(VIEWS, VEHICLES, 1), low=1.0, high=9.0)
    distance = new(size=(VIEWS, VEHICLES), low=40.0, high=60.0)
    out = [new(np.zeros((VIEWS, VEHICLES))), new(np.zeros((VIEWS, VEHICLES)))]
    half, range_m = new(size=VEHICLES, low=2.0, high=6.0), new(size=VEHICLES, low=48.0, high=52.0)
    return (VIEWS, VEHICLES), [points, distance, half, 2.7, range_m, new(size=(VIEWS, VEHICLES), low=0.5)], out


def zone_excess(new):
    # in the middle of cells of half a metre; beyond the border, and beyond a corner
    pose = new(np.c_[[[0.8, -0.2], [1.2, 4.0], [-1.0, -2.5]], np.zeros((3, 5))])
    return 3, [pose, new(size=(5, 4)), wp.vec2(0.0, -1.0), 0.5, 0.05], [new(np.zeros(3))]


def spacing_excess(new):
    return 1, [new(size=(4 * ROTATIONS, 3), dtype=wp.vec3), ROTATIONS, 0.8], [new(np.zeros(4 + 6))]


def keep_excess(new):
    return 3, [new(size=6), new.integers([0, 3, 5])], [new(np.zeros(3))]


def damped_lagrangian(new):
    # broken, nearly kept with a multiplier, kept by far with one, and with a small one
    excess, multiplier = new([0.6, -0.2, -0.9, -0.5]), new([0.5, 1.2, 0.6, 0.1])
    return 1, [new(size=2), new(size=2), excess, multiplier, 1.5], [new(np.zeros(1))]


def probability_of_detection(new):
    # values of every measure: areas down to a part of a pixel, extents near a corner and in the middle
    areas = new.rng.uniform([0.3, 8.0, 0.0], [6.0, 12.0, 1.0], (VIEWS, VEHICLES, 3))
    extents = new.rng.uniform([1.0, 4.0, 0.5, 5.0], [2.0, 6.0, 1.5, 7.0], (VIEWS, VEHICLES, 4))
    pairs, curves = (VIEWS, VEHICLES), int(detection_probability.FEATURE_COUNT)
    inputs = [new(np.concatenate([areas, extents], axis=2)), new(size=(*pairs, 1), low=0.2, high=0.5)]
    inputs += [new(size=pairs, low=0.6, high=0.9), *(new(size=pairs, low=0.1, high=0.5) for _ in range(3))]
    inputs += [new.integers(np.arange(VEHICLES) % 3), 9.0, 10.0, 1.1, 0.9, new(size=(2, curves, 5))]
    inputs += [new(size=curves, low=-0.5, high=0.0), new(size=curves, low=0.3, high=0.6), new(size=2)]
    outputs = [new(np.zeros((*pairs, curves))), new(np.zeros(pairs))]
    return pairs, inputs, outputs


def sum_over_panorama(new):
    inputs = [new(size=(CAMERAS * ROTATIONS, VEHICLES, 1)), ROTATIONS]
    return (CAMERAS, VEHICLES), inputs, [new(np.zeros((CAMERAS, VEHICLES)))]


def camera_probability(new):
    pairs = (CAMERAS, VEHICLES)
    best_view = new.integers([[0, 1, 0], [3, 2, 3]])
    inputs = [new(size=(CAMERAS * ROTATIONS, VEHICLES), low=0.1, high=0.9), best_view]
    inputs += [new(size=pairs, low=0.1, high=0.5), new(size=pairs, low=0.5, high=0.9), new([0.4]), ROTATIONS]
    return pairs, inputs, [new(np.zeros(pairs))]


def log_missed(new):
    pairs = (CAMERAS, VEHICLES)
    counted_camera = new.integers([-1] * (VEHICLES - 1) + [1])
    inputs = [new(size=pairs, low=0.1, high=0.9), new(size=pairs, low=0.1, high=0.9), new([0.4]), counted_camera]
    return VEHICLES, inputs, [new(np.zeros(VEHICLES))]


def box_share(new):
    pairs = (CAMERAS, VEHICLES)
    return pairs, [new(size=(*pairs, int(detection_probability.FEATURE_COUNT))), 1], [new(np.zeros(pairs))]


def missed(new):
    return 1, [new(size=VEHICLES, low=-2.0, high=0.0), new(size=VEHICLES, low=0.0, high=2.0)], [new(np.zeros(1))]


CASES = {
    linearise.split_pose_kernel: split_pose,
    linearise.linearise_measures_kernel: linearise_measures,
    linearise.linearise_window_kernel: linearise_window,
    mount_pose.place_on_surface_kernel: place_on_surface,
    mount_pose.place_windows_kernel: place_windows,
    thesis.out_of_bounds_loss_kernel: out_of_bounds_loss,
    thesis.camera_spacing_loss_kernel: camera_spacing_loss,
    constraint_losses.zone_excess_kernel: zone_excess,
    constraint_losses.spacing_excess_kernel: spacing_excess,
    constraint_losses.keep_excess_kernel: keep_excess,
    thesis.in_frame_rotation_loss_kernel: in_frame_rotation_loss,
    thesis.sum_area_around_kernel: sum_area_around,
    thesis.detected_area_loss_kernel: detected_area_loss,
    thesis.object_visibility_loss_kernel: object_visibility_loss,
    thesis.surface_blockage_loss_kernel: surface_blockage_loss,
    thesis.angular_coverage_loss_kernel: angular_coverage_loss,
    thesis.mean_vehicle_loss_kernel: mean_vehicle_loss,
    detection_probability.box_solid_angle_kernel: box_solid_angle,
    detection_probability.line_of_sight_kernel: line_of_sight,
    detection_probability.detection_probability_kernel: probability_of_detection,
    lidar_probability.lidar_probability_kernel: lidar_finds,
    expected_misses.sum_over_panorama_kernel: sum_over_panorama,
    expected_misses.camera_probability_kernel: camera_probability,
    expected_misses.box_share_kernel: box_share,
    expected_misses.log_missed_kernel: log_missed,
    expected_misses.expected_misses_kernel: missed,
    lagrangian.lagrangian_kernel: lagrangian_of_losses,
    lagrangian.damped_lagrangian_kernel: damped_lagrangian,
    benchmark.place_level_cameras_kernel: place_level_cameras,
    benchmark.sum_target_areas_kernel: sum_target_areas,
}


def test_every_taped_kernel_is_checked():
    modules = read_modules(Path(__file__).parents[2] / "kernels" / "warpav_kernels")
    taped = {
        function.name
        for module in modules
        for function in module.functions
        if function.kind == "kernel" and function.is_differentiable(module.enable_backward)
    }
    assert {kernel.key for kernel in CASES} == taped, "say in CASES with what arrays it is checked"


@pytest.mark.parametrize("kernel", [pytest.param(kernel, id=kernel.key) for kernel in CASES])
def test_gradient_matches_differences(device, rng, kernel):
    dim, inputs, outputs = CASES[kernel](Arrays(device, rng))
    # worst seen 7e-4 of the Lagrangian, 1e-4 of the others: the grain of float32 over the step
    assert gradcheck(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device, eps=2e-3, atol=2e-3, rtol=0.0)
    # not the equality of nothing
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device)
    assert any(output.numpy().any() for output in outputs)
