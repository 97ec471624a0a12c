"""The search by a pool as a run: records, candidates, and objectives that it cannot search for."""

import numpy as np
import pytest

from tests.driving_scene import ConstantDetector
from tests.optimisation.objectives import rig_objective, thesis_losses
from tests.optimisation.test_polish import zone_of
from tests.optimisation.test_pool import cameras_of, mount_of, poses_of, streets
from tests.optimisation.test_pool_search import SMALL
from warpav.core.errors import InputError
from warpav.optimisation.losses.scene_on_tape import AssignedScene
from warpav.optimisation.objective import single_cameras_of
from warpav.optimisation.pool_descent import PoolDescent
from warpav.optimisation.settings import LossSettings


def objective_of(settings=None):
    mount = mount_of(free=None)
    return rig_objective(
        mount,
        ConstantDetector(np.zeros((0, 4)), np.zeros(0)),
        settings=settings or LossSettings(expected_miss_rate=1.0),
        probability=cameras_of().probability.model,
        camera_count=3,
        constraints=zone_of(mount),
    )


def scenes():
    return [AssignedScene(scene, np.zeros(scene.vehicle_count, np.int32)) for scene in streets()]


def descent_of(objective=None):
    objective = objective or objective_of()
    return PoolDescent(objective, scenes(), poses_of(3), SMALL, seed=0)


def test_a_run_goes_from_its_start_to_a_verdict():
    descent, records = descent_of(), []
    while descent.verdict is None:
        records.append(descent.step())
    assert records[0].stage == "start"
    assert records[-1].stage == "settled"
    assert [record.iteration for record in records] == list(range(len(records)))
    assert records[-1].training_objective == descent.finish().training_objective
    assert records[-1].training_objective < 0.9 * records[0].training_objective
    renders = [record.camera_renders for record in records]
    assert renders == sorted(renders)
    assert "camera renders" in descent.verdict


def test_objectives_are_those_of_the_objective():
    objective = objective_of()
    descent = descent_of(objective)
    while descent.verdict is None:
        record = descent.step()
        found = objective.evaluate(descent.mount_pose, scenes())
        assert record.training_objective == pytest.approx(found.objective, abs=1e-6)
    first = descent.candidates[0]
    constraints, mount = objective.constraints, objective.mount
    np.testing.assert_allclose(first.mount_pose[:, :2], constraints.project(poses_of(3)[:, :2], np.zeros(3)), atol=1e-5)
    assert constraints.violation_m(mount.rig(first.mount_pose)) == 0.0


@pytest.mark.parametrize(
    "settings",
    [
        LossSettings(expected_miss_rate=0.5),
        LossSettings(expected_miss_rate=1.0, probability="visible_share"),
        LossSettings(expected_miss_rate=1.0, object_visibility=1.0),
        LossSettings(expected_miss_rate=1.0, combine="best"),
        LossSettings(expected_miss_rate=1.0, detector_share=0.5),
        thesis_losses(),
    ],
)
def test_settings_know_which_objectives_suit_a_pool(settings):
    assert settings.suits_pool == (single_cameras_of(objective_of(settings)) is not None)


@pytest.mark.parametrize(
    "settings",
    [
        thesis_losses(),
        LossSettings(expected_miss_rate=1.0, combine="best"),
        LossSettings(expected_miss_rate=1.0, detector_share=0.5),
    ],
)
def test_other_losses_are_refused(settings):
    with pytest.raises(InputError, match=r"^optimiser.search: expected descent, as a pool knows the loss"):
        descent_of(objective_of(settings))
