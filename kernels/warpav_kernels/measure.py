"""Measure: areas and extents of every object in every view, with their Jacobians to the view's six degrees of freedom.

Pair flow. Move the camera a little and every point of the static scene moves in the image. The area of a silhouette
changes only at its outline, that is between two neighbouring samples of which one belongs to it and the other does
not. What moves there is the surface in front: the object itself at its outline, the occluder where something hides it.
So every such pair of neighbours contributes (mask_p - mask_q) x (image flow of the front surface's point across the
pair).

A perturbation of a view is a shift of its centre, ``shift`` (ego axes), and a small rotation, ``spin`` (camera axes,
from the left): a point q in camera coordinates becomes ``q + spin x q - camera_from_ego shift``. With g = d(u or v)/dq
this gives the flow ``g . (spin x q) - g . camera_from_ego shift``, hence the Jacobians ``q x g`` and
``-camera_from_ego^T g``.
"""

import warp as wp

from warpav_kernels.view import GUARD, View, inverse_depth_of, ray_in_camera

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

# How far beyond the last sample centre the depth is followed outwards, in samples, and by how much it may change.
OUTWARD_STEP = wp.constant(1.0)
OUTWARD_LIMIT = wp.constant(0.1)


@wp.func
def outward_inverse_depth(front: wp.int32, inner: wp.int32) -> float:
    """Inverse depth of the front surface at its boundary, followed outwards from its inner neighbour."""
    w = inverse_depth_of(front)
    if inner == wp.int32(0):
        return w
    change = OUTWARD_STEP * (w - inverse_depth_of(inner))
    return w + wp.clamp(change, -OUTWARD_LIMIT * w, OUTWARD_LIMIT * w)


@wp.func
def column_flow_gradient(ray: wp.vec3, focal_px: float, inverse_depth: float) -> wp.vec3:
    """Gradient of the image column to the point at ``ray / inverse_depth`` in camera coordinates [px/m]."""
    return wp.vec3(focal_px * inverse_depth, 0.0, -focal_px * inverse_depth * ray[0])


@wp.func
def row_flow_gradient(ray: wp.vec3, focal_px: float, inverse_depth: float) -> wp.vec3:
    """Gradient of the image row to the point at ``ray / inverse_depth`` in camera coordinates [px/m]."""
    return wp.vec3(0.0, focal_px * inverse_depth, -focal_px * inverse_depth * ray[1])


@wp.func
def bits_at(row: int, column: int, rectangle: wp.vec4i, offset: int, bits: wp.array[wp.int32]) -> wp.int32:
    """Bits at a place of a rectangle of the atlas; 0 outside the rectangle."""
    if row < 0 or column < 0 or row >= rectangle[3] or column >= rectangle[2]:
        return wp.int32(0)
    return bits[offset + row * rectangle[2] + column]


@wp.func
def frame_weight(row: int, column: int, width: int, height: int) -> float:
    """1 inside the image, 0 in the guard band."""
    if row < GUARD or column < GUARD or row >= height - GUARD or column >= width - GUARD:
        return 0.0
    return 1.0


@wp.func
def box_weight(row: int, column: int, box: wp.vec4, samples_per_px: float) -> float:
    """1 where the sample's centre lies inside the box (left, top, right, bottom [px]), else 0."""
    x = (float(column - GUARD) + 0.5) / samples_per_px
    y = (float(row - GUARD) + 0.5) / samples_per_px
    if x >= box[0] and x < box[2] and y >= box[1] and y < box[3]:
        return 1.0
    return 0.0


@wp.struct
class Extent:
    """How far an object reaches towards one side of the image, and what moves there.

    Attributes:
        outermost: Column or row of the outermost sample, counted outwards: negative to the left and to the top.
        sample_count: Number of samples that reach as far.
        gradient: Sum of their flow gradients g, in camera axes [px/m].
        moment: Sum of their moments q x g [px/rad].
    """

    outermost: int
    sample_count: float
    gradient: wp.vec3
    moment: wp.vec3


@wp.func
def widened(extent: Extent, outwards: int, gradient: wp.vec3, moment: wp.vec3) -> Extent:
    """The extent with one more sample, which reaches at least as far as it."""
    wider = extent
    if outwards > extent.outermost:
        wider.outermost = outwards
        wider.sample_count = 0.0
        wider.gradient = wp.vec3(0.0, 0.0, 0.0)
        wider.moment = wp.vec3(0.0, 0.0, 0.0)
    wider.sample_count += 1.0
    wider.gradient += gradient
    wider.moment += moment
    return wider


@wp.func
def share_of_one_sample(extent: Extent, border: int) -> float:
    """Factor that turns an extent's sums into means; 0 where nothing is seen or the image's border cuts the object."""
    if extent.sample_count == 0.0 or extent.outermost == border:
        return 0.0
    return 1.0 / extent.sample_count


@wp.kernel(enable_backward=False)
def measure_objects_kernel(
    # in
    view: wp.array[View],
    layer_rectangle: wp.array2d[wp.vec4i],
    layer_offset: wp.array2d[wp.int32],
    layer_bits: wp.array[wp.int32],
    hiding_bits: wp.array[wp.int32],
    box_px: wp.array2d[wp.vec4],
    width: int,
    height: int,
    supersampling: int,
    first_view: int,
    # out
    measure: wp.array3d[float],
    per_shift: wp.array3d[wp.vec3],
    per_spin: wp.array3d[wp.vec3],
):
    """All measures of one object in one view, and their Jacobians, by one sweep over the object's rectangle.

    The extents of an object that is not in the image are LEFT = TOP = the image's size and RIGHT = BOTTOM = 0, with
    zero Jacobians; an extent cut by the image's border does not move either.

    Launch: ``dim=(views of this chunk, vehicle_count)``; one thread per pair. Not taped.
    Writes: every element of ``measure`` [view, vehicle, measure], ``per_shift`` [1/m] and ``per_spin`` [1/rad] of these
    views once.
    """
    chunk_view, vehicle = wp.tid()
    v = first_view + chunk_view
    camera = view[v]
    rectangle = layer_rectangle[v, vehicle]
    offset = layer_offset[v, vehicle]
    box = box_px[v, vehicle]
    samples_per_px = float(supersampling)
    focal_px = camera.focal_px
    zero = wp.vec3(0.0, 0.0, 0.0)

    visible_area = float(0.0)
    amodal_area = float(0.0)
    box_area = float(0.0)
    # sums of the flow gradient g and of its moment q x g, in camera axes
    visible_g = zero
    visible_m = zero
    amodal_g = zero
    amodal_m = zero
    box_g = zero
    box_m = zero
    nothing = Extent()
    nothing.outermost = -2147483647
    left = nothing
    right = nothing
    top = nothing
    bottom = nothing

    for row in range(rectangle[3]):
        for column in range(rectangle[2]):
            grid_row = rectangle[1] + row
            grid_column = rectangle[0] + column
            own_p = bits_at(row, column, rectangle, offset, layer_bits)
            hider_p = bits_at(row, column, rectangle, offset, hiding_bits)
            frame_p = frame_weight(grid_row, grid_column, width, height)
            in_box_p = frame_p * box_weight(grid_row, grid_column, box, samples_per_px)
            amodal_p = float(0.0)
            visible_p = float(0.0)
            if own_p != wp.int32(0):
                amodal_p = 1.0
                if hider_p == wp.int32(0):
                    visible_p = 1.0
            amodal_area += frame_p * amodal_p
            visible_area += frame_p * visible_p
            box_area += in_box_p * visible_p

            for direction in range(2):
                to_row = direction
                to_column = 1 - direction
                if row + to_row < rectangle[3] and column + to_column < rectangle[2]:
                    own_q = bits_at(row + to_row, column + to_column, rectangle, offset, layer_bits)
                    hider_q = bits_at(row + to_row, column + to_column, rectangle, offset, hiding_bits)
                    amodal_q = float(0.0)
                    visible_q = float(0.0)
                    if own_q != wp.int32(0):
                        amodal_q = 1.0
                        if hider_q == wp.int32(0):
                            visible_q = 1.0
                    if amodal_p != amodal_q or visible_p != visible_q:
                        frame_q = frame_weight(grid_row + to_row, grid_column + to_column, width, height)
                        in_box_q = frame_q * box_weight(grid_row + to_row, grid_column + to_column, box, samples_per_px)
                        ray = ray_in_camera(
                            camera,
                            float(grid_column) + 0.5 + 0.5 * float(to_column),
                            float(grid_row) + 0.5 + 0.5 * float(to_row),
                            width,
                            height,
                        )
                        # the object's own surface at its outline
                        own_w = float(0.0)
                        if amodal_p != amodal_q:
                            if own_p != wp.int32(0):
                                inner = bits_at(row - to_row, column - to_column, rectangle, offset, layer_bits)
                                own_w = outward_inverse_depth(own_p, inner)
                            else:
                                inner = bits_at(row + 2 * to_row, column + 2 * to_column, rectangle, offset, layer_bits)
                                own_w = outward_inverse_depth(own_q, inner)
                            g = zero
                            if direction == 0:
                                g = column_flow_gradient(ray, focal_px, own_w)
                            else:
                                g = row_flow_gradient(ray, focal_px, own_w)
                            step = (amodal_p - amodal_q) * 0.5 * (frame_p + frame_q)
                            amodal_g += step * g
                            amodal_m += step * (wp.cross(ray, g) / own_w)
                        if visible_p != visible_q:
                            # the surface in front: the hider where it covers the object, else the object's own outline
                            hider_w = float(0.0)
                            if visible_p > 0.0 and hider_q != wp.int32(0):
                                inner = bits_at(
                                    row + 2 * to_row, column + 2 * to_column, rectangle, offset, hiding_bits
                                )
                                hider_w = outward_inverse_depth(hider_q, inner)
                            if visible_q > 0.0 and hider_p != wp.int32(0):
                                inner = bits_at(row - to_row, column - to_column, rectangle, offset, hiding_bits)
                                hider_w = outward_inverse_depth(hider_p, inner)
                            front_w = wp.max(own_w, hider_w)
                            g = zero
                            if direction == 0:
                                g = column_flow_gradient(ray, focal_px, front_w)
                            else:
                                g = row_flow_gradient(ray, focal_px, front_w)
                            moment = wp.cross(ray, g) / front_w
                            step = (visible_p - visible_q) * 0.5 * (frame_p + frame_q)
                            visible_g += step * g
                            visible_m += step * moment
                            step = (visible_p - visible_q) * 0.5 * (in_box_p + in_box_q)
                            box_g += step * g
                            box_m += step * moment

            if amodal_p * frame_p > 0.0:
                w = inverse_depth_of(own_p)
                ray = ray_in_camera(camera, float(grid_column) + 0.5, float(grid_row) + 0.5, width, height)
                if -grid_column >= left.outermost or grid_column >= right.outermost:
                    g = column_flow_gradient(ray, focal_px, w)
                    moment = wp.cross(ray, g) / w
                    if -grid_column >= left.outermost:
                        left = widened(left, -grid_column, g, moment)
                    if grid_column >= right.outermost:
                        right = widened(right, grid_column, g, moment)
                if -grid_row >= top.outermost or grid_row >= bottom.outermost:
                    g = row_flow_gradient(ray, focal_px, w)
                    moment = wp.cross(ray, g) / w
                    if -grid_row >= top.outermost:
                        top = widened(top, -grid_row, g, moment)
                    if grid_row >= bottom.outermost:
                        bottom = widened(bottom, grid_row, g, moment)

    ego_from_camera = wp.transpose(camera.camera_from_ego)
    per_sample = 1.0 / (samples_per_px * samples_per_px)
    measure[v, vehicle, VISIBLE_AREA] = visible_area * per_sample
    per_shift[v, vehicle, VISIBLE_AREA] = -per_sample * (ego_from_camera * visible_g)
    per_spin[v, vehicle, VISIBLE_AREA] = per_sample * visible_m
    measure[v, vehicle, AMODAL_AREA] = amodal_area * per_sample
    per_shift[v, vehicle, AMODAL_AREA] = -per_sample * (ego_from_camera * amodal_g)
    per_spin[v, vehicle, AMODAL_AREA] = per_sample * amodal_m
    measure[v, vehicle, BOX_AREA] = box_area * per_sample
    per_shift[v, vehicle, BOX_AREA] = -per_sample * (ego_from_camera * box_g)
    per_spin[v, vehicle, BOX_AREA] = per_sample * box_m

    left_px = float(width - 2 * GUARD) / samples_per_px
    right_px = float(0.0)
    top_px = float(height - 2 * GUARD) / samples_per_px
    bottom_px = float(0.0)
    if left.sample_count > 0.0:
        left_px = float(-left.outermost - GUARD) / samples_per_px
        right_px = float(right.outermost + 1 - GUARD) / samples_per_px
        top_px = float(-top.outermost - GUARD) / samples_per_px
        bottom_px = float(bottom.outermost + 1 - GUARD) / samples_per_px
    share = share_of_one_sample(left, -GUARD) / samples_per_px
    measure[v, vehicle, LEFT] = left_px
    per_shift[v, vehicle, LEFT] = -share * (ego_from_camera * left.gradient)
    per_spin[v, vehicle, LEFT] = share * left.moment
    share = share_of_one_sample(right, width - 1 - GUARD) / samples_per_px
    measure[v, vehicle, RIGHT] = right_px
    per_shift[v, vehicle, RIGHT] = -share * (ego_from_camera * right.gradient)
    per_spin[v, vehicle, RIGHT] = share * right.moment
    share = share_of_one_sample(top, -GUARD) / samples_per_px
    measure[v, vehicle, TOP] = top_px
    per_shift[v, vehicle, TOP] = -share * (ego_from_camera * top.gradient)
    per_spin[v, vehicle, TOP] = share * top.moment
    share = share_of_one_sample(bottom, height - 1 - GUARD) / samples_per_px
    measure[v, vehicle, BOTTOM] = bottom_px
    per_shift[v, vehicle, BOTTOM] = -share * (ego_from_camera * bottom.gradient)
    per_spin[v, vehicle, BOTTOM] = share * bottom.moment
