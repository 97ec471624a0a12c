"""The relaxation of a node, also of one that has no rig."""

import math
import time

import numpy as np
import pytest

from tests.optimisation.selection.pools import best_by_brute_force
from warpav.optimisation.selection._problem import SelectionProblem
from warpav.optimisation.selection._relaxation import Node, Relaxation

pytestmark = pytest.mark.filterwarnings("error")
EVERY = range(8)


def relaxed(rng, allowed, required, in_model):
    """The relaxation of a node of rigs of 2 of 8 cameras, and the least expected miss rate of its rigs."""
    probability = rng.uniform(size=(8, 20))
    problem = SelectionProblem.create(probability, 2, conflict=None, required=(), rows=(), weight=None)
    relaxation = Relaxation(problem, time.perf_counter() + 60.0)
    relaxation.add_cameras(np.array(in_model))
    relaxation.add_cuts(np.arange(20), relaxation.most_violated(np.full(8, 0.25), np.arange(8))[0])
    node = Node(np.isin(EVERY, allowed), np.isin(EVERY, required), {}, 0.0)
    kept = np.where(np.isin(EVERY, allowed)[:, None], probability, 0.0)
    return relaxation.relax(node, 1.0), best_by_brute_force(kept, 2, required=required)


@pytest.mark.parametrize("in_model", [[0, 1, 2], EVERY], ids=["some", "all"])
@pytest.mark.parametrize(
    ("allowed", "required"),
    [(EVERY, [5, 6, 7]), (range(7), [7]), ([0, 1], [6, 7]), ([0], [])],
    ids=["too many required", "required but not allowed", "others allowed", "too few allowed"],
)
def test_a_node_without_a_rig_has_no_bound(rng, allowed, required, in_model):
    found, _ = relaxed(rng, list(allowed), required, in_model)
    assert math.isinf(found.bound)
    assert found.price is None


def test_the_solver_prints_nothing(rng, capfd):
    relaxed(rng, [0, 1, 2], [], EVERY)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("in_model", [[0, 1, 2], EVERY], ids=["some", "all"])
@pytest.mark.parametrize(("allowed", "required"), [(EVERY, []), (EVERY, [6]), (EVERY, [6, 7]), ([0, 1], [0])])
def test_no_rig_of_a_node_is_below_its_bound(rng, allowed, required, in_model):
    found, best = relaxed(rng, list(allowed), required, in_model)
    assert 0.0 < found.bound <= best + 1e-12
    for rise in (found.rise_in, found.rise_out):
        assert not np.isnan(rise).any()
