"""Measure: how far every object reaches to the left, right, top and bottom of the image, with Jacobians.

An extent moves with the surface points of the outermost samples; their mean counts. One that is cut by the image's
border does not move.
"""

import warp as wp

from warpav_kernels.layers import Layers
from warpav_kernels.measure import EXTENT_COUNT, LEFT
from warpav_kernels.view import GUARD, View, column_gradient, inverse_depth_of, ray_in_camera, row_gradient

wp.set_module_options({"enable_backward": False})

# sides in the order of the measures LEFT, RIGHT, TOP, BOTTOM
TO_THE_LEFT = wp.constant(0)
TO_THE_RIGHT = wp.constant(1)
TO_THE_TOP = wp.constant(2)


@wp.struct
class Extent:
    """How far an object reaches towards one side of the image, and what moves there.

    Attributes:
        outermost: Column or row of the outermost sample, counted outwards: negative to the left and to the top.
        sample_count: Number of samples that reach as far; 0 where nothing is seen.
        gradient: Sum of their flow gradients g, in camera axes [samples/m].
        moment: Sum of their moments q x g [samples/rad].
        zoom: Sum of their distances from the principal point along the side's axis [samples].
    """

    outermost: int
    sample_count: float
    gradient: wp.vec3
    moment: wp.vec3
    zoom: float


@wp.func
def outwards(side: int, row: int, column: int) -> int:
    """Column or row of a sample, counted outwards to a side."""
    if side == TO_THE_LEFT:
        return -column
    if side == TO_THE_RIGHT:
        return column
    if side == TO_THE_TOP:
        return -row
    return row


@wp.func
def joined(a: Extent, b: Extent) -> Extent:
    """The extent of the union of two sets of samples."""
    if b.sample_count == 0.0:
        return a
    if a.sample_count == 0.0 or b.outermost > a.outermost:
        return b
    if b.outermost < a.outermost:
        return a
    both = a
    both.sample_count += b.sample_count
    both.gradient += b.gradient
    both.moment += b.moment
    both.zoom += b.zoom
    return both


@wp.kernel(enable_backward=False)
def measure_extents_kernel(
    # in
    view: wp.array[View],
    layers: Layers,
    width: int,
    height: int,
    first_view: int,
    row_lanes: int,
    column_lanes: int,
    # out
    extent: wp.array4d[Extent],
):
    """Extents inside the image of one object alone in one view, over one lane's samples.

    Launch: ``dim=(views of this chunk, vehicle_count, row_lanes * column_lanes)``. Not taped.
    Writes: ``extent`` [view, vehicle, side, lane] of these views; sides in the order LEFT, RIGHT, TOP, BOTTOM.
    """
    chunk_view, vehicle, lane = wp.tid()
    v = first_view + chunk_view
    camera = view[v]
    rectangle = layers.rectangle[v, vehicle]
    offset = layers.offset[v, vehicle]
    # the sweep leaves out the guard band
    first_row = wp.max(GUARD - rectangle[1], 0)
    last_row = wp.min(height - GUARD - rectangle[1], rectangle[3])
    first_column = wp.max(GUARD - rectangle[0], 0)
    last_column = wp.min(width - GUARD - rectangle[0], rectangle[2])
    for side in range(EXTENT_COUNT):
        found = Extent()
        for row in range(first_row + lane / column_lanes, last_row, row_lanes):
            for column in range(first_column + lane % column_lanes, last_column, column_lanes):
                bits = layers.inverse_depth_bits[offset + row * rectangle[2] + column]
                if bits != wp.int32(0):
                    grid_row = rectangle[1] + row
                    grid_column = rectangle[0] + column
                    reached = outwards(side, grid_row, grid_column)
                    if found.sample_count == 0.0 or reached >= found.outermost:
                        x = float(grid_column) + 0.5
                        y = float(grid_row) + 0.5
                        point_m = ray_in_camera(camera, x, y) / inverse_depth_of(bits)
                        sample = Extent()
                        sample.outermost = reached
                        sample.sample_count = 1.0
                        if side <= TO_THE_RIGHT:
                            sample.gradient = column_gradient(camera, point_m)
                            sample.zoom = x - camera.centre[0]
                        else:
                            sample.gradient = row_gradient(camera, point_m)
                            sample.zoom = y - camera.centre[1]
                        sample.moment = wp.cross(point_m, sample.gradient)
                        found = joined(found, sample)
        extent[v, vehicle, side, lane] = found


@wp.kernel(enable_backward=False)
def join_extents_kernel(
    # in
    view: wp.array[View],
    extent: wp.array4d[Extent],
    width: int,
    height: int,
    supersampling: int,
    # out
    measure: wp.array3d[float],
    per_shift: wp.array3d[wp.vec3],
    per_spin: wp.array3d[wp.vec3],
    per_zoom: wp.array3d[float],
):
    """Join what the lanes have found, in their order, and turn it into pixels and ego axes.

    The extents of an object that is not in the image are LEFT = TOP = the image's size and RIGHT = BOTTOM = 0, with
    zero Jacobians.

    Launch: ``dim=(view_count, vehicle_count, EXTENT_COUNT)``; one thread per side. Not taped.
    Writes: the measures LEFT, RIGHT, TOP and BOTTOM of every view and vehicle once.
    """
    v, vehicle, side = wp.tid()
    total = Extent()
    for lane in range(extent.shape[3]):
        total = joined(total, extent[v, vehicle, side, lane])
    samples_per_px = float(supersampling)
    size = width
    if side > TO_THE_RIGHT:
        size = height
    is_low = side == TO_THE_LEFT or side == TO_THE_TOP
    border = size - 1 - GUARD
    place_px = float(0.0)
    if is_low:
        border = -GUARD
        place_px = float(size - 2 * GUARD) / samples_per_px
    share = float(0.0)
    if total.sample_count > 0.0:
        if is_low:
            place_px = float(-total.outermost - GUARD) / samples_per_px
        else:
            place_px = float(total.outermost + 1 - GUARD) / samples_per_px
        if total.outermost != border:
            share = 1.0 / (total.sample_count * samples_per_px)
    i = LEFT + side
    measure[v, vehicle, i] = place_px
    per_shift[v, vehicle, i] = -share * (wp.transpose(view[v].camera_from_ego) * total.gradient)
    per_spin[v, vehicle, i] = share * total.moment
    per_zoom[v, vehicle, i] = share * total.zoom
