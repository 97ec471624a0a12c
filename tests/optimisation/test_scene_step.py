"""One scene's step: recorded launches do what launches do, and the same again and again."""

import numpy as np
import pytest
import warp as wp

from tests.driving_scene import packed_street, roof
from tests.optimisation.objectives import OneScene, thesis_losses
from warpav.optimisation import AssignedScene, CameraMount, Reference
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer

MODEL = CameraModel(128, 128)
POSE = np.array([[1.61, 0.31, 0.15, 0.0, 0.0, 0.0, 0.0], [0.43, -0.27, 3.35, 0.0, 0.0, 0.0, 0.0]], np.float32)


class Steps:
    """A step of two cameras on a street, with boxes that cut through what they see."""

    def __init__(self, device, *, recorded, occlusion=Occlusion.EXACT, car_count=10, renderer=None):
        mount = CameraMount(roof(), camera=MODEL, height_offset_m=0.25, device=device)
        self.renderer = renderer or Renderer(
            [MODEL] * (2 * mount.rotation_count),
            occlusion=occlusion,
            device=device,
            thread_count=1,
            foreground_layer=True,
        )
        scene = packed_street(device, car_count, 1)
        self.one = OneScene(
            mount,
            self.renderer,
            AssignedScene(scene, (np.arange(car_count) % 2).astype(np.int32)),
            2,
            thesis_losses(
                epsilon=0.05, surface_blockage=3.0, object_visibility=2.0, angular_coverage=1.5, min_unblocked_area=1.0
            ),
            reference=Reference.ALONE,
            recorded=recorded,
        )
        self.step = self.one.step
        self.box_px = np.tile(np.float32([20.0, 30.0, 100.0, 90.0]), (2, car_count, 1))

    def at(self, pose):
        """Image, losses and gradient there."""
        loss, gradient = self.one.at(pose, self.box_px)
        self.step.draw()
        self.step.loss()
        np.testing.assert_array_equal(self.step.losses.value.numpy(), loss)
        return self.step.image.numpy().copy(), loss, gradient


@pytest.mark.parametrize("occlusion", list(Occlusion))
def test_recorded_steps_equal_launched_ones(device, rng, occlusion):
    launched = Steps(device, recorded=False, occlusion=occlusion)
    recorded = Steps(device, recorded=True, occlusion=occlusion)
    for _ in range(4):  # the first call launches, the second records, the others replay
        pose = POSE + rng.uniform(-0.1, 0.1, POSE.shape).astype(np.float32)
        expected, found = launched.at(pose), recorded.at(pose)
        assert np.abs(expected[2][:, :3]).max() > 0.05
        for one, other in zip(expected, found, strict=True):
            np.testing.assert_array_equal(other, one)


def test_steps_repeat_bit_by_bit(device):
    steps = Steps(device, recorded=None)
    first = steps.at(POSE)
    for _ in range(3):
        for one, other in zip(first, steps.at(POSE), strict=True):
            np.testing.assert_array_equal(other, one)


def test_replays_write_into_nobody_elses_memory(device, rng):
    """What a recorded step allocated and let go is not handed to others while it replays."""
    steps = Steps(device, recorded=True)
    for _ in range(3):
        steps.at(POSE)
    others = [wp.full(int(size), 7.0, dtype=float, device=device) for size in rng.integers(4, 100_000, 300)]
    for _ in range(3):
        steps.at(POSE + rng.uniform(-0.05, 0.05, POSE.shape).astype(np.float32))
    assert all((other.numpy() == 7.0).all() for other in others)


def test_a_recording_that_ran_out_of_room_is_made_again(device):
    steps, fresh = Steps(device, recorded=True), Steps(device, recorded=False)
    far_above = np.array([[0.0, 0.0, 0.0, -1.5, 0.0, 0.0, 0.0]] * 2, np.float32)  # sees hardly a car
    for _ in range(3):
        steps.at(far_above)
    while True:
        found = steps.at(POSE)
        if not steps.renderer.grew():
            break
    for one, other in zip(fresh.at(POSE), found, strict=True):
        np.testing.assert_array_equal(other, one)


@pytest.mark.parametrize("car_counts", [(10, 2), (2, 10)])
def test_a_first_launch_after_replays_measures_its_own_scene(device, car_counts):
    # one renderer for two scenes of different numbers of vehicles: the buffers of one are not the other's
    losses = []
    for recorded in (False, True):
        one = Steps(device, recorded=recorded, car_count=car_counts[0])
        other = Steps(device, recorded=recorded, car_count=car_counts[1], renderer=one.renderer)
        for _ in range(3):
            for steps in (one, other):
                steps.one.at(POSE, steps.box_px)
        one.step.observe()
        one.step.loss()  # its first call
        losses.append(one.step.losses.value.numpy().copy())
        assert losses[-1][0] > 0.1
    np.testing.assert_array_equal(*losses)
