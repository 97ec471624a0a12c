"""Views at once: half as many where a device's memory does not hold them."""

import pytest

from warpav.core.errors import is_out_of_memory
from warpav.raster.chunks import ViewsAtOnce

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
