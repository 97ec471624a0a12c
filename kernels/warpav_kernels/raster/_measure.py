"""Measure: areas and extents of every object in every view, with their Jacobians to the view's pose and focal length.

Move the camera a little and every point of the static scene moves in the image. The area of a mask changes only at its
outline, and what moves there is the surface in front: the object itself at its own outline, the occluder where
something hides it. With the outline as a polygon (see `outline`), the change of a weighted area is the sum over its
segments of weight x (image flow of the front surface's point) x (normal of the segment times its length).

A perturbation of a view is a shift of its centre, ``shift`` (world axes), a small rotation, ``spin`` (camera axes, from
the left), and a relative change of its focal lengths, ``log_focal``: a point q in camera coordinates becomes
``q + spin x q - camera_from_world shift``. With g the gradient to q of the flow along the normal, this gives the
Jacobians ``q x g`` and ``-camera_from_world^T g``; under the last every image point moves away from the principal
point.

The samples of a pair of view and object are shared by lanes, whose sums are added in a fixed order: results are the
same bit for bit from run to run.
"""

import warp as wp

from warpav_kernels.raster._layers import Layers
from warpav_kernels.raster._outline import (
    ALONE,
    VISIBLE,
    Hiding,
    Segment,
    cell_of,
    cell_segment,
    is_in_mask,
    mask_corners,
    own_corners,
    pair_of,
    segment_cuts,
    unhidden_corners,
)
from warpav_kernels.raster._triangles import Triangles
from warpav_kernels.raster._view import GUARD, View, column_gradient, depth_gradient, ray_in_camera, row_gradient

wp.set_module_options({"enable_backward": False})

# the measures of an object in a view, in this order
VISIBLE_AREA = wp.constant(0)  # not hidden by anything, inside the image [px^2]
AMODAL_AREA = wp.constant(1)  # the object alone, inside the image [px^2]
BOX_AREA = wp.constant(2)  # the visible part inside a given box [px^2]
LEFT = wp.constant(3)  # extent of the object alone inside the image [px]
RIGHT = wp.constant(4)
TOP = wp.constant(5)
BOTTOM = wp.constant(6)
MEASURE_COUNT = wp.constant(7)
AREA_COUNT = wp.constant(3)
EXTENT_COUNT = wp.constant(4)

# A gradient is meant for steps, and within a step an outline moves: where weights jump from pixel to pixel, those so
# far [px] to either side of it count.
_OUTLINE_STEP = wp.constant(1.0 / 16.0)

_LEAST_LEVEL = wp.constant(1.0e-6)  # squared sine of the angle between a surface and the near plane that cuts it
_LEAST_TURN = wp.constant(0.01)  # squared sine of the angle between two cuts that have a corner


@wp.struct
class BoundaryDerivative:
    """An area and how it changes as the view moves: sums over samples and over segments of its boundary."""

    area: float  # the area, in samples
    gradient: wp.vec3  # sum of the gradients g of the flow along the boundary's normal, in camera axes [samples/m]
    moment: wp.vec3  # sum of their moments q x g [samples/rad]
    log_focal: float  # change under a relative change of the focal lengths [samples]


@wp.func
def _cut_gradient(
    camera: View, scene: Triangles, start_triangle: int, end_triangle: int, point_m: wp.vec3, flow: wp.vec3
) -> wp.vec3:
    """Gradient of the flow across a segment along which the near plane cuts a surface, to the surface's point.

    The cut is no point of the surface: it slides along it and stays on the near plane. Where a surface of normal n is
    displaced by dq, its cut moves by a step d in the near plane with ``m . d = n . dq``, m being the part of n along
    that plane. Two surfaces that meet in the segment give two equations, and so the step of their corner; one alone
    gives its step along m. ``flow`` is the gradient of the flow of a point of the near plane; it is returned for
    surfaces as level as that plane. (For lenses whose depth is distance it is a sphere, and this its tangent plane.)
    """
    start_plane = scene.triangle_plane[start_triangle]
    end_plane = scene.triangle_plane[end_triangle]
    a = camera.camera_from_world * wp.vec3(start_plane[0], start_plane[1], start_plane[2])
    b = camera.camera_from_world * wp.vec3(end_plane[0], end_plane[1], end_plane[2])
    # the parts along the near plane
    axis = depth_gradient(camera, point_m)
    a_level = a - wp.dot(a, axis) * axis
    b_level = b - wp.dot(b, axis) * axis
    a_squared = wp.dot(a_level, a_level)
    b_squared = wp.dot(b_level, b_level)
    if wp.min(a_squared, b_squared) < _LEAST_LEVEL:
        return flow
    turn = wp.dot(axis, wp.cross(a_level, b_level))
    if turn * turn > _LEAST_TURN * a_squared * b_squared:
        along_a = wp.dot(flow, wp.cross(a_level, axis))
        along_b = wp.dot(flow, wp.cross(b_level, axis))
        return (along_b * a - along_a * b) / turn
    return 0.5 * (wp.dot(flow, a_level) / a_squared * a + wp.dot(flow, b_level) / b_squared * b)


@wp.func
def with_step(
    derivative: BoundaryDerivative,
    camera: View,
    scene: Triangles,
    segment: Segment,
    across_columns: float,
    across_rows: float,
) -> BoundaryDerivative:
    """The derivative with one more segment, whose weighted normal is (across_columns, across_rows)."""
    column = 0.5 * (segment.start[0] + segment.end[0])
    row = 0.5 * (segment.start[1] + segment.end[1])
    moved = derivative
    moved.log_focal += across_columns * (column - camera.centre[0]) + across_rows * (row - camera.centre[1])
    if segment.is_fixed:
        return moved
    point_m = ray_in_camera(camera, column, row) / segment.inverse_depth
    g = across_columns * column_gradient(camera, point_m) + across_rows * row_gradient(camera, point_m)
    if segment.start_cut >= 0 and segment.end_cut >= 0:
        g = _cut_gradient(camera, scene, segment.start_cut, segment.end_cut, point_m, g)
    moved.gradient += g
    moved.moment += wp.cross(point_m, g)
    return moved


@wp.func
def frame_weight(column: float, row: float, width: int, height: int) -> float:
    """1 inside the image, 0 in the guard band."""
    if row < float(GUARD) or column < float(GUARD):
        return 0.0
    if row >= float(height - GUARD) or column >= float(width - GUARD):
        return 0.0
    return 1.0


@wp.func
def _box_weight(column: float, row: float, box_px: wp.vec4, samples_per_px: float) -> float:
    """1 where a place of the grid lies inside the box (left, top, right, bottom [px]), else 0."""
    x = (column - float(GUARD)) / samples_per_px
    y = (row - float(GUARD)) / samples_per_px
    if x >= box_px[0] and x < box_px[2] and y >= box_px[1] and y < box_px[3]:
        return 1.0
    return 0.0


@wp.func
def _pixel_weight(column: int, row: int, weight_image: wp.array3d[float], image: int) -> float:
    """Weight of a pixel in one of the images; 0 beyond it."""
    if column < 0 or row < 0 or column >= weight_image.shape[2] or row >= weight_image.shape[1]:
        return 0.0
    return weight_image[image, row, column]


@wp.func
def image_weight(
    column: float, row: float, weight_image: wp.array3d[float], image: int, samples_per_px: float
) -> float:
    """The weight of the pixel that holds a sample's centre."""
    x = int(wp.floor((column - float(GUARD)) / samples_per_px))
    y = int(wp.floor((row - float(GUARD)) / samples_per_px))
    return _pixel_weight(x, y, weight_image, image)


@wp.func
def _outline_weight(
    column: float, row: float, weight_image: wp.array3d[float], image: int, samples_per_px: float
) -> float:
    """Weight at a place of an outline: the mean over as far as it moves in a small step, see `_OUTLINE_STEP`."""
    x = (column - float(GUARD)) / samples_per_px - _OUTLINE_STEP
    y = (row - float(GUARD)) / samples_per_px - _OUTLINE_STEP
    left = wp.floor(x)
    top = wp.floor(y)
    # shares of the next column and row of pixels in the square of twice the step
    right_share = wp.clamp((x - left - 1.0) / (2.0 * _OUTLINE_STEP) + 1.0, 0.0, 1.0)
    bottom_share = wp.clamp((y - top - 1.0) / (2.0 * _OUTLINE_STEP) + 1.0, 0.0, 1.0)
    i = int(top)
    j = int(left)
    weight = (1.0 - right_share) * (1.0 - bottom_share) * _pixel_weight(j, i, weight_image, image)
    if right_share > 0.0:
        weight += right_share * (1.0 - bottom_share) * _pixel_weight(j + 1, i, weight_image, image)
    if bottom_share > 0.0:
        weight += (1.0 - right_share) * bottom_share * _pixel_weight(j, i + 1, weight_image, image)
        if right_share > 0.0:
            weight += right_share * bottom_share * _pixel_weight(j + 1, i + 1, weight_image, image)
    return weight


@wp.kernel(enable_backward=False)
def measure_areas_kernel(
    # in
    view: wp.array[View],
    scene: Triangles,
    layers: Layers,
    hiding: Hiding,
    box_px: wp.array2d[wp.vec4],
    width: int,
    height: int,
    supersampling: int,
    first_view: int,
    row_lanes: int,
    column_lanes: int,
    # out
    derivative: wp.array4d[BoundaryDerivative],
    farthest: wp.array3d[wp.int32],
):
    """Visible, amodal and in-box area of one object in one view, and their derivatives, over one lane's samples.

    On the way it finds how far the object reaches in the image to the left, right, top and bottom: ``farthest`` counts
    the samples from the opposite side of the grid.

    Launch: ``dim=(views of this chunk, object_count, row_lanes * column_lanes)``. Not taped.
    Writes: ``derivative`` [view, object, measure, lane] of these views, in the order VISIBLE_AREA, AMODAL_AREA,
        BOX_AREA; ``farthest`` [view, object, side] by atomic maximum; the caller zeroes it.
    """
    chunk_view, object_index, lane = wp.tid()
    v = first_view + chunk_view
    camera = view[v]
    pair = pair_of(v, object_index, layers)
    box = box_px[v, object_index]
    samples_per_px = float(supersampling)
    visible = BoundaryDerivative()
    amodal = BoundaryDerivative()
    boxed = BoundaryDerivative()
    to_left = int(0)
    to_right = int(0)
    to_top = int(0)
    to_bottom = int(0)
    for row in range(lane / column_lanes, pair.rectangle[3], row_lanes):
        for column in range(lane % column_lanes, pair.rectangle[2], column_lanes):
            place = pair.offset + row * pair.rectangle[2] + column
            if layers.inverse_depth_bits[place] != wp.int32(0):
                x = float(pair.rectangle[0] + column) + 0.5
                y = float(pair.rectangle[1] + row) + 0.5
                weight = frame_weight(x, y, width, height)
                amodal.area += weight
                if weight > 0.0:
                    to_left = wp.max(to_left, width - pair.rectangle[0] - column)
                    to_right = wp.max(to_right, pair.rectangle[0] + column + 1)
                    to_top = wp.max(to_top, height - pair.rectangle[1] - row)
                    to_bottom = wp.max(to_bottom, pair.rectangle[1] + row + 1)
                if hiding.bits[place] == wp.int32(0):
                    visible.area += weight
                    boxed.area += weight * _box_weight(x, y, box, samples_per_px)
            if row + 1 < pair.rectangle[3] and column + 1 < pair.rectangle[2]:
                own = own_corners(pair, row, column, layers)
                if own != 0:
                    seen = own & unhidden_corners(pair, row, column, hiding)
                    if own != 15:
                        cell = cell_of(camera, pair, row, column, own)
                        for index in range(cell.segment_count):
                            segment = cell_segment(
                                cell, index, pair, ALONE, camera, scene, layers, hiding, width, height
                            )
                            cut = segment_cuts(segment)
                            extent = segment.end - segment.start
                            inside = float(0.0)
                            for k in range(3):
                                middle = segment.start + 0.5 * (cut[k] + cut[k + 1]) * extent
                                inside += (cut[k + 1] - cut[k]) * frame_weight(middle[0], middle[1], width, height)
                            amodal = with_step(amodal, camera, scene, segment, inside * extent[1], -inside * extent[0])
                    if seen != 0 and seen != 15:
                        cell = cell_of(camera, pair, row, column, seen)
                        for index in range(cell.segment_count):
                            segment = cell_segment(
                                cell, index, pair, VISIBLE, camera, scene, layers, hiding, width, height
                            )
                            cut = segment_cuts(segment)
                            extent = segment.end - segment.start
                            inside = float(0.0)
                            in_box = float(0.0)
                            for k in range(3):
                                middle = segment.start + 0.5 * (cut[k] + cut[k + 1]) * extent
                                share = (cut[k + 1] - cut[k]) * frame_weight(middle[0], middle[1], width, height)
                                inside += share
                                in_box += share * _box_weight(middle[0], middle[1], box, samples_per_px)
                            visible = with_step(
                                visible, camera, scene, segment, inside * extent[1], -inside * extent[0]
                            )
                            if in_box > 0.0:
                                boxed = with_step(
                                    boxed, camera, scene, segment, in_box * extent[1], -in_box * extent[0]
                                )
    derivative[v, object_index, VISIBLE_AREA, lane] = visible
    derivative[v, object_index, AMODAL_AREA, lane] = amodal
    derivative[v, object_index, BOX_AREA, lane] = boxed
    if to_left > 0:
        wp.atomic_max(farthest, v, object_index, LEFT - LEFT, to_left)
        wp.atomic_max(farthest, v, object_index, RIGHT - LEFT, to_right)
        wp.atomic_max(farthest, v, object_index, TOP - LEFT, to_top)
        wp.atomic_max(farthest, v, object_index, BOTTOM - LEFT, to_bottom)


@wp.kernel(enable_backward=False)
def measure_weighted_area_kernel(
    # in
    view: wp.array[View],
    scene: Triangles,
    layers: Layers,
    hiding: Hiding,
    weight_image: wp.array3d[float],
    view_stride: int,
    object_stride: int,
    kind: int,
    width: int,
    height: int,
    supersampling: int,
    first_view: int,
    row_lanes: int,
    column_lanes: int,
    # out
    derivative: wp.array4d[BoundaryDerivative],
):
    """Area of one object in one view weighted by an image, and its derivative, over one lane's samples.

    ``weight_image`` is [image, row, column] in pixels; object k in view v takes image
    ``v * view_stride + k * object_stride``.

    Launch: ``dim=(views of this chunk, object_count, row_lanes * column_lanes)``. Not taped.
    Writes: ``derivative`` [view, object, 0, lane] of these views.
    """
    chunk_view, object_index, lane = wp.tid()
    v = first_view + chunk_view
    camera = view[v]
    pair = pair_of(v, object_index, layers)
    image = v * view_stride + object_index * object_stride
    samples_per_px = float(supersampling)
    weighted = BoundaryDerivative()
    for row in range(lane / column_lanes, pair.rectangle[3], row_lanes):
        for column in range(lane % column_lanes, pair.rectangle[2], column_lanes):
            if is_in_mask(pair, row, column, kind, layers, hiding):
                x = float(pair.rectangle[0] + column) + 0.5
                y = float(pair.rectangle[1] + row) + 0.5
                weighted.area += image_weight(x, y, weight_image, image, samples_per_px)
            mask = mask_corners(pair, row, column, kind, layers, hiding)
            if mask != 0 and mask != 15:
                cell = cell_of(camera, pair, row, column, mask)
                for index in range(cell.segment_count):
                    segment = cell_segment(cell, index, pair, kind, camera, scene, layers, hiding, width, height)
                    cut = segment_cuts(segment)
                    extent = segment.end - segment.start
                    weight = float(0.0)
                    for k in range(3):
                        middle = segment.start + 0.5 * (cut[k] + cut[k + 1]) * extent
                        weight += (cut[k + 1] - cut[k]) * _outline_weight(
                            middle[0], middle[1], weight_image, image, samples_per_px
                        )
                    weighted = with_step(weighted, camera, scene, segment, weight * extent[1], -weight * extent[0])
    derivative[v, object_index, 0, lane] = weighted


@wp.func
def derivative_of_lanes(
    derivative: wp.array4d[BoundaryDerivative], v: int, object_index: int, i: int, first_lane: int, end_lane: int
) -> BoundaryDerivative:
    """The sum of what some lanes have measured, in their order."""
    total = BoundaryDerivative()
    for lane in range(first_lane, end_lane):
        part = derivative[v, object_index, i, lane]
        total.area += part.area
        total.gradient += part.gradient
        total.moment += part.moment
        total.log_focal += part.log_focal
    return total


@wp.kernel(enable_backward=False)
def sum_lanes_kernel(
    # in
    derivative: wp.array4d[BoundaryDerivative],
    group_lanes: int,
    # out
    group_derivative: wp.array4d[BoundaryDerivative],
):
    """Sum groups of neighbouring lanes, so that the last sum is short.

    Launch: ``dim=(view_count, object_count, area_count, group_count)``; one thread per group. Not taped.
    Writes: every element of ``group_derivative`` once.
    """
    v, object_index, i, group = wp.tid()
    first_lane = group * group_lanes
    group_derivative[v, object_index, i, group] = derivative_of_lanes(
        derivative, v, object_index, i, first_lane, first_lane + group_lanes
    )


@wp.kernel(enable_backward=False)
def sum_derivatives_kernel(
    # in
    view: wp.array[View],
    derivative: wp.array4d[BoundaryDerivative],
    supersampling: int,
    # out
    measure: wp.array3d[float],
    jac_translation: wp.array3d[wp.vec3],
    jac_rotation: wp.array3d[wp.vec3],
    jac_log_focal: wp.array3d[float],
):
    """Sum what the lanes have measured, in their order, and turn it into pixels and world axes.

    Launch: ``dim=(view_count, object_count, area_count)``; one thread per sum. Not taped.
    Writes: the first ``area_count`` measures of every view and object once.
    """
    v, object_index, i = wp.tid()
    total = derivative_of_lanes(derivative, v, object_index, i, 0, derivative.shape[3])
    per_sample = 1.0 / (float(supersampling) * float(supersampling))
    measure[v, object_index, i] = per_sample * total.area
    jac_translation[v, object_index, i] = -per_sample * (wp.transpose(view[v].camera_from_world) * total.gradient)
    jac_rotation[v, object_index, i] = per_sample * total.moment
    jac_log_focal[v, object_index, i] = per_sample * total.log_focal


@wp.kernel(enable_backward=False)
def gather_jacobian_kernel(
    # in
    jac_translation: wp.array3d[wp.vec3],
    jac_rotation: wp.array3d[wp.vec3],
    jac_log_focal: wp.array3d[float],
    first: int,
    # out
    jacobian: wp.array4d[float],
):
    """The Jacobians of some neighbouring measures in one array, from the measure ``first`` on.

    Launch: ``dim=jacobian.shape[:3]``; one thread per measure of an object in a view. Not taped.
    Writes: every element of ``jacobian`` [view, object, measure, 7] once: translation, rotation, log focal length.
    """
    v, object_index, i = wp.tid()
    translation = jac_translation[v, object_index, first + i]
    rotation = jac_rotation[v, object_index, first + i]
    for axis in range(3):
        jacobian[v, object_index, i, axis] = translation[axis]
        jacobian[v, object_index, i, 3 + axis] = rotation[axis]
    jacobian[v, object_index, i, 6] = jac_log_focal[v, object_index, first + i]
