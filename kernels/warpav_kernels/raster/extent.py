"""Measure: how far every object reaches to the left, right, top and bottom of the image, with Jacobians.

An extent moves with the surface points of the outermost samples; their mean counts. One that is cut by the image's
border, or by the edge of what the lens sees, does not move. Where the object is cut at one side of the image and
reaches farthest up or down right there, the extent is the crossing of outline and border: it slides along the outline,
which takes ``slope x motion across`` off its motion. The same holds at the upper and lower border for left and right.
"""

import warp as wp

from warpav_kernels.raster._layers import Layers, place_in
from warpav_kernels.raster._measure import BOTTOM, LEFT, RIGHT, TOP
from warpav_kernels.raster._view import GUARD, View, column_gradient, inverse_depth_of, row_gradient, sample_ray, sees

wp.set_module_options({"enable_backward": False})

_SLOPE_PX = wp.constant(4)  # from the border, over which the slope of an outline is taken
_STEEPEST = wp.constant(4)  # slope; what falls back faster counts as level


@wp.func
def _shows_object(layers: Layers, rectangle: wp.vec4i, offset: int, line: int, place: int, along_columns: bool) -> bool:
    """Whether the sample at a place along a line shows the object; a line is a column or a row of samples."""
    row = line
    column = place
    if along_columns:
        row = place
        column = line
    sample = place_in(rectangle, offset, row, column)
    if sample < 0:
        return False
    return layers.inverse_depth_bits[sample] != wp.int32(0)


@wp.func
def _slope_at_border(
    layers: Layers,
    rectangle: wp.vec4i,
    offset: int,
    line: int,
    along_columns: bool,
    outwards: int,
    border: int,
    inwards: int,
    reach: int,
) -> float:
    """Slope of the outline where the farthest line meets a border of the image: lines gained per place along it.

    ``border`` is the last place inside the image and ``inwards`` the step away from it. The outline there is compared
    with that ``reach`` samples further in. 0 where the object does not reach that border, or ends at it by itself.
    """
    if not _shows_object(layers, rectangle, offset, line, border, along_columns):
        return 0.0
    if not _shows_object(layers, rectangle, offset, line, border - inwards, along_columns):
        return 0.0
    for back in range(_STEEPEST * reach):
        if _shows_object(layers, rectangle, offset, line - outwards * back, border + inwards * reach, along_columns):
            return -float(outwards * back) / float(inwards * reach)
    return 0.0


@wp.kernel(enable_backward=False)
def measure_extents_kernel(
    # in
    view: wp.array[View],
    layers: Layers,
    farthest: wp.array3d[wp.int32],
    width: int,
    height: int,
    supersampling: int,
    # out
    measure: wp.array3d[float],
    jac_translation: wp.array3d[wp.vec3],
    jac_rotation: wp.array3d[wp.vec3],
    jac_log_focal: wp.array3d[float],
):
    """Extents inside the image of one object alone in one view, from the line of samples that reaches farthest.

    ``farthest`` says which line, for the sides in the order LEFT, RIGHT, TOP, BOTTOM: its number of samples from the
    opposite side of the grid; 0 where the object is not in the image. There LEFT = TOP = the image's size and
    RIGHT = BOTTOM = 0, with zero Jacobians.

    Launch: ``dim=(view_count, object_count, EXTENT_COUNT)``; one thread per side. Not taped.
    Writes: the measures LEFT, RIGHT, TOP and BOTTOM of every view and object once.
    """
    v, object_index, side = wp.tid()
    camera = view[v]
    rectangle = layers.rectangle[v, object_index]
    samples = farthest[v, object_index, side]
    i = LEFT + side
    along_columns = i == LEFT or i == RIGHT
    size = height
    if along_columns:
        size = width
    line = samples - 1
    outwards = int(1)
    if i == LEFT or i == TOP:
        line = size - samples
        outwards = -1

    sample_count = float(0.0)
    gradient = wp.vec3(0.0, 0.0, 0.0)
    moment = wp.vec3(0.0, 0.0, 0.0)
    zoom = float(0.0)
    if samples > 0:
        first = wp.max(rectangle[0], GUARD)
        last = wp.min(rectangle[0] + rectangle[2], width - GUARD)
        end = width - GUARD
        if along_columns:
            first = wp.max(rectangle[1], GUARD)
            last = wp.min(rectangle[1] + rectangle[3], height - GUARD)
            end = height - GUARD
        offset = layers.offset[v, object_index]
        reach = _SLOPE_PX * supersampling
        slope = _slope_at_border(layers, rectangle, offset, line, along_columns, outwards, GUARD, 1, reach)
        slope += _slope_at_border(layers, rectangle, offset, line, along_columns, outwards, end - 1, -1, reach)
        for k in range(first, last):
            row = line
            column = k
            if along_columns:
                row = k
                column = line
            place = offset + (row - rectangle[1]) * rectangle[2] + column - rectangle[0]
            bits = layers.inverse_depth_bits[place]
            if bits != wp.int32(0):
                x = float(column) + 0.5
                y = float(row) + 0.5
                point_m = sample_ray(camera, row, column) / inverse_depth_of(bits)
                by_column = column_gradient(camera, point_m)
                by_row = row_gradient(camera, point_m)
                from_column = x - camera.centre[0]
                from_row = y - camera.centre[1]
                g = by_row - slope * by_column
                away = from_row - slope * from_column
                is_free = sees(camera, row + outwards, column)
                if along_columns:
                    g = by_column - slope * by_row
                    away = from_column - slope * from_row
                    is_free = sees(camera, row, column + outwards)
                sample_count += 1.0
                if is_free:
                    gradient += g
                    moment += wp.cross(point_m, g)
                    zoom += away

    samples_per_px = float(supersampling)
    place_px = float(0.0)
    border = size - 1 - GUARD
    if i == LEFT or i == TOP:
        border = GUARD
        place_px = float(size - 2 * GUARD) / samples_per_px
    share = float(0.0)
    if sample_count > 0.0:
        place_px = float(line - GUARD) / samples_per_px
        if i == RIGHT or i == BOTTOM:
            place_px = float(line + 1 - GUARD) / samples_per_px
        if line != border:
            share = 1.0 / (sample_count * samples_per_px)
    measure[v, object_index, i] = place_px
    jac_translation[v, object_index, i] = -share * (wp.transpose(camera.camera_from_world) * gradient)
    jac_rotation[v, object_index, i] = share * moment
    jac_log_focal[v, object_index, i] = share * zoom
