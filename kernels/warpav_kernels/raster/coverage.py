"""Measure: areas, extents and solid angles of every object in every view, as `measure` and `window`, without Jacobians.

What only the samples say needs no outline, and so no edge crossings.
"""

import warp as wp

from warpav_kernels.raster._layers import Layers
from warpav_kernels.raster._measure import (
    AMODAL_AREA,
    BOTTOM,
    BOX_AREA,
    LEFT,
    RIGHT,
    TOP,
    VISIBLE_AREA,
    frame_weight,
    image_weight,
)
from warpav_kernels.raster._outline import Hiding, pair_of
from warpav_kernels.raster._triangles import Triangles
from warpav_kernels.raster._view import GUARD, View, sample_ray, solid_angle

wp.set_module_options({"enable_backward": False})


@wp.struct
class Coverage:
    """What an object covers: sums over samples inside the image.

    Attributes:
        visible: Samples that nothing hides.
        amodal: Samples of the object alone.
        solid_angle_sr: Their solid angle.
        visible_sr: Solid angle of the samples that nothing hides.
        farthest: How far they reach to the left, right, top and bottom: samples from the opposite side of the grid; 0
            where there are none.
    """

    visible: float
    amodal: float
    solid_angle_sr: float
    visible_sr: float
    farthest: wp.vec4i


@wp.kernel(enable_backward=False)
def measure_coverage_kernel(
    # in
    view: wp.array[View],
    layers: Layers,
    hiding: Hiding,
    width: int,
    height: int,
    first_view: int,
    row_lanes: int,
    column_lanes: int,
    # out
    coverage: wp.array3d[Coverage],
):
    """What one object covers in one view, over one lane's samples.

    Launch: ``dim=(views of this chunk, object_count, row_lanes * column_lanes)``. Not taped.
    Writes: ``coverage`` [view, object, lane] of these views.
    """
    chunk_view, object_index, lane = wp.tid()
    v = first_view + chunk_view
    camera = view[v]
    pair = pair_of(v, object_index, layers)
    visible = float(0.0)
    amodal = float(0.0)
    solid_angle_sr = float(0.0)
    visible_sr = float(0.0)
    to_left = int(0)
    to_right = int(0)
    to_top = int(0)
    to_bottom = int(0)
    for r in range(lane / column_lanes, pair.rectangle[3], row_lanes):
        for c in range(lane % column_lanes, pair.rectangle[2], column_lanes):
            place = pair.offset + r * pair.rectangle[2] + c
            if layers.inverse_depth_bits[place] != wp.int32(0):
                row = pair.rectangle[1] + r
                column = pair.rectangle[0] + c
                x = float(column) + 0.5
                y = float(row) + 0.5
                if frame_weight(x, y, width, height) > 0.0:
                    amodal += 1.0
                    if hiding.bits[place] == wp.int32(0):
                        visible += 1.0
                    ray = sample_ray(camera, row, column)
                    if wp.length_sq(ray) > 0.0:
                        of_sample_sr = solid_angle(camera, ray)
                        solid_angle_sr += of_sample_sr
                        if hiding.bits[place] == wp.int32(0):
                            visible_sr += of_sample_sr
                    to_left = wp.max(to_left, width - column)
                    to_right = wp.max(to_right, column + 1)
                    to_top = wp.max(to_top, height - row)
                    to_bottom = wp.max(to_bottom, row + 1)
    covered = Coverage()
    covered.visible = visible
    covered.amodal = amodal
    covered.solid_angle_sr = solid_angle_sr
    covered.visible_sr = visible_sr
    covered.farthest = wp.vec4i(to_left, to_right, to_top, to_bottom)
    coverage[v, object_index, lane] = covered


@wp.kernel(enable_backward=False)
def sum_coverage_kernel(
    # in
    coverage: wp.array3d[Coverage],
    width: int,
    height: int,
    supersampling: int,
    # out
    measure: wp.array3d[float],
    solid_angle_sr: wp.array3d[float],
    visible_sr: wp.array3d[float],
):
    """Sum what the lanes have found, in their order, and turn it into pixels.

    Launch: ``dim=(view_count, object_count)``; one thread per pair. Not taped.
    Writes: every element of ``measure`` [view, object, measure] once, BOX_AREA with 0, and of ``solid_angle_sr`` and
        ``visible_sr`` [view, object, 1].
    """
    v, k = wp.tid()
    visible = float(0.0)
    amodal = float(0.0)
    solid_angle = float(0.0)
    visible_solid_angle = float(0.0)
    farthest = wp.vec4i(0, 0, 0, 0)
    for lane in range(coverage.shape[2]):
        part = coverage[v, k, lane]
        visible += part.visible
        amodal += part.amodal
        solid_angle += part.solid_angle_sr
        visible_solid_angle += part.visible_sr
        farthest = wp.max(farthest, part.farthest)
    samples_per_px = float(supersampling)
    per_sample = 1.0 / (samples_per_px * samples_per_px)
    measure[v, k, VISIBLE_AREA] = per_sample * visible
    measure[v, k, AMODAL_AREA] = per_sample * amodal
    measure[v, k, BOX_AREA] = 0.0
    solid_angle_sr[v, k, 0] = solid_angle
    visible_sr[v, k, 0] = visible_solid_angle
    measure[v, k, LEFT] = float(width - 2 * GUARD) / samples_per_px
    measure[v, k, RIGHT] = 0.0
    measure[v, k, TOP] = float(height - 2 * GUARD) / samples_per_px
    measure[v, k, BOTTOM] = 0.0
    if farthest[0] > 0:
        measure[v, k, LEFT] = float(width - farthest[0] - GUARD) / samples_per_px
        measure[v, k, RIGHT] = float(farthest[1] - GUARD) / samples_per_px
        measure[v, k, TOP] = float(height - farthest[2] - GUARD) / samples_per_px
        measure[v, k, BOTTOM] = float(farthest[3] - GUARD) / samples_per_px


@wp.kernel(enable_backward=False)
def weigh_keys_kernel(
    # in
    key: wp.array3d[wp.int64],
    scene: Triangles,
    scissor: wp.array[wp.vec4i],
    weight_image: wp.array3d[float],
    view_stride: int,
    object_stride: int,
    supersampling: int,
    first_view: int,
    lane_count: int,
    # out
    weighted: wp.array3d[float],
):
    """Area of what of every object is nearest in its view weighted by an image, over one lane's rows, in samples.

    ``weight_image`` is that of `measure_weighted_area_kernel`, whose values these are where the nearest surface hides.

    Launch: ``dim=(views of this chunk, lane_count)``; lane k of n takes the rows k, k + n, ... of a scissor. Not taped.
    Writes: ``weighted`` [view, lane, object] of these views; the caller zeroes it.
    """
    chunk_view, lane = wp.tid()
    v = first_view + chunk_view
    frame = scissor[v]
    for row in range(frame[1] + lane, frame[3], lane_count):
        for column in range(frame[0], frame[2]):
            nearest = key[v, row, column]
            if nearest != wp.int64(0):
                layer = scene.body_layer[scene.triangle_body[wp.int32(nearest & wp.int64(0xFFFFFFFF))]]
                if layer >= 0 and layer < weighted.shape[2]:
                    image = v * view_stride + layer * object_stride
                    x = float(column) + 0.5
                    y = float(row) + 0.5
                    weighted[v, lane, layer] += image_weight(x, y, weight_image, image, float(supersampling))
