"""Many renders: chunks that fit, renderers that are kept, launches that are recorded."""

import gc
import math

import numpy as np
import pytest
import warp as wp

from tests.driving_scene import camera_pose, on_device, packed_street
from warpav.core.errors import is_out_of_memory
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.chunks import KeptRenderers, ViewsAtOnce, _views_with_room, record_graph
from warpav.raster.renderer import Renderer

LACK = RuntimeError("Failed to allocate 8589934592 bytes on device 'cuda:0'")


def test_half_as_many_until_they_fit(caplog):
    at_once, asked, released = ViewsAtOnce(50), [], []

    def render(most):
        asked.append(most)
        if most > 7:
            raise LACK
        return "image"

    assert at_once.run(render, release=lambda: released.append(len(asked))) == "image"
    assert asked == [50, 25, 12, 6]
    assert released == [1, 2, 3]
    assert at_once.run(render, release=released.clear) == "image"  # remembered
    assert asked[4:] == [6]
    assert [record.getMessage().split("; ")[1] for record in caplog.records] == [
        f"going on with {most} views at once" for most in (25, 12, 6)
    ]


def test_one_view_without_room_and_other_errors_are_raised():
    def lacking(most):
        raise LACK

    at_once = ViewsAtOnce(5)
    with pytest.raises(RuntimeError, match="Failed to allocate"):
        at_once.run(lacking, release=int)
    assert at_once.most == 1

    def broken(most):
        raise RuntimeError("Warp CUDA error 700: an illegal memory access was encountered")

    at_once = ViewsAtOnce(5)
    with pytest.raises(RuntimeError, match="illegal"):
        at_once.run(broken, release=int)
    assert at_once.most == 5
    assert is_out_of_memory(RuntimeError("Graph launch error: Warp CUDA error 2: out of memory"))
    assert not is_out_of_memory(MemoryError("out of memory"))


@pytest.mark.parametrize(
    ("most", "free_gib", "sharers", "expected"),
    [
        (64, 80.0, 1, 64),  # all that is wanted
        (64, 8.0, 1, 16),  # half of what is free, 256 MiB each
        (64, 8.0, 4, 4),  # and of that a share
        (64, 0.1, 11, 1),  # one at least
        (3, 2.0, 1, 3),
    ],
)
def test_a_gpu_renders_what_has_room(most, free_gib, sharers, expected):
    free_bytes = int(free_gib * 2**30)
    assert _views_with_room(most, 2**28, free_bytes=free_bytes, sharers=sharers) == expected


SIZE = 96, 64


def renderer_of(views, device, *, lens="pinhole"):
    return Renderer([CameraModel(*SIZE, math.radians(80.0), lens=lens)] * views, device=device)


def rendered(renderer, device):
    pose = np.stack([camera_pose((1.0, 0.0, 1.8), 0.1 * k, 0.1) for k in range(renderer.view_count)])
    renderer.render(packed_street(device).raster, *on_device(pose, device), content=Content.ALL)
    return renderer


def test_the_last_used_are_kept_as_far_as_they_fit():
    made = []

    def make(views):
        def new():
            made.append(views)
            return [rendered(renderer_of(views, "cpu"), "cpu")]

        return new

    one_byte = rendered(renderer_of(2, "cpu"), "cpu").held_bytes
    kept = KeptRenderers(bytes_max=int(2.5 * one_byte))
    a, b = kept.of("a", make(2)), kept.of("b", make(2))
    assert kept.of("a", make(2)) is a
    assert kept.of("b", make(2)) is b
    assert kept.of("a", make(2)) is a
    kept.of("c", make(2))  # three are too many, which the next call sees
    assert len(kept) == 3
    assert kept.of("c", make(2))
    assert len(kept) == 2
    assert kept.of("a", make(2)) is a
    large = kept.of("large", make(40))
    assert kept.of("large", make(40)) is large  # too many by themselves, and in use
    assert len(kept) == 1
    assert kept.of("a", make(2)) is not a
    assert len(kept) == 1
    kept.clear()
    assert (len(kept), made) == (0, [2, 2, 2, 40, 2])


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
