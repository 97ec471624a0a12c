"""Launches that are recorded once as a CUDA graph and replayed."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cache

import warp as wp

from warpav.raster.buffers import RenderState
from warpav.raster.chunks import record_graph
from warpav.raster.renderer import Renderer

_logger = logging.getLogger(__name__)


class Recording:
    """A function that only launches kernels on fixed arrays; its second call is recorded, later ones replay.

    A recording holds memory of a GPU as long as it lives: half of what was free there before the first is left to other
    programs, and what has no room in the rest is launched again every time.

    The first call runs as it is: it compiles modules and lets the renderer's buffers grow. Whenever the renderer has
    moved its buffers, this starts again. After every call the renderer knows what it holds, as if it had been launched.
    """

    def __init__(self, function: Callable[[], None], renderer: Renderer, *, enabled: bool | None = None) -> None:
        """Record ``function``, which may use ``renderer``."""
        self._function = function
        self._renderer = renderer
        self._enabled = (renderer.device.is_cuda or renderer.thread_count == 1) if enabled is None else enabled
        self._graph: wp.Graph | None = None
        self._state: RenderState | None = None
        self._generation = -1

    def __call__(self) -> None:
        """Run the function."""
        renderer = self._renderer
        if not self._enabled or not renderer.is_recordable or self._generation != renderer.generation:
            self._graph = None
            self._function()
            self._generation = renderer.generation
            return
        if self._graph is None and not _has_room(renderer.device):
            self._function()
            return
        if self._graph is None:
            self._graph = record_graph(self._function, renderer.device)
            self._state = renderer.state
        wp.capture_launch(self._graph)
        renderer.state = self._state


def _has_room(device: wp.Device) -> bool:
    if not device.is_cuda or device.free_memory >= _left_bytes(device.alias):
        return True
    _say_full(device.alias)
    return False


@cache
def _left_bytes(device: str) -> int:
    """What recordings leave free on a GPU: half of what was free when this was asked first."""
    return wp.get_device(device).free_memory // 2


@cache
def _say_full(device: str) -> None:
    """Say once that nothing more is recorded."""
    text = "%s has %.1f GB free: other scenes are launched again every time, which is slower; the numbers are the same"
    _logger.warning(text, device, wp.get_device(device).free_memory / 1e9)
