"""Any number of views through one renderer, a chunk at a time, so that memory does not grow with them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import warp as wp

from warpav.raster.camera import CameraModel
from warpav.raster.device_scene import DeviceScene
from warpav.raster.renderer import Content, Renderer

CHUNK_KEY_BYTES = 2**28
MAX_CHUNK_VIEWS = 64


def chunk_view_count(model: CameraModel, *, supersampling: int = 1) -> int:
    """Views that are rendered at once by default: as many as fit into 256 MiB of keys, at most 64."""
    view_bytes = 8 * (model.width_px * supersampling + 2) * (model.height_px * supersampling + 2)
    return max(1, min(MAX_CHUNK_VIEWS, CHUNK_KEY_BYTES // view_bytes))


def render_in_chunks(
    scene: DeviceScene,
    models: Sequence[CameraModel],
    position_ego_m: np.ndarray,
    camera_from_ego: np.ndarray,
    *,
    renderer: Renderer | None = None,
    views_at_once: int | None = None,
    supersampling: int = 1,
    content: Content = Content.ALL,
    device: str = "cpu",
) -> Iterator[tuple[slice, Renderer]]:
    """Render views chunk by chunk; no gradient.

    Args:
        scene: The scene, on ``device``.
        models: Camera model of every view; all of one image size.
        position_ego_m: Camera centres [m], [view, 3].
        camera_from_ego: Rotations from ego to camera axes, [view, 3, 3].
        renderer: Renderer to use, of ``views_at_once`` views, whose lenses are replaced; None: a new one.
        views_at_once: Views per chunk, at least 1; None: `chunk_view_count`.
        supersampling: Samples per pixel along each axis.
        content: What is wanted of the renders.
        device: Warp device.

    Yields:
        The views of the chunk, and the renderer that holds them. A last chunk that is not full is filled up with copies
        of the last view: the renderer's first views are the chunk's.

    Raises:
        ValueError: The numbers of models and poses differ, or a chunk of no views was asked for.
    """
    view_count = len(models)
    if len(position_ego_m) != view_count or len(camera_from_ego) != view_count:
        raise ValueError(
            f"every view needs a model, a position and a rotation, got {view_count}, {len(position_ego_m)} and "
            f"{len(camera_from_ego)}"
        )
    if renderer is not None:
        views_at_once = renderer.view_count
    elif views_at_once is None:
        views_at_once = min(chunk_view_count(models[0], supersampling=supersampling), view_count)
    if views_at_once < 1:
        raise ValueError(f"views_at_once must be at least 1, got {views_at_once}")
    for first in range(0, view_count, views_at_once):
        chunk = np.minimum(np.arange(first, first + views_at_once), view_count - 1)
        chunk_models = [models[i] for i in chunk]
        if renderer is None:
            renderer = Renderer(chunk_models, supersampling=supersampling, device=device)
        else:
            renderer.set_lenses(chunk_models)
        renderer.render(
            scene,
            wp.array(np.asarray(position_ego_m)[chunk].astype(np.float32), dtype=wp.vec3, device=device),
            wp.array(np.asarray(camera_from_ego)[chunk].astype(np.float32), dtype=wp.mat33, device=device),
            content=content,
        )
        yield slice(first, min(first + views_at_once, view_count)), renderer
