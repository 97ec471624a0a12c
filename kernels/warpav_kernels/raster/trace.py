"""Decide, for lenses that are no pinholes: the buffers of `rasterise` by ray queries, those that `ray_space` leaves.

A straight edge is no straight line in such an image, so every sample sends a ray through the lens instead. The scene is
one mesh whose triangles are grouped by object: a ray for a layer only asks that object's group.

Where a layer ends between two samples, or its front does and a farther part of it begins, is found by halving the way
from the last ray that hits it to the first that does not.
"""

import warp as wp

from warpav_kernels.raster.layers import LEAST_INVERSE_DEPTH, NEAR_CUT, Layers, place_in, step_of
from warpav_kernels.raster.rasterise import LEAST_OFFSET
from warpav_kernels.raster.triangles import Triangles
from warpav_kernels.raster.view import View, inverse_depth_of, ray_between, sample_ray

wp.set_module_options({"enable_backward": False})

FARTHEST_M = wp.constant(1.0e6)
CROSSING_STEPS = wp.constant(12)  # halvings of a sample
NEAR_TOLERANCE = wp.constant(3.0e-4)  # of 1/z, by which a surface ends where it is too near
LEAST_STEP = wp.constant(0.1)  # of 1/z, from a layer's front to a part behind it
WHOLE_SCENE = wp.constant(-1)  # root of the whole mesh


@wp.struct
class Hit:
    """What a ray hits.

    Attributes:
        inverse_depth: 1/depth [1/m]; 0 where it hits nothing.
        triangle: The triangle; -1 where it hits nothing.
    """

    inverse_depth: float
    triangle: int


@wp.func
def first_hit(camera: View, mesh: wp.uint64, root: int, ray: wp.vec3) -> Hit:
    """The nearest surface along a ray of depth 1 in camera coordinates; none for a ray of zero."""
    hit = Hit()
    hit.inverse_depth = 0.0
    hit.triangle = -1
    if wp.length_sq(ray) > 0.0:
        direction = wp.transpose(camera.camera_from_world) * ray
        # what is nearer is cut away
        start_world_m = camera.position_world_m + camera.near_m * direction
        query = wp.mesh_query_ray(mesh, start_world_m, direction, FARTHEST_M, root)
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
    hit = first_hit(camera, mesh, WHOLE_SCENE, sample_ray(camera, row, column))
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


@wp.kernel(enable_backward=False, launch_bounds=(256, 4))
def trace_crossings_kernel(
    # in
    view: wp.array[View],
    mesh: wp.uint64,
    layer_body: wp.array[wp.int32],
    bent_view: wp.array[wp.int32],
    first: int,
    row_lanes: int,
    column_lanes: int,
    # out
    layers: Layers,
):
    """How far every layer's front goes on from its outermost samples towards the neighbours that it does not cover.

    Launch: ``dim=(bent views of this chunk, layer_count, row_lanes * column_lanes)``; the lanes of a pair share its
    samples. Not taped.
    Writes: ``layers.crossing_key`` of these views at outlines; the caller zeroes it.
    """
    i, layer, lane = wp.tid()
    v = bent_view[first + i]
    camera = view[v]
    rectangle = layers.rectangle[v, layer]
    offset = layers.offset[v, layer]
    root = wp.mesh_get_group_root(mesh, layer_body[layer])
    for r in range(lane / column_lanes, rectangle[3], row_lanes):
        for c in range(lane % column_lanes, rectangle[2], column_lanes):
            row = rectangle[1] + r
            column = rectangle[0] + c
            place = offset + r * rectangle[2] + c
            bits = layers.inverse_depth_bits[place]
            if bits != wp.int32(0):
                for direction in range(4):
                    step = step_of(direction)
                    other = place_in(rectangle, offset, row + step[0], column + step[1])
                    # what is at least so near is the front that is followed
                    front = float(0.0)
                    is_outline = False
                    if other >= 0:
                        behind = inverse_depth_of(layers.inverse_depth_bits[other])
                        is_outline = behind < (1.0 - LEAST_STEP) * inverse_depth_of(bits)
                        if behind > 0.0:
                            front = 0.5 * (behind + inverse_depth_of(bits))
                    if is_outline:
                        here = sample_ray(camera, row, column)
                        there = sample_ray(camera, row + step[0], column + step[1])
                        if wp.length_sq(there) > 0.0:
                            inside = float(0.0)
                            outside = float(1.0)
                            end_inverse_depth = inverse_depth_of(bits)
                            end_triangle = int(-1)
                            for _ in range(CROSSING_STEPS):
                                middle = 0.5 * (inside + outside)
                                hit = first_hit(camera, mesh, root, ray_between(here, there, middle))
                                if hit.triangle >= 0 and hit.inverse_depth >= front:
                                    inside = middle
                                    end_inverse_depth = hit.inverse_depth
                                    end_triangle = hit.triangle
                                else:
                                    outside = middle
                            end = wp.int64(wp.cast(end_inverse_depth, wp.int32))
                            if end_triangle >= 0 and end_inverse_depth * camera.near_m > 1.0 - NEAR_TOLERANCE:
                                end = NEAR_CUT | wp.int64(end_triangle)
                            offset_bits = wp.cast(wp.max(0.5 * (inside + outside), LEAST_OFFSET), wp.int32)
                            layers.crossing_key[direction, place] = (wp.int64(offset_bits) << wp.int64(32)) | end
