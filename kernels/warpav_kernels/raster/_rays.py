"""The rays of all samples of the views whose lenses are no pinholes, and bounds of bundles of them.

Inverting a lens takes Newton's steps, so the rays are found once for each lens and zoom and kept; see `Rays`.
"""

import warp as wp

from warpav_kernels.raster._lens import PANORAMA, SPHERE
from warpav_kernels.raster._view import View, ray_in_camera

wp.set_module_options({"enable_backward": False})

BLOCK = wp.constant(8)  # rows and columns of samples of a block, and samples tested at once
SPARE_RAD = wp.constant(0.3)  # more than two corners of a triangle without a cone are apart


@wp.struct
class Rays:
    """Rays of the samples of all views that are no pinholes."""

    set_of_view: wp.array[wp.int32]  # which rays a view has; -1 for a pinhole, [view]
    table_of_view: wp.array[wp.int32]  # which table a view's lens has, [view]
    # Cosine of an angle from the axis beyond which no ray is, with `SPARE_RAD` to spare, [set]
    widest_cosine: wp.array[float]
    is_flat: wp.array[wp.int32]  # whether all rays have z = 1, [set]
    # x, y and z of the ray of depth 1 in camera coordinates through the centre of every sample, 0 where nothing is
    # seen, [set, axis, row, column]
    ray: wp.array4d[float]
    # Of an equirectangular panorama, whose rays are products of them: sine and cosine of the columns' azimuths, cosine
    # and sine of the rows' elevations, 0 where nothing is seen, [set, part, column or row]; of other lenses 0
    factor: wp.array3d[float]
    # x, y and z of the mean of the rays of every block of samples, and the greatest distance from it; -1 where none of
    # them sees anything, [set, part, row, column]
    block: wp.array4d[float]
    # x, y and z of the first and of the last ray of every row of a block that sees anything, and the greatest distance
    # of one between them from the line through both; -1 where none does, [set, part, block, row]
    block_row: wp.array4d[float]
    # Of a lens, over half of one less the cosine of the angle from the axis: radius over the sine of the angle [focal
    # lengths], and the greatest curvature of the image of a great circle near there [focal lengths/rad^2], [table,
    # entry]
    table: wp.array2d[wp.vec2]


@wp.kernel(enable_backward=False)
def place_rays_kernel(
    # in
    view: wp.array[View],
    view_of_set: wp.array[wp.int32],
    # out
    ray: wp.array4d[float],
    factor: wp.array3d[float],
):
    """The rays of every set, from one of its views.

    Launch: ``dim=(set_count, height, width)``; one thread per sample. Not taped.
    Writes: every element of ``ray`` once; ``factor`` where the set has it, else the caller zeroes it.
    """
    i, row, column = wp.tid()
    camera = view[view_of_set[i]]
    each = ray_in_camera(camera, float(column) + 0.5, float(row) + 0.5)
    if camera.lens.kind == PANORAMA and camera.lens.formula == SPHERE:
        if row == 0:
            azimuth = (float(column) + 0.5 - camera.centre[0]) / camera.focal[0]
            factor[i, 0, column] = wp.sin(azimuth)
            factor[i, 1, column] = wp.cos(azimuth)
        if column == 0 and wp.length_sq(each) > 0.0:
            elevation = (float(row) + 0.5 - camera.centre[1]) / camera.focal[1]
            factor[i, 2, row] = wp.cos(elevation)
            factor[i, 3, row] = wp.sin(elevation)
    for axis in range(3):
        ray[i, axis, row, column] = each[axis]


@wp.kernel(enable_backward=False)
def bound_rays_kernel(
    # in
    ray: wp.array4d[float],
    # out
    widest_cosine: wp.array[float],
    is_flat: wp.array[wp.int32],
):
    """See `Rays.widest_cosine` and `Rays.is_flat`.

    Launch: ``dim=(set_count, height)``; one thread per row. Not taped.
    Writes: ``widest_cosine`` and ``is_flat`` by atomic minimum; the caller fills them with ones.
    """
    i, row = wp.tid()
    least = float(1.0)
    others = int(0)
    for column in range(ray.shape[3]):
        each = _ray_at(ray, i, row, column)
        others += int(each[2] != 1.0)
        if wp.length_sq(each) > 0.0:
            least = wp.min(least, each[2] / wp.length(each))
    if others > 0:
        wp.atomic_min(is_flat, i, 0)
    wp.atomic_min(widest_cosine, i, wp.cos(wp.min(wp.acos(least) + SPARE_RAD, wp.pi)))


@wp.func
def _ray_at(ray: wp.array4d[float], ray_set: int, row: int, column: int) -> wp.vec3:
    """Ray of depth 1 through a sample's centre; see `Rays`."""
    return wp.vec3(ray[ray_set, 0, row, column], ray[ray_set, 1, row, column], ray[ray_set, 2, row, column])


@wp.func
def _mean_and_spread(ray: wp.array4d[float], ray_set: int, samples: wp.vec4i) -> wp.vec4:
    """Mean of some rays, of those that see something, and the greatest distance from it; -1: none does.

    ``samples`` are the first row and column, and those after the last.
    """
    total = wp.vec3(0.0, 0.0, 0.0)
    count = float(0.0)
    for row in range(samples[0], wp.min(samples[2], ray.shape[2])):
        for column in range(samples[1], wp.min(samples[3], ray.shape[3])):
            each = _ray_at(ray, ray_set, row, column)
            if wp.length_sq(each) > 0.0:
                total += each
                count += 1.0
    mean = total / wp.max(count, 1.0)
    spread = float(-1.0)
    for row in range(samples[0], wp.min(samples[2], ray.shape[2])):
        for column in range(samples[1], wp.min(samples[3], ray.shape[3])):
            each = _ray_at(ray, ray_set, row, column)
            if wp.length_sq(each) > 0.0:
                spread = wp.max(spread, wp.length(each - mean))
    return wp.vec4(mean[0], mean[1], mean[2], spread)


@wp.struct
class _RowEnds:
    """The rays of a few samples of a row."""

    first: wp.vec3  # the first that sees anything
    last: wp.vec3  # the last that does
    bulge: float  # the greatest distance of one between them from the line through both; -1 where none sees anything


@wp.func
def _row_ends(ray: wp.array4d[float], ray_set: int, row: int, first_column: int) -> _RowEnds:
    """What bounds the rays of a block's row."""
    ends = _RowEnds()
    ends.bulge = -1.0
    if row >= ray.shape[2]:
        return ends
    for column in range(first_column, wp.min(first_column + BLOCK, ray.shape[3])):
        each = _ray_at(ray, ray_set, row, column)
        if wp.length_sq(each) > 0.0:
            if ends.bulge < 0.0:
                ends.first = each
                ends.bulge = 0.0
            ends.last = each
    along = wp.normalize(ends.last - ends.first)
    for column in range(first_column, wp.min(first_column + BLOCK, ray.shape[3])):
        each = _ray_at(ray, ray_set, row, column)
        if wp.length_sq(each) > 0.0:
            aside = each - ends.first
            aside -= wp.dot(aside, along) * along
            # a little more for rounding
            ends.bulge = wp.max(ends.bulge, wp.length(aside) + 1.0e-6 * wp.length(each))
    return ends


@wp.kernel(enable_backward=False)
def place_blocks_kernel(
    # in
    ray: wp.array4d[float],
    # out
    block: wp.array4d[float],
    block_row: wp.array4d[float],
):
    """See `Rays.block` and `Rays.block_row`.

    Launch: ``dim=(set_count, rows of blocks, columns of blocks)``; one thread per block. Not taped.
    Writes: every element of ``block`` and ``block_row`` once.
    """
    i, row, column = wp.tid()
    first = wp.vec4i(row * BLOCK, column * BLOCK, (row + 1) * BLOCK, (column + 1) * BLOCK)
    whole = _mean_and_spread(ray, i, first)
    for part in range(4):
        block[i, part, row, column] = whole[part]
    for k in range(BLOCK):
        ends = _row_ends(ray, i, first[0] + k, first[1])
        number = row * block.shape[3] + column
        for axis in range(3):
            block_row[i, axis, number, k] = ends.first[axis]
            block_row[i, 3 + axis, number, k] = ends.last[axis]
        block_row[i, 6, number, k] = ends.bulge


@wp.func
def table_entry(rays: Rays, table: int, cosine: float) -> wp.vec2:
    """Radius over sine, and curvature, of a lens at a cosine of the angle from its axis."""
    place = 0.5 * (1.0 - cosine) * float(rays.table.shape[1] - 1)
    entry = wp.clamp(int(place), 0, rays.table.shape[1] - 2)
    share = wp.clamp(place - float(entry), 0.0, 1.0)
    low = rays.table[table, entry]
    high = rays.table[table, entry + 1]
    return wp.vec2(low[0] + share * (high[0] - low[0]), wp.max(low[1], high[1]))
