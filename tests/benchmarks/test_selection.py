"""Time until a rig out of a pool of rendered cameras is proven to be within .001 of the best expected miss rate.

Left out of the ordinary run; ``pytest tests/benchmarks/test_selection.py --benchmark-only`` runs it where
``WARPAV_TEST_POOLS`` names the pools.
"""

import numpy as np
import pytest

from tests.optimisation.calls import select


@pytest.mark.parametrize(
    ("name", "count", "gap"),
    [
        ("pool_2x60", 2, 0.0),
        ("pool_4x90", 4, 0.0),
        ("pool_150", 4, 0.0),
        ("pool_150", 4, 1e-3),
        ("pool_150", 5, 1e-3),
        ("pool_150", 6, 1e-3),
        ("pool_150", 7, 1e-3),
        ("pool_150", 8, 1e-3),
    ],
)
def test_selection(benchmark, pool_folder, name, count, gap):
    probability = np.load(pool_folder / f"{name}.npz")["P"]
    found = benchmark.pedantic(lambda: select(probability, count, gap=gap, time_limit_s=300.0), rounds=1, iterations=1)
    benchmark.extra_info |= {"objective": found.objective, "bound": found.bound, "nodes": found.nodes}
    assert found.gap <= max(gap, 1e-9)
