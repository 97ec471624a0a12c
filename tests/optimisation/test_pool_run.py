"""The search by a pool as a run: records, candidates, and objectives that it cannot search for."""

import dataclasses
import io

import numpy as np
import pytest

from tests.driving_scene import ConstantDetector
from tests.optimisation.objectives import rig_objective, thesis_losses
from tests.optimisation.test_polish import zone_of
from tests.optimisation.test_pool import cameras_of, mount_of, poses_of, streets
from tests.optimisation.test_pool_search import SMALL, short_refinement
from warpav.core.errors import InputError
from warpav.optimisation import AssignedScene, LossSettings, PoolRun, PoolTask, single_cameras_of
from warpav.optimisation.selection._select import BranchAndBound

REFINED = dataclasses.replace(SMALL, pool_cameras=12, rounds=1, refinements=1)


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


def begun(settings=SMALL, objective=None):
    return PoolRun(PoolTask.of(objective or objective_of(), scenes(), start=poses_of(3)), settings, seed=0)


def told(record):
    return {**dataclasses.asdict(record), "seconds": None}


def all_of(run):
    records = []
    while run.stop_reason is None:
        records.append(told(run.step()))
    return records


def written(run):
    """The state as a file keeps it."""
    file = io.BytesIO()
    np.savez(file, **run.state(), allow_pickle=False)
    return file.getvalue()


def resumed(content, settings=REFINED):
    run = begun(settings)
    with np.load(io.BytesIO(content), allow_pickle=False) as state:
        run.restore(dict(state))
    return run


@pytest.fixture(scope="module", autouse=True)
def refinements_are_short():
    with short_refinement():
        yield


@pytest.fixture(scope="module")
def whole():
    """A search at once: its records, its state after each of them, and the run itself."""
    run, records, states = begun(REFINED), [], []
    while run.stop_reason is None:
        records.append(told(run.step()))
        states.append(written(run))
    return records, states, run


def test_objectives_are_those_of_the_objective():
    objective = objective_of()
    descent = begun(objective=objective)
    while descent.stop_reason is None:
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
    assert settings.is_by_single_cameras == (single_cameras_of(objective_of(settings)) is not None)


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
        begun(objective=objective_of(settings))


# --- going on --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("every", [9, pytest.param(1, marks=pytest.mark.slow)])
def test_from_every_state_the_next_one_is_the_same(whole, every):
    records, states, _ = whole
    assert {"start", "selection", "polish", "pricing", "settled"} == {record["stage"] for record in records}
    for number in (*range(1, len(states), every), len(states) - 1):
        run = resumed(states[number - 1])
        assert run.iteration == number
        assert told(run.step()) == records[number]


@pytest.mark.parametrize("number", [pytest.param(1, marks=pytest.mark.nightly), 24])  # without a pool, refining
def test_from_a_state_the_end_is_the_same(whole, number):
    records, states, at_once = whole
    run = resumed(states[number - 1])
    assert all_of(run) == records[number:]
    pool, expected = run.found.pool, at_once.found.pool
    np.testing.assert_array_equal(pool.mount_pose, expected.mount_pose)
    np.testing.assert_array_equal(pool.detection_probability, expected.detection_probability)
    for one, other in zip(run.candidates, at_once.candidates, strict=True):
        np.testing.assert_array_equal(one.mount_pose, other.mount_pose)
        assert (one.training_objective, one.iteration) == (other.training_objective, other.iteration)
    assert run.state().keys() == at_once.state().keys()
    for name, value in at_once.state().items():
        np.testing.assert_array_equal(run.state()[name], value, err_msg=name)


def test_an_interrupted_selection_is_made_again(whole, monkeypatch):
    records, _, _ = whole
    select, calls = BranchAndBound.run, []

    def interrupted_later(self):
        calls.append(None)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return select(self)

    stopped = begun(REFINED)
    with monkeypatch.context() as patch:
        patch.setattr(BranchAndBound, "run", interrupted_later)
        with pytest.raises(KeyboardInterrupt):
            all_of(stopped)
    assert stopped.found.stage == "selection"
    assert not stopped.found.is_final
    run = resumed(written(stopped))
    assert run.iteration == stopped.iteration - 1
    assert told(run.step()) == records[run.iteration - 1]


def test_a_search_that_was_stopped_takes_more_rounds_as_at_once():
    one, two = (dataclasses.replace(SMALL, pool_cameras=12, rounds=rounds) for rounds in (1, 2))
    stopped = begun(one)
    for _ in range(3):
        stopped.step()
    assert all_of(resumed(written(stopped), two)) == all_of(begun(two))[3:]


def test_a_search_that_has_converged_goes_on_where_it_may():
    none, one = (dataclasses.replace(SMALL, pool_cameras=12, rounds=rounds) for rounds in (0, 1))
    ended = begun(none)
    all_of(ended)
    assert resumed(written(ended), none).stop_reason is not None
    further = resumed(written(ended), one)
    assert further.stop_reason is None
    records = [told(further.step()) for _ in range(2)]
    assert [record["stage"] for record in records] == ["pricing", "selection"]
    assert records[0]["iteration"] == ended.iteration
    content = written(further)
    records += all_of(further)
    assert records[-1]["stage"] == "settled"
    assert further.best.training_objective <= ended.best.training_objective
    assert all_of(resumed(content, one)) == records[2:]  # and is stopped and goes on once more


def test_a_state_of_another_search_is_refused(whole):
    _, states, _ = whole
    with np.load(io.BytesIO(states[-1]), allow_pickle=False) as state:
        known = dict(state)
    with pytest.raises(InputError, match="checkpoint: expected the state of a search by a pool, got no words"):
        begun().restore({name: value for name, value in known.items() if name != "words"})
    with pytest.raises(InputError, match="got arrays that do not fit together"):
        begun().restore({**known, "pool_indptr": known["pool_indptr"][:-1]})
    with pytest.raises(InputError, match="got more states than it comes to"):
        begun(REFINED).restore({**known, "iteration": np.array(1000)})
