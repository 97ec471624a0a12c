"""Prices of further cameras: a bound on the larger pool, and their derivative."""

import numpy as np
import pytest

from tests.optimisation.calls import select
from tests.optimisation.selection.pools import random_pool
from warpav.optimisation.selection._problem import Row


@pytest.fixture(scope="module")
def cameras():
    """Cameras of a pool of 40, and 20 others."""
    return random_pool(np.random.default_rng(8), 60, 150)


@pytest.fixture(scope="module")
def chosen(cameras):
    return select(cameras[:40], 4, gap=1.0)


def test_the_bound_holds_with_one_more_camera(cameras, chosen):
    cost = chosen.price.reduced_cost(cameras[40:])
    assert (cost < 0.0).any()
    for camera, change in zip(cameras[40:], cost, strict=True):
        larger = select(np.vstack([cameras[:40], camera]), 4, gap=0.0)
        assert larger.objective >= chosen.price.bound + min(change, 0.0) - 1e-12


def test_what_the_pool_does_not_see_counts_in_full(cameras):
    blind = cameras[:40].copy()
    blind[:, [3, 9]] = 0.0
    price = select(blind, 4, gap=1.0).price
    one = np.zeros((1, 150))
    one[0, [3, 9]] = 0.5, 1.0
    assert price.reduced_cost(one)[0] == pytest.approx(-1.5 / 150.0 - price.dearest, abs=1e-12)


def test_rows_have_prices(cameras):
    """A row that holds the rig back has one, which a camera pays by its coefficient; a slack one has none."""
    power_w = np.linspace(1.0, 9.0, 40)
    rows = [Row("power", power_w, high=8.0), Row("no limit", power_w, high=100.0)]
    price = select(cameras[:40], 4, rows=rows, gap=1.0).price
    assert price.row_dual[0] < 0.0
    assert price.row_dual[1] == 0.0
    cheap, dear = price.reduced_cost(cameras[40:42] * 0.0 + cameras[40], np.array([[1.0, 0.0], [3.0, 0.0]]))
    assert dear - cheap == pytest.approx(-2.0 * price.row_dual[0])
    larger = [Row(row.name, np.append(row.coefficient, 2.0), high=row.high) for row in rows]
    for camera in cameras[40:48]:
        best = select(np.vstack([cameras[:40], camera]), 4, rows=larger, gap=0.0).objective
        change = price.reduced_cost(camera[None], np.array([[2.0, 2.0]]))[0]
        assert best >= price.bound + min(change, 0.0) - 1e-9


def test_slope_is_the_derivative(cameras, chosen, rng):
    camera = rng.uniform(0.01, 0.99, (3, 150))
    slope = chosen.price.reduced_cost_slope(camera)
    assert slope.shape == (3, 150)
    assert (slope <= 0.0).all()
    step = 1e-6
    for _ in range(20):
        k, o = rng.integers(3), rng.integers(150)
        moved = np.repeat(camera[k][None], 2, axis=0)
        moved[:, o] += [-step, step]
        below, above = chosen.price.reduced_cost(moved)
        # worst seen: 3e-9
        assert slope[k, o] == pytest.approx((above - below) / (2.0 * step), abs=1e-7)
