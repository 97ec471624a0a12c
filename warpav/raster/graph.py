"""Launches recorded as one graph."""

from __future__ import annotations

import gc
from collections.abc import Callable

import warp as wp


def record_graph(function: Callable[[], None], device: wp.Device) -> wp.Graph:
    """Record what a function launches; `warp.capture_launch` repeats it.

    Python's garbage collector rests meanwhile: an old graph or array that it finds on its own frees memory on another
    stream, and CUDA ends the capture with error 906.

    Args:
        function: Launches kernels; neither allocates on the host nor reads arrays there.
        device: Where the kernels run; the CPU records as well.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        with wp.ScopedCapture(device=device) as capture:
            function()
    finally:
        if was_enabled:
            gc.enable()
    assert capture.graph is not None
    return capture.graph
