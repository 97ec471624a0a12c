"""Decide: which surface every sample sees, what every object covers alone, and what hides it. Nothing is taped."""

from __future__ import annotations

from enum import Enum
from typing import Any

import warp as wp

from warpav.raster.buffers import CUDA_STRIP_GROUPS, CUDA_STRIP_LANES, FIRST, Buffers, Content, RenderState
from warpav.raster.scene import CLUSTER_SIZE, Scene
from warpav_kernels import raster as kernels
from warpav_kernels.raster import hide


class Occlusion(Enum):
    """What hides an object."""

    EXACT = "exact"  # whatever surface is nearest in the joint render
    PAIRWISE = "pairwise"  # the thesis: nearer objects by median depth, and the foreground
    OCCLUDERS = "occluders"  # occluders alone, which images show alone too: objects hide nothing, as ghosts


def decide(buffers: Buffers, scene: Scene, content: Content, occlusion: Occlusion) -> RenderState:
    """Fill the buffers from the views that were placed last."""
    # the foreground is the last layer; exact occlusion does not need its silhouette
    layer_count = scene.object_count
    if content is Content.IMAGES:
        layer_count = 0
    elif content is not Content.OBJECTS and (
        occlusion is Occlusion.PAIRWISE or (buffers.has_foreground and content in (Content.ALL, Content.MEASURES))
    ):
        layer_count = scene.layer_count
    has_outlines = layer_count > 0 and content is not Content.COVERAGE
    is_whole = content not in (Content.COVERAGE, Content.MEASURES)
    buffers.place_layers(scene, layer_count, is_whole=is_whole, has_outlines=has_outlines)
    state = RenderState(scene, content, occlusion is Occlusion.EXACT, buffers.layers.rectangle, buffers.layers.offset)
    has_key = content is not Content.OBJECTS
    if has_key:
        if buffers.key.size == 0:
            buffers.key = buffers.zeros((buffers.view_count, buffers.height, buffers.width), wp.int64)
        if is_whole:
            buffers.over_views(buffers.view_count, lambda first, count: buffers.key[first : first + count].zero_())
        else:
            buffers.launch_views(
                kernels.clear_keys_kernel,
                (buffers.view_count, buffers.row_lanes),
                inputs=[buffers.scissor, FIRST, buffers.row_lanes],
                outputs=[buffers.key],
            )
    if layer_count:
        buffers.layers.inverse_depth_bits.zero_()
        buffers.hiding.bits.zero_()
    if has_outlines:
        buffers.layers.crossing_key.zero_()
    is_ghostly = occlusion is Occlusion.OCCLUDERS
    # occluders come first among the clusters: by themselves they write keys, and after that every object its layer
    passes = [(scene.cluster_count, has_key)]
    if is_ghostly and has_key:
        passes = [(scene.occluder_cluster_count, True), *([(scene.cluster_count, False)] if layer_count else [])]
    left = buffers.kept("left", (buffers.view_count if buffers.device.is_cpu else 0, CLUSTER_SIZE), wp.int32)
    for cluster_count, writes_key in passes:
        _scatter(buffers, scene, left, layer_count, cluster_count, has_key=writes_key, has_outlines=has_outlines)
        if buffers.bent and buffers.device.is_cpu:
            _scatter_bent(buffers, scene, layer_count, cluster_count, has_key=writes_key, has_outlines=has_outlines)
    if buffers.bent and not buffers.device.is_cpu:
        _trace(buffers, scene, layer_count, has_key=has_key, is_ghostly=is_ghostly)
        if layer_count and has_outlines:
            _cross_bent(buffers, scene, layer_count)
    if scene.object_count and content in (Content.ALL, Content.COVERAGE, Content.MEASURES):
        _hide(buffers, scene, occlusion)
    return state


def _scatter(
    buffers: Buffers,
    scene: Scene,
    left: wp.array,
    layer_count: int,
    cluster_count: int,
    *,
    has_key: bool,
    has_outlines: bool,
) -> None:
    """The keys, layers and edge crossings of the first clusters in the views of pinholes."""
    if not cluster_count:
        return
    buffers.strip_count.zero_()
    buffers.launch_views(
        kernels.scatter_triangles_kernel,
        (buffers.view_count, cluster_count, buffers.cluster_lanes),
        inputs=[
            buffers.view, scene.triangles, layer_count, buffers.scissor, FIRST, int(has_key), int(has_outlines),
            buffers.cluster_lanes,
        ],
        outputs=[left, buffers.key, buffers.layers, buffers.strip, buffers.strip_count],
    )  # fmt: skip
    if buffers.strip.size:
        buffers.launch(
            kernels.fill_strips_kernel,
            (CUDA_STRIP_GROUPS, CUDA_STRIP_LANES),
            inputs=[
                buffers.view, scene.triangles, layer_count, buffers.scissor, int(has_key), buffers.strip,
                buffers.strip_count, CUDA_STRIP_GROUPS, CUDA_STRIP_LANES,
            ],
            outputs=[buffers.key, buffers.layers],
        )  # fmt: skip


def _scatter_bent(
    buffers: Buffers, scene: Scene, layer_count: int, cluster_count: int, *, has_key: bool, has_outlines: bool
) -> None:
    """The keys, layers and edge crossings of the views whose lenses are no pinholes, in the space of rays."""
    candidate = buffers.kept("candidate", (buffers.view_count, CLUSTER_SIZE), kernels.Candidate)
    buffers.launch_views(
        kernels.scatter_bent_triangles_kernel,
        (len(buffers.bent), cluster_count),
        inputs=[
            buffers.view, scene.triangles, buffers.rays, buffers.bent_view, layer_count, buffers.scissor, FIRST,
            int(has_key), int(has_outlines),
        ],
        outputs=[candidate, buffers.key, buffers.layers],
    )  # fmt: skip


def _trace(buffers: Buffers, scene: Scene, layer_count: int, *, has_key: bool, is_ghostly: bool) -> None:
    """Fill the keys and layers of the views whose lenses are no pinholes, by ray queries."""
    mesh, bent, count = scene.mesh.id, buffers.bent_view, len(buffers.bent)
    rows, columns = buffers.lanes
    if has_key and not (is_ghostly and scene.occluder_count == 0):
        solid = scene.occluder_mesh.id if is_ghostly else mesh
        buffers.launch_views(
            kernels.trace_keys_kernel,
            (count, buffers.height, buffers.width),
            inputs=[buffers.view, solid, bent, buffers.scissor, FIRST],
            outputs=[buffers.key],
        )
    if layer_count:
        buffers.launch_views(
            kernels.trace_layers_kernel,
            (count, layer_count, rows * columns),
            inputs=[
                buffers.view, scene.triangles, mesh, scene.layer_body, bent, buffers.key,
                int(has_key and not is_ghostly), FIRST, rows, columns,
            ],
            outputs=[buffers.layers],
        )  # fmt: skip


def _cross_bent(buffers: Buffers, scene: Scene, layer_count: int) -> None:
    """The edge crossings of the layers in the views whose lenses are no pinholes, on a GPU."""
    buffers.launch(
        kernels.scatter_bent_crossings_kernel,
        (len(buffers.bent), scene.cluster_count, buffers.cluster_lanes),
        inputs=[
            buffers.view, scene.triangles, buffers.rays, buffers.bent_view, layer_count, buffers.scissor,
            buffers.cluster_lanes,
        ],
        outputs=[buffers.layers],
    )  # fmt: skip


def _hide(buffers: Buffers, scene: Scene, occlusion: Occlusion) -> None:
    if occlusion is not Occlusion.PAIRWISE:
        rows, columns = buffers.lanes
        buffers.launch_views(
            hide.hide_by_nearest_surface_kernel,
            (buffers.view_count, scene.object_count, rows * columns),
            inputs=[buffers.key, scene.triangles, scene.layer_body, buffers.layers, FIRST, rows, columns],
            outputs=[buffers.hiding.bits, buffers.hiding.source],
        )
        return
    is_hidden_by = buffers.kept("order", (buffers.view_count, scene.object_count, scene.object_count), wp.int32)
    is_hidden_by.zero_()
    buffers.launch_views(
        hide.order_overlapping_layers_kernel,
        (buffers.view_count, scene.object_count, scene.object_count),
        inputs=[buffers.layers, scene.object_count, FIRST],
        outputs=[is_hidden_by],
    )
    _hide_by_layers(buffers, scene, is_hidden_by, buffers.hiding)


def hide_by_foreground(buffers: Buffers, scene: Scene) -> None:
    """Hide the objects by the foreground's silhouette alone, in ``buffers.foreground_hiding``."""
    buffers.foreground_hiding.bits.zero_()
    nobody = buffers.kept("no order", (buffers.view_count, scene.object_count, scene.object_count), wp.int32)
    _hide_by_layers(buffers, scene, nobody, buffers.foreground_hiding)


def _hide_by_layers(buffers: Buffers, scene: Scene, is_hidden_by: wp.array, hiding: Any) -> None:  # noqa: ANN401 (a struct)
    """Hide objects by the silhouettes of the objects that ``is_hidden_by`` names, and of the foreground."""
    buffers.launch_views(
        hide.hide_by_ordered_layers_kernel,
        (buffers.view_count, scene.object_count),
        inputs=[buffers.layers, is_hidden_by, scene.foreground_layer, FIRST],
        outputs=[hiding.bits, hiding.source],
    )
