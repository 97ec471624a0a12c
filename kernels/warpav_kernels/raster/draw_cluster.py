"""A cluster of triangles behind a pinhole, drawn in one piece by the one thread that a view has on a CPU.

It computes what `front_part`, `image_triangle` and `fill_rows` of `rasterise` compute, to the last bit, so that
triangles drawn here and there leave no hole between them. It is C++, as vertices, triangles and samples lie in one
piece here (Warp's arrays may have any strides): so a compiler uses its vectors.
"""

import warp as wp

from warpav_kernels.raster.layers import Layers
from warpav_kernels.raster.triangles import Triangles
from warpav_kernels.raster.view import View

wp.set_module_options({"enable_backward": False})

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
def draw_cluster(
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
