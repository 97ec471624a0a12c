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
from warpav_kernels.raster.triangles import Triangles, behind_m, faces, may_be_outline, shows_no_back
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
        is_flat: Whether all rays have z = 1, [set].
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
    is_flat: wp.array[wp.int32]
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
    ray: wp.array4d[float],
    block: wp.array4d[float],
    # out
    widest_cosine: wp.array[float],
    is_flat: wp.array[wp.int32],
):
    """See `Rays.widest_cosine` and `Rays.is_flat`.

    Launch: ``dim=set_count``; one thread per set. Not taped.
    Writes: every element of ``widest_cosine`` and ``is_flat`` once.
    """
    i = wp.tid()
    others = int(0)
    for row in range(ray.shape[2]):
        for column in range(ray.shape[3]):
            others += int(ray[i, 2, row, column] != 1.0)
    is_flat[i] = int(others == 0)
    widest = float(0.0)
    for row in range(block.shape[2]):
        for column in range(block.shape[3]):
            mean = ray_at(block, i, row, column)
            if wp.length_sq(mean) > 0.0:
                angle = wp.atan2(wp.sqrt(mean[0] * mean[0] + mean[1] * mean[1]), mean[2])
                widest = wp.max(widest, angle + 2.0 * wp.asin(wp.min(block[i, 3, row, column] / wp.length(mean), 1.0)))
    widest_cosine[i] = wp.cos(wp.min(widest + 1.2 * WIDE, wp.pi))


@wp.struct
class Candidate:
    """A triangle that a view with a bent lens may see, in the space of rays.

    A ray d meets it where no product with an edge's normal is negative.

    Attributes:
        edge0: Normal of the plane through the camera's centre and its first edge [m^2].
        edge1: That of the second.
        edge2: That of the third.
        inverse_depth: Its product with a ray of depth 1 is the inverse depth [1/m].
        first_column: First column of samples that it may cover; of one of its turns for a panorama.
        last_column: Last such column; below the first where there is none.
        first_row: First such row.
        last_row: Last such row; below the first where there is none.
        triangle: Its number in the scene.
        is_wide: Whether it reaches so far that a cone has to bound its image, which is not done yet.
    """

    edge0: wp.vec3
    edge1: wp.vec3
    edge2: wp.vec3
    inverse_depth: wp.vec3
    first_column: int
    last_column: int
    first_row: int
    last_row: int
    triangle: int
    is_wide: int


_FIND_CANDIDATES = """
#ifdef __CUDACC__
    return 0;
#else
    const auto least = [](float p, float q) { return p < q ? p : q; };
    const auto most = [](float p, float q) { return p > q ? p : q; };
    const float half_turn = 3.14159265f;
    const bool is_flat = camera.lens.kind == brown_conrady, is_panorama = camera.lens.kind == panorama;

    // vertices: direction, distance, depth, place in the image and how much great circles bend there
    const wp::vec2i vertices = scene.cluster_vertices.data[cluster];
    const wp::vec3* vertex = scene.vertex_world_m.data + vertices[0];
    const wp::vec3 place = camera.position_world_m;
    const wp::mat33 r = camera.camera_from_world;
    const float limit = camera.lens.limit * camera.lens.limit;
    float px[192], py[192], pz[192], dx[192], dy[192], dz[192], distance[192], depth[192], u[192], v[192], bend[192], secant[192];
    for (int i = 0; i < vertices[1]; ++i) {
        const float wx = vertex[i][0] - place[0], wy = vertex[i][1] - place[1], wz = vertex[i][2] - place[2];
        const float x = r.data[0][0] * wx + r.data[0][1] * wy + r.data[0][2] * wz;
        const float y = r.data[1][0] * wx + r.data[1][1] * wy + r.data[1][2] * wz;
        const float z = r.data[2][0] * wx + r.data[2][1] * wy + r.data[2][2] * wz;
        distance[i] = sqrtf(x * x + y * y + z * z);
        depth[i] = is_flat ? z : distance[i];
        px[i] = x;
        py[i] = y;
        pz[i] = z;
        const float whole = 1.0f / most(distance[i], least_distance_m);
        dx[i] = x * whole;
        dy[i] = y * whole;
        dz[i] = z * whole;
    }
    if (is_panorama) {
        for (int i = 0; i < vertices[1]; ++i) {
            u[i] = atan2f(dx[i], dz[i]);
            v[i] = dy[i] / most(sqrtf(dx[i] * dx[i] + dz[i] * dz[i]), 1.0e-6f);
            bend[i] = wp::abs(dy[i]);
        }
    } else {
        const int entries = rays.table.shape[1];
        const wp::vec2* entry = rays.table.data + size_t(table) * entries;
        for (int i = 0; i < vertices[1]; ++i) {
            const float at = 0.5f * (1.0f - dz[i]) * (entries - 1);
            wp::int32 k = at;
            k = k < 0 ? 0 : k > entries - 2 ? entries - 2 : k;
            const float share = least(most(at - k, 0.0f), 1.0f);
            const float ratio = entry[k][0] + share * (entry[k + 1][0] - entry[k][0]);
            bend[i] = most(entry[k][1], entry[k + 1][1]);
            u[i] = ratio * dx[i];
            v[i] = ratio * dy[i];
        }
    }
    if (is_flat) {
        const auto& q = camera.lens.distortion;
        for (int i = 0; i < vertices[1]; ++i) {
            const float w = 1.0f / most(dz[i], 1.0e-3f);
            const float x = dx[i] * w, y = dy[i] * w, squared = x * x + y * y;
            secant[i] = w * w;
            const float above = 1.0f + squared * (q[0] + squared * (q[1] + squared * q[4]));
            const float below = 1.0f + squared * (q[5] + squared * (q[6] + squared * q[7]));
            const float factor = above / below;
            const bool is_seen = secant[i] <= 1.0f + limit;
            u[i] = is_seen ? factor * x + 2.0f * q[2] * x * y + q[3] * (squared + 2.0f * x * x) : u[i];
            v[i] = is_seen ? factor * y + q[2] * (squared + 2.0f * y * y) + 2.0f * q[3] * x * y : v[i];
        }
    }

    const int first_triangle = scene.cluster_first.data[cluster], count = scene.cluster_count.data[cluster];
    const wp::vec3i* corner = scene.triangle.data + first_triangle;
    const wp::vec4* plane = scene.triangle_plane.data + first_triangle;
    const float frame_left = frame[0], frame_top = frame[1], frame_right = frame[2], frame_bottom = frame[3];
    const float low = is_panorama ? -far_away : frame_left, high = is_panorama ? far_away : frame_right;
    const float turn = 2.0f * half_turn * camera.focal[0];
    const float sideways = is_flat ? 3.0f * (wp::abs(camera.lens.distortion[2]) + wp::abs(camera.lens.distortion[3])) : 0.0f;
    // a plane is computed from the same end whichever way the edge runs: triangles that share it share every bit of it
    const auto plane_of = [&](int p, int q, float side) {
        const bool is_turned =
            px[p] > px[q] || (px[p] == px[q] && (py[p] > py[q] || (py[p] == py[q] && pz[p] > pz[q])));
        const int from = is_turned ? q : p, to = is_turned ? p : q;
        const float sign = is_turned ? -side : side;
        const float x = px[to] - px[from], y = py[to] - py[from], z = pz[to] - pz[from];
        return wp::vec3(
            sign * (py[from] * z - pz[from] * y), sign * (pz[from] * x - px[from] * z),
            sign * (px[from] * y - py[from] * x));
    };
    const auto set_planes = [&](auto& each, int a, int b, int c) {
        const float x1 = px[b] - px[a], y1 = py[b] - py[a], z1 = pz[b] - pz[a];
        const float x2 = px[c] - px[a], y2 = py[c] - py[a], z2 = pz[c] - pz[a];
        const float nx = y1 * z2 - z1 * y2, ny = z1 * x2 - x1 * z2, nz = x1 * y2 - y1 * x2;
        const float volume = px[a] * nx + py[a] * ny + pz[a] * nz;
        if (wp::abs(volume) < least_volume * distance[a] * distance[b] * distance[c]) return 0;
        const float side = volume > 0.0f ? 1.0f : -1.0f;
        each.edge0 = plane_of(a, b, side);
        each.edge1 = plane_of(b, c, side);
        each.edge2 = plane_of(c, a, side);
        each.inverse_depth = wp::vec3(nx / volume, ny / volume, nz / volume);
        return 1;
    };
    auto* slot = candidate.data + view * candidate.shape[1];
    int found = 0;
    #pragma clang loop vectorize(disable)
    for (int k = 0; k < count; ++k) {
        const float height = plane[k][0] * place[0] + plane[k][1] * place[1] + plane[k][2] * place[2] - plane[k][3];
        if (is_front_only & (height < -behind_m)) continue;
        const int a = corner[k][0] - vertices[0], b = corner[k][1] - vertices[0], c = corner[k][2] - vertices[0];
        if ((most(depth[a], most(depth[b], depth[c])) < camera.near_m)
            | (least(distance[a], least(distance[b], distance[c])) < least_distance_m)) continue;
        const auto chord_of = [&](int p, int q) {
            const float x = dx[q] - dx[p], y = dy[q] - dy[p], z = dz[q] - dz[p];
            return x * x + y * y + z * z;
        };
        const float chord = most(chord_of(a, b), most(chord_of(b, c), chord_of(c, a)));
        const float most_bend = most(bend[a], most(bend[b], bend[c]));
        const bool is_wide = (chord > wide * wide) | (is_panorama & (most_bend > steep));
        auto& each = slot[found];
        each.triangle = first_triangle + k;
        each.is_wide = is_wide;
        if (is_wide) {
            found += set_planes(each, a, b, c);
            continue;
        }
        // an arc of length s bends away from its chord by at most an eighth of s^2 times its curvature
        float bulge = 0.14f * chord * most_bend + table_error;
        float u1 = u[b], u2 = u[c];
        if (is_panorama) {
            // of y and x over the level distance; both bend by less than this
            const float level = sqrtf(1.0f - most_bend * most_bend);
            bulge = 0.5f * chord / (level * level * level);
            u1 -= 2.0f * half_turn * rintf((u1 - u[a]) / (2.0f * half_turn));
            u2 -= 2.0f * half_turn * rintf((u2 - u[a]) / (2.0f * half_turn));
        } else if (most(dz[a], most(dz[b], dz[c])) < widest_cosine) continue;
        if (sideways > 0.0f) {
            // the table knows the radius alone; what moves sideways is at most this times the squared tangent
            const float widest = most(secant[a], most(secant[b], secant[c]));
            // an arc's slope changes by at most three times its second derivative, and it may pass beyond its ends
            bulge += widest <= 1.0f + limit ? 0.84f * chord * sideways * widest * (1.0f + limit) : 1.4f * sideways * limit;
        }
        const float fx = camera.focal[0], fy = camera.focal[1], cx = camera.centre[0], cy = camera.centre[1];
        float left = least(most(cx + fx * (least(u[a], least(u1, u2)) - bulge), low), high);
        float right = least(most(cx + fx * (most(u[a], most(u1, u2)) + bulge), low), high);
        const float top = least(most(cy + fy * (least(v[a], least(v[b], v[c])) - bulge), frame_top), frame_bottom);
        const float bottom = least(most(cy + fy * (most(v[a], most(v[b], v[c])) + bulge), frame_top), frame_bottom);
        if (is_panorama & (right - left >= turn)) {
            left = frame_left;
            right = frame_right;
        }
        each.first_column = floorf(left + 0.5f);
        each.last_column = floorf(right + 0.5f) - 1.0f;
        each.first_row = top + 0.5f;
        each.last_row = wp::int32(bottom + 0.5f) - 1;
        const bool has_column = each.first_column <= each.last_column, has_row = each.first_row <= each.last_row;
        if ((has_column & has_row) | (has_outline & (has_column | has_row))) found += set_planes(each, a, b, c);
    }
    return found;
#endif
"""


@wp.func_native(_FIND_CANDIDATES)
def find_candidates(
    camera: View,
    scene: Triangles,
    cluster: int,
    frame: wp.vec4i,
    rays: Rays,
    table: int,
    widest_cosine: float,
    is_front_only: bool,
    behind_m: float,
    has_outline: bool,
    brown_conrady: int,
    panorama: int,
    least_distance_m: float,
    least_volume: float,
    wide: float,
    steep: float,
    table_error: float,
    far_away: float,
    view: int,
    candidate: wp.array2d[Candidate],
) -> int:
    """Triangles of a cluster that a view with a bent lens may see inside a frame of the grid: how many; on a GPU, none.

    With ``has_outline`` they may lie between the rows or the columns.

    Writes: ``candidate`` [view, triangle of a cluster].
    """
    ...


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


@wp.func(inline=False)
def bound_wide(camera: View, candidate: Candidate, p: wp.vec3, q: wp.vec3, r: wp.vec3, frame: wp.vec4i) -> Candidate:
    """A wide triangle with its bounds."""
    found = candidate
    place = wide_bounds(camera, wp.normalize(p), wp.normalize(q), wp.normalize(r))
    low = float(frame[0])
    high = float(frame[2])
    if camera.lens.kind == PANORAMA:
        low = -WHOLE
        high = WHOLE
    found.first_row = line_after(camera.centre[1] + camera.focal[1] * place[1], frame[1], frame[3])
    found.last_row = line_after(camera.centre[1] + camera.focal[1] * place[3], frame[1], frame[3]) - 1
    left = wp.clamp(camera.centre[0] + camera.focal[0] * place[0], low, high)
    right = wp.clamp(camera.centre[0] + camera.focal[0] * place[2], low, high)
    if camera.lens.kind == PANORAMA and right - left >= 2.0 * wp.pi * camera.focal[0]:
        left = float(frame[0])
        right = float(frame[2])
    found.first_column = int(wp.floor(left + 0.5))
    found.last_column = int(wp.floor(right + 0.5)) - 1
    return found


# Eight samples of a row, or blocks, are tested at once. Warp's arrays may have any strides; that these rows lie in one
# piece is what lets a compiler use its vectors.
_FILL_TRIANGLE = """
#ifndef __CUDACC__
    const auto& image = candidate.data[v * candidate.shape[1] + number];
    const int triangle = image.triangle, first_row = image.first_row, last_row = image.last_row;
    if (first_row > last_row || image.first_column > image.last_column) return;
    const float a0 = image.edge0[0], b0 = image.edge0[1], c0 = image.edge0[2];
    const float a1 = image.edge1[0], b1 = image.edge1[1], c1 = image.edge1[2];
    const float a2 = image.edge2[0], b2 = image.edge2[1], c2 = image.edge2[2];
    const float aw = image.inverse_depth[0], bw = image.inverse_depth[1], cw = image.inverse_depth[2];
    const int width = rays.ray.shape[3];
    const size_t axis = size_t(rays.ray.shape[2]) * width;
    const bool is_flat = rays.is_flat.data[ray_set];
    const float* ray = rays.ray.data + 3 * axis * ray_set;
    wp::int64* keys = key.data + size_t(v) * key.shape[1] * key.shape[2];
    wp::int32* front = layers.inverse_depth_bits.data + offset - rectangle[0];
    struct Yes { enum { is = 1 }; };
    struct No { enum { is = 0 }; };

    // samples of a row from a column on; inside a triangle only its depth is asked for
    const auto fill = [&](auto flat, auto inner, int lanes, int row, int first) {
        const float* x = ray + size_t(row) * width + first;
        wp::int32 bits[8];
        for (int i = 0; i < lanes; ++i) {
            const float dx = x[i], dy = x[i + axis];
            const float dz = flat.is ? 1.0f : x[i + 2 * axis];
            union { float number; wp::int32 bits; } here;
            const float w = aw * dx + bw * dy + cw * dz;
            here.number = wp::max(w, least_inverse_depth);
            int is_covered = (w > 0.0f) & (w <= farthest);
            if (!inner.is)
                is_covered &= (a0 * dx + b0 * dy + c0 * dz >= 0.0f)
                    & (a1 * dx + b1 * dy + c1 * dz >= 0.0f) & (a2 * dx + b2 * dy + c2 * dz >= 0.0f);
            bits[i] = is_covered ? here.bits : 0;
        }
        if (has_key) {
            wp::int64* nearest = keys + size_t(row) * width + first;
            for (int i = 0; i < lanes; ++i) {
                const wp::int64 value = wp::int64(bits[i]) << 32 | (bits[i] ? triangle : 0);
                nearest[i] = wp::max(nearest[i], value);
            }
        }
        if (offset >= 0 && row >= rectangle[1] && row < rectangle[1] + rectangle[3]) {
            const int layer_row = (row - rectangle[1]) * rectangle[2];
            const int end = wp::min(rectangle[0] + rectangle[2], first + lanes);
            for (int i = wp::max(rectangle[0], first); i < end; ++i)
                front[layer_row + i] = wp::max(front[layer_row + i], bits[i - first]);
        }
    };
    // the last samples of a row are drawn once more, so that eight remain
    const auto fill_eight = [&](auto flat, auto inner, int row, int first) {
        if (width >= 8) fill(flat, inner, 8, row, wp::min(first, width - 8));
        else fill(flat, inner, width, row, 0);
    };

    const auto fill_small = [&](auto flat, int first_column, int last_column) {
        for (int row = first_row; row <= last_row; ++row)
            for (int first = first_column; first <= last_column; first += 8) fill_eight(flat, No(), row, first);
    };

    const auto fill_large = [&](auto flat, int first_column, int last_column) {
        const int columns = rays.block.shape[3];
        const size_t block_axis = size_t(rays.block.shape[2]) * columns;
        const float* block = rays.block.data + 4 * block_axis * ray_set;
        const float* block_row = rays.block_row.data + 32 * block_axis * ray_set;
        const float r0 = 1.0001f * wp::length(image.edge0);
        const float r1 = 1.0001f * wp::length(image.edge1);
        const float r2 = 1.0001f * wp::length(image.edge2);
        // of bundles of rays: whether the triangle may reach any, and whether it covers all
        const auto look = [&](wp::int32* is_reached, wp::int32* is_inner, const float* x, size_t axis, int count) {
            for (int i = 0; i < count; ++i) {
                const float dx = x[i], dy = x[i + axis], dz = x[i + 2 * axis], spread = x[i + 3 * axis];
                const float h0 = a0 * dx + b0 * dy + c0 * dz;
                const float h1 = a1 * dx + b1 * dy + c1 * dz;
                const float h2 = a2 * dx + b2 * dy + c2 * dz;
                const float margin = spread + 1.0e-6f * (wp::abs(dx) + wp::abs(dy) + wp::abs(dz));
                is_reached[i] =
                    (spread >= 0.0f) & (h0 >= -r0 * spread) & (h1 >= -r1 * spread) & (h2 >= -r2 * spread);
                is_inner[i] = (h0 >= r0 * margin) & (h1 >= r1 * margin) & (h2 >= r2 * margin);
            }
        };
        for (int i = first_row / 8; i <= last_row / 8; ++i) {
            const int begin = wp::max(first_row, 8 * i), end = wp::min(last_row, 8 * i + 7);
            for (int first = first_column / 8; first <= last_column / 8; first += 8) {
                wp::int32 is_reached[8], is_inner[8];
                const size_t at = size_t(i) * columns + first;
                if (first + 8 <= columns) look(is_reached, is_inner, block + at, block_axis, 8);
                else look(is_reached, is_inner, block + at, block_axis, columns - first);
                for (int k = 0; k < 8 && first + k <= last_column / 8; ++k) {
                    if (!is_reached[k]) continue;
                    const int column = 8 * (first + k);
                    if (is_inner[k] & (column + 8 <= width)) {
                        for (int row = begin; row <= end; ++row) fill_eight(flat, Yes(), row, column);
                        continue;
                    }
                    wp::int32 row_is_reached[8], row_is_inner[8];
                    look(row_is_reached, row_is_inner, block_row + 8 * (at + k), 8 * block_axis, 8);
                    for (int row = begin; row <= end; ++row)
                        if (row_is_reached[row & 7]) fill_eight(flat, No(), row, column);
                }
            }
        }
    };
    // a panorama's image may be cut by the seam, and go on in other turns
    const int turns = turn_samples > 0.0f;
    for (int turn = -turns; turn <= turns; ++turn) {
        const int shift = rintf(turn * turn_samples);
        const int first = wp::max(image.first_column + shift - turns, frame[0]);
        const int last = wp::min(image.last_column + shift + turns, frame[2] - 1);
        if (first > last) continue;
        const bool is_large = (last - first + 1) * (last_row - first_row + 1) > large;
        if (is_flat) is_large ? fill_large(Yes(), first, last) : fill_small(Yes(), first, last);
        else is_large ? fill_large(No(), first, last) : fill_small(No(), first, last);
    }
#endif
"""


@wp.func_native(_FILL_TRIANGLE)
def fill_triangle(
    candidate: wp.array2d[Candidate],
    v: int,
    number: int,
    rays: Rays,
    ray_set: int,
    turn_samples: float,
    frame: wp.vec4i,
    large: int,
    least_inverse_depth: float,
    farthest: float,
    has_key: bool,
    rectangle: wp.vec4i,
    offset: int,
    layers: Layers,
    key: wp.array3d[wp.int64],
):
    """Scatter a triangle inside a frame into the key buffer and, where ``offset`` is not negative, into its layer.

    ``turn_samples`` are the columns of a whole turn of a panorama, 0 for other lenses.

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
    image: Candidate,
    camera: View,
    rays: Rays,
    ray_set: int,
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
                                raise_crossing(layers, direction, place, share, nearest, image.triangle)


@wp.func
def least_depth(camera: View, p: wp.vec3, q: wp.vec3, r: wp.vec3) -> float:
    """The least depth of three points in camera coordinates [m]."""
    if camera.lens.kind == BROWN_CONRADY:
        return wp.min(p[2], wp.min(q[2], r[2]))
    return wp.min(wp.length(p), wp.min(wp.length(q), wp.length(r)))


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


@wp.func(inline=False)
def cross_outline(
    image: Candidate,
    p: wp.vec3,
    q: wp.vec3,
    r: wp.vec3,
    camera: View,
    scene: Triangles,
    rays: Rays,
    ray_set: int,
    table: int,
    widest_cosine: float,
    is_front_only: bool,
    rectangle: wp.vec4i,
    offset: int,
    layers: Layers,
):
    """Scatter where a triangle of corners p, q and r ends between samples, if it may be at an outline."""
    neighbour = scene.neighbour[image.triangle]
    is_facing = faces(camera, scene.triangle_plane[image.triangle])
    is_outline0 = may_be_outline(camera, scene, is_facing, neighbour[0])
    is_outline1 = may_be_outline(camera, scene, is_facing, neighbour[1])
    is_outline2 = may_be_outline(camera, scene, is_facing, neighbour[2])
    if is_outline0 or is_outline1 or is_outline2:
        a = corner_of(camera, rays, table, p)
        b = corner_of(camera, rays, table, q)
        c = corner_of(camera, rays, table, r)
        if is_outline0:
            cross_bent_edge(
                camera, rays, ray_set, table, widest_cosine, a, b, image.edge0, image.inverse_depth, rectangle, offset,
                layers,
            )  # fmt: skip
        if is_outline1:
            cross_bent_edge(
                camera, rays, ray_set, table, widest_cosine, b, c, image.edge1, image.inverse_depth, rectangle, offset,
                layers,
            )  # fmt: skip
        if is_outline2:
            cross_bent_edge(
                camera, rays, ray_set, table, widest_cosine, c, a, image.edge2, image.inverse_depth, rectangle, offset,
                layers,
            )  # fmt: skip
    if not is_front_only and least_depth(camera, p, q, r) < camera.near_m:
        cross_near_cut(image, camera, rays, ray_set, rectangle, offset, layers)


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
    candidate: wp.array2d[Candidate],
    key: wp.array3d[wp.int64],
    layers: Layers,
):
    """Scatter every triangle into the key buffer and, where its object has one below ``layer_count``, into its layer.

    As `rasterise.scatter_triangles_kernel`, for the views whose lenses are no pinholes.

    Launch: ``dim=(such views of this chunk, cluster_count)``; one thread per cluster of a view. Not taped.
    Writes: ``key`` and ``layers``, which the caller zeroes; ``candidate`` [view, triangle of a cluster], which nobody else
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
    turn_samples = float(0.0)
    if camera.lens.kind == PANORAMA:
        turn_samples = 2.0 * wp.pi * camera.focal[0]
    count = find_candidates(
        camera, scene, cluster, frame, rays, table, widest_cosine, is_front_only, behind_m(camera), has_outline,
        BROWN_CONRADY, PANORAMA, LEAST_DISTANCE_M, LEAST_VOLUME, WIDE, STEEP, TABLE_ERROR, WHOLE, v, candidate,
    )  # fmt: skip
    for k in range(count):
        triangle = candidate[v, k].triangle
        of_triangle = scene.triangle[triangle]
        if candidate[v, k].is_wide == 1 or has_outline:
            p = point_in_camera(camera, scene.vertex_world_m[of_triangle[0]])
            q = point_in_camera(camera, scene.vertex_world_m[of_triangle[1]])
            r = point_in_camera(camera, scene.vertex_world_m[of_triangle[2]])
            found = candidate[v, k]
            if found.is_wide == 1:
                candidate[v, k] = bound_wide(camera, found, p, q, r, frame)
            if has_outline:
                cross_outline(
                    found, p, q, r, camera, scene, rays, ray_set, table, widest_cosine, is_front_only, rectangle,
                    offset, layers,
                )  # fmt: skip
        fill_triangle(
            candidate, v, k, rays, ray_set, turn_samples, frame, LARGE_SAMPLES,
            LEAST_INVERSE_DEPTH, 1.0 / camera.near_m, has_key == 1, rectangle, offset, layers, key,
        )  # fmt: skip
