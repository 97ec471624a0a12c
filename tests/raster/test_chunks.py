"""Views at once: half as many where a device's memory does not hold them."""

from types import SimpleNamespace

import pytest

from warpav.core.errors import is_out_of_memory
from warpav.raster import chunks
from warpav.raster.camera import CameraModel
from warpav.raster.chunks import ViewsAtOnce, gpu_view_count, views_with_room

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
    assert views_with_room(most, 2**28, free_bytes=free_bytes, sharers=sharers) == expected


def test_what_has_no_room_on_a_gpu_is_said_in_one_line(monkeypatch, caplog):
    monkeypatch.setattr(chunks.wp, "get_device", lambda _: SimpleNamespace(free_memory=2 * 10**9))
    model = CameraModel(1022, 1022)
    count = gpu_view_count(64, model, supersampling=1, device="cuda:0")
    assert count == 2 * 10**9 // (2 * 4 * 8 * 1024 * 1024) == 29
    assert [record.getMessage() for record in caplog.records] == [
        "cuda:0 has 2.0 GB free: 29 views at once instead of 64; the numbers are the same"
    ]
    caplog.clear()
    assert gpu_view_count(29, model, supersampling=1, device="cuda:0") == 29
    assert not caplog.records
