"""Polish: exact Jacobians object by object, steps that keep their promises, rigs within the constraints."""

import itertools
import math

import numpy as np
import pytest

from tests.driving_scene import ConstantDetector
from tests.optimisation.calls import polish
from tests.optimisation.objectives import rig_objective
from tests.optimisation.test_pool import cameras_of, mount_of, poses_of, streets
from warpav.detection import SUREST, expected_miss_rate, expected_miss_slope
from warpav.optimisation import AssignedScene, FreeRanges, LossSettings, ZoneAndSpacing
from warpav.optimisation import _polish as module
from warpav.optimisation._tangent_model import Rendered, TangentModel
from warpav.raster.camera import CameraModel

WHOLE = CameraModel(96, 96, math.pi / 2)


def jacobian_of(cameras, pose):
    return cameras.with_jacobian(pose, streets())


def test_probabilities_are_those_of_the_pool():
    cameras, pose = cameras_of(), poses_of(5)
    found, jacobian = jacobian_of(cameras, pose)
    expected = np.concatenate([cameras.detection_probability(pose, scene) for scene in streets()], axis=1)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert jacobian.shape == (5, 10, 7)
    assert not jacobian[found == 0.0].any()


@pytest.mark.parametrize("kind", ["fitted", "visible_share"])
def test_the_jacobian_adds_up_to_the_gradient_on_the_tape(kind):
    """The mean product of misses has the gradient that the loss has, which differences of renders are held to."""
    cameras, mount = cameras_of(probability=kind), mount_of()
    settings = LossSettings(expected_miss_rate=1.0, probability=kind, detector_share=0.0)
    objective = rig_objective(
        mount,
        ConstantDetector(np.zeros((0, 4)), np.zeros(0)),
        settings=settings,
        probability=cameras.probability.model,
        camera_count=3,
        occlusion=cameras.occlusion,
    )
    assigned = [AssignedScene(scene, np.zeros(scene.vehicle_count, np.int32)) for scene in streets()]
    worst = 0.0
    for seed in range(3):
        pose = poses_of(3, seed=seed)
        expected = objective.evaluate(pose, assigned, gradient=True, with_constraints=False)
        found, jacobian = jacobian_of(cameras, pose)
        missed = 1.0 - np.minimum(found, SUREST)
        product = missed.prod(axis=0)
        slope = np.where(found < SUREST, -product / missed, 0.0)
        gradient = np.einsum("co,cok->ck", slope, jacobian) / found.shape[1]
        assert expected_miss_rate(found, np.full(10, 0.1)) == pytest.approx(expected.objective, abs=1e-6)
        scale = np.abs(expected.gradient).max()
        assert scale > 1e-3
        worst = max(worst, np.abs(gradient - expected.gradient).max() / scale)
    assert worst < 2e-4, worst


def test_the_slope_of_the_miss_rate_is_that_of_its_differences(rng):
    """Probabilities that are linear in the mount poses; without weights and with some."""
    found, jacobian = rng.uniform(0.1, 0.8, (3, 6)), rng.normal(size=(3, 6, 7))
    for weight in (None, rng.dirichlet(np.ones(6))):
        slope = expected_miss_slope(found, jacobian, weight)
        for camera, number in itertools.product(range(3), range(7)):
            change = np.zeros_like(found)
            change[camera] = 1e-6 * jacobian[camera, :, number]
            ends = [expected_miss_rate(found + side * change, weight) for side in (1.0, -1.0)]
            assert slope[camera, number] == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=1e-8)  # worst seen 2e-10


def zone_of(mount, camera_count=3, frozen=None, min_spacing_m=0.3):
    spacing = {"min_spacing_m": min_spacing_m, "margin_m": 0.05}
    return ZoneAndSpacing(mount.surface, camera_count=camera_count, frozen=frozen, **spacing)


def polished(cameras, pose, constraints, **options):
    steps = polish(
        pose,
        lambda moved: cameras.with_jacobian(moved, streets()),
        mount=cameras.mount,
        constraints=constraints,
        scene_count=len(streets()),
        **options,
    )
    return list(steps)


@pytest.mark.parametrize("free", [None, FreeRanges(pitch_rad=(-0.2, 0.3))])
def test_every_step_is_no_worse_and_within_the_constraints(free):
    mount = mount_of(free=free, model=WHOLE)
    cameras, constraints = cameras_of(mount=mount), zone_of(mount)
    steps = polished(cameras, poses_of(3, mount), constraints)
    objectives = [step.objective for step in steps]
    assert objectives[-1] < 0.9 * objectives[0]
    assert all(after <= before for before, after in itertools.pairwise(objectives))
    for step in steps:
        assert constraints.violation_m(mount.rig(step.mount_pose)) == 0.0
        np.testing.assert_array_equal(mount.within(step.mount_pose), step.mount_pose)
    found = cameras.with_jacobian(steps[-1].mount_pose, streets())[0]
    assert expected_miss_rate(found, np.full(10, 0.1)) == pytest.approx(objectives[-1], abs=1e-9)
    fixed = [number for number in range(3, 7) if not mount.is_free[number]]
    assert not steps[-1].mount_pose[:, fixed].any()


def test_renders_are_counted_as_they_are_made():
    mount = mount_of(free=None, model=WHOLE)
    cameras, made = cameras_of(mount=mount), []

    def detect(pose):
        made.append(len(pose) * len(streets()))
        return cameras.with_jacobian(pose, streets())

    options = {"mount": mount, "constraints": zone_of(mount), "scene_count": len(streets())}
    *_, last = polish(poses_of(3, mount), detect, **options)
    assert len(made) > 1
    assert last.camera_renders == sum(made)


def test_the_first_step_comes_near_what_was_promised():
    """The model is exact to first order: within a small radius, what it promises comes true."""
    mount = mount_of(free=None, model=CameraModel(256, 256, math.pi / 2))
    cameras, constraints = cameras_of(mount=mount), zone_of(mount)
    pose = polished(cameras, poses_of(3, mount), constraints, camera_renders_max=9)[0].mount_pose
    probability, jacobian = cameras.with_jacobian(pose, streets())
    weight = np.full(10, 0.1)
    before = expected_miss_rate(probability, weight)
    problem = module._Problem(mount, constraints, pose)
    model = TangentModel(Rendered(pose, probability, jacobian, before), weight)
    assert model.value(np.zeros((3, 7))) == pytest.approx(before, abs=1e-6)
    tried = module.nearest_rig(problem.minimised(model, pose, 0.05), mount, constraints)
    promised = model.value(tried - pose)
    found = expected_miss_rate(cameras.with_jacobian(tried, streets())[0], weight)
    assert before - promised > 1e-3
    assert (before - found) / (before - promised) == pytest.approx(1.0, abs=0.3)


def test_the_budget_is_kept_and_frozen_cameras_stay():
    mount = mount_of(free=None)
    rig = mount.rig(poses_of(3, mount))
    frozen = mount.freezing(rig, [rig.cameras[1].name])
    constraints = zone_of(frozen, frozen=frozen.frozen)
    cameras = cameras_of(mount=frozen)
    steps = polished(cameras, frozen.mount_pose_of_rig(rig), constraints, camera_renders_max=31)
    assert [step.camera_renders for step in steps][-1] <= 31
    assert len(steps) > 1
    for step in steps:
        np.testing.assert_array_equal(step.mount_pose[1], frozen.frozen.mount_pose[1])
    assert polished(cameras, frozen.mount_pose_of_rig(rig), constraints, camera_renders_max=9)[-1].camera_renders == 9


def test_steps_may_rise_and_go_back_to_the_best_where_they_rise_by_much():
    """On an objective with a bump: taking only what is better ends before it, the schedule comes over it."""
    mount = mount_of(free=None)
    start = poses_of(1, mount)
    start[:, :2] = 0.0
    calls = []

    def detect(pose):
        """Better and better to the left, but for a bump of 2 cm."""
        y_m = float(pose[0, 1])
        calls.append(y_m)
        bump = 0.03 * np.exp(-((y_m - 0.05) ** 2) / 2e-4)
        probability = 0.5 + 0.4 * y_m - bump
        jacobian = np.zeros((1, 1, 7))
        jacobian[0, 0, 1] = 0.4
        return np.array([[probability]]), jacobian

    steps = list(polish(start, detect, mount=mount, constraints=zone_of(mount, 1), scene_count=1))
    assert max(calls) == max(step.mount_pose[0, 1] for step in steps) > 0.15
    assert steps[-1].objective == min(step.tried_objective for step in steps)
