"""Images of a render: colours, depths, ids and silhouettes, and what a gradient to them says about the views."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import warp as wp

from warpav.core.errors import InputError
from warpav.raster.areas import checked_weight, measure_weighted
from warpav.raster.buffers import FIRST, GUARD, Buffers
from warpav.raster.poses import ViewPoses
from warpav.raster.scene import Scene
from warpav_kernels import raster as kernels
from warpav_kernels.raster import image_flow, linearise


def draw_colours(buffers: Buffers, scene: Scene, shown: wp.array, into: wp.array | None) -> wp.array:
    """Colours 0..1 of the shown views, vec3 [image, row, column]."""
    image = buffers.image(len(shown), wp.vec3, into)
    buffers.launch_views(
        kernels.resolve_rgb_kernel,
        (len(shown), buffers.height_px, buffers.row_lanes),
        inputs=[
            buffers.view, scene.triangles, scene.vertex_rgb, *scene.background_rgb, buffers.key, shown,
            buffers.supersampling, FIRST, buffers.row_lanes,
        ],
        outputs=[image],
    )  # fmt: skip
    return image


def draw_depths(
    buffers: Buffers, scene: Scene, background_m: float, into: tuple[wp.array, wp.array] | None
) -> tuple[wp.array, wp.array]:
    """Depths [m] and ids, [view, row, column]."""
    depth_m = buffers.image(buffers.view_count, float, into[0] if into else None)
    object_id = buffers.image(buffers.view_count, wp.int32, into[1] if into else None)
    buffers.launch_views(
        kernels.resolve_depth_kernel,
        (buffers.view_count, buffers.height_px, buffers.row_lanes),
        inputs=[
            buffers.key, scene.triangles, background_m, scene.occluder_count, buffers.supersampling, FIRST,
            buffers.row_lanes,
        ],
        outputs=[depth_m, object_id],
    )  # fmt: skip
    return depth_m, object_id


def draw_incidence(buffers: Buffers, scene: Scene) -> wp.array:
    """Cosines of incidence, float [view, row, column]."""
    cosine = buffers.image(buffers.view_count, float, None)
    lanes = buffers.row_lanes
    buffers.launch_views(
        kernels.resolve_incidence_kernel,
        (buffers.view_count, buffers.height_px, lanes),
        inputs=[buffers.view, buffers.key, scene.triangles, buffers.supersampling, FIRST, lanes],
        outputs=[cosine],
    )
    return cosine


def draw_silhouettes(buffers: Buffers, scene: Scene, kind: int) -> wp.array:
    """Share of every pixel that each object covers, float [view, object, row, column]."""
    silhouette = buffers.zeros((buffers.view_count, scene.object_count, buffers.height_px, buffers.width_px), float)
    buffers.launch_views(
        kernels.resolve_silhouettes_kernel,
        (buffers.view_count, scene.object_count, buffers.row_lanes),
        inputs=[buffers.layers, buffers.hiding, kind, buffers.supersampling, FIRST, buffers.row_lanes],
        outputs=[silhouette],
    )
    return silhouette


def flow_of_colours(buffers: Buffers, scene: Scene, image: wp.array, shown: wp.array, into: list[wp.array]) -> None:
    """Add what the gradient to a colour image says about the views to the gradients of their parts."""
    derivative = _flows(buffers, shown)
    buffers.launch_views(
        image_flow.flow_colours_kernel,
        (len(shown), math.prod(buffers.flow_lanes)),
        inputs=[
            buffers.view, scene.triangles, scene.vertex_rgb, *scene.background_rgb, buffers.key, shown, image.grad,
            buffers.supersampling, FIRST, *buffers.flow_lanes,
        ],
        outputs=[derivative],
    )  # fmt: skip
    _add_flow(buffers, shown, derivative, into)


def flow_of_depths(buffers: Buffers, depth_m: wp.array, background_m: float, into: list[wp.array]) -> None:
    """Add what the gradient to a depth image says about the views to the gradients of their parts."""
    shown = buffers.shown_views(None)
    derivative = _flows(buffers, shown)
    buffers.launch_views(
        image_flow.flow_depths_kernel,
        (len(shown), math.prod(buffers.flow_lanes)),
        inputs=[
            buffers.view, buffers.key, depth_m.grad, background_m, buffers.supersampling, FIRST, *buffers.flow_lanes,
        ],
        outputs=[derivative],
    )  # fmt: skip
    _add_flow(buffers, shown, derivative, into)


def flow_of_silhouettes(buffers: Buffers, scene: Scene, silhouette: wp.array, kind: int, into: list[wp.array]) -> None:
    """Add what the gradient to the silhouettes says about the views to the gradients of their parts.

    A sum of weights times silhouettes is a weighted area.
    """
    assert silhouette.grad is not None
    weight = checked_weight(buffers, scene, silhouette.grad)
    measures = measure_weighted(buffers, scene, weight, kind=kind, hiding=buffers.hiding, into=None)
    buffers.launch(
        linearise.add_pose_gradient_kernel,
        buffers.view_count,
        inputs=[
            buffers.camera_from_world, measures.jac_translation, measures.jac_rotation, measures.jac_log_focal,
        ],
        outputs=into,
    )  # fmt: skip


def _flows(buffers: Buffers, shown: wp.array) -> wp.array:
    """Room for what flows through each image."""
    wp.load_module(image_flow, device=buffers.device)  # few programs need it; before threads launch
    shape = (len(shown), 1, 1, math.prod(buffers.flow_lanes))
    return buffers.kept("image derivative", shape, kernels.BoundaryDerivative)


def _add_flow(buffers: Buffers, shown: wp.array, derivative: wp.array, into: list[wp.array]) -> None:
    buffers.launch(
        image_flow.add_view_gradient_kernel,
        buffers.view_count,
        inputs=[buffers.view, shown, buffers.grouped(derivative), buffers.supersampling],
        outputs=into,
    )


def record(buffers: Buffers, image: wp.array, poses: ViewPoses, backward: Callable[[list[wp.array]], None]) -> None:
    """Record on the active tape that ``backward(gradients)`` adds to the gradients of the poses' parts.

    Parts that want no gradient get a buffer that nobody reads.
    """
    # Warp has no public name for the tape that records now, None outside of any: its own ``wp.copy`` asks so (1.19)
    tape: wp.Tape | None = wp._src.context.runtime.tape  # pyright: ignore[reportAttributeAccessIssue]
    wanted = [array for array in poses if array is not None and array.requires_grad]
    if tape is None or not wanted:
        return
    gradients = [
        array.grad
        if array is not None and array.grad is not None
        else buffers.kept(f"unwanted {i}", (buffers.view_count,), dtype)
        for i, (array, dtype) in enumerate(zip(poses, (wp.vec3, wp.mat33, float), strict=True))
    ]
    tape.record_func(lambda: backward(gradients), [image, *wanted])


def require_depth(background_m: float) -> None:
    if not math.isfinite(background_m):
        raise InputError(f"background_m must be finite where depths have a gradient, got {background_m}")


def visible_masks(buffers: Buffers, scene: Scene, shown_view: list[int]) -> list[list[tuple[int, int, np.ndarray]]]:
    rectangle, offset = buffers.layers.rectangle.numpy(), buffers.layers.offset.numpy()
    visible = (buffers.layers.inverse_depth_bits.numpy() != 0) & (buffers.hiding.bits.numpy() == 0)
    masks = []
    for v in shown_view:
        row_of_masks = []
        for k in range(scene.object_count):
            left, top, columns, rows = (int(value) for value in rectangle[v, k])
            first = int(offset[v, k])
            mask = visible[first : first + rows * columns].reshape(rows, columns)
            # cut the guard band off
            cut_left, cut_top = max(GUARD - left, 0), max(GUARD - top, 0)
            mask = mask[cut_top : buffers.height - GUARD - top, cut_left : buffers.width - GUARD - left]
            row_of_masks.append((left + cut_left - GUARD, top + cut_top - GUARD, mask))
        masks.append(row_of_masks)
    return masks
