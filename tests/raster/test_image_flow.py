"""Gradients of colour and depth images on the tape against central differences of supersampled renders."""

import functools
import math

import numpy as np
import pytest
import warp as wp
from scipy.ndimage import gaussian_filter

from tests.driving_scene import on_device
from tests.raster.test_gradients import SIX, SIX_WEIGHT, SPIN_X, moved, poses_round_the_car, two_cars
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.chunks import record_graph
from warpav.raster.poses import ViewPoses
from warpav.raster.renderer import Renderer
from warpav.scene import DeviceScene

SIZE_PX, FOV_RAD, POSE_COUNT = 96, math.radians(80.0), 10
# Steps of a few of the truth's samples; the truth is the mean of them over a pixel.
TRUTH_SAMPLES, STEP_M, STEP_RAD, STEP_ZOOM = 8, 0.06, 0.006, 0.01
SKY_DEPTH_M = 100.0
ZOOM = 6  # direction after the six of the pose


def model(scale=1, zoom=1.0):
    return CameraModel(SIZE_PX * scale, SIZE_PX * scale, 2.0 * math.atan(math.tan(0.5 * FOV_RAD) / zoom), 0.1)


@functools.cache
def scene_on(device):
    return DeviceScene.pack(two_cars(), device=device).raster


def slopes(look):
    """Central differences of ``look(poses, zoom)``, [direction, pose, ...]: the six of the pose, then zoom."""
    poses, columns = poses_round_the_car()[:POSE_COUNT], []
    for direction in SIX:
        step = STEP_M if direction < SPIN_X else STEP_RAD
        columns.append((look(moved(poses, direction, step)) - look(moved(poses, direction, -step))) / (2.0 * step))
    columns.append((look(poses, math.exp(STEP_ZOOM)) - look(poses, math.exp(-STEP_ZOOM))) / (2.0 * STEP_ZOOM))
    return np.stack(columns)


@functools.cache
def true_colours(device):
    """Mean colour of every pixel [pose, row, column, channel], and its slopes."""
    renderer = Renderer([model()] * POSE_COUNT, supersampling=TRUTH_SAMPLES, device=device)

    def look(at, zoom=1.0):
        renderer.set_lenses([model(zoom=zoom)] * POSE_COUNT)
        frame = renderer.render(scene_on(device), *on_device(at, device), content=Content.IMAGES)
        return frame.colours().numpy()

    return look(poses_round_the_car()[:POSE_COUNT]), slopes(look)


@functools.cache
def true_depth_slopes(device):
    """Slopes of the mean depth of every pixel."""
    renderer = Renderer([model(TRUTH_SAMPLES)] * POSE_COUNT, device=device)

    def look(at, zoom=1.0):
        renderer.set_lenses([model(TRUTH_SAMPLES, zoom)] * POSE_COUNT)
        frame = renderer.render(scene_on(device), *on_device(at, device), content=Content.IMAGES)
        depth_m = frame.depths_and_ids()[0].numpy()
        depth_m[np.isinf(depth_m)] = SKY_DEPTH_M
        return depth_m.reshape(POSE_COUNT, SIZE_PX, TRUTH_SAMPLES, SIZE_PX, TRUTH_SAMPLES).mean(axis=4).mean(axis=2)

    return slopes(look)


class Look:
    """A render whose images go on a tape."""

    def __init__(self, device, poses, *, supersampling=1, scene=None, camera=None, thread_count=None):
        self.device, self.poses = device, np.asarray(poses)
        self.scene = scene_on(device) if scene is None else DeviceScene.pack(scene, device=device).raster
        self.renderer = Renderer(
            [camera or model()] * len(poses), supersampling=supersampling, device=device, thread_count=thread_count
        )
        self.position, self.rotation = on_device(poses, device)
        self.log_zoom = wp.zeros(len(poses), dtype=float, device=device)
        for array in (self.position, self.rotation, self.log_zoom):
            array.requires_grad = True
        self.tape = wp.Tape()
        self.render()

    def render(self):
        self.frame = self.renderer.render(self.scene, self.position, self.rotation, content=Content.IMAGES)

    def rgb(self, shown_view=None):
        with self.tape:
            return self.frame.colours(ViewPoses(self.position, self.rotation, self.log_zoom), views=shown_view)

    def depth(self):
        with self.tape:
            return self.frame.depths(ViewPoses(self.position, self.rotation, self.log_zoom), background_m=SKY_DEPTH_M)

    def gradients(self, image, weight):
        """What the tape makes of an image's gradient: shift, spin about the camera's axes, zoom; [view, 7]."""
        self.tape.backward(grads={image: wp.array(weight, dtype=image.dtype, device=self.device)})
        per_entry, columns = self.rotation.grad.numpy().astype(float), []
        for axis in np.eye(3):
            turned = np.cross(axis, np.eye(3)).T @ self.poses[:, :3, :3].transpose(0, 2, 1)
            columns.append((per_entry * turned).sum(axis=(1, 2)))
        return np.c_[self.position.grad.numpy(), np.stack(columns, axis=1), self.log_zoom.grad.numpy()]


def smooth_weights(rng, channels, width_px=6.0):
    noise = gaussian_filter(rng.normal(size=(POSE_COUNT, SIZE_PX, SIZE_PX, channels)), (0, width_px, width_px, 0))
    return (noise / noise.std()).astype(np.float32)


def agreement(ours, expected):
    """Cosines of the gradients to the pose, their relative errors over all poses, and those of the zoom's."""
    ours_pose, pose = ours[:, :6] * SIX_WEIGHT, expected[:, :6] * SIX_WEIGHT
    cosine = (ours_pose * pose).sum(axis=1) / np.linalg.norm(ours_pose, axis=1) / np.linalg.norm(pose, axis=1)
    zoom_error = np.linalg.norm(ours[:, ZOOM] - expected[:, ZOOM]) / np.linalg.norm(expected[:, ZOOM])
    return cosine, np.linalg.norm(ours_pose - pose) / np.linalg.norm(pose), zoom_error


# Median cosine, and relative errors over all poses of the pose and of the zoom; seen: .9969 .096 .083 and
# .9998 .038 .079 with weights, .9947 .163 .075 and .9961 .129 .063 with a target.
@pytest.mark.parametrize(
    ("loss", "supersampling", "least_cosine", "largest_error"),
    [("weights", 1, 0.995, 0.12), ("weights", 2, 0.998, 0.1), ("target", 1, 0.992, 0.2), ("target", 2, 0.994, 0.16)],
)
def test_colour_gradients_match_differences(device, rng, loss, supersampling, least_cosine, largest_error):
    value, slope = true_colours(device)
    look = Look(device, poses_round_the_car()[:POSE_COUNT], supersampling=supersampling)
    image = look.rgb()
    weight = true_weight = smooth_weights(rng, 3)
    if loss == "target":  # squared distance to the image of the pose before
        target = gaussian_filter(np.roll(value, 1, axis=0), (0, 2, 2, 0))
        weight, true_weight = (2.0 * (shown - target) for shown in (image.numpy(), value))
    cosine, *errors = agreement(look.gradients(image, weight), np.einsum("knijc,nijc->nk", slope, true_weight))
    assert np.median(cosine) >= least_cosine
    assert max(errors) <= largest_error


# seen: .9979 .109 .089 and .9997 .051 .048
@pytest.mark.parametrize(("supersampling", "least_cosine", "largest_error"), [(1, 0.996, 0.14), (2, 0.999, 0.07)])
def test_depth_gradients_match_differences(device, rng, supersampling, least_cosine, largest_error):
    slope = true_depth_slopes(device)
    look = Look(device, poses_round_the_car()[:POSE_COUNT], supersampling=supersampling)
    weight = smooth_weights(rng, 1)[..., 0]
    cosine, *errors = agreement(look.gradients(look.depth(), weight), np.einsum("knij,nij->nk", slope, weight))
    assert np.median(cosine) >= least_cosine
    assert max(errors) <= largest_error


def test_every_image_of_a_view_counts(device, rng):
    poses = poses_round_the_car()[:3]
    weight = rng.normal(size=(1, SIZE_PX, SIZE_PX, 3)).astype(np.float32)
    one, two = Look(device, poses), Look(device, poses)
    found = one.gradients(one.rgb([1]), weight)
    assert not found[[0, 2]].any()
    assert found[1].any()
    np.testing.assert_allclose(two.gradients(two.rgb([1, 1]), np.r_[weight, 2.0 * weight]), 3.0 * found, rtol=1e-4)
    # gradients add up until they are zeroed
    assert one.tape.gradients[one.position] is one.position.grad
    one.tape.backward()
    np.testing.assert_allclose(one.position.grad.numpy(), 2.0 * found[:, :3], rtol=1e-5)
    one.tape.zero()
    assert not one.position.grad.numpy().any()


def test_colours_and_depths_on_one_tape(device, rng):
    poses = poses_round_the_car()[:2]
    rgb_weight, depth_weight = smooth_weights(rng, 3)[:2], smooth_weights(rng, 1)[:2, ..., 0]
    both, colours, depths = (Look(device, poses) for _ in range(3))
    expected = colours.gradients(colours.rgb(), rgb_weight) + depths.gradients(depths.depth(), depth_weight)
    image, depth_m = both.rgb(), both.depth()
    image.grad = wp.array(rgb_weight, dtype=wp.vec3, device=device)
    image.grad.assign(rgb_weight)
    np.testing.assert_allclose(both.gradients(depth_m, depth_weight), expected, rtol=1e-4, atol=1e-2)


def test_a_later_render_is_noticed(device):
    look = Look(device, poses_round_the_car()[:1])
    image = look.rgb()
    look.render()
    with pytest.raises(ValueError, match="got a stale one"):
        look.gradients(image, np.ones((1, SIZE_PX, SIZE_PX, 3), np.float32))


def test_an_infinitely_far_sky_has_no_depth_gradient(device):
    look = Look(device, poses_round_the_car()[:1])
    with pytest.raises(ValueError, match="background_m must be finite where depths have a gradient, got inf"):
        look.frame.depths(ViewPoses(look.position, look.rotation), background_m=math.inf)


def test_a_recorded_step_equals_the_eager_one(device, rng):
    # render, image and backward pass in one graph, replayed at other poses
    weight = wp.array(rng.normal(size=(2, SIZE_PX, SIZE_PX, 3)).astype(np.float32), dtype=wp.vec3, device=device)
    look = Look(device, poses_round_the_car()[:2], thread_count=1)

    def step():
        look.tape.reset()
        for array in (look.position, look.rotation, look.log_zoom):
            array.grad.zero_()
        look.render()
        look.tape.backward(grads={look.rgb(): weight})

    step()
    graph = record_graph(step, device)
    there = on_device(poses_round_the_car()[2:4], device)
    wp.copy(look.position, there[0])
    wp.copy(look.rotation, there[1])
    wp.capture_launch(graph)
    replayed = [array.grad.numpy().copy() for array in (look.position, look.rotation, look.log_zoom)]
    recorded_tape, look.tape = look.tape, wp.Tape()  # a graph goes on using the arrays of the tape that it recorded
    step()
    for one, array in zip(replayed, (look.position, look.rotation, look.log_zoom), strict=True):
        assert one.any()
        np.testing.assert_array_equal(one, array.grad.numpy())
    del recorded_tape
