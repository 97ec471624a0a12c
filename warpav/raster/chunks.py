"""Many renders: views a chunk at a time, renderers that are kept from call to call, launches recorded as one graph."""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from queue import SimpleQueue
from typing import TypeVar

import numpy as np
import warp as wp

from warpav.core.cores import gpu_processes
from warpav.core.errors import is_out_of_memory
from warpav.raster.buffers import Content, RenderState
from warpav.raster.camera import CameraModel
from warpav.raster.frame import Frame
from warpav.raster.renderer import Renderer
from warpav.raster.scene import Scene

KEPT_BYTES = 2**29
_CHUNK_KEY_BYTES = 2**28
MAX_CHUNK_VIEWS = 64
_GPU_ROOM = 4  # what a view takes on a GPU over its keys: silhouettes, images and what is measured of them as well

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_logger = logging.getLogger(__name__)


def chunk_view_count(model: CameraModel, *, supersampling: int = 1, key_bytes: int = _CHUNK_KEY_BYTES) -> int:
    """Views that are rendered at once: as many as fit into so many bytes of keys, 1 to 64; by default 256 MiB.

    Street scenes take about as much again for silhouettes.
    """
    return max(1, min(MAX_CHUNK_VIEWS, key_bytes // _key_bytes(model, supersampling)))


def _key_bytes(model: CameraModel, supersampling: int) -> int:
    """Of the keys of a view."""
    return 8 * (model.width_px * supersampling + 2) * (model.height_px * supersampling + 2)


def _views_with_room(most: int, view_bytes: int, *, free_bytes: int, sharers: int) -> int:
    """How many of so many views have room on a GPU at once, at least 1."""
    return max(1, min(most, free_bytes // (2 * sharers * view_bytes)))


def gpu_view_count(most: int, model: CameraModel, *, supersampling: int, device: str, renderers: int = 1) -> int:
    """How many of so many views a renderer on a GPU renders at once, by what is free there now; fewer are said."""
    free_bytes = wp.get_device(device).free_memory
    view_bytes = _GPU_ROOM * _key_bytes(model, supersampling)
    count = _views_with_room(most, view_bytes, free_bytes=free_bytes, sharers=renderers * gpu_processes())
    if count < most:
        text = "%s has %.1f GB free: %d views at once instead of %d; the numbers are the same"
        _logger.warning(text, device, free_bytes / 1e9, count, most)
    return count


def equal_chunks(count: int, most: int) -> list[np.ndarray]:
    """Which of ``count`` views each chunk holds, int [view of the chunk]: chunks of one size, at most ``most``.

    A last chunk that is not full is filled up with copies of the last view.
    """
    size = -(-count // -(-count // most)) if count else 1
    return [np.minimum(np.arange(first, first + size), count - 1) for first in range(0, count, size)]


def beside_each_other(
    work: Callable[[_Item, Renderer], _Result], items: Sequence[_Item], renderers: Sequence[Renderer]
) -> list[_Result]:
    """What is made of each item with a renderer that is free, in a thread for each renderer."""
    free: SimpleQueue[Renderer] = SimpleQueue()
    for renderer in renderers:
        free.put(renderer)

    def done(item: _Item) -> _Result:
        renderer = free.get()
        try:
            return work(item, renderer)
        finally:
            free.put(renderer)

    if len(renderers) == 1 or len(items) == 1:
        return [done(item) for item in items]
    with ThreadPoolExecutor(len(renderers)) as threads:
        return list(threads.map(done, items))


class ViewsAtOnce:
    """How many views are rendered at once: half as many from the first time on that a device's memory is too small."""

    def __init__(self, most: int) -> None:
        self.most = most

    def run(self, render: Callable[[int], _Result], *, release: Callable[[], object]) -> _Result:
        """What ``render(most)`` gives, called again with half as many views as long as memory does not hold them."""
        while True:
            try:
                return render(self.most)
            except RuntimeError as error:
                if self.most == 1 or not is_out_of_memory(error):
                    raise
                self.most //= 2
                _logger.warning("%s; going on with %d views at once", " ".join(str(error).split()), self.most)
            release()
            gc.collect()


def render_in_chunks(
    scene: Scene,
    models: Sequence[CameraModel],
    position_world_m: np.ndarray,
    camera_from_world: np.ndarray,
    *,
    renderer: Renderer | None = None,
    content: Content = Content.ALL,
) -> Iterator[tuple[slice, Frame]]:
    """Render views chunk by chunk, as many at once as the renderer has views (None: a new one); no gradient.

    Yields the views of the chunk and their frame, whose first views they are: copies of the last view fill it up.
    """
    view_count, device = len(models), scene.device
    if renderer is None:
        renderer = Renderer(models[: chunk_view_count(models[0])], device=device.alias)
    for first in range(0, view_count, renderer.view_count):
        chunk = np.minimum(np.arange(first, first + renderer.view_count), view_count - 1)
        renderer.set_lenses([models[i] for i in chunk])
        frame = renderer.render(
            scene,
            wp.array(position_world_m[chunk].astype(np.float32), dtype=wp.vec3, device=device),
            wp.array(camera_from_world[chunk].astype(np.float32), dtype=wp.mat33, device=device),
            content=content,
        )
        yield slice(first, min(first + renderer.view_count, view_count)), frame


@dataclass(eq=False)
class KeptRenderers:
    """Renderers by what they are asked for; those that were not used for the longest time go first."""

    bytes_max: int = KEPT_BYTES  # how much all of them may hold. Those of the last call stay even if they hold more
    _kept: dict[Hashable, tuple[Renderer, ...]] = field(default_factory=dict, init=False, repr=False)

    def __len__(self) -> int:
        return sum(map(len, self._kept.values()))

    @property
    def held_bytes(self) -> int:
        return sum(each.held_bytes for renderers in self._kept.values() for each in renderers)

    @property
    def used(self) -> list[Renderer]:
        return [each for renderers in self._kept.values() for each in renderers if each.state is not None]

    def clear(self) -> None:
        self._kept.clear()

    def of(self, key: Hashable, make: Callable[[], Sequence[Renderer]]) -> tuple[Renderer, ...]:
        """The renderers of a key; those that ``make`` gives, if none are kept.

        Not to be called while renderers of an earlier call are in use.
        """
        known = self._kept.pop(key, ())
        others_max = self.bytes_max - sum(each.held_bytes for each in known)
        # buffers grow as they are used, so this is the time to look; first, so that new ones find room
        while self._kept and self.held_bytes > others_max:
            del self._kept[next(iter(self._kept))]
        self._kept[key] = known or tuple(make())
        return self._kept[key]


def record_graph(function: Callable[[], None], device: wp.Device) -> wp.Graph:
    """Record what a function launches; `warp.capture_launch` repeats it.

    Python's garbage collector rests meanwhile: an old graph or array that it finds on its own frees memory on another
    stream, and CUDA ends the capture with error 906.
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


class Recording:
    """A function that only launches kernels on fixed arrays; its second call is recorded, later ones replay.

    It holds memory of a GPU as long as it lives: half of what was free before the first is left to other programs, and
    what has no room in the rest is launched again every time. The first call compiles modules and lets the
    renderer's buffers grow; whenever these have moved, this starts again.
    """

    def __init__(self, function: Callable[[], None], renderer: Renderer, *, enabled: bool | None = None) -> None:
        self._function = function
        self._renderer = renderer
        self._enabled = (renderer.device.is_cuda or renderer.thread_count == 1) if enabled is None else enabled
        self._graph: wp.Graph | None = None
        self._state: RenderState | None = None
        self._generation = -1

    def __call__(self) -> None:
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
