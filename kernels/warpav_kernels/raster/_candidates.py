"""Which triangles of a cluster a view with a bent lens may see, and where: planes and bounds in the space of rays.

Where a triangle's image may be is bounded by the images of its corners, and by how much the lens bends what lies
between. It is C++, as vertices and triangles lie in one piece here (Warp's arrays may have any strides): so a compiler
uses its vectors.
"""

import warp as wp

from warpav_kernels.raster._lens import BROWN_CONRADY, PANORAMA, SPHERE, cone_bounds
from warpav_kernels.raster._rasterise import line_after
from warpav_kernels.raster._rays import Rays
from warpav_kernels.raster._triangles import Triangles
from warpav_kernels.raster._view import View

wp.set_module_options({"enable_backward": False})

WIDE = wp.constant(0.25)  # chord of two directions; triangles that reach farther are bounded by a cone
STEEP = wp.constant(0.95)  # sine of the elevation from which a panorama's triangles are bounded by a cone
TABLE_ERROR = wp.constant(1.0e-4)  # of a place in the table [focal lengths]
LEAST_VOLUME = wp.constant(1.0e-12)  # of three directions: a triangle that is seen from its side
LEAST_DISTANCE_M = wp.constant(1.0e-9)  # of a corner that has a direction
WHOLE = wp.constant(1.0e9)  # beyond any image [focal lengths]


@wp.struct
class Candidate:
    """A triangle that a view with a bent lens may see, in the space of rays.

    A ray d meets it where no product with an edge's normal is negative.
    """

    edge0: wp.vec3  # normal of the plane through the camera's centre and its first edge [m^2]
    edge1: wp.vec3  # that of the second
    edge2: wp.vec3  # that of the third
    inverse_depth: wp.vec3  # its product with a ray of depth 1 is the inverse depth [1/m]
    first_column: int  # first column of samples that it may cover; of one of its turns for a panorama
    last_column: int  # last such column; below the first where there is none
    first_row: int  # first such row
    last_row: int  # last such row; below the first where there is none
    triangle: int  # its number in the scene
    is_wide: int  # whether it reaches so far that a cone has to bound its image, which is not done yet
    is_outline: int  # whether an outline may run along one of its sides or along the near cut, where that is asked for


@wp.struct
class Question:
    """What of a cluster is asked for."""

    frame: wp.vec4i  # first column, first row, and those after the last, of the samples
    table: int  # number of the lens's table in `Rays`
    widest_cosine: float  # least cosine of a ray from the optical axis
    is_front_only: bool  # whether backs that are seen from more than ``behind_m`` are left out
    behind_m: float  # see `triangles.behind_m`
    has_outline: bool  # whether triangles may lie between the rows or the columns, for their outlines


_CONSTANTS = {
    "brown_conrady": BROWN_CONRADY,
    "panorama": PANORAMA,
    "sphere": SPHERE,
    "least_distance_m": LEAST_DISTANCE_M,
    "least_volume": LEAST_VOLUME,
    "wide": WIDE,
    "steep": STEEP,
    "table_error": TABLE_ERROR,
    "far_away": WHOLE,
}
"""What the C++ below calls the constants."""

_FIND_CANDIDATES = """
#ifdef __CUDACC__
    return 0;
#else
    $constants
    const wp::vec4i frame = asked.frame;
    const int table = asked.table;
    const float widest_cosine = asked.widest_cosine, behind_m = asked.behind_m;
    const bool is_front_only = asked.is_front_only, has_outline = asked.has_outline;
    const auto least = [](float p, float q) { return p < q ? p : q; };
    const auto most = [](float p, float q) { return p > q ? p : q; };
    const float half_turn = 3.14159265f;
    // within 4e-7, many at once (Abramowitz and Stegun 4.4.49)
    const auto angle_of = [&](float y, float x) {
        const float p = wp::abs(x), q = wp::abs(y), t = least(p, q) / most(most(p, q), 1.0e-30f), s = t * t;
        const float odd = -0.3333314528f + s * (0.1999355085f + s * (-0.1420889944f + s * (0.1065626393f
            + s * (-0.0752896400f + s * (0.0429096138f + s * (-0.0161657367f + s * 0.0028662257f))))));
        const float small = t + t * s * odd, angle = q > p ? 0.5f * half_turn - small : small;
        const float ahead = x < 0.0f ? half_turn - angle : angle;
        return y < 0.0f ? -ahead : ahead;
    };
    const bool is_flat = camera.lens.kind == brown_conrady, is_panorama = camera.lens.kind == panorama;
    const bool is_sphere = camera.lens.formula == sphere;

    // vertices: direction, distance, depth, place in the image and how much great circles bend there
    const wp::vec2i vertices = scene.cluster_vertices.data[cluster];
    const wp::vec3* vertex = scene.vertex_world_m.data + vertices[0];
    const wp::vec3 place = camera.position_world_m;
    const wp::mat33 r = camera.camera_from_world;
    const float limit = camera.lens.limit * camera.lens.limit;
    float px[192], py[192], pz[192], dx[192], dy[192], dz[192], distance[192], depth[192];
    float u[192], v[192], bend[192], secant[192];
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
            u[i] = angle_of(dx[i], dz[i]);
            const float level = sqrtf(dx[i] * dx[i] + dz[i] * dz[i]);
            v[i] = is_sphere ? angle_of(dy[i], level) : dy[i] / most(level, 1.0e-6f);
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
    const wp::vec3i* neighbour = scene.neighbour.data + first_triangle;
    const wp::vec4* plane = scene.triangle_plane.data;
    const auto height_above = [&](int t) {
        return plane[t][0] * place[0] + plane[t][1] * place[1] + plane[t][2] * place[2] - plane[t][3];
    };
    const float frame_left = frame[0], frame_top = frame[1], frame_right = frame[2], frame_bottom = frame[3];
    const float low = is_panorama ? -far_away : frame_left, high = is_panorama ? far_away : frame_right;
    const float turn = 2.0f * half_turn * camera.focal[0];
    const float fx = camera.focal[0], fy = camera.focal[1], cx = camera.centre[0], cy = camera.centre[1];
    const float tangential = wp::abs(camera.lens.distortion[2]) + wp::abs(camera.lens.distortion[3]);
    const float sideways = is_flat ? 3.0f * tangential : 0.0f;
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

    // backs that fronts hide are left out first
    wp::int32 is_front[64], front[64];
    for (int k = 0; k < count; ++k) {
        is_front[k] = !is_front_only | (height_above(first_triangle + k) >= -behind_m);
    }
    int front_count = 0;
    for (int k = 0; k < count; ++k) {
        front[front_count] = k;
        front_count += is_front[k];
    }
    // where they may be, without branches, many at once
    wp::int32 first_column[64], last_column[64], first_row[64], last_row[64], is_wide[64], is_seen[64];
    #pragma clang loop vectorize(enable)
    for (int i = 0; i < front_count; ++i) {
        const int k = front[i];
        const int a = corner[k][0] - vertices[0], b = corner[k][1] - vertices[0], c = corner[k][2] - vertices[0];
        const int is_near = (most(depth[a], most(depth[b], depth[c])) < camera.near_m)
            | (least(distance[a], least(distance[b], distance[c])) < least_distance_m);
        const auto squared_chord = [&](int p, int q) {
            const float x = dx[q] - dx[p], y = dy[q] - dy[p], z = dz[q] - dz[p];
            return x * x + y * y + z * z;
        };
        const float chord = most(squared_chord(a, b), most(squared_chord(b, c), squared_chord(c, a)));
        const float most_bend = most(bend[a], most(bend[b], bend[c]));
        is_wide[i] = (chord > wide * wide) | (is_panorama & (most_bend > steep));
        // an arc of length s bends away from its chord by at most an eighth of s^2 times its curvature
        float bulge = 0.14f * chord * most_bend + table_error;
        float u1 = u[b], u2 = u[c];
        if (is_panorama) {
            // of y and x over the level distance; both bend by less than this
            const float level = sqrtf(1.0f - most_bend * most_bend);
            bulge = 0.5f * chord / (level * level * level);
            u1 -= 2.0f * half_turn * rintf((u1 - u[a]) / (2.0f * half_turn));
            u2 -= 2.0f * half_turn * rintf((u2 - u[a]) / (2.0f * half_turn));
        } else if (is_flat) {
            // the table knows the radius alone; what moves sideways is at most this times the squared tangent
            const float widest = most(secant[a], most(secant[b], secant[c]));
            // an arc's slope changes by at most three times its second derivative, and it may pass beyond its ends
            const float within = 0.84f * chord * sideways * widest * (1.0f + limit), beyond = 2.0f * sideways * limit;
            bulge += widest <= 1.0f + limit ? within : beyond;
        }
        float left = least(most(cx + fx * (least(u[a], least(u1, u2)) - bulge), low), high);
        float right = least(most(cx + fx * (most(u[a], most(u1, u2)) + bulge), low), high);
        const float top = least(most(cy + fy * (least(v[a], least(v[b], v[c])) - bulge), frame_top), frame_bottom);
        const float bottom = least(most(cy + fy * (most(v[a], most(v[b], v[c])) + bulge), frame_top), frame_bottom);
        const int is_all_round = is_panorama & (right - left >= turn);
        left = is_all_round ? frame_left : left;
        right = is_all_round ? frame_right : right;
        first_column[i] = floorf(left + 0.5f);
        last_column[i] = wp::int32(floorf(right + 0.5f)) - 1;
        first_row[i] = top + 0.5f;
        last_row[i] = wp::int32(bottom + 0.5f) - 1;
        const int has_column = first_column[i] <= last_column[i], has_row = first_row[i] <= last_row[i];
        const int is_ahead = is_panorama | (most(dz[a], most(dz[b], dz[c])) >= widest_cosine);
        const int is_reached = (has_column & has_row) | (has_outline & (has_column | has_row));
        is_seen[i] = (is_wide[i] | (is_ahead & is_reached)) & (is_near ^ 1);
    }
    wp::int32 chosen[64];
    int chosen_count = 0;
    for (int i = 0; i < front_count; ++i) {
        chosen[chosen_count] = i;
        chosen_count += is_seen[i];
    }

    auto* slot = candidate.data + view * candidate.shape[1];
    int found = 0;
    for (int j = 0; j < chosen_count; ++j) {
        const int i = chosen[j], k = front[i];
        auto& each = slot[found];
        each.first_column = first_column[i];
        each.last_column = last_column[i];
        each.first_row = first_row[i];
        each.last_row = last_row[i];
        each.triangle = first_triangle + k;
        each.is_wide = is_wide[i];
        const int a = corner[k][0] - vertices[0], b = corner[k][1] - vertices[0], c = corner[k][2] - vertices[0];
        each.is_outline = 0;
        if (has_outline) {
            each.is_outline = !is_front_only & (least(depth[a], least(depth[b], depth[c])) < camera.near_m);
            const bool is_facing = height_above(first_triangle + k) > 0.0f;
            for (int e = 0; e < 3; ++e) {
                const int other = neighbour[k][e];
                each.is_outline |= other < 0 || (height_above(other) > 0.0f) != is_facing;
            }
        }
        const bool has_samples = (first_column[i] <= last_column[i]) & (first_row[i] <= last_row[i]);
        if (is_wide[i] | each.is_outline | has_samples) found += set_planes(each, a, b, c);
    }
    return found;
#endif
"""


def _constant(name: str, value: float) -> str:
    return f"const int {name} = {value};" if isinstance(value, int) else f"const float {name} = {value!r};"


@wp.func_native(
    _FIND_CANDIDATES.replace("$constants", "\n    ".join(_constant(name, k) for name, k in _CONSTANTS.items()))
)
def find_candidates(
    camera: View,
    scene: Triangles,
    rays: Rays,
    cluster: int,
    asked: Question,
    view: int,
    candidate: wp.array2d[Candidate],
) -> int:
    """Triangles of a cluster that a view with a bent lens may see inside a frame of the grid: how many; on a GPU, none.

    Writes: ``candidate`` [view, triangle of a cluster].
    """
    ...


@wp.func
def _half_angle_of(axis: wp.vec3, direction: wp.vec3) -> float:
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
    half = wp.max(_half_angle_of(axis, a), wp.max(_half_angle_of(axis, b), _half_angle_of(axis, c)))
    if half >= 0.5 * wp.pi:
        return wp.vec4(-WHOLE, -WHOLE, WHOLE, WHOLE)
    return cone_bounds(camera.lens, axis, half)


@wp.func
def with_bounds(camera: View, candidate: Candidate, place: wp.vec4, frame: wp.vec4i) -> Candidate:
    """A triangle with the rows and columns of its bounds (left, top, right, bottom) in focal lengths."""
    found = candidate
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


@wp.func(inline=False)
def bound_wide(camera: View, candidate: Candidate, p: wp.vec3, q: wp.vec3, r: wp.vec3, frame: wp.vec4i) -> Candidate:
    """A wide triangle with its bounds."""
    place = wide_bounds(camera, wp.normalize(p), wp.normalize(q), wp.normalize(r))
    return with_bounds(camera, candidate, place, frame)
