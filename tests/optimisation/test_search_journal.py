"""A search by a pool that is taken again from its journal: the same states to the bit, and nothing rendered twice."""

import dataclasses
import io

import numpy as np
import pytest

from tests.optimisation.test_pool import poses_of
from tests.optimisation.test_pool_descent import objective_of, scenes
from tests.optimisation.test_pool_search import SMALL, short_refinement
from warpav.core.errors import InputError
from warpav.optimisation.pool_descent import PoolDescent
from warpav.optimisation.search_journal import SearchJournal, _Sparse
from warpav.optimisation.selection.select import BranchAndBound
from warpav.optimisation.single_cameras import SingleCameras

REFINED = dataclasses.replace(SMALL, pool_cameras=12, rounds=1, refinements=1)


def begun(settings=REFINED):
    return PoolDescent(objective_of(), scenes(), poses_of(3), settings, seed=0, is_kept=True)


def told(record):
    return {**dataclasses.asdict(record), "seconds": None}


def written(descent):
    """The state as a file keeps it."""
    file = io.BytesIO()
    np.savez(file, **descent.state(), allow_pickle=False)
    return file.getvalue()


def resumed(content, settings=REFINED):
    descent = begun(settings)
    with np.load(io.BytesIO(content), allow_pickle=False) as state:
        descent.restore(dict(state))
    return descent


def all_of(descent):
    records = []
    while descent.verdict is None:
        records.append(told(descent.step()))
    return records


@pytest.fixture(scope="module", autouse=True)
def refinements_are_short():
    with short_refinement():
        yield


@pytest.fixture(scope="module")
def whole():
    """A search at once: its records, its state after each of them, and the search itself."""
    descent, records, states = begun(), [], []
    while descent.verdict is None:
        records.append(told(descent.step()))
        states.append(written(descent))
    return records, states, descent


@pytest.mark.parametrize("every", [9, pytest.param(1, marks=pytest.mark.slow)])
def test_from_every_state_the_next_one_is_the_same(whole, every):
    records, states, _ = whole
    assert {"start", "selection", "polish", "pricing", "settled"} == {record["stage"] for record in records}
    for number in (*range(1, len(states), every), len(states) - 1):
        descent = resumed(states[number - 1])
        assert descent.iteration == number
        assert told(descent.step()) == records[number]


@pytest.mark.parametrize(
    "number", [pytest.param(1, marks=pytest.mark.nightly), pytest.param(7, marks=pytest.mark.nightly), 24]
)  # before the pool is drawn, in a polish, in the refinement
def test_from_a_state_the_end_is_the_same(whole, number):
    records, states, at_once = whole
    descent = resumed(states[number - 1])
    assert all_of(descent) == records[number:]
    pool, expected = descent.found.pool, at_once.found.pool
    np.testing.assert_array_equal(pool.mount_pose, expected.mount_pose)
    np.testing.assert_array_equal(pool.detection_probability, expected.detection_probability)
    assert len(descent.candidates) == len(at_once.candidates)
    for one, other in zip(descent.candidates, at_once.candidates, strict=True):
        np.testing.assert_array_equal(one.mount_pose, other.mount_pose)
        assert (one.training_objective, one.iteration) == (other.training_objective, other.iteration)
    with np.load(io.BytesIO(written(descent))) as one, np.load(io.BytesIO(states[-1])) as other:
        assert set(one.files) == set(other.files)
        for name in one.files:
            if not name.endswith("_numbers"):  # among them the seconds of a selection
                np.testing.assert_array_equal(one[name], other[name], err_msg=name)


def test_what_was_rendered_with_jacobians_is_not_rendered_again(whole, monkeypatch):
    """Also in the middle of a polish, whose steps are kept as they come."""
    render, asked = SingleCameras.with_jacobian, []

    def counted(self, mount_pose, scenes):
        asked.append(np.array(mount_pose))
        if len(asked) == 5:
            raise KeyboardInterrupt
        return render(self, mount_pose, scenes)

    with monkeypatch.context() as patch:
        patch.setattr(SingleCameras, "with_jacobian", counted)
        stopped = begun()
        with pytest.raises(KeyboardInterrupt):
            all_of(stopped)
        patch.setattr("warpav.optimisation.pool_search.select", None)  # nor is anything selected again
        first = asked.pop()
        asked.clear()
        descent = resumed(written(stopped))
        assert asked == []
        descent.step()
        np.testing.assert_array_equal(asked[0], first)


def test_an_interrupted_selection_is_made_again(whole, monkeypatch):
    records, _, _ = whole
    run, calls = BranchAndBound.run, []

    def interrupted_later(self):
        calls.append(None)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return run(self)

    stopped = begun()
    with monkeypatch.context() as patch:
        patch.setattr(BranchAndBound, "run", interrupted_later)
        with pytest.raises(KeyboardInterrupt):
            all_of(stopped)
    assert stopped.found.stage == "selection"
    assert not stopped.found.is_final
    descent = resumed(written(stopped))
    assert descent.iteration == stopped.iteration - 1
    assert told(descent.step()) == records[descent.iteration - 1]


def test_a_search_that_was_stopped_takes_more_rounds_as_at_once():
    one, two = (dataclasses.replace(SMALL, pool_cameras=12, rounds=rounds) for rounds in (1, 2))
    stopped = begun(one)
    for _ in range(3):
        stopped.step()
    assert all_of(resumed(written(stopped), two)) == all_of(begun(two))[3:]


def test_a_search_that_has_settled_goes_on_where_it_may():
    none, one = (dataclasses.replace(SMALL, pool_cameras=12, rounds=rounds) for rounds in (0, 1))
    ended = begun(none)
    all_of(ended)
    assert resumed(written(ended), none).verdict is not None
    further = resumed(written(ended), one)
    assert further.verdict is None
    records = [told(further.step()) for _ in range(2)]
    assert [record["stage"] for record in records] == ["pricing", "selection"]
    assert records[0]["iteration"] == ended.iteration
    content = written(further)
    records += all_of(further)
    assert records[-1]["stage"] == "settled"
    assert further.best.training_objective <= ended.best.training_objective
    # and is stopped and goes on once more
    assert all_of(resumed(content, one)) == records[2:]


def test_rigs_that_another_machine_would_not_come_to_are_rendered_again(whole):
    """Sums are rounded in other ways elsewhere: then a polish is not told what it did not ask for."""
    records, states, _ = whole
    with np.load(io.BytesIO(states[3]), allow_pickle=False) as state:
        changed = dict(state)
    assert changed["journal_walk_is_open"][-1]
    changed["journal_answer_pose"] = changed["journal_answer_pose"].copy()
    changed["journal_answer_pose"][-1, 0] += 0.1
    descent = begun()
    descent.restore(changed)
    assert told(descent.step()) == records[4]


def test_a_state_of_another_search_is_refused(whole):
    _, states, _ = whole
    with np.load(io.BytesIO(states[-1]), allow_pickle=False) as state:
        whole_state = dict(state)
    with pytest.raises(InputError, match="checkpoint: expected the state of a search by a pool, got no entries"):
        begun().restore({name: value for name, value in whole_state.items() if name != "journal_entries"})
    with pytest.raises(InputError, match="got arrays that do not fit together"):
        begun().restore({**whole_state, "journal_pooled_bits": whole_state["journal_pooled_bits"][:, :0]})
    with pytest.raises(InputError, match="got more states than it comes to"):
        begun().restore({**whole_state, "iteration": np.array(1000)})
    with pytest.raises(InputError, match="checkpoint: expected that of this search, got one of another"):
        begun(dataclasses.replace(REFINED, polishes=False)).restore(
            {**whole_state, "journal_entries": 1 - whole_state["journal_entries"][:1]}
            | {"journal_walk_answers": np.array([0]), "journal_walk_rigs": np.array([0])}
        )
    journal = SearchJournal()
    journal._entries.append("a selection, where the search comes to a walk")
    with pytest.raises(InputError, match="checkpoint: expected that of this search, got one of another"):
        next(journal.walk(lambda _: iter(()), lambda _: None, lambda *_: None))


def test_nothing_is_kept_where_nobody_asks():
    journal = SearchJournal(is_kept=False)
    journal.begin({})
    pose, found = np.zeros((2, 7), np.float32), (np.ones((2, 3)), np.ones((2, 3, 7)))

    def steps(detect):
        detect(pose)
        yield pose, 0.5

    [(rig, objective)] = journal.walk(steps, lambda pose: found, lambda pose, probability: probability)
    assert (rig is pose, objective) == (True, 0.5)
    assert journal.state()["answer_pose"].size == 0


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.float16])
def test_numbers_that_are_0_take_no_room_and_come_back_to_the_bit(dtype):
    matrix = np.zeros((3, 100), dtype)
    matrix[1, 7], matrix[2, 99], matrix[0, 3] = 0.1, np.finfo(dtype).tiny, -0.0
    sparse = _Sparse.of(matrix)
    assert sparse.values.size == 3
    assert sparse.whole.tobytes() == matrix.tobytes()
