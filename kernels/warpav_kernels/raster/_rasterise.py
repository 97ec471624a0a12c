"""Decide: which surface is nearest in every sample, and what each object covers when it stands alone.

Two kinds of buffer are filled in one sweep over the triangles:

* the key buffer, int64 [view, row, column]: ``bits(1/z) << 32 | triangle``, filled by atomic maximum, 0 is background.
  Z-buffer, triangle and object of every sample are read from it;
* the layers (see `layers`): 1/z of single objects, and how far each goes on between its samples.

A row of samples meets a triangle in one span, whose ends are solved from the triangle's edges. The samples inside are
covered; the rest of the span, beyond its last sample on either side, ends at the edge
crossing. Columns are swept as well, for the edge crossings alone.
"""

import warp as wp

from warpav_kernels.raster._layers import (
    LEAST_INVERSE_DEPTH,
    NEAR_CUT,
    TO_BOTTOM,
    TO_LEFT,
    TO_RIGHT,
    TO_TOP,
    Layers,
    point_on_near_plane,
)
from warpav_kernels.raster._lens import PINHOLE
from warpav_kernels.raster._triangles import (
    Triangles,
    behind_m,
    faces,
    is_behind,
    may_be_outline,
    shows_no_back,
)
from warpav_kernels.raster._view import View, point_in_camera

wp.set_module_options({"enable_backward": False})

# On a GPU, triangles of more samples than this are cut into strips of rows, which many threads fill together.
_LARGE_SAMPLES = wp.constant(64)
_STRIP_ROWS = wp.constant(8)

LEAST_OFFSET = wp.constant(1.0e-6)  # 0 means unknown


@wp.struct
class _FrontPart:
    """What the near plane leaves of a triangle, in camera coordinates."""

    part_count: int  # triangles of the fan: 0, 1 (a, b, c), or 2 (a, b, c and a, c, d)
    is_whole: bool  # whether nothing was cut off
    a: wp.vec3  # first corner
    b: wp.vec3  # second corner
    c: wp.vec3  # third corner
    d: wp.vec3  # fourth corner of a fan of two


@wp.func
def front_part(camera: View, scene: Triangles, triangle: int) -> _FrontPart:
    """The part of a triangle in front of the near plane."""
    near_m = camera.near_m
    corner = scene.triangle[triangle]
    part = _FrontPart()
    part.a = point_in_camera(camera, scene.vertex_world_m[corner[0]])
    part.b = point_in_camera(camera, scene.vertex_world_m[corner[1]])
    part.c = point_in_camera(camera, scene.vertex_world_m[corner[2]])
    in_front = int(part.a[2] >= near_m) + int(part.b[2] >= near_m) + int(part.c[2] >= near_m)
    part.part_count = 0
    part.is_whole = in_front == 3
    if in_front == 3:
        part.part_count = 1
    elif in_front == 1:
        # turn the triangle so that p is the corner in front
        p = part.a
        q = part.b
        r = part.c
        if part.b[2] >= near_m:
            p = part.b
            q = part.c
            r = part.a
        elif part.c[2] >= near_m:
            p = part.c
            q = part.a
            r = part.b
        part.part_count = 1
        part.a = p
        part.b = point_on_near_plane(p, q, near_m)
        part.c = point_on_near_plane(p, r, near_m)
    elif in_front == 2:
        # turn the triangle so that r is the corner behind
        p = part.a
        q = part.b
        r = part.c
        if part.a[2] < near_m:
            p = part.b
            q = part.c
            r = part.a
        elif part.b[2] < near_m:
            p = part.c
            q = part.a
            r = part.b
        part.part_count = 2
        part.a = p
        part.b = q
        part.c = point_on_near_plane(q, r, near_m)
        part.d = point_on_near_plane(p, r, near_m)
    return part


@wp.struct
class _Edge:
    """A side of a triangle in the sample grid: inside is ``a (x - u) + b (y - v) >= 0``."""

    u: float  # column of a point on it
    v: float  # row of that point
    a: float  # growth of the inequality along a row
    b: float  # growth of the inequality along a column


@wp.func
def _edge_from(u: float, v: float, next_u: float, next_v: float, side: float) -> _Edge:
    """The edge from one corner to the next; ``side`` is the sign of the triangle's area.

    It starts at its upper end, whichever way it runs: so two triangles that share it meet every row at the same place,
    to the last bit, and leave no hole.
    """
    edge = _Edge()
    edge.u = u
    edge.v = v
    if next_v < v or (next_v == v and next_u < u):
        edge.u = next_u
        edge.v = next_v
    edge.a = (v - next_v) * side
    edge.b = (next_u - u) * side
    return edge


@wp.func
def slope_of(along: float, across: float) -> float:
    """By how much the crossing of an edge moves back along a line from one line to the next; 0 if it never crosses."""
    if along == 0.0:
        return 0.0
    return across / along


@wp.func
def line_after(place: float, first: int, end: int) -> int:
    """The first row or column from ``first`` to ``end`` whose centre lies at or after a place in the grid."""
    # clamp in float: the cast of a huge float to an integer is undefined; a positive float's cast rounds down
    return int(wp.clamp(place, float(first), float(end)) + 0.5)


@wp.struct
class ImageTriangle:
    """A triangle in the sample grid."""

    a: wp.vec3  # first corner: column, row and inverse depth [1/m]
    b: wp.vec3  # second corner
    c: wp.vec3  # third corner
    side: float  # sign of its area; 0 where it is too thin to have a plane
    edge0: _Edge  # first side
    edge1: _Edge  # second side
    edge2: _Edge  # third side
    w: float  # inverse depth at the first corner [1/m]; it is linear in the image
    w_per_column: float  # its growth along a row
    w_per_row: float  # its growth along a column
    first_column: int  # first column whose centre lies between the leftmost and the rightmost corner
    last_column: int  # last such column; below the first where there is none
    first_row: int  # first row whose centre lies between the highest and the lowest corner
    last_row: int  # last such row; below the first where there is none


@wp.func
def image_triangle(camera: View, part: _FrontPart, index: int, has_outline: bool, scissor: wp.vec4i) -> ImageTriangle:
    """The image of one triangle of a fan in front of the near plane, its rows and columns cut to a scissor.

    Where it holds no sample's centre, its sides are left out (0), unless ``has_outline`` and it crosses a row or a
    column.
    """
    b = part.b
    c = part.c
    if index == 1:
        b = part.c
        c = part.d
    w0 = 1.0 / part.a[2]
    w1 = 1.0 / b[2]
    w2 = 1.0 / c[2]
    u0 = camera.centre[0] + camera.focal[0] * part.a[0] * w0
    v0 = camera.centre[1] + camera.focal[1] * part.a[1] * w0
    u1 = camera.centre[0] + camera.focal[0] * b[0] * w1
    v1 = camera.centre[1] + camera.focal[1] * b[1] * w1
    u2 = camera.centre[0] + camera.focal[0] * c[0] * w2
    v2 = camera.centre[1] + camera.focal[1] * c[1] * w2
    image = ImageTriangle()
    image.first_column = line_after(wp.min(u0, wp.min(u1, u2)), scissor[0], scissor[2])
    image.last_column = line_after(wp.max(u0, wp.max(u1, u2)), scissor[0], scissor[2]) - 1
    image.first_row = line_after(wp.min(v0, wp.min(v1, v2)), scissor[1], scissor[3])
    image.last_row = line_after(wp.max(v0, wp.max(v1, v2)), scissor[1], scissor[3]) - 1
    if image.first_column > image.last_column and (image.first_row > image.last_row or not has_outline):
        return image
    if image.first_row > image.last_row and not has_outline:
        return image
    doubled_area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
    if wp.abs(doubled_area) < 1.0e-12:
        return image
    image.w = w0
    image.a = wp.vec3(u0, v0, w0)
    image.b = wp.vec3(u1, v1, w1)
    image.c = wp.vec3(u2, v2, w2)
    image.w_per_column = ((w1 - w0) * (v2 - v0) - (w2 - w0) * (v1 - v0)) / doubled_area
    image.w_per_row = ((w2 - w0) * (u1 - u0) - (w1 - w0) * (u2 - u0)) / doubled_area
    image.side = wp.sign(doubled_area)
    image.edge0 = _edge_from(u0, v0, u1, v1, image.side)
    image.edge1 = _edge_from(u1, v1, u2, v2, image.side)
    image.edge2 = _edge_from(u2, v2, u0, v0, image.side)
    return image


@wp.func
def narrowed(span: wp.vec2, start: float, along: float, across: float, slope: float, beyond: float) -> wp.vec2:
    """A span of a line, cut by one edge that meets the line's neighbour ``beyond`` lines back at ``start``.

    A span that an edge shuts out becomes empty: its end lies before its start.
    """
    if along > 0.0:
        return wp.vec2(wp.max(span[0], start - slope * beyond), span[1])
    if along < 0.0:
        return wp.vec2(span[0], wp.min(span[1], start - slope * beyond))
    if across * beyond < 0.0:
        return wp.vec2(1.0, -1.0)
    return span


@wp.func
def _raise_bits(bits: wp.array[wp.int32], place: int, value: wp.int32):
    """Raise an element to a value, without an atomic operation where it is as high already."""
    if bits[place] < value:
        wp.atomic_max(bits, place, value)


@wp.func
def raise_crossing(layers: Layers, direction: int, place: int, offset: float, inverse_depth: float, cut_triangle: int):
    """Raise a sample's edge crossing in one direction.

    ``inverse_depth`` is the surface's where it ends; ``cut_triangle`` the triangle that the near plane ends there, or
    -1.
    """
    far = wp.int64(wp.cast(wp.clamp(offset, LEAST_OFFSET, 1.0), wp.int32))
    end = wp.int64(wp.cast(wp.max(inverse_depth, LEAST_INVERSE_DEPTH), wp.int32))
    if cut_triangle >= 0:
        end = NEAR_CUT | wp.int64(cut_triangle)
    value = (far << wp.int64(32)) | end
    if layers.crossing_key[direction, place] < value:
        wp.atomic_max(layers.crossing_key, direction, place, value)


@wp.func
def _fill_rows(
    image: ImageTriangle,
    first_row: int,
    last_row: int,
    lane: int,
    lane_count: int,
    v: int,
    triangle: int,
    has_key: bool,
    rectangle: wp.vec4i,
    offset: int,
    layers: Layers,
    scissor: wp.vec4i,
    key: wp.array3d[wp.int64],
):
    """Scatter some rows of a triangle into the key buffer and, where ``offset`` is not negative, into its layer.

    Lane k of n takes the samples k, k + n, ... of each row.
    """
    slope0 = slope_of(image.edge0.a, image.edge0.b)
    slope1 = slope_of(image.edge1.a, image.edge1.b)
    slope2 = slope_of(image.edge2.a, image.edge2.b)
    for row in range(first_row, last_row + 1):
        y = float(row) + 0.5
        span = wp.vec2(float(scissor[0]), float(scissor[2]))
        span = narrowed(span, image.edge0.u, image.edge0.a, image.edge0.b, slope0, y - image.edge0.v)
        span = narrowed(span, image.edge1.u, image.edge1.a, image.edge1.b, slope1, y - image.edge1.v)
        span = narrowed(span, image.edge2.u, image.edge2.a, image.edge2.b, slope2, y - image.edge2.v)
        if span[0] <= span[1]:
            first = int(span[0] + 0.5)
            last = int(span[1] + 0.5) - 1
            # the place of column 0 of this row in the layer
            layer_row = offset + (row - rectangle[1]) * rectangle[2] - rectangle[0]
            for column in range(first + lane, last + 1, lane_count):
                w = image.w + image.w_per_column * (float(column) + 0.5 - image.a[0])
                w = wp.max(w + image.w_per_row * (y - image.a[1]), LEAST_INVERSE_DEPTH)
                bits = wp.cast(w, wp.int32)
                if has_key:
                    value = (wp.int64(bits) << wp.int64(32)) | wp.int64(triangle)
                    if key[v, row, column] < value:
                        wp.atomic_max(key, v, row, column, value)
                if offset >= 0:
                    _raise_bits(layers.inverse_depth_bits, layer_row + column, bits)


@wp.func
def _cross_edge(
    start: wp.vec3, end: wp.vec3, side: float, cut_triangle: int, rectangle: wp.vec4i, offset: int, layers: Layers
):
    """Scatter where one side of a triangle crosses the lines from the samples next to it to their neighbours.

    ``start`` and ``end`` are (column, row, 1/z) of the side's corners; ``side`` is the sign of the triangle's area.
    Where the near plane has made the side, ``cut_triangle`` is the triangle, else -1.
    """
    along = end - start
    bottom = rectangle[1] + rectangle[3]
    right = rectangle[0] + rectangle[2]
    first_row = line_after(start[1], rectangle[1], bottom)
    last_row = line_after(end[1], rectangle[1], bottom)
    if first_row != last_row:
        for row in range(wp.min(first_row, last_row), wp.max(first_row, last_row)):
            share = (float(row) + 0.5 - start[1]) / along[1]
            x = start[0] + share * along[0]
            column = line_after(x, rectangle[0], right)
            direction = TO_LEFT
            distance = float(column) + 0.5 - x
            if along[1] * side > 0.0:  # the triangle lies to the left
                column -= 1
                direction = TO_RIGHT
                distance = 1.0 - distance
            if column >= rectangle[0] and column < right and distance <= 1.0:
                place = offset + (row - rectangle[1]) * rectangle[2] + column - rectangle[0]
                raise_crossing(layers, direction, place, distance, start[2] + share * along[2], cut_triangle)
    first_column = line_after(start[0], rectangle[0], right)
    last_column = line_after(end[0], rectangle[0], right)
    if first_column != last_column:
        for column in range(wp.min(first_column, last_column), wp.max(first_column, last_column)):
            share = (float(column) + 0.5 - start[0]) / along[0]
            y = start[1] + share * along[1]
            row = line_after(y, rectangle[1], bottom)
            direction = TO_TOP
            distance = float(row) + 0.5 - y
            if along[0] * side < 0.0:  # the triangle lies above
                row -= 1
                direction = TO_BOTTOM
                distance = 1.0 - distance
            if row >= rectangle[1] and row < bottom and distance <= 1.0:
                place = offset + (row - rectangle[1]) * rectangle[2] + column - rectangle[0]
                raise_crossing(layers, direction, place, distance, start[2] + share * along[2], cut_triangle)


@wp.func
def _is_outside(centre_m: wp.vec3, radius_m: float, view: View, scissor: wp.vec4i) -> bool:
    """Whether a sphere (camera coordinates) misses the pyramid of a view's scissor."""
    if centre_m[2] + radius_m < view.near_m:
        return True
    # distance to each side of the pyramid, which goes through the camera's centre
    left = (view.centre[0] - float(scissor[0])) / view.focal[0]
    right = (float(scissor[2]) - view.centre[0]) / view.focal[0]
    top = (view.centre[1] - float(scissor[1])) / view.focal[1]
    bottom = (float(scissor[3]) - view.centre[1]) / view.focal[1]
    if -centre_m[0] - left * centre_m[2] > radius_m * wp.sqrt(1.0 + left * left):
        return True
    if centre_m[0] - right * centre_m[2] > radius_m * wp.sqrt(1.0 + right * right):
        return True
    if -centre_m[1] - top * centre_m[2] > radius_m * wp.sqrt(1.0 + top * top):
        return True
    return centre_m[1] - bottom * centre_m[2] > radius_m * wp.sqrt(1.0 + bottom * bottom)


@wp.kernel(enable_backward=False)
def clear_keys_kernel(
    # in
    scissor: wp.array[wp.vec4i],
    first_view: int,
    lane_count: int,
    # out
    key: wp.array3d[wp.int64],
):
    """Empty the key buffer inside the views' scissors.

    Launch: ``dim=(views of this chunk, lane_count)``; the lanes share the columns of a view. Not taped.
    Writes: the keys of these views inside their scissors once.
    """
    chunk_view, lane = wp.tid()
    v = first_view + chunk_view
    frame = scissor[v]
    for row in range(frame[1], frame[3]):
        for column in range(frame[0] + lane, frame[2], lane_count):
            key[v, row, column] = wp.int64(0)


# What `front_part`, `image_triangle` and `_fill_rows` compute, to the last bit, so that triangles drawn here and there
# leave no hole between them. It is C++, as vertices, triangles and samples lie in one piece here (Warp arrays may
# have any strides): so a compiler uses its vectors.
_DRAW_CLUSTER = """
#ifdef __CUDACC__
    return 0;  // a GPU has a thread for every few triangles
#else
    #pragma clang fp contract(off)
    const auto least = [](float p, float q) { return p < q ? p : q; };
    const auto most = [](float p, float q) { return p > q ? p : q; };

    // vertices in the sample grid, with their inverse depth; three for each of 64 triangles at most
    const wp::vec2i vertices = scene.cluster_vertices.data[cluster];
    const wp::vec3* vertex = scene.vertex_world_m.data + vertices[0];
    const wp::vec3 place = camera.position_world_m;
    const wp::mat33 r = camera.camera_from_world;
    float u[192], v[192], w[192], depth[192];
    for (int i = 0; i < vertices[1]; ++i) {
        const float x = vertex[i][0] - place[0], y = vertex[i][1] - place[1], z = vertex[i][2] - place[2];
        depth[i] = r.data[2][0] * x + r.data[2][1] * y + r.data[2][2] * z;
        w[i] = 1.0f / depth[i];
        u[i] = camera.centre[0] + camera.focal[0] * (r.data[0][0] * x + r.data[0][1] * y + r.data[0][2] * z) * w[i];
        v[i] = camera.centre[1] + camera.focal[1] * (r.data[1][0] * x + r.data[1][1] * y + r.data[1][2] * z) * w[i];
    }

    // triangles that hold a sample's centre, and those that are left to the caller
    const int first_triangle = scene.cluster_first.data[cluster], count = scene.cluster_count.data[cluster];
    const wp::vec3i* corner = scene.triangle.data + first_triangle;
    const wp::vec3i* neighbour = scene.neighbour.data + first_triangle;
    const wp::vec4* plane = scene.triangle_plane.data;
    const auto height_above = [&](int t) {
        return plane[t][0] * place[0] + plane[t][1] * place[1] + plane[t][2] * place[2] - plane[t][3];
    };
    const float frame_left = frame[0], frame_top = frame[1], frame_right = frame[2], frame_bottom = frame[3];
    wp::int32 chosen[64];
    int chosen_count = 0, left_count = 0;
    int* left_over = left.data + view * left.shape[1];
    #pragma clang loop vectorize(disable)
    for (int k = 0; k < count; ++k) {
        const int a = corner[k][0] - vertices[0], b = corner[k][1] - vertices[0], c = corner[k][2] - vertices[0];
        const float low_u = most(least(u[a], least(u[b], u[c])), frame_left);
        const float high_u = least(most(u[a], most(u[b], u[c])), frame_right);
        const float low_v = most(least(v[a], least(v[b], v[c])), frame_top);
        const float high_v = least(most(v[a], most(v[b], v[c])), frame_bottom);
        const int has_column = wp::int32(high_u + 0.5f) > wp::int32(low_u + 0.5f);
        const int has_row = wp::int32(high_v + 0.5f) > wp::int32(low_v + 0.5f);
        const float height = height_above(first_triangle + k);
        const int is_hidden = is_front_only & (height < -behind_m);
        const int is_cut = least(depth[a], least(depth[b], depth[c])) < camera.near_m;
        chosen[chosen_count] = k;
        chosen_count += has_column & has_row & (is_hidden ^ 1) & (is_cut ^ 1);
        int is_left = is_cut & (is_hidden ^ 1);
        left_over[left_count] = 2 * k + is_left;
        if (has_outline & (has_column | has_row) & (is_hidden ^ 1) & (is_cut ^ 1))
            for (int e = 0; e < 3; ++e) {
                const int other = neighbour[k][e];
                is_left |= other < 0 || (height_above(other) > 0.0f) != (height > 0.0f);
            }
        left_count += is_left;
    }

    const int width = key.shape[2];
    wp::int64* view_keys = key.data + size_t(view) * key.shape[1] * width;
    for (int j = 0; j < chosen_count; ++j) {
        const int k = chosen[j], triangle = first_triangle + k;
        const int at[4] = {
            corner[k][0] - vertices[0], corner[k][1] - vertices[0],
            corner[k][2] - vertices[0], corner[k][0] - vertices[0]};
        const float u0 = u[at[0]], u1 = u[at[1]], u2 = u[at[2]];
        const float v0 = v[at[0]], v1 = v[at[1]], v2 = v[at[2]];
        const float w0 = w[at[0]], w1 = w[at[1]], w2 = w[at[2]];
        const float doubled_area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0);
        if (wp::abs(doubled_area) < 1.0e-12f) continue;
        const float w_per_column = ((w1 - w0) * (v2 - v0) - (w2 - w0) * (v1 - v0)) / doubled_area;
        const float w_per_row = ((w2 - w0) * (u1 - u0) - (w1 - w0) * (u2 - u0)) / doubled_area;
        int row = wp::int32(most(least(v0, least(v1, v2)), frame_top) + 0.5f);
        int last_row = wp::int32(least(most(v0, most(v1, v2)), frame_bottom) + 0.5f) - 1;

        // a side ends the rows' spans at their left or at their right; the other way it is the frame's
        const float side = doubled_area > 0.0f ? 1.0f : -1.0f;
        float left_u[3], left_slope[3], right_u[3], right_slope[3], upper_v[3];
        for (int e = 0; e < 3; ++e) {
            const float from_u = u[at[e]], from_v = v[at[e]], to_u = u[at[e + 1]], to_v = v[at[e + 1]];
            const bool is_turned = (to_v < from_v) | ((to_v == from_v) & (to_u < from_u));
            const float upper_u = is_turned ? to_u : from_u;
            upper_v[e] = is_turned ? to_v : from_v;
            const float along = (from_v - to_v) * side, across = (to_u - from_u) * side;
            const float slope = across / along;
            left_u[e] = along > 0.0f ? upper_u : frame_left;
            left_slope[e] = along > 0.0f ? slope : 0.0f;
            right_u[e] = along < 0.0f ? upper_u : frame_right;
            right_slope[e] = along < 0.0f ? slope : 0.0f;
            if (along == 0.0f) {
                row += (across > 0.0f) & (row + 0.5f < upper_v[e]);
                last_row -= (across < 0.0f) & (last_row + 0.5f > upper_v[e]);
            }
        }

        for (; row <= last_row; ++row) {
            const float y = row + 0.5f;
            float begin = frame_left, end = frame_right;
            for (int e = 0; e < 3; ++e) {
                begin = most(begin, left_u[e] - left_slope[e] * (y - upper_v[e]));
                end = least(end, right_u[e] - right_slope[e] * (y - upper_v[e]));
            }
            if (!(begin <= end)) continue;
            const int last = wp::int32(end + 0.5f) - 1;
            wp::int64* row_keys = view_keys + size_t(row) * width;
            wp::int32* row_front =
                layers.inverse_depth_bits.data + offset + (row - rectangle[1]) * rectangle[2] - rectangle[0];
            // eight samples at once; 0 raises nothing
            for (int first = wp::int32(begin + 0.5f); first <= last; first += 8) {
                wp::int32 bits[8];
                for (int i = 0; i < 8; ++i) {
                    union { float number; wp::int32 bits; } here;
                    here.number = w0 + w_per_column * (first + i + 0.5f - u0);
                    here.number = most(here.number + w_per_row * (y - v0), least_inverse_depth);
                    bits[i] = first + i <= last ? here.bits : 0;
                }
                const auto raise = [&](int lanes) {
                    for (int i = 0; i < lanes; ++i) {
                        const wp::int64 value = wp::int64(bits[i]) << 32 | (bits[i] ? triangle : 0);
                        row_keys[first + i] = wp::max(row_keys[first + i], value);
                    }
                };
                if (has_key & (width - first >= 8)) raise(8); else if (has_key) raise(width - first);
                if (offset >= 0)
                    for (int i = first; i <= wp::min(last, first + 7); ++i)
                        row_front[i] = wp::max(row_front[i], bits[i - first]);
            }
        }
    }
    return left_count;
#endif
"""


@wp.func_native(_DRAW_CLUSTER)
def _draw_cluster(
    camera: View,
    scene: Triangles,
    cluster: int,
    frame: wp.vec4i,
    is_front_only: bool,
    behind_m: float,
    has_outline: bool,
    least_inverse_depth: float,
    view: int,
    has_key: bool,
    rectangle: wp.vec4i,
    offset: int,
    left: wp.array2d[wp.int32],
    key: wp.array3d[wp.int64],
    layers: Layers,
) -> int:
    """Scatter a cluster's triangles inside a frame of the grid; on a GPU, nothing.

    With ``is_front_only``, those whose back is seen from more than ``behind_m`` are left out. What the caller has to
    do is returned, and written to a row of ``left``: the triangles that the near plane cuts are not drawn yet (2 k + 1
    for triangle k of the cluster), and those with a side that may be an outline, where ``has_outline``, are (2 k).

    Writes: ``left`` [view, triangle of a cluster]; ``key`` and ``layers`` without atomic operations.
    """
    ...


# Registers for four blocks on a multiprocessor: with all that a compiler would take, half as many threads run.
@wp.kernel(enable_backward=False, launch_bounds=(256, 4))
def scatter_triangles_kernel(
    # in
    view: wp.array[View],
    scene: Triangles,
    layer_count: int,
    scissor: wp.array[wp.vec4i],
    first_view: int,
    has_key: int,
    has_outlines: int,
    lane_count: int,
    # out
    left: wp.array2d[wp.int32],
    key: wp.array3d[wp.int64],
    layers: Layers,
    strip: wp.array[wp.vec4i],
    strip_count: wp.array[wp.int32],
):
    """Scatter every triangle into the key buffer and, where its object has one below ``layer_count``, into its layer.

    Views whose lens is no pinhole are left to `ray_space` and `trace`. A cluster whose bounding sphere misses the
    view's ``scissor`` (first column, first row, and those after the last) is skipped whole, and so are backs that
    fronts hide; a triangle that crosses the near plane is cut to one or two. Without a key buffer (``has_key`` 0)
    clusters without a layer are left out; with ``has_outlines`` 0 layers get no edge crossings. Large triangles go to
    the queue ``strip`` instead, as (view, triangle, part of the fan, first row), as long as it has room; a queue of
    length 0 is for devices where one thread fills them as well as many.

    Launch: ``dim=(views of this chunk, cluster_count, lane_count)``; thread (view - first_view, cluster, lane) fills
    the cluster's triangles lane, lane + lane_count, ... Not taped.
    Writes: ``key`` and ``layers`` by atomic maximum, ``strip_count[0]`` by atomic add; the caller zeroes them; ``left``
        [view, triangle of a cluster], which nobody else reads. Where it is not empty one thread draws a view, without
        atomic operations, most of it in `_draw_cluster`.
    """
    chunk_view, cluster, lane = wp.tid()
    v = first_view + chunk_view
    layer = scene.cluster_layer[cluster]
    if layer >= layer_count:
        layer = -1
    if has_key == 0 and layer < 0:
        return
    camera = view[v]
    frame = scissor[v]
    if camera.lens.kind != PINHOLE or frame[0] >= frame[2]:
        return
    sphere = scene.cluster_sphere_world_m[cluster]
    centre_m = point_in_camera(camera, wp.vec3(sphere[0], sphere[1], sphere[2]))
    if _is_outside(centre_m, sphere[3], camera, frame):
        return
    rectangle = wp.vec4i(0, 0, 0, 0)
    offset = int(-1)
    if layer >= 0:
        rectangle = layers.rectangle[v, layer]
        offset = layers.offset[v, layer]
        if rectangle[2] == 0:
            offset = -1
    has_outline = offset >= 0 and has_outlines == 1
    is_front_only = shows_no_back(camera, scene, cluster, frame)
    first = scene.cluster_first[cluster]
    count = scene.cluster_count[cluster]
    is_drawn = left.shape[0] > 0
    if is_drawn:
        count = _draw_cluster(
            camera,
            scene,
            cluster,
            frame,
            is_front_only,
            behind_m(camera),
            has_outline,
            LEAST_INVERSE_DEPTH,
            v,
            has_key == 1,
            rectangle,
            offset,
            left,
            key,
            layers,
        )
    for k in range(lane, count, lane_count):
        triangle = first + k
        is_cut = False
        if is_drawn:
            triangle = first + left[v, k] / 2
            is_cut = left[v, k] % 2 == 1
        elif is_front_only and is_behind(camera, scene.triangle_plane[triangle]):
            continue
        part = front_part(camera, scene, triangle)
        for index in range(part.part_count):
            image = image_triangle(camera, part, index, has_outline, frame)
            if has_outline and image.side != 0.0:
                # the near plane makes new sides
                neighbour = wp.vec3i(-1, -1, -1)
                is_facing = False
                if part.is_whole:
                    neighbour = scene.neighbour[triangle]
                    is_facing = faces(camera, scene.triangle_plane[triangle])
                if may_be_outline(camera, scene, is_facing, neighbour[0]):
                    _cross_edge(image.a, image.b, image.side, -1, rectangle, offset, layers)
                if may_be_outline(camera, scene, is_facing, neighbour[1]):
                    # the last triangle of a fan has the side that the near plane made
                    cut_triangle = int(-1)
                    if not part.is_whole and index == part.part_count - 1:
                        cut_triangle = triangle
                    _cross_edge(image.b, image.c, image.side, cut_triangle, rectangle, offset, layers)
                if may_be_outline(camera, scene, is_facing, neighbour[2]):
                    _cross_edge(image.c, image.a, image.side, -1, rectangle, offset, layers)
            rows = image.last_row - image.first_row + 1
            columns = image.last_column - image.first_column + 1
            if (is_cut or not is_drawn) and image.side != 0.0 and rows > 0 and columns > 0:
                room = int(-1)
                if strip.shape[0] > 0 and rows * columns > _LARGE_SAMPLES:
                    strips = (rows + _STRIP_ROWS - 1) / _STRIP_ROWS
                    room = wp.atomic_add(strip_count, 0, strips)
                    for s in range(strips):
                        if room + s < strip.shape[0]:
                            strip[room + s] = wp.vec4i(v, triangle, index, image.first_row + s * _STRIP_ROWS)
                    if room + strips > strip.shape[0]:
                        room = -1
                if room < 0:
                    _fill_rows(
                        image,
                        image.first_row,
                        image.last_row,
                        0,
                        1,
                        v,
                        triangle,
                        has_key == 1,
                        rectangle,
                        offset,
                        layers,
                        frame,
                        key,
                    )


@wp.kernel(enable_backward=False)
def fill_strips_kernel(
    # in
    view: wp.array[View],
    scene: Triangles,
    layer_count: int,
    scissor: wp.array[wp.vec4i],
    has_key: int,
    strip: wp.array[wp.vec4i],
    strip_count: wp.array[wp.int32],
    group_count: int,
    lane_count: int,
    # out
    key: wp.array3d[wp.int64],
    layers: Layers,
):
    """Fill the strips of rows of large triangles that `scatter_triangles_kernel` has queued.

    Launch: ``dim=(group_count, lane_count)``; group g takes the strips g, g + group_count, ..., its lanes share the
    samples of a row. Not taped.
    Writes: ``key`` and ``layers`` by atomic maximum.
    """
    group, lane = wp.tid()
    for s in range(group, wp.min(strip_count[0], strip.shape[0]), group_count):
        entry = strip[s]
        v = entry[0]
        camera = view[v]
        frame = scissor[v]
        triangle = entry[1]
        layer = scene.body_layer[scene.triangle_body[triangle]]
        rectangle = wp.vec4i(0, 0, 0, 0)
        offset = int(-1)
        if layer >= 0 and layer < layer_count:
            rectangle = layers.rectangle[v, layer]
            offset = layers.offset[v, layer]
            if rectangle[2] == 0:
                offset = -1
        image = image_triangle(camera, front_part(camera, scene, triangle), entry[2], False, frame)
        last_row = wp.min(image.last_row, entry[3] + _STRIP_ROWS - 1)
        _fill_rows(
            image,
            entry[3],
            last_row,
            lane,
            lane_count,
            v,
            triangle,
            has_key == 1,
            rectangle,
            offset,
            layers,
            frame,
            key,
        )
