"""Polish: exact Jacobians object by object, steps that keep their promises, rigs within the constraints."""

import math

import numpy as np
import pytest

from tests.driving_scene import ConstantDetector
from tests.optimisation.objectives import rig_objective
from tests.optimisation.test_pool import cameras_of, mount_of, poses_of, streets
from warpav.optimisation.assignment import AssignedScene
from warpav.optimisation.polish import SUREST, expected_miss_rate
from warpav.optimisation.settings import LossSettings
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
