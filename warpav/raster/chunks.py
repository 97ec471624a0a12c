"""Any number of views through one renderer, a chunk at a time, so that memory does not grow with them."""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import numpy as np
import warp as wp

from warpav.core.errors import InputError, is_out_of_memory
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.frame import Frame
from warpav.raster.renderer import Renderer
from warpav.raster.scene import Scene

CHUNK_KEY_BYTES = 2**28
MAX_CHUNK_VIEWS = 64

_Result = TypeVar("_Result")
_logger = logging.getLogger(__name__)


def chunk_view_count(model: CameraModel, *, supersampling: int = 1, key_bytes: int = CHUNK_KEY_BYTES) -> int:
    """Views that are rendered at once: as many as fit into so many bytes of keys, 1 to 64; by default 256 MiB.

    Street scenes take about as much again for silhouettes.
    """
    view_bytes = 8 * (model.width_px * supersampling + 2) * (model.height_px * supersampling + 2)
    return max(1, min(MAX_CHUNK_VIEWS, key_bytes // view_bytes))


def equal_chunks(count: int, most: int) -> list[np.ndarray]:
    """Which of ``count`` views each chunk holds, int [view of the chunk]: chunks of one size, at most ``most``.

    A last chunk that is not full is filled up with copies of the last view.
    """
    size = -(-count // -(-count // most)) if count else 1
    return [np.minimum(np.arange(first, first + size), count - 1) for first in range(0, count, size)]


class ViewsAtOnce:
    """How many views are rendered at once: half as many from the first time on that a device's memory is too small.

    Attributes:
        most: As many at most, at least 1.
    """

    def __init__(self, most: int) -> None:
        self.most = most

    def run(self, render: Callable[[int], _Result], *, release: Callable[[], object]) -> _Result:
        """What ``render(most)`` gives, called again with half as many views as long as memory does not hold them.

        Args:
            render: Renders so many views at once; its results do not depend on how many.
            release: Lets go of what it holds on the device.

        Raises:
            RuntimeError: Not even one view has room, or it failed in another way.
        """
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
    views_at_once: int | None = None,
    supersampling: int = 1,
    content: Content = Content.ALL,
    device: str = "cpu",
) -> Iterator[tuple[slice, Frame]]:
    """Render views chunk by chunk; no gradient.

    Args:
        scene: The scene, on ``device``.
        models: Camera model of every view; all of one image size.
        position_world_m: Camera centres [m], [view, 3].
        camera_from_world: Rotations from world to camera axes, [view, 3, 3].
        renderer: Renderer to use, of ``views_at_once`` views, whose lenses are replaced; None: a new one.
        views_at_once: Views per chunk, at least 1; None: `chunk_view_count`.
        supersampling: Samples per pixel along each axis.
        content: What is wanted of the renders.
        device: Warp device.

    Yields:
        The views of the chunk, and their frame. A last chunk that is not full is filled up with copies
        of the last view: the frame's first views are the chunk's.

    Raises:
        InputError: The numbers of models and poses differ, or a chunk of no views was asked for.
    """
    view_count = len(models)
    if len(position_world_m) != view_count or len(camera_from_world) != view_count:
        raise InputError(
            f"every view needs a model, a position and a rotation, got {view_count}, {len(position_world_m)} and "
            f"{len(camera_from_world)}"
        )
    if renderer is not None:
        views_at_once = renderer.view_count
    elif views_at_once is None:
        views_at_once = min(chunk_view_count(models[0], supersampling=supersampling), view_count)
    if views_at_once < 1:
        raise InputError(f"views_at_once must be at least 1, got {views_at_once}")
    for first in range(0, view_count, views_at_once):
        chunk = np.minimum(np.arange(first, first + views_at_once), view_count - 1)
        chunk_models = [models[i] for i in chunk]
        if renderer is None:
            renderer = Renderer(chunk_models, supersampling=supersampling, device=device)
        else:
            renderer.set_lenses(chunk_models)
        frame = renderer.render(
            scene,
            wp.array(np.asarray(position_world_m)[chunk].astype(np.float32), dtype=wp.vec3, device=device),
            wp.array(np.asarray(camera_from_world)[chunk].astype(np.float32), dtype=wp.mat33, device=device),
            content=content,
        )
        yield slice(first, min(first + views_at_once, view_count)), frame
