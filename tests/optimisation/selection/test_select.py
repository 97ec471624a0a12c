"""The rig that is chosen, and what is proven of it, against brute force and against pools of rendered cameras."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.optimisation.calls import select
from tests.optimisation.selection.pools import best_by_brute_force, every_rig, miss_rate, random_pool
from warpav.core.errors import InputError
from warpav.detection import Fusion
from warpav.optimisation import RigLimits
from warpav.optimisation.selection._problem import Row
from warpav.optimisation.selection._relaxation import Relaxation

ROUNDING = 1e-12
pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


@st.composite
def choices(draw):
    """A small pool with some of the constraints."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    cameras, objects = draw(st.integers(2, 11)), draw(st.integers(1, 30))
    count = draw(st.integers(1, min(cameras, 5)))
    probability = random_pool(rng, cameras, objects)
    probability[rng.integers(cameras), rng.integers(objects)] = 0.5
    if draw(st.booleans()):  # twins
        probability[rng.integers(cameras)] = probability[rng.integers(cameras)]
        probability[rng.integers(cameras), rng.integers(objects)] = 0.5
    constraints = {}
    if draw(st.booleans()):
        constraints["conflict"] = rng.uniform(size=(cameras, cameras)) < draw(st.sampled_from([0.05, 0.2, 0.4]))
    if draw(st.booleans()):
        constraints["required"] = rng.choice(cameras, rng.integers(0, count + 1), replace=False)
    if draw(st.booleans()):
        price = rng.integers(1, 9, cameras).astype(float)
        zone = rng.uniform(size=cameras) < 0.5
        low = int(rng.integers(0, count + 1))
        constraints["rows"] = [
            Row("cost", price, high=float(np.sort(price)[:count].sum() + rng.integers(0, 9))),
            Row("roof", zone, low=low, high=low + rng.integers(0, 2)),
        ][: draw(st.integers(1, 2))]
    weight = rng.uniform(0.0, 2.0, objects) + 1e-3 if draw(st.booleans()) else None
    if draw(st.booleans()):
        constraints["cost"] = rng.uniform(0.0, 0.3, cameras)
    return probability, count, weight, constraints


@settings(max_examples=40)
@given(choices())
def test_equal_to_brute_force(choice):
    assert_best(*choice)


@pytest.mark.nightly
@settings(max_examples=1000)
@given(choices())
def test_equal_to_brute_force_a_thousand_times(choice):
    assert_best(*choice)


def assert_best(probability, count, weight, constraints):
    best = best_by_brute_force(probability, count, weight=weight, **constraints)
    if best is None:
        with pytest.raises(InputError, match=f"count = {count}"):
            select(probability, count, weight=weight, gap=0.0, **constraints)
        return
    found = select(probability, count, weight=weight, gap=0.0, **constraints)
    cost = constraints.pop("cost", None)
    assert tuple(found.cameras) in set(every_rig(len(probability), count, **constraints))
    assert found.objective == pytest.approx(miss_rate(probability, found.cameras, weight, cost), abs=ROUNDING)
    assert found.objective <= best + 1e-9
    assert found.bound <= best + ROUNDING
    assert found.ended == "optimal"
    assert found.gap <= 1e-9


@settings(max_examples=20)
@given(choices(), st.sampled_from([0.003, 0.03, 0.3]))
def test_bounds_are_never_above_the_best_rig(choice, gap):
    probability, count, weight, constraints = choice
    best = best_by_brute_force(probability, count, weight=weight, **constraints)
    if best is None:
        return
    found = select(probability, count, weight=weight, gap=gap, **constraints)
    assert found.gap <= gap
    assert best - ROUNDING <= found.objective <= best + gap + ROUNDING
    assert found.bound <= best + ROUNDING


MIXED = {"camera": (1, 4), "lidar": (0, 2)}


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("cost_max", [None, 9.0, 4.0])
@pytest.mark.parametrize("gap", [0.0, 0.05])
@pytest.mark.parametrize("fusion", [Fusion(), Fusion(20.0), Fusion(math.inf)], ids=["any", "20 m", "both"])
def test_the_bound_holds_for_cameras_and_lidars_with_counts_and_a_budget(seed, cost_max, gap, fusion):
    """Against every rig of 2 to 5 sensors out of 7 cameras and 4 LiDARs, which see all round and cost more."""
    rng = np.random.default_rng(seed)
    distance_m, weight = rng.uniform(5.0, 60.0, 25), rng.uniform(0.5, 2.0, 25)
    lidars = np.where(rng.uniform(size=(4, 25)) < 0.6, rng.uniform(size=(4, 25)), 0.0)
    probability = np.minimum(np.vstack([random_pool(rng, 7, 25), lidars]), 0.9999)
    limits = RigLimits.of(MIXED, count=(2, 5), price={"camera": 1.0, "lidar": 3.0}, cost_max=cost_max)
    kind = np.array([0] * 7 + [1] * 4 + [-1] * limits.absent)
    rows, found = limits.rows(kind), np.pad(probability, ((0, limits.absent), (0, 0)))
    is_camera = np.array(kind)[:, None] == 0

    def missed(rig):
        chosen = np.array(rig)
        by_cameras, by_lidars = (np.prod(1.0 - found[chosen] * own[chosen], axis=0) for own in (is_camera, ~is_camera))
        both = 1.0 - (1.0 - by_cameras) * (1.0 - by_lidars)
        return np.average(np.where(distance_m < fusion.within_m, both, by_cameras * by_lidars), weights=weight)

    rigs = list(every_rig(len(found), 5, rows=rows))
    best = min(map(missed, rigs))
    fused = {"weight": fusion.weights(distance_m, weight), "triple": Fusion.triples([25])}
    chosen = select(Fusion.columns(found, ~is_camera, [25]), 5, rows=rows, gap=gap, **fused)
    assert chosen.objective == pytest.approx(missed(chosen.cameras), abs=1e-12)
    assert tuple(chosen.cameras) in rigs
    assert best - ROUNDING <= chosen.objective <= best + gap + 1e-9
    assert chosen.bound <= best + ROUNDING
    assert chosen.gap <= max(gap, 1e-9)


@pytest.fixture(scope="module")
def streets():
    """60 cameras, 200 objects."""
    return random_pool(np.random.default_rng(3), 60, 200)


@pytest.mark.parametrize("seed", [7, 9])
def test_branches_find_the_best_of_a_million_rigs(seed):
    probability = random_pool(np.random.default_rng(seed), 70, 150)
    found = select(probability, 4, gap=0.0)
    assert found.nodes > 1  # the relaxation alone proves nothing here
    assert found.ended == "optimal"
    assert found.objective == pytest.approx(best_of_four(probability), abs=1e-9)


def best_of_four(probability, conflict=None):
    """Of all rigs of four cameras without a conflict: every pair against every pair."""
    missed = 1.0 - probability
    one, other = np.triu_indices(len(missed), 1)
    pair = missed[one] * missed[other]
    value = pair @ pair.T / missed.shape[1]
    shared = (one[:, None] == one) | (one[:, None] == other) | (other[:, None] == one) | (other[:, None] == other)
    if conflict is not None:
        each = np.c_[one, other]
        shared |= conflict[one, other][:, None] | conflict[one, other]
        shared |= conflict[each[:, None, :, None], each[None, :, None, :]].any(axis=(2, 3))
    return value[~shared].min()


def test_so_tight_that_no_random_rig_fits(streets):
    """Four numbers with one sum and a large sum of squares: random rigs do not have them, an integer programme does."""
    number = np.arange(60.0)
    rows = [Row("sum", number, low=117.0 + 1.0, high=118.0), Row("squares", number**2, low=59.0**2 + 58.0**2 + 1.0)]
    found = select(streets, 4, rows=rows, gap=0.0)
    rigs = [rig for rig in itertools.combinations(range(60), 4) if sum(rig) == 118]
    rigs = [rig for rig in rigs if sum(each**2 for each in rig) >= 59**2 + 58**2 + 1]
    assert found.objective == pytest.approx(min(miss_rate(streets, rig) for rig in rigs), abs=1e-9)


def test_a_start_is_kept_or_bettered(streets):
    best = select(streets, 4, gap=0.0)
    found = select(streets, 4, gap=1.0, start=best.cameras[::-1])
    np.testing.assert_array_equal(found.cameras, best.cameras)
    assert found.gap <= 1.0


def test_the_time_ends_it_with_a_valid_bound(streets):
    found = select(streets, 6, gap=0.0, time_limit_s=1e-3)
    assert found.ended == "time"
    assert found.price is None  # there was none for the first relaxation
    best = select(streets, 6, gap=0.0)
    assert 0.0 < found.bound <= best.objective <= found.objective
    assert best.ended == "optimal"


def test_ctrl_c_keeps_the_best(streets, monkeypatch):
    relax, calls = Relaxation.relax, []

    def stopped(*arguments):
        calls.append(arguments)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return relax(*arguments)

    best = select(streets, 6, gap=0.0)
    monkeypatch.setattr(Relaxation, "relax", stopped)
    found = select(streets, 6, gap=0.0)
    assert found.ended == "interrupted"
    assert 0.0 < found.bound < best.objective <= found.objective
    assert found.objective == pytest.approx(miss_rate(streets, found.cameras), abs=ROUNDING)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": 61}, "count: expected 1 to 60, the cameras of the pool, got 61"),
        ({"count": 0}, "count: expected 1 to 60"),
        ({"time_limit_s": 0.0}, "time_limit_s: expected more than 0 s, got 0"),
        ({"time_limit_s": math.nan}, "time_limit_s"),
        ({"gap": -1.0}, "gap"),
        ({"required": [3, 3]}, "required: expected different cameras"),
        ({"required": [60]}, "required: expected different cameras, 0..59"),
        ({"required": [1, 2, 3, 4, 5]}, "required: expected at most `count` = 4 cameras, got 5"),
        ({"conflict": np.zeros((3, 3), bool)}, r"conflict: expected \[60, 60\]"),
        ({"weight": np.full(200, np.nan)}, r"weight: expected \[200\] finite numbers"),
        ({"weight": np.zeros(200)}, "weight"),
        ({"rows": [Row("cost", np.ones(3))]}, r"rows: cost: expected \[60\] finite coefficients"),
        ({"rows": [Row("cost", np.ones(60), low=math.nan)]}, "rows: cost: expected numbers as bounds"),
        ({"start": [1, 2, 3]}, "start: expected 4 cameras"),
        ({"start": [1, 2, 3, 99]}, "start"),
        ({"start": [1, 2, 3, 4], "required": [5]}, "start"),
        ({"rows": [Row("cost", np.ones(60), high=3.0)]}, "no rig of the pool satisfies count = 4 and cost; loosen"),
        ({"conflict": np.ones((60, 60), bool)}, "count = 4 and conflict; loosen"),
    ],
)
def test_what_cannot_be_used(streets, change, message):
    arguments = {"count": 4, **change}
    with pytest.raises(InputError, match=message):
        select(streets, arguments.pop("count"), **arguments)


def test_constraints_in_conflict_are_named_and_none_is_dispensable(streets):
    front = np.arange(60) < 10
    rows = [
        Row("cost", np.ones(60), high=100.0),
        Row("front", front, low=3.0),
        Row("rear", ~front, low=1.0),
        Row("budget", np.where(front, 5.0, 1.0), high=14.0),
    ]
    with pytest.raises(InputError, match="count = 4 and front and budget") as raised:
        select(streets, 4, rows=rows, required=[50], conflict=np.eye(60, k=1, dtype=bool))
    assert "\n" not in str(raised.value)
    for name in ("front", "budget"):
        found = select(streets, 4, rows=[row for row in rows if row.name != name], required=[50], gap=1.0)
        assert len(found.cameras) == 4


def test_required_cameras_that_conflict_are_named(streets):
    conflict = np.zeros((60, 60), bool)
    conflict[4, 9] = True
    with pytest.raises(InputError, match="count = 4 and required and conflict"):
        select(streets, 4, required=[9, 4], conflict=conflict)


def pool_of(folder, name):
    return np.load(folder / f"{name}.npz")["P"]


def test_four_of_204_rendered_cameras(pool_folder):
    """All pairs of pairs give the same (70 million rigs, 18 s): .0543593, cameras 55, 64, 119, 166."""
    found = select(pool_of(pool_folder, "pool_4x90"), 4, gap=0.0)
    assert found.ended == "optimal"
    assert found.cameras.tolist() == [55, 64, 119, 166]
    assert found.objective == pytest.approx(0.05435933, abs=1e-8)
