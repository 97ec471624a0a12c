"""Recorded launches."""

import gc

import numpy as np
import pytest
import warp as wp

from warpav.raster.chunks import record_graph


@wp.kernel
def add_one_k(value: wp.array(dtype=float)):
    i = wp.tid()
    value[i] = value[i] + 1.0


@pytest.fixture
def value(device):
    return wp.full(4, np.nan, dtype=float, device=device)


def test_a_graph_repeats_launches_that_are_not_done_while_it_is_recorded(value, device):
    launch = lambda: wp.launch(add_one_k, dim=4, inputs=[value], device=device)  # noqa: E731
    launch()
    value.zero_()
    graph = record_graph(launch, device)
    for count in (1, 2, 3):
        wp.capture_launch(graph)
        np.testing.assert_array_equal(value.numpy(), np.full(4, count))


@pytest.mark.parametrize("enabled", [True, False])
def test_nothing_is_collected_while_a_graph_is_recorded(value, device, enabled):
    seen = []

    def launch():
        seen.append(gc.isenabled())
        wp.launch(add_one_k, dim=4, inputs=[value], device=device)

    launch()
    (gc.enable if enabled else gc.disable)()
    try:
        record_graph(launch, device)
        assert seen[1] is False
        assert gc.isenabled() is enabled
    finally:
        gc.enable()


def test_an_error_leaves_the_collector_as_it_was(device):
    def fail():
        raise ArithmeticError

    with pytest.raises(ArithmeticError):
        record_graph(fail, device)
    assert gc.isenabled()
