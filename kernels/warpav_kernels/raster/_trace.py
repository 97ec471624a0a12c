"""Decide, for lenses that are no pinholes: the buffers of `rasterise` by ray queries, those that `ray_space` leaves.

A straight edge is no straight line in such an image, so every sample sends a ray through the lens instead. The scene is
one mesh whose triangles are grouped by object: a ray for a layer only asks that object's group. Where layers end
between their samples `bent_edges` finds.
"""

import warp as wp

from warpav_kernels.raster._layers import LEAST_INVERSE_DEPTH, Layers
from warpav_kernels.raster._triangles import Triangles
from warpav_kernels.raster._view import View, sample_ray

wp.set_module_options({"enable_backward": False})

_FARTHEST_M = wp.constant(1.0e6)
_WHOLE_SCENE = wp.constant(-1)  # root of the whole mesh


@wp.struct
class _Hit:
    """What a ray hits."""

    inverse_depth: float  # 1/depth [1/m]; 0 where it hits nothing
    triangle: int  # the triangle; -1 where it hits nothing


@wp.func
def first_hit(camera: View, mesh: wp.uint64, root: int, ray: wp.vec3) -> _Hit:
    """The nearest surface along a ray of depth 1 in camera coordinates; none for a ray of zero."""
    hit = _Hit()
    hit.inverse_depth = 0.0
    hit.triangle = -1
    if wp.length_sq(ray) > 0.0:
        direction = wp.transpose(camera.camera_from_world) * ray
        # what is nearer is cut away
        start_world_m = camera.position_world_m + camera.near_m * direction
        query = wp.mesh_query_ray(mesh, start_world_m, direction, _FARTHEST_M, root)
        if query.result:
            hit.inverse_depth = wp.max(1.0 / (camera.near_m + query.t), LEAST_INVERSE_DEPTH)
            hit.triangle = query.face
    return hit


@wp.kernel(enable_backward=False, launch_bounds=(256, 4))
def trace_keys_kernel(
    # in
    view: wp.array[View],
    mesh: wp.uint64,
    bent_view: wp.array[wp.int32],
    scissor: wp.array[wp.vec4i],
    first: int,
    # out
    key: wp.array3d[wp.int64],
):
    """Nearest surface of every sample of these views inside their scissors, as `rasterise` keeps it.

    Launch: ``dim=(bent views of this chunk, height, width)``; one thread per sample. Not taped.
    Writes: the keys of these views inside their scissors once.
    """
    i, row, column = wp.tid()
    v = bent_view[first + i]
    frame = scissor[v]
    if column < frame[0] or row < frame[1] or column >= frame[2] or row >= frame[3]:
        return
    camera = view[v]
    hit = first_hit(camera, mesh, _WHOLE_SCENE, sample_ray(camera, row, column))
    nearest = wp.int64(0)
    if hit.triangle >= 0:
        nearest = (wp.int64(wp.cast(hit.inverse_depth, wp.int32)) << wp.int64(32)) | wp.int64(hit.triangle)
    key[v, row, column] = nearest


@wp.kernel(enable_backward=False, launch_bounds=(256, 4))
def trace_layers_kernel(
    # in
    view: wp.array[View],
    scene: Triangles,
    mesh: wp.uint64,
    layer_body: wp.array[wp.int32],
    bent_view: wp.array[wp.int32],
    key: wp.array3d[wp.int64],
    has_key: int,
    first: int,
    row_lanes: int,
    column_lanes: int,
    # out
    layers: Layers,
):
    """Nearest surface of every layer alone, at every sample of its rectangle.

    Where the key buffer (``has_key`` 1) holds the layer's own object, or nothing, no ray is needed.

    Launch: ``dim=(bent views of this chunk, layer_count, row_lanes * column_lanes)``; the lanes of a pair share its
    samples. Not taped.
    Writes: ``layers.inverse_depth_bits`` of these views where the layers cover them; the caller zeroes it.
    """
    i, layer, lane = wp.tid()
    v = bent_view[first + i]
    camera = view[v]
    rectangle = layers.rectangle[v, layer]
    root = wp.mesh_get_group_root(mesh, layer_body[layer])
    for row in range(lane / column_lanes, rectangle[3], row_lanes):
        for column in range(lane % column_lanes, rectangle[2], column_lanes):
            nearest = wp.int64(0)
            is_asked = True
            if has_key == 1:
                nearest = key[v, rectangle[1] + row, rectangle[0] + column]
                is_asked = nearest != wp.int64(0)
            bits = wp.int32(0)
            if is_asked:
                is_own = False
                if nearest != wp.int64(0):
                    is_own = scene.triangle_body[wp.int32(nearest & wp.int64(0xFFFFFFFF))] == layer_body[layer]
                if is_own:
                    bits = wp.int32(nearest >> wp.int64(32))
                else:
                    ray = sample_ray(camera, rectangle[1] + row, rectangle[0] + column)
                    bits = wp.cast(first_hit(camera, mesh, root, ray).inverse_depth, wp.int32)
            layers.inverse_depth_bits[layers.offset[v, layer] + row * rectangle[2] + column] = bits
