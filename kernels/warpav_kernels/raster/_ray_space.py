"""Decide, for lenses that are no pinholes: the buffers of `rasterise`, by rasterisation in the space of rays.

A straight edge is no straight line in such an image, but the rays through it still lie in a plane through the camera's
centre. So a triangle covers a sample if the sample's ray lies on the inner side of three planes, and the inverse depth
is linear in the ray. Nothing is inverted, cut or divided up: corners may be behind the camera. The rays of all samples
are kept (see `rays`), and blocks of them are passed over whole.
"""

import warp as wp

from warpav_kernels.raster._bent_edges import cross_outline
from warpav_kernels.raster._candidates import Candidate, Question, bound_wide, find_candidates
from warpav_kernels.raster._layers import LEAST_INVERSE_DEPTH, Layers
from warpav_kernels.raster._lens import PANORAMA, SPHERE, cone_bounds
from warpav_kernels.raster._rays import Rays
from warpav_kernels.raster._triangles import Triangles, behind_m, shows_no_back
from warpav_kernels.raster._view import View, point_in_camera

wp.set_module_options({"enable_backward": False})

_BLOCK_SAMPLES = wp.constant(256)  # triangles whose bounds hold more are filled block by block


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
    const int longest = rays.factor.shape[2];
    const float* factor = rays.factor.data + 4 * size_t(longest) * ray_set;
    const float* ray = rays.ray.data + 3 * axis * ray_set;
    wp::int64* keys = key.data + size_t(v) * key.shape[1] * key.shape[2];
    wp::int32* front = layers.inverse_depth_bits.data + offset - rectangle[0];
    struct No { enum { is = 0 }; };
    struct Yes { enum { is = 1 }; };
    struct Sphere { enum { is = 2 }; };

    // samples of a row from a column on; inside a triangle only its depth is asked for
    const auto fill = [&](auto flat, auto inner, int lanes, int row, int first) {
        const float* x = ray + size_t(row) * width + first;
        const float *around = factor + first, level = factor[2 * longest + row], drop = factor[3 * longest + row];
        wp::int32 bits[8];
        for (int i = 0; i < lanes; ++i) {
            const float dx = flat.is == 2 ? around[i] * level : x[i], dy = flat.is == 2 ? drop : x[i + axis];
            const float dz = flat.is == 2 ? around[i + longest] * level : flat.is ? 1.0f : x[i + 2 * axis];
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
        const float* block_row = rays.block_row.data + 56 * block_axis * ray_set;
        const float r0 = 1.0001f * wp::length(image.edge0);
        const float r1 = 1.0001f * wp::length(image.edge1);
        const float r2 = 1.0001f * wp::length(image.edge2);
        const auto bits_of = [](const wp::int32* flags) {
            typedef wp::int32 Flags __attribute__((ext_vector_type(8)));
            typedef bool Bits __attribute__((ext_vector_type(8)));
            Flags all;
            __builtin_memcpy(&all, flags, sizeof(all));
            const Bits bits = __builtin_convertvector(all, Bits);
            unsigned char packed;
            __builtin_memcpy(&packed, &bits, 1);
            return unsigned(packed);
        };
        // of up to eight blocks: which the triangle may reach, and which it covers whole, a bit for each
        struct Seen { unsigned reached, inner; };
        const auto look_at_blocks = [&](const float* x, int count) {
            wp::int32 is_reached[8] = {}, is_inner[8] = {};
            const auto look = [&](int count) {
                for (int i = 0; i < count; ++i) {
                    const float dx = x[i], dy = x[i + block_axis], dz = x[i + 2 * block_axis];
                    const float spread = x[i + 3 * block_axis];
                    const float h0 = a0 * dx + b0 * dy + c0 * dz;
                    const float h1 = a1 * dx + b1 * dy + c1 * dz;
                    const float h2 = a2 * dx + b2 * dy + c2 * dz;
                    const float margin = spread + 1.0e-6f * (wp::abs(dx) + wp::abs(dy) + wp::abs(dz));
                    is_reached[i] =
                        (spread >= 0.0f) & (h0 >= -r0 * spread) & (h1 >= -r1 * spread) & (h2 >= -r2 * spread);
                    is_inner[i] = (h0 >= r0 * margin) & (h1 >= r1 * margin) & (h2 >= r2 * margin);
                }
            };
            if (count >= 8) look(8); else look(count);
            return Seen{bits_of(is_reached), bits_of(is_inner)};
        };
        // which of the eight rows of a block it may reach
        const auto look_at_rows = [&](const float* x) {
            wp::int32 is_reached[8];
            const size_t part = 8 * block_axis;
            for (int i = 0; i < 8; ++i) {
                const float x0 = x[i], y0 = x[i + part], z0 = x[i + 2 * part];
                const float x1 = x[i + 3 * part], y1 = x[i + 4 * part], z1 = x[i + 5 * part], bulge = x[i + 6 * part];
                const auto reach = [&](float a, float b, float c, float r) {
                    const float start = a * x0 + b * y0 + c * z0, end = a * x1 + b * y1 + c * z1;
                    return (start > end ? start : end) >= -r * bulge;
                };
                is_reached[i] =
                    (bulge >= 0.0f) & reach(a0, b0, c0, r0) & reach(a1, b1, c1, r1) & reach(a2, b2, c2, r2);
            }
            return bits_of(is_reached);
        };
        for (int i = first_row / 8; i <= last_row / 8; ++i)
            for (int first = first_column / 8; first <= last_column / 8; first += 8) {
                const size_t at = size_t(i) * columns + first;
                const Seen blocks = look_at_blocks(block + at, columns - first);
                const int begin = wp::max(first_row - 8 * i, 0), end = wp::min(last_row - 8 * i, 7);
                const unsigned rows = (2u << end) - (1u << begin);
                unsigned reached = blocks.reached & ((2u << wp::min(last_column / 8 - first, 7)) - 1u);
                for (; reached; reached &= reached - 1u) {
                    const int k = __builtin_ctz(reached), column = 8 * (first + k);
                    // the last eight samples of a row reach into the block before
                    if ((blocks.inner >> k & 1u) & (column + 8 <= width)) {
                        for (int row = begin; row <= end; ++row) fill_eight(flat, Yes(), 8 * i + row, column);
                        continue;
                    }
                    unsigned parts = look_at_rows(block_row + 8 * (at + k)) & rows;
                    for (; parts; parts &= parts - 1u) fill_eight(flat, No(), 8 * i + __builtin_ctz(parts), column);
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
        const auto draw = [&](auto form) { is_large ? fill_large(form, first, last) : fill_small(form, first, last); };
        if (is_flat) draw(Yes());
        else if (is_sphere) draw(Sphere());
        else draw(No());
    }
#endif
"""


@wp.func_native(_FILL_TRIANGLE)
def _fill_triangle(
    candidate: wp.array2d[Candidate],
    v: int,
    number: int,
    rays: Rays,
    ray_set: int,
    turn_samples: float,
    is_sphere: bool,
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


@wp.func(inline=False)
def _misses_scissor(camera: View, centre_m: wp.vec3, radius_m: float, scissor: wp.vec4i) -> bool:
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
    left = camera.centre[0] + camera.focal[0] * place[0]
    right = camera.centre[0] + camera.focal[0] * place[2]
    turn = float(0.0)
    if camera.lens.kind == PANORAMA:
        turn = 2.0 * wp.pi * camera.focal[0]
    for n in range(-1, 2):
        if left + float(n) * turn <= float(scissor[2]) and right + float(n) * turn >= float(scissor[0]):
            return False
    return True


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
    Writes: ``key`` and ``layers``, which the caller zeroes; ``candidate`` [view, triangle of a cluster], which nobody
        else reads. So all clusters of a view must be drawn by one thread, as on a CPU.
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
    if _misses_scissor(camera, centre_m, sphere[3], frame):
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
    turn_samples = float(0.0)
    if camera.lens.kind == PANORAMA:
        turn_samples = 2.0 * wp.pi * camera.focal[0]
    is_sphere = camera.lens.kind == PANORAMA and camera.lens.formula == SPHERE
    asked = Question()
    asked.frame = frame
    asked.table = table
    asked.widest_cosine = widest_cosine
    asked.is_front_only = is_front_only
    asked.behind_m = behind_m(camera)
    asked.has_outline = has_outline
    count = find_candidates(camera, scene, rays, cluster, asked, v, candidate)
    for k in range(count):
        triangle = candidate[v, k].triangle
        of_triangle = scene.triangle[triangle]
        if candidate[v, k].is_wide == 1 or candidate[v, k].is_outline == 1:
            p = point_in_camera(camera, scene.vertex_world_m[of_triangle[0]])
            q = point_in_camera(camera, scene.vertex_world_m[of_triangle[1]])
            r = point_in_camera(camera, scene.vertex_world_m[of_triangle[2]])
            found = candidate[v, k]
            if found.is_wide == 1:
                candidate[v, k] = bound_wide(camera, found, p, q, r, frame)
            if found.is_outline == 1:
                cross_outline(
                    found, p, q, r, camera, scene, rays, table, widest_cosine, is_front_only, rectangle,
                    offset, layers,
                )  # fmt: skip
        _fill_triangle(
            candidate, v, k, rays, ray_set, turn_samples, is_sphere, frame, _BLOCK_SAMPLES,
            LEAST_INVERSE_DEPTH, 1.0 / camera.near_m, has_key == 1, rectangle, offset, layers, key,
        )  # fmt: skip
