"""Decide, for lenses that are no pinholes: the buffers of `rasterise`, by rasterisation in the space of rays.

A straight edge is no straight line in such an image, but the rays through it still lie in a plane through the camera's
centre. So a triangle covers a sample if the sample's ray lies on the inner side of three planes, and the inverse depth
is linear in the ray. Nothing is inverted, cut or divided up: corners may be behind the camera. The rays of all samples
are kept (`Rays`), and blocks of them are passed over whole.

Where a triangle's image may be is bounded by the images of its corners, and by how much the lens bends what lies
between.
"""

import warp as wp

from warpav_kernels.raster.layers import LEAST_INVERSE_DEPTH, TO_BOTTOM, TO_LEFT, TO_RIGHT, Layers, place_in, step_of
from warpav_kernels.raster.lens import BROWN_CONRADY, PANORAMA, cone_bounds, moved_place
from warpav_kernels.raster.rasterise import (
    LARGE_SAMPLES,
    line_after,
    raise_crossing,
)
from warpav_kernels.raster.triangles import Triangles, faces, is_behind, may_be_outline, shows_no_back
from warpav_kernels.raster.view import View, point_in_camera, ray_between, ray_in_camera

wp.set_module_options({"enable_backward": False})

BLOCK = wp.constant(8)  # rows and columns of samples of a block, and samples tested at once
WIDE = wp.constant(0.1)  # chord of two directions; triangles that reach farther are bounded by a cone
LEAST_VOLUME = wp.constant(1.0e-12)  # of three directions: a triangle that is seen from its side
LEAST_DISTANCE_M = wp.constant(1.0e-9)  # of a corner that has a direction
STEEP = wp.constant(0.98)  # sine of the elevation from which a panorama's triangles are bounded by a cone
PIECE = wp.constant(0.05)  # chord of the directions of a piece of an edge
PIECE_SAMPLES = wp.constant(8.0)  # its length
MAX_PIECES = wp.constant(256)  # of an edge
END_SLACK = wp.constant(2.0e-6)  # by which an edge may reach beyond its ends [rad]
TABLE_ERROR = wp.constant(1.0e-4)  # of a place in the table [focal lengths]
WHOLE = wp.constant(1.0e9)


@wp.struct
class Rays:
    """Rays of the samples of all views that are no pinholes.

    Attributes:
        set_of_view: Which rays a view has; -1 for a pinhole, [view].
        table_of_view: Which table a view's lens has, [view].
        ray: x, y and z of the ray of depth 1 in camera coordinates through the centre of every sample, 0 where nothing
            is seen, [set, axis, row, column].
        widest_cosine: Cosine of an angle from the axis beyond which no ray is, with room for a small triangle, [set].
        block: x, y and z of the mean of the rays of every block of samples, and the greatest distance from it; -1 where
            none of them sees anything, [set, part, row, column].
        block_row: The same of every row of a block, [set, part, block, row].
        table: Of a lens, over half of one less the cosine of the angle from the axis: radius over the sine of the angle
            [focal lengths], and the greatest curvature of the image of a great circle near there [focal
            lengths/rad^2], [table, entry].
    """

    set_of_view: wp.array[wp.int32]
    table_of_view: wp.array[wp.int32]
    widest_cosine: wp.array[float]
    ray: wp.array4d[float]
    block: wp.array4d[float]
    block_row: wp.array4d[float]
    table: wp.array2d[wp.vec2]


@wp.kernel(enable_backward=False)
def place_rays_kernel(
    # in
    view: wp.array[View],
    view_of_set: wp.array[wp.int32],
    # out
    ray: wp.array4d[float],
):
    """The rays of every set, from one of its views.

    Launch: ``dim=(set_count, height, width)``; one thread per sample. Not taped.
    Writes: every element of ``ray`` once.
    """
    i, row, column = wp.tid()
    each = ray_in_camera(view[view_of_set[i]], float(column) + 0.5, float(row) + 0.5)
    for axis in range(3):
        ray[i, axis, row, column] = each[axis]


@wp.func
def ray_at(ray: wp.array4d[float], ray_set: int, row: int, column: int) -> wp.vec3:
    """Ray of depth 1 through a sample's centre; see `Rays`."""
    return wp.vec3(ray[ray_set, 0, row, column], ray[ray_set, 1, row, column], ray[ray_set, 2, row, column])


@wp.func
def mean_and_spread(ray: wp.array4d[float], ray_set: int, samples: wp.vec4i) -> wp.vec4:
    """Mean of some rays, of those that see something, and the greatest distance from it; -1: none does.

    ``samples`` are the first row and column, and those after the last.
    """
    total = wp.vec3(0.0, 0.0, 0.0)
    count = float(0.0)
    for row in range(samples[0], wp.min(samples[2], ray.shape[2])):
        for column in range(samples[1], wp.min(samples[3], ray.shape[3])):
            each = ray_at(ray, ray_set, row, column)
            if wp.length_sq(each) > 0.0:
                total += each
                count += 1.0
    mean = total / wp.max(count, 1.0)
    spread = float(-1.0)
    for row in range(samples[0], wp.min(samples[2], ray.shape[2])):
        for column in range(samples[1], wp.min(samples[3], ray.shape[3])):
            each = ray_at(ray, ray_set, row, column)
            if wp.length_sq(each) > 0.0:
                spread = wp.max(spread, wp.length(each - mean))
    return wp.vec4(mean[0], mean[1], mean[2], spread)


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
    whole = mean_and_spread(ray, i, first)
    for part in range(4):
        block[i, part, row, column] = whole[part]
    for k in range(BLOCK):
        of_row = mean_and_spread(ray, i, wp.vec4i(first[0] + k, first[1], first[0] + k + 1, first[3]))
        for part in range(4):
            block_row[i, part, row * block.shape[3] + column, k] = of_row[part]


@wp.kernel(enable_backward=False)
def bound_rays_kernel(
    # in
    block: wp.array4d[float],
    # out
    widest_cosine: wp.array[float],
):
    """See `Rays.widest_cosine`.

    Launch: ``dim=set_count``; one thread per set. Not taped.
    Writes: every element of ``widest_cosine`` once.
    """
    i = wp.tid()
    widest = float(0.0)
    for row in range(block.shape[2]):
        for column in range(block.shape[3]):
            mean = ray_at(block, i, row, column)
            if wp.length_sq(mean) > 0.0:
                angle = wp.atan2(wp.sqrt(mean[0] * mean[0] + mean[1] * mean[1]), mean[2])
                widest = wp.max(widest, angle + 2.0 * wp.asin(wp.min(block[i, 3, row, column] / wp.length(mean), 1.0)))
    widest_cosine[i] = wp.cos(wp.min(widest + 1.2 * WIDE, wp.pi))


@wp.func
def edge_plane(p: wp.vec3, q: wp.vec3, side: float) -> wp.vec3:
    """Normal of the plane through the camera's centre and an edge from p to q; the triangle is on its positive side.

    It is computed from the same end whichever way the edge runs, so two triangles that share it share every bit of it.
    """
    is_turned = p[0] > q[0] or (p[0] == q[0] and (p[1] > q[1] or (p[1] == q[1] and p[2] > q[2])))
    low = p
    high = q
    sign = side
    if is_turned:
        low = q
        high = p
        sign = -side
    return sign * wp.cross(low, high - low)


@wp.struct
class RayTriangle:
    """A triangle in the space of rays: a ray d meets it where no product with an edge's normal is negative.

    Attributes:
        edge0: Normal of the plane of its first edge [m^2].
        edge1: That of the second.
        edge2: That of the third.
        inverse_depth: Its product with a ray of depth 1 is the inverse depth [1/m].
        first_column: First column of samples that it may cover.
        last_column: Last such column; below the first where there is none.
        first_row: First such row.
        last_row: Last such row.
    """

    edge0: wp.vec3
    edge1: wp.vec3
    edge2: wp.vec3
    inverse_depth: wp.vec3
    first_column: int
    last_column: int
    first_row: int
    last_row: int
    is_solid: bool


@wp.func
def table_entry(rays: Rays, table: int, cosine: float) -> wp.vec2:
    """Radius over sine, and curvature, of a lens at a cosine of the angle from its axis."""
    place = 0.5 * (1.0 - cosine) * float(rays.table.shape[1] - 1)
    entry = wp.clamp(int(place), 0, rays.table.shape[1] - 2)
    share = wp.clamp(place - float(entry), 0.0, 1.0)
    low = rays.table[table, entry]
    high = rays.table[table, entry + 1]
    return wp.vec2(low[0] + share * (high[0] - low[0]), wp.max(low[1], high[1]))


@wp.func
def half_angle_of(axis: wp.vec3, direction: wp.vec3) -> float:
    """Angle between two directions of unit length [rad], a little more for rounding."""
    return 2.0 * wp.asin(wp.min(0.5 * wp.length(direction - axis), 1.0)) + 1.0e-5


@wp.func(inline=False)
def wide_bounds(camera: View, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec4:
    """Bounds (left, top, right, bottom) in focal lengths of the images of three directions and all between them."""
    axis = a + b + c
    length = wp.length(axis)
    if length < 1.0e-3:
        return wp.vec4(-WHOLE, -WHOLE, WHOLE, WHOLE)
    axis /= length
    half = wp.max(half_angle_of(axis, a), wp.max(half_angle_of(axis, b), half_angle_of(axis, c)))
    if half >= 0.5 * wp.pi:
        return wp.vec4(-WHOLE, -WHOLE, WHOLE, WHOLE)
    return cone_bounds(camera.lens, axis, half)


@wp.struct
class Corner:
    """A vertex as a view with a bent lens sees it.

    Attributes:
        point_m: Place in camera coordinates [m].
        distance_m: Distance from the camera's centre [m].
        depth_m: Its depth: z or distance, as the lens has it [m].
        direction: Direction, of unit length.
        place: Place in the image [focal lengths]; of a Brown-Conrady lens beyond its limit without what moves sideways.
        bend: Greatest curvature of the image of a great circle near there [focal lengths/rad^2]; of a PANORAMA the sine
            of the elevation, without its sign.
    """

    point_m: wp.vec3
    distance_m: float
    depth_m: float
    direction: wp.vec3
    place: wp.vec2
    bend: float


@wp.func
def squared_secant(cosine: float) -> float:
    """The square of the secant of an angle; very large from a right angle on."""
    cosine = wp.max(cosine, 1.0e-3)
    return 1.0 / (cosine * cosine)


@wp.func
def corner_of(camera: View, rays: Rays, table: int, point_m: wp.vec3) -> Corner:
    """A point in camera coordinates as the view sees it."""
    corner = Corner()
    corner.point_m = point_m
    corner.distance_m = wp.length(point_m)
    corner.depth_m = corner.distance_m
    if camera.lens.kind == BROWN_CONRADY:
        corner.depth_m = point_m[2]
    direction = point_m / wp.max(corner.distance_m, LEAST_DISTANCE_M)
    corner.direction = direction
    if camera.lens.kind == PANORAMA:
        level = wp.sqrt(direction[0] * direction[0] + direction[2] * direction[2])
        corner.place = wp.vec2(wp.atan2(direction[0], direction[2]), direction[1] / wp.max(level, 1.0e-6))
        corner.bend = wp.abs(direction[1])
    else:
        entry = table_entry(rays, table, direction[2])
        corner.place = wp.vec2(entry[0] * direction[0], entry[0] * direction[1])
        corner.bend = entry[1]
        if (
            camera.lens.kind == BROWN_CONRADY
            and squared_secant(direction[2]) <= 1.0 + camera.lens.limit * camera.lens.limit
        ):
            corner.place = moved_place(camera.lens, direction[0] / direction[2], direction[1] / direction[2])
    return corner


@wp.func
def corners_bounds(camera: View, widest_cosine: float, a: Corner, b: Corner, c: Corner) -> wp.vec4:
    """Bounds (left, top, right, bottom) in focal lengths of the image of a triangle.

    Columns of a panorama may lie a turn or two beside its image.
    """
    chord = wp.max(
        wp.length_sq(b.direction - a.direction),
        wp.max(wp.length_sq(c.direction - b.direction), wp.length_sq(a.direction - c.direction)),
    )
    bend = wp.max(a.bend, wp.max(b.bend, c.bend))
    if chord > WIDE * WIDE or (camera.lens.kind == PANORAMA and bend > STEEP):
        return wide_bounds(camera, a.direction, b.direction, c.direction)
    # an arc of length s bends away from its chord by at most an eighth of s^2 times its curvature
    bulge = 0.14 * chord * bend + TABLE_ERROR
    u1 = b.place[0]
    u2 = c.place[0]
    if camera.lens.kind == PANORAMA:
        # of y and x over the level distance; both bend by less than this
        level = wp.sqrt(1.0 - bend * bend)
        bulge = 0.5 * chord / (level * level * level)
        u1 -= 2.0 * wp.pi * wp.round((u1 - a.place[0]) / (2.0 * wp.pi))
        u2 -= 2.0 * wp.pi * wp.round((u2 - a.place[0]) / (2.0 * wp.pi))
    elif wp.max(a.direction[2], wp.max(b.direction[2], c.direction[2])) < widest_cosine:
        return wp.vec4(WHOLE, WHOLE, -WHOLE, -WHOLE)
    if camera.lens.kind == BROWN_CONRADY:
        # the table knows the radius alone; what moves sideways is at most this times the square of the angle's tangent
        sideways = 3.0 * (wp.abs(camera.lens.distortion[2]) + wp.abs(camera.lens.distortion[3]))
        limit = camera.lens.limit * camera.lens.limit
        widest = squared_secant(wp.min(a.direction[2], wp.min(b.direction[2], c.direction[2])))
        if widest <= 1.0 + limit:
            # an arc's slope changes by at most three times its second derivative, and it may pass beyond its ends
            bulge += 0.14 * chord * 6.0 * sideways * widest * (1.0 + limit)
        else:
            bulge += 1.4 * sideways * limit
    return wp.vec4(
        wp.min(a.place[0], wp.min(u1, u2)) - bulge,
        wp.min(a.place[1], wp.min(b.place[1], c.place[1])) - bulge,
        wp.max(a.place[0], wp.max(u1, u2)) + bulge,
        wp.max(a.place[1], wp.max(b.place[1], c.place[1])) + bulge,
    )


@wp.func
def ray_triangle(
    camera: View, widest_cosine: float, a: Corner, b: Corner, c: Corner, has_outline: bool, scissor: wp.vec4i
) -> RayTriangle:
    """A triangle in the space of a view's rays, its rows and columns cut to a scissor.

    A panorama's columns are those of one of its turns, and may lie beside the scissor.
    """
    found = RayTriangle()
    found.first_row = 0
    found.last_row = -1
    p = a.point_m
    q = b.point_m
    r = c.point_m
    farthest = wp.max(a.depth_m, wp.max(b.depth_m, c.depth_m))
    nearest = wp.min(a.distance_m, wp.min(b.distance_m, c.distance_m))
    if farthest < camera.near_m or nearest < LEAST_DISTANCE_M:
        return found
    place = corners_bounds(camera, widest_cosine, a, b, c)
    low = -WHOLE
    high = WHOLE
    if camera.lens.kind != PANORAMA:
        low = float(scissor[0])
        high = float(scissor[2])
    found.first_row = line_after(camera.centre[1] + camera.focal[1] * place[1], scissor[1], scissor[3])
    found.last_row = line_after(camera.centre[1] + camera.focal[1] * place[3], scissor[1], scissor[3]) - 1
    has_rows = found.first_row <= found.last_row
    if not (has_rows or has_outline):
        return found
    left = wp.clamp(camera.centre[0] + camera.focal[0] * place[0], low, high)
    right = wp.clamp(camera.centre[0] + camera.focal[0] * place[2], low, high)
    if camera.lens.kind == PANORAMA and right - left >= 2.0 * wp.pi * camera.focal[0]:
        left = float(scissor[0])
        right = float(scissor[2])
    found.first_column = int(wp.floor(left + 0.5))
    found.last_column = int(wp.floor(right + 0.5)) - 1
    has_columns = found.first_column <= found.last_column
    if not (has_rows and has_columns):
        found.last_row = found.first_row - 1
        if not (has_outline and (has_rows or has_columns)):
            return found
    normal = wp.cross(q - p, r - p)
    volume = wp.dot(p, normal)
    if wp.abs(volume) < LEAST_VOLUME * a.distance_m * b.distance_m * c.distance_m:
        found.last_row = found.first_row - 1
        return found
    side = wp.sign(volume)
    found.edge0 = edge_plane(p, q, side)
    found.edge1 = edge_plane(q, r, side)
    found.edge2 = edge_plane(r, p, side)
    found.inverse_depth = normal / volume
    found.is_solid = True
    return found


# Eight samples of a row, or blocks, are tested at once. Warp's arrays may have any strides; that these rows lie in one
# piece is what lets a compiler use its vectors.
_FILL_TRIANGLE = """
    const float a0 = image.edge0[0], b0 = image.edge0[1], c0 = image.edge0[2];
    const float a1 = image.edge1[0], b1 = image.edge1[1], c1 = image.edge1[2];
    const float a2 = image.edge2[0], b2 = image.edge2[1], c2 = image.edge2[2];
    const float aw = image.inverse_depth[0], bw = image.inverse_depth[1], cw = image.inverse_depth[2];
    const float reach0 = -1.0001f * wp::length(image.edge0);
    const float reach1 = -1.0001f * wp::length(image.edge1);
    const float reach2 = -1.0001f * wp::length(image.edge2);
    const int width = rays.ray.shape[3], blocks = rays.block.shape[3];
    const size_t ray_axis = size_t(rays.ray.shape[2]) * width, block_axis = size_t(rays.block.shape[2]) * blocks;
    const float* block_data = rays.block.data + 4 * block_axis * ray_set;
    const float* row_data = rays.block_row.data + 32 * block_axis * ray_set;
    const bool is_large = (last_column - first_column + 1) * (image.last_row - image.first_row + 1) > large;
    const int size = is_large ? 8 : 1 << 30;
    for (int block_row = image.first_row / size; block_row <= image.last_row / size; ++block_row) {
        const int first_row = is_large ? wp::max(image.first_row, block_row * 8) : image.first_row;
        const int last_row = is_large ? wp::min(image.last_row, block_row * 8 + 7) : image.last_row;
        for (int first_block = first_column / size; first_block <= last_column / size; first_block += 8) {
            wp::int32 block_is_reached[8] = {1, 1, 1, 1, 1, 1, 1, 1};
            const auto reach = [&](wp::int32* is_reached, const float* x, size_t axis, int count) {
                for (int i = 0; i < count; ++i) {
                    const float dx = x[i], dy = x[i + axis], dz = x[i + 2 * axis], spread = x[i + 3 * axis];
                    is_reached[i] = (a0 * dx + b0 * dy + c0 * dz >= reach0 * spread)
                        & (a1 * dx + b1 * dy + c1 * dz >= reach1 * spread)
                        & (a2 * dx + b2 * dy + c2 * dz >= reach2 * spread);
                }
            };
            if (is_large) {
                const float* x = block_data + size_t(block_row) * blocks + first_block;
                if (first_block + 8 <= blocks) reach(block_is_reached, x, block_axis, 8);
                else reach(block_is_reached, x, block_axis, blocks - first_block);
            }
            const int last_block = wp::min(first_block + 7, last_column / size);
            for (int block = first_block; block <= last_block; ++block) {
                if (!block_is_reached[block - first_block]) continue;
                const int begin = is_large ? block * 8 : first_column;
                const int end = is_large ? begin : last_column;
                wp::int32 row_is_reached[8];
                if (is_large)
                    reach(row_is_reached, row_data + 8 * (size_t(block_row) * blocks + block), 8 * block_axis, 8);
                for (int row = first_row; row <= last_row; ++row) {
                    if (is_large && !row_is_reached[row & 7]) continue;
                    wp::int64* nearest = key.data + (size_t(v) * key.shape[1] + row) * key.shape[2];
                    const bool has_layer = offset >= 0 && row >= rectangle[1] && row < rectangle[1] + rectangle[3];
                    const int layer_row = offset + (row - rectangle[1]) * rectangle[2] - rectangle[0];
                    for (int first = begin; first <= end; first += 8) {
                        const float* x = rays.ray.data + 3 * ray_axis * ray_set + size_t(row) * width + first;
                        wp::int32 bits[8];
                        const auto fill = [&](int count) {
                            for (int i = 0; i < count; ++i) {
                                const float dx = x[i], dy = x[i + ray_axis], dz = x[i + 2 * ray_axis];
                                const float w = aw * dx + bw * dy + cw * dz;
                                const bool is_inside = (a0 * dx + b0 * dy + c0 * dz >= 0.0f)
                                    & (a1 * dx + b1 * dy + c1 * dz >= 0.0f) & (a2 * dx + b2 * dy + c2 * dz >= 0.0f);
                                union { float number; wp::int32 bits; } kept;
                                kept.number = wp::max(w, least_inverse_depth);
                                bits[i] = (is_inside & (w > 0.0f) & (w <= farthest)) ? kept.bits : 0;
                            }
                            if (has_key)
                                for (int i = 0; i < count; ++i) {
                                    const wp::int64 value = wp::int64(bits[i]) << 32 | (bits[i] ? triangle : 0);
                                    nearest[first + i] = wp::max(nearest[first + i], value);
                                }
                        };
                        const int count = wp::min(8, width - first);
                        if (count == 8) fill(8); else fill(count);
                        if (has_layer) {
                            const int from = wp::max(rectangle[0] - first, 0);
                            const int to = wp::min(rectangle[0] + rectangle[2] - first, count);
                            wp::int32* front = layers.inverse_depth_bits.data + layer_row + first;
                            for (int i = from; i < to; ++i) front[i] = wp::max(front[i], bits[i]);
                        }
                    }
                }
            }
        }
    }
"""


@wp.func_native(_FILL_TRIANGLE)
def fill_triangle(
    image: RayTriangle,
    rays: Rays,
    ray_set: int,
    first_column: int,
    last_column: int,
    large: int,
    least_inverse_depth: float,
    farthest: float,
    v: int,
    triangle: int,
    has_key: bool,
    rectangle: wp.vec4i,
    offset: int,
    layers: Layers,
    key: wp.array3d[wp.int64],
):
    """Scatter a triangle between two columns into the key buffer and, where ``offset`` is not negative, its layer.

    One of more than ``large`` samples goes block by block, and those that it does not reach are passed over.

    Writes: ``key`` and ``layers``, without atomic operations: one thread draws a view.
    """
    ...


@wp.func
def cross_pair(
    rays: Rays,
    ray_set: int,
    row: int,
    column: int,
    direction: int,
    edge: wp.vec3,
    start: wp.vec3,
    end: wp.vec3,
    inverse_depth: wp.vec3,
    farthest: float,
    rectangle: wp.vec4i,
    offset: int,
    layers: Layers,
):
    """Scatter where an edge crosses the line from a sample to its neighbour TO_RIGHT or TO_BOTTOM, either way.

    ``edge`` is the normal of the edge's plane, the triangle on its positive side; ``start`` and ``end`` are normals of
    planes that the crossing lies between.
    """
    step = step_of(direction)
    here = ray_at(rays.ray, ray_set, row, column)
    there = ray_at(rays.ray, ray_set, row + step[0], column + step[1])
    height = wp.dot(edge, here)
    other_height = wp.dot(edge, there)
    if (height >= 0.0) == (other_height >= 0.0) or wp.length_sq(here) == 0.0 or wp.length_sq(there) == 0.0:
        return
    share = height / (height - other_height)
    crossing = ray_between(here, there, share)
    slack = -END_SLACK * wp.length(crossing)
    if wp.dot(start, crossing) < slack * wp.length(start) or wp.dot(end, crossing) < slack * wp.length(end):
        return
    w = wp.dot(inverse_depth, crossing)
    if w <= 0.0 or w > farthest:
        return
    if height >= 0.0:
        place = place_in(rectangle, offset, row, column)
        if place >= 0:
            raise_crossing(layers, direction, place, share, w, -1)
    else:
        place = place_in(rectangle, offset, row + step[0], column + step[1])
        if place >= 0:
            raise_crossing(layers, TO_LEFT + TO_RIGHT - direction, place, 1.0 - share, w, -1)


@wp.func(inline=False)
def cross_bent_edge(
    camera: View,
    rays: Rays,
    ray_set: int,
    table: int,
    widest_cosine: float,
    p: Corner,
    q: Corner,
    edge: wp.vec3,
    inverse_depth: wp.vec3,
    rectangle: wp.vec4i,
    offset: int,
    layers: Layers,
):
    """Scatter where one side of a triangle, from p to q, crosses the lines between neighbouring samples.

    It is cut to pieces whose images are short.
    """
    right = rectangle[0] + rectangle[2]
    bottom = rectangle[1] + rectangle[3]
    farthest = 1.0 / camera.near_m
    # the two planes through the axis of the edge's circle and its ends
    raw = wp.cross(p.direction, q.direction)
    start = wp.cross(raw, p.direction)
    end = wp.cross(q.direction, raw)
    length = wp.length(q.direction - p.direction) / PIECE
    if length < 1.0:
        # of a short edge the table knows the length in the image
        length = wp.max(camera.focal[0], camera.focal[1]) * wp.length(q.place - p.place) / PIECE_SAMPLES
    else:
        length *= wp.max(1.0, wp.max(camera.focal[0], camera.focal[1]) * PIECE / PIECE_SAMPLES)
    pieces = wp.clamp(int(wp.ceil(length)), 1, MAX_PIECES)
    a = p
    for piece in range(pieces):
        b = q
        if piece + 1 < pieces:
            share = float(piece + 1) / float(pieces)
            b = corner_of(camera, rays, table, (1.0 - share) * p.direction + share * q.direction)
        bounds = corners_bounds(camera, widest_cosine, a, b, b)
        turn = int(0)
        if camera.lens.kind == PANORAMA:
            turn = 1
        # half a sample more for rounding
        first_row = line_after(camera.centre[1] + camera.focal[1] * bounds[1] - 0.5, rectangle[1], bottom)
        last_row = line_after(camera.centre[1] + camera.focal[1] * bounds[3] + 0.5, rectangle[1], bottom) - 1
        for n in range(-turn, turn + 1):
            if first_row <= last_row:
                shift = 2.0 * wp.pi * camera.focal[0] * float(n)
                first_column = line_after(
                    camera.centre[0] + camera.focal[0] * bounds[0] + shift - 0.5, rectangle[0], right
                )
                last_column = (
                    line_after(camera.centre[0] + camera.focal[0] * bounds[2] + shift + 0.5, rectangle[0], right) - 1
                )
                for row in range(wp.max(first_row - 1, 0), last_row + 1):
                    for column in range(wp.max(first_column - 1, 0), last_column + 1):
                        if column + 1 < rays.ray.shape[3] and row >= first_row:
                            cross_pair(
                                rays, ray_set, row, column, TO_RIGHT, edge, start, end, inverse_depth, farthest,
                                rectangle, offset, layers,
                            )  # fmt: skip
                        if row + 1 < rays.ray.shape[2] and column >= first_column:
                            cross_pair(
                                rays, ray_set, row, column, TO_BOTTOM, edge, start, end, inverse_depth, farthest,
                                rectangle, offset, layers,
                            )  # fmt: skip
        a = b


@wp.func(inline=False)
def cross_near_cut(
    image: RayTriangle,
    camera: View,
    rays: Rays,
    ray_set: int,
    triangle: int,
    rectangle: wp.vec4i,
    offset: int,
    layers: Layers,
):
    """Scatter where the near cut ends a triangle between a sample and its neighbours."""
    nearest = 1.0 / camera.near_m
    for r in range(rectangle[3]):
        for c in range(rectangle[2]):
            here = ray_at(rays.ray, ray_set, rectangle[1] + r, rectangle[0] + c)
            w = wp.dot(image.inverse_depth, here)
            if w > 0.0 and w <= nearest:
                for direction in range(4):
                    step = step_of(direction)
                    row = rectangle[1] + r + step[0]
                    column = rectangle[0] + c + step[1]
                    if row >= 0 and column >= 0 and row < rays.ray.shape[2] and column < rays.ray.shape[3]:
                        there = ray_at(rays.ray, ray_set, row, column)
                        other_w = wp.dot(image.inverse_depth, there)
                        if other_w > nearest:
                            # 1/depth is linear in the ray, and nearly so in the share of rays of one length
                            share = (nearest - w) / (other_w - w)
                            crossing = ray_between(here, there, share)
                            middle_w = wp.dot(image.inverse_depth, crossing)
                            if middle_w < nearest:
                                share += (1.0 - share) * (nearest - middle_w) / (other_w - middle_w)
                            else:
                                share *= (nearest - w) / (middle_w - w)
                            crossing = ray_between(here, there, share)
                            inner = wp.min(wp.dot(image.edge0, crossing), wp.dot(image.edge1, crossing))
                            if wp.min(inner, wp.dot(image.edge2, crossing)) >= 0.0:
                                place = offset + r * rectangle[2] + c
                                raise_crossing(layers, direction, place, share, nearest, triangle)


@wp.func(inline=False)
def misses_scissor(camera: View, centre_m: wp.vec3, radius_m: float, scissor: wp.vec4i) -> bool:
    """Whether a sphere (camera coordinates) surely has no image inside a view's scissor."""
    distance = wp.length(centre_m)
    if distance + radius_m < camera.near_m:
        return True
    if distance <= 1.01 * radius_m:
        return False
    half = wp.asin(radius_m / distance) + 1.0e-5
    place = cone_bounds(camera.lens, centre_m / distance, half)
    top = camera.centre[1] + camera.focal[1] * place[1]
    bottom = camera.centre[1] + camera.focal[1] * place[3]
    if top > float(scissor[3]) or bottom < float(scissor[1]) or place[2] < place[0]:
        return True
    if camera.lens.kind == PANORAMA:
        return False
    left = camera.centre[0] + camera.focal[0] * place[0]
    right = camera.centre[0] + camera.focal[0] * place[2]
    return left > float(scissor[2]) or right < float(scissor[0])


@wp.kernel(enable_backward=False)
def scatter_bent_triangles_kernel(
    # in
    view: wp.array[View],
    scene: Triangles,
    rays: Rays,
    bent_view: wp.array[wp.int32],
    layer_count: int,
    scissor: wp.array[wp.vec4i],
    first: int,
    has_key: int,
    has_outlines: int,
    # out
    corner: wp.array2d[Corner],
    key: wp.array3d[wp.int64],
    layers: Layers,
):
    """Scatter every triangle into the key buffer and, where its object has one below ``layer_count``, into its layer.

    As `rasterise.scatter_triangles_kernel`, for the views whose lenses are no pinholes.

    Launch: ``dim=(such views of this chunk, cluster_count)``; one thread per cluster of a view. Not taped.
    Writes: ``key`` and ``layers``, which the caller zeroes; ``corner`` [view, vertex of a cluster], which nobody else
        reads. So all clusters of a view must be drawn by one thread, as on a CPU.
    """
    i, cluster = wp.tid()
    v = bent_view[first + i]
    layer = scene.cluster_layer[cluster]
    if layer >= layer_count:
        layer = -1
    if has_key == 0 and layer < 0:
        return
    camera = view[v]
    frame = scissor[v]
    if frame[0] >= frame[2]:
        return
    sphere = scene.cluster_sphere_world_m[cluster]
    centre_m = point_in_camera(camera, wp.vec3(sphere[0], sphere[1], sphere[2]))
    if misses_scissor(camera, centre_m, sphere[3], frame):
        return
    rectangle = wp.vec4i(0, 0, 0, 0)
    offset = int(-1)
    if layer >= 0:
        rectangle = layers.rectangle[v, layer]
        offset = layers.offset[v, layer]
        if rectangle[2] == 0:
            offset = -1
    has_outline = offset >= 0 and has_outlines == 1
    table = rays.table_of_view[v]
    ray_set = rays.set_of_view[v]
    widest_cosine = rays.widest_cosine[ray_set]
    is_front_only = shows_no_back(camera, scene, cluster, frame)
    first_triangle = scene.cluster_first[cluster]
    turn = int(0)
    if camera.lens.kind == PANORAMA:
        turn = 1
    vertices = scene.cluster_vertices[cluster]
    for k in range(vertices[1]):
        point_m = point_in_camera(camera, scene.vertex_world_m[vertices[0] + k])
        corner[v, k] = corner_of(camera, rays, table, point_m)
    for k in range(scene.cluster_count[cluster]):
        triangle = first_triangle + k
        if is_front_only and is_behind(camera, scene.triangle_plane[triangle]):
            continue
        of_triangle = scene.triangle[triangle]
        a = corner[v, of_triangle[0] - vertices[0]]
        b = corner[v, of_triangle[1] - vertices[0]]
        c = corner[v, of_triangle[2] - vertices[0]]
        image = ray_triangle(camera, widest_cosine, a, b, c, has_outline, frame)
        if has_outline and image.is_solid:
            neighbour = scene.neighbour[triangle]
            is_facing = faces(camera, scene.triangle_plane[triangle])
            if may_be_outline(camera, scene, is_facing, neighbour[0]):
                cross_bent_edge(
                    camera, rays, ray_set, table, widest_cosine, a, b, image.edge0, image.inverse_depth, rectangle,
                    offset, layers,
                )  # fmt: skip
            if may_be_outline(camera, scene, is_facing, neighbour[1]):
                cross_bent_edge(
                    camera, rays, ray_set, table, widest_cosine, b, c, image.edge1, image.inverse_depth, rectangle,
                    offset, layers,
                )  # fmt: skip
            if may_be_outline(camera, scene, is_facing, neighbour[2]):
                cross_bent_edge(
                    camera, rays, ray_set, table, widest_cosine, c, a, image.edge2, image.inverse_depth, rectangle,
                    offset, layers,
                )  # fmt: skip
            if not is_front_only and wp.min(a.depth_m, wp.min(b.depth_m, c.depth_m)) < camera.near_m:
                cross_near_cut(image, camera, rays, ray_set, triangle, rectangle, offset, layers)
        if image.first_row <= image.last_row:
            for n in range(-turn, turn + 1):
                # the other turns of a panorama, whose images may be cut by the seam
                shift = int(wp.round(2.0 * wp.pi * camera.focal[0] * float(n)))
                first_column = wp.max(image.first_column + shift - turn, frame[0])
                last_column = wp.min(image.last_column + shift + turn, frame[2] - 1)
                if first_column <= last_column:
                    fill_triangle(
                        image,
                        rays,
                        ray_set,
                        first_column,
                        last_column,
                        LARGE_SAMPLES,
                        LEAST_INVERSE_DEPTH,
                        1.0 / camera.near_m,
                        v,
                        triangle,
                        has_key == 1,
                        rectangle,
                        offset,
                        layers,
                        key,
                    )
