"""Where outlines cross between samples, by ray queries: an oracle for crossings in the space of rays.

Where a layer ends between two samples, or its front does and a farther part of it begins, is found by halving the way
from the last ray that hits it to the first that does not.
"""

import warp as wp

from warpav.raster.buffers import Buffers
from warpav.raster.scene import Scene
from warpav_kernels.raster._layers import NEAR_CUT, Layers, place_in, step_of
from warpav_kernels.raster._rasterise import LEAST_OFFSET
from warpav_kernels.raster._trace import first_hit
from warpav_kernels.raster._view import View, inverse_depth_of, ray_between, sample_ray

wp.set_module_options({"enable_backward": False})

CROSSING_STEPS = wp.constant(12)  # halvings of a sample
NEAR_TOLERANCE = wp.constant(3.0e-4)  # of 1/z, by which a surface ends where it is too near
LEAST_STEP = wp.constant(0.1)  # of 1/z, from a layer's front to a part behind it


@wp.kernel(enable_backward=False)
def trace_crossings_kernel(
    # in
    view: wp.array[View],
    mesh: wp.uint64,
    layer_body: wp.array[wp.int32],
    bent_view: wp.array[wp.int32],
    # out
    layers: Layers,
):
    """How far every layer's front goes on from its outermost samples towards the neighbours that it does not cover."""
    i, layer = wp.tid()
    v = bent_view[i]
    camera = view[v]
    rectangle = layers.rectangle[v, layer]
    offset = layers.offset[v, layer]
    root = wp.mesh_get_group_root(mesh, layer_body[layer])
    for r in range(rectangle[3]):
        for c in range(rectangle[2]):
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


def trace_crossings(buffers: Buffers, scene: Scene, layer_count: int) -> None:
    """Raise ``buffers.layers.crossing_key``, which the caller zeroes, at the outlines of the first layers."""
    wp.launch(
        trace_crossings_kernel,
        (len(buffers.bent), layer_count),
        inputs=[buffers.view, scene.mesh.id, scene.layer_body, buffers.bent_view],
        outputs=[buffers.layers],
        device=buffers.device,
    )
