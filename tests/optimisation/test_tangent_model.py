"""The model of what a rig misses near rendered rigs: exact where logits are least planes, with an exact gradient."""

import numpy as np
import pytest

from tests.optimisation.calls import polish
from tests.optimisation.test_polish import zone_of
from tests.optimisation.test_pool import mount_of, poses_of
from warpav.detection import expected_miss_rate
from warpav.optimisation._tangent_model import CONTRADICTION, Rendered, TangentModel

SLOPE = np.random.default_rng(0).normal(size=(3, 5, 7))  # [camera, object, number]
PLANES = np.stack([SLOPE, SLOPE * np.r_[-2.0, np.ones(6)]])  # they meet where the first number is 0
WEIGHT = np.full(5, 0.2)
REACH = np.full(7, 10.0)


def rendered(pose, which=np.argmin):
    """Cameras whose logits are the least (or the greatest) of two planes."""
    pose = np.asarray(pose, np.float32)
    side = which(np.einsum("pcok,ck->pco", PLANES, pose), axis=0)
    slope = np.take_along_axis(PLANES, side[None, ..., None], axis=0)[0]
    probability = 1.0 / (1.0 + np.exp(-np.einsum("cok,ck->co", slope, pose)))
    jacobian = (probability * (1.0 - probability))[..., None] * slope
    return Rendered(pose, probability, jacobian, expected_miss_rate(probability))


def two_sides(seed, **options):
    """Rigs with the first number below and above 0, and a move from the first one beyond 0."""
    pose = 0.5 * np.random.default_rng(seed).normal(size=(3, 3, 7))
    pose[:, :, 0] = np.array([-0.3, 0.2, 0.6])[:, None]
    return rendered(pose[0], **options), [rendered(pose[1], **options)], pose[2] - pose[0]


def test_with_both_planes_seen_the_model_is_what_a_render_finds():
    here, earlier, moved = two_sides(1)
    truth = rendered(here.mount_pose + moved).objective
    alone = TangentModel(here, WEIGHT)
    both = TangentModel(here, WEIGHT, earlier=earlier, reach=REACH)
    assert abs(alone.value(moved) - truth) > 0.05
    assert both.value(moved) == pytest.approx(truth, abs=1e-3)  # kinks are rounded
    assert both.value(np.zeros((3, 7))) == pytest.approx(here.objective, abs=1e-3)


@pytest.mark.parametrize("charge", [None, np.linspace(0.0, 0.4, 5)], ids=["misses", "false alarms"])
def test_the_gradient_is_that_of_differences(charge):
    here, earlier, moved = two_sides(3)
    model = TangentModel(here, WEIGHT, earlier=earlier, reach=REACH, charge=charge)
    unsure = here.probability * (1.0 - here.probability)
    alone = TangentModel(here, WEIGHT, charge=charge).value(np.zeros((3, 7)))
    assert alone - here.objective == pytest.approx(0.0 if charge is None else (unsure @ charge).sum(), abs=1e-6)
    moved[:, 0] = 0.302  # right at the kinks
    gradient = model.value_and_gradient(moved)[1]
    for camera, number in np.ndindex(3, 7):
        step = np.zeros((3, 7))
        step[camera, number] = 1e-6
        difference = (model.value(moved + step) - model.value(moved - step)) / 2e-6
        assert gradient[camera, number] == pytest.approx(difference, abs=1e-6)


def test_tangents_that_were_proven_wrong_do_not_count():
    """Where a logit is the greatest of two planes, the other one lies below what was rendered."""
    here, earlier, moved = two_sides(6, which=np.argmax)
    others = earlier[0].logit + np.einsum("cok,ck->co", earlier[0].slope, here.mount_pose - earlier[0].mount_pose)
    far = others < here.logit - CONTRADICTION
    assert far.mean() > 0.5
    model = TangentModel(here, WEIGHT, earlier=earlier, reach=REACH)
    for pair in np.argwhere(far):
        assert np.isinf(model._logit[pair[0], 1, pair[1]])
    kept = Rendered(here.mount_pose, here.probability * far, here.jacobian * far[..., None], 0.0)
    alone = TangentModel(kept, WEIGHT)
    assert TangentModel(kept, WEIGHT, earlier=earlier, reach=REACH).value(moved) == pytest.approx(alone.value(moved))


def test_a_polish_follows_a_ridge_of_two_planes():
    """One camera, one object: surest where two planes meet, and along that line ever surer to the left."""
    mount = mount_of(free=None)
    start = poses_of(1, mount)
    start[:, :3] = 0.0, -0.3, 0.15

    def detect(pose):
        y_m, yaw = float(pose[0, 1]), float(pose[0, 2])
        side = 8.0 if yaw > 0.3 * y_m else -8.0
        logit = y_m - side * (yaw - 0.3 * y_m)
        probability = 1.0 / (1.0 + np.exp(-logit))
        jacobian = np.zeros((1, 1, 7))
        jacobian[0, 0, 1:3] = probability * (1.0 - probability) * np.array([1.0 + 0.3 * side, -side])
        return np.array([[probability]]), jacobian

    constraints = zone_of(mount, 1)
    *_, last = polish(start, detect, mount=mount, constraints=constraints, scene_count=1)
    y_m = float(last.mount_pose[0, 1])
    assert y_m > 0.45  # seen .55; steps that follow one tangent only go to and fro at -.12
    assert last.objective == pytest.approx(1.0 / (1.0 + np.exp(y_m)), abs=0.01)
