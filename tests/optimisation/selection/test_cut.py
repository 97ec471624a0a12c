"""The cuts: below every rig, tight where they are made for, and the most violated one found."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from warpav.optimisation.selection._relaxation import _cut_coefficient, _cut_constant, _cut_slope, cut_level

PROBABILITY = st.one_of(st.sampled_from([0.0, 1.0, 1.0 - 1e-12, 1e-12]), st.floats(0.0, 1.0))
SEVERAL = hnp.arrays(float, st.integers(1, 6), elements=PROBABILITY)


def log_missed(probability):
    with np.errstate(divide="ignore"):
        return -np.log(1.0 - probability)


def right_side(fraction, probability, level):
    return _cut_constant(level) - fraction @ _cut_coefficient(1.0 - probability, log_missed(probability), level)


@given(SEVERAL, st.floats(0.0, 30.0))
def test_no_rig_misses_less_than_a_cut_says(probability, level):
    for size in range(len(probability) + 1):
        for rig in itertools.combinations(probability, size):
            chosen = np.array(rig)
            # worst seen: 2e-16
            assert right_side(np.ones(size), chosen, level) <= np.prod(1.0 - chosen) + 1e-14


@given(SEVERAL)
def test_the_cut_of_a_rig_is_tight_there(probability):
    everyone = np.ones(len(probability))
    level = cut_level(everyone, log_missed(probability)[:, None])
    # worst seen: 1.2e-11, of levels that end at 30
    assert right_side(everyone, probability, level[0]) == pytest.approx(np.prod(1.0 - probability), abs=2e-11)


@given(SEVERAL, st.data())
def test_no_level_is_violated_more(probability, data):
    fraction = data.draw(hnp.arrays(float, len(probability), elements=st.floats(0.0, 1.0)))
    found = right_side(fraction, probability, cut_level(fraction, log_missed(probability)[:, None])[0])
    levels = np.concatenate([np.linspace(0.0, 5.0, 401), np.linspace(5.0, 30.0, 51)])
    assert found >= max(right_side(fraction, probability, level) for level in levels) - 1e-9


@given(st.floats(1e-4, 1.0 - 1e-4), st.floats(0.0, 8.0))
def test_slope_is_the_derivative_by_the_probability(probability, level):
    step = 1e-6
    around = np.array([probability - step, probability + step])
    below, above = _cut_coefficient(1.0 - around, log_missed(around), level)
    # the second derivative jumps where the branches meet; it is at most 1 / (1 - p)
    assert _cut_slope(1.0 - probability, level) == pytest.approx(
        (above - below) / (2.0 * step), abs=2.0 * step / (1.0 - probability) + 1e-8
    )
