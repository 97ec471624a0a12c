"""Decide: which surface is nearest in every sample, and what each object covers when it stands alone.

Two kinds of buffer are filled in one sweep over the triangles:

* the key buffer, int64 [view, row, column]: ``bits(1/z) << 32 | triangle``, filled by atomic maximum, 0 is background.
  Z-buffer, triangle and object of every sample are read from it;
* the layers, int32: for every (view, layer) the bits of 1/z of that one object alone, inside its bounding rectangle.
  All rectangles of all views lie one behind the other in one flat array (the atlas); ``layer_offset`` says where.

A layer is an object whose silhouette is wanted alone: every vehicle, and the ego vehicle where the pairwise occlusion
of the thesis needs it.
"""

import warp as wp

from warpav_kernels.view import View, point_in_camera

wp.set_module_options({"enable_backward": False})


@wp.struct
class Triangles:
    """The scene's triangles, sorted by object and by place, in clusters of one object each.

    Attributes:
        vertex_ego_m: Vertex positions in the ego frame [m], [vertex].
        triangle: Vertex indices, [triangle].
        cluster_first: First triangle of each cluster, [cluster].
        cluster_count: Number of triangles of each cluster, [cluster].
        cluster_layer: Layer of each cluster's object; -1 where the object has none, [cluster].
        cluster_sphere_ego_m: Bounding sphere, centre and radius [m], [cluster].
    """

    vertex_ego_m: wp.array[wp.vec3]
    triangle: wp.array[wp.vec3i]
    cluster_first: wp.array[wp.int32]
    cluster_count: wp.array[wp.int32]
    cluster_layer: wp.array[wp.int32]
    cluster_sphere_ego_m: wp.array[wp.vec4]


@wp.func
def point_on_near_plane(a: wp.vec3, b: wp.vec3, near_m: float) -> wp.vec3:
    """Where the edge from a to b (camera coordinates) crosses the near plane."""
    crossing = a + (near_m - a[2]) / (b[2] - a[2]) * (b - a)
    return wp.vec3(crossing[0], crossing[1], near_m)


@wp.func
def grow_rectangle(rectangle: wp.vec4, point_m: wp.vec3, focal_px: float, width: int, height: int) -> wp.vec4:
    """The rectangle (left, top, right, bottom) in samples, grown to hold the image of a point."""
    u = 0.5 * float(width) + focal_px * point_m[0] / point_m[2]
    v = 0.5 * float(height) + focal_px * point_m[1] / point_m[2]
    return wp.vec4(wp.min(rectangle[0], u), wp.min(rectangle[1], v), wp.max(rectangle[2], u), wp.max(rectangle[3], v))


@wp.kernel(enable_backward=False)
def bound_layers_kernel(
    # in
    view: wp.array[View],
    layer_bounds_ego_m: wp.array2d[wp.vec3],
    width: int,
    height: int,
    # out
    layer_rectangle: wp.array2d[wp.vec4i],
):
    """Rectangle of samples that surely holds each layer's image, one sample wider than needed on every side.

    The rectangle is (first column, first row, columns, rows); an object out of sight has 0 columns. The eight corners
    and, where the near plane cuts the object's box, its twelve edges are projected.

    Launch: ``dim=(view_count, layer_count)``; one thread per pair. Not taped.
    Writes: every element of ``layer_rectangle`` once.
    """
    v, layer = wp.tid()
    camera = view[v]
    low = layer_bounds_ego_m[layer, 0]
    high = layer_bounds_ego_m[layer, 1]
    far = 1.0e9
    box = wp.vec4(far, far, -far, -far)
    for corner in range(8):
        a_ego = low
        if (corner & 1) != 0:
            a_ego = wp.vec3(high[0], a_ego[1], a_ego[2])
        if (corner & 2) != 0:
            a_ego = wp.vec3(a_ego[0], high[1], a_ego[2])
        if (corner & 4) != 0:
            a_ego = wp.vec3(a_ego[0], a_ego[1], high[2])
        a = point_in_camera(camera, a_ego)
        if a[2] >= camera.near_m:
            box = grow_rectangle(box, a, camera.focal_px, width, height)
        for axis in range(3):
            if (corner & (1 << axis)) == 0:
                b_ego = a_ego
                if axis == 0:
                    b_ego = wp.vec3(high[0], a_ego[1], a_ego[2])
                elif axis == 1:
                    b_ego = wp.vec3(a_ego[0], high[1], a_ego[2])
                else:
                    b_ego = wp.vec3(a_ego[0], a_ego[1], high[2])
                b = point_in_camera(camera, b_ego)
                if (a[2] >= camera.near_m) != (b[2] >= camera.near_m):
                    crossing = point_on_near_plane(a, b, camera.near_m)
                    box = grow_rectangle(box, crossing, camera.focal_px, width, height)
    # clamp in float: the cast of a huge float to an integer is undefined
    left = int(wp.floor(wp.clamp(box[0] - 1.0, 0.0, float(width))))
    top = int(wp.floor(wp.clamp(box[1] - 1.0, 0.0, float(height))))
    right = int(wp.ceil(wp.clamp(box[2] + 1.0, 0.0, float(width))))
    bottom = int(wp.ceil(wp.clamp(box[3] + 1.0, 0.0, float(height))))
    if right > left and bottom > top:
        layer_rectangle[v, layer] = wp.vec4i(left, top, right - left, bottom - top)
    else:
        layer_rectangle[v, layer] = wp.vec4i(0, 0, 0, 0)


@wp.kernel(enable_backward=False)
def place_layers_kernel(
    # in
    layer_rectangle: wp.array2d[wp.vec4i],
    # out
    layer_offset: wp.array2d[wp.int32],
    sample_count: wp.array[wp.int64],
):
    """Lay the rectangles one behind the other.

    Launch: ``dim=1``; one thread, the pairs are few. Not taped.
    Writes: every element of ``layer_offset``, and ``sample_count[0]``, the length of the atlas; offsets are only valid
        if it is below 2**31.
    """
    offset = wp.int64(0)
    for v in range(layer_rectangle.shape[0]):
        for layer in range(layer_rectangle.shape[1]):
            layer_offset[v, layer] = wp.int32(offset)
            rectangle = layer_rectangle[v, layer]
            offset = offset + wp.int64(rectangle[2]) * wp.int64(rectangle[3])
    sample_count[0] = offset


@wp.struct
class Edge:
    """A side of a triangle in the sample grid: inside is ``a (x - u) + b (y - v) >= 0``.

    Attributes:
        u: Column of a point on it.
        v: Row of that point.
        a: Growth of the inequality along a row.
        b: Growth of the inequality along a column.
        slope: ``b / a``, by which its crossing moves to the left from row to row; 0 for a level edge.
    """

    u: float
    v: float
    a: float
    b: float
    slope: float


@wp.func
def edge_from(u: float, v: float, next_u: float, next_v: float, side: float) -> Edge:
    """The edge from one corner to the next; ``side`` is the sign of the triangle's area."""
    edge = Edge()
    edge.u = u
    edge.v = v
    edge.a = (v - next_v) * side
    edge.b = (next_u - u) * side
    edge.slope = 0.0
    if edge.a != 0.0:
        edge.slope = edge.b / edge.a
    return edge


@wp.func
def first_inside(first: float, edge: Edge, y: float) -> float:
    """Column from which on a row lies on the inner side of an edge; ``first`` where the edge does not say."""
    if edge.a > 0.0:
        return wp.max(first, edge.u - edge.slope * (y - edge.v))
    return first


@wp.func
def last_inside(last: float, edge: Edge, y: float) -> float:
    """Column up to which a row lies on the inner side of an edge; -1 where a level edge shuts the whole row out."""
    if edge.a < 0.0:
        return wp.min(last, edge.u - edge.slope * (y - edge.v))
    if edge.a == 0.0 and edge.b * (y - edge.v) < 0.0:
        return -1.0
    return last


@wp.func
def fill_triangle(
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    focal_px: float,
    v: int,
    triangle: int,
    rectangle: wp.vec4i,
    offset: int,
    key: wp.array3d[wp.int64],
    layer_bits: wp.array[wp.int32],
):
    """Scatter one triangle in front of the near plane: spans of samples solved row by row."""
    height = key.shape[1]
    width = key.shape[2]
    w0 = 1.0 / a[2]
    w1 = 1.0 / b[2]
    w2 = 1.0 / c[2]
    u0 = 0.5 * float(width) + focal_px * a[0] * w0
    v0 = 0.5 * float(height) + focal_px * a[1] * w0
    u1 = 0.5 * float(width) + focal_px * b[0] * w1
    v1 = 0.5 * float(height) + focal_px * b[1] * w1
    u2 = 0.5 * float(width) + focal_px * c[0] * w2
    v2 = 0.5 * float(height) + focal_px * c[1] * w2
    # clamp in float: the cast of a huge float to an integer is undefined
    first_column = int(wp.ceil(wp.max(wp.min(u0, wp.min(u1, u2)), 0.0) - 0.5))
    last_column = int(wp.floor(wp.min(wp.max(u0, wp.max(u1, u2)), float(width)) - 0.5))
    first_row = int(wp.ceil(wp.max(wp.min(v0, wp.min(v1, v2)), 0.0) - 0.5))
    last_row = int(wp.floor(wp.min(wp.max(v0, wp.max(v1, v2)), float(height)) - 0.5))
    if first_column > last_column or first_row > last_row:
        return
    doubled_area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
    if wp.abs(doubled_area) < 1.0e-12:
        return
    # inverse depth is linear in the image
    w_per_column = ((w1 - w0) * (v2 - v0) - (w2 - w0) * (v1 - v0)) / doubled_area
    w_per_row = ((w2 - w0) * (u1 - u0) - (w1 - w0) * (u2 - u0)) / doubled_area
    side = wp.sign(doubled_area)
    edge0 = edge_from(u0, v0, u1, v1, side)
    edge1 = edge_from(u1, v1, u2, v2, side)
    edge2 = edge_from(u2, v2, u0, v0, side)
    for row in range(first_row, last_row + 1):
        y = float(row) + 0.5
        first = first_inside(float(first_column) + 0.5, edge0, y)
        first = first_inside(first, edge1, y)
        first = first_inside(first, edge2, y)
        last = last_inside(float(last_column) + 0.5, edge0, y)
        last = last_inside(last, edge1, y)
        last = last_inside(last, edge2, y)
        # the place of column 0 of this row in the layer
        layer_row = offset + (row - rectangle[1]) * rectangle[2] - rectangle[0]
        for column in range(int(wp.ceil(first - 0.5)), int(wp.floor(last - 0.5)) + 1):
            w = wp.max(w0 + w_per_column * (float(column) + 0.5 - u0) + w_per_row * (y - v0), 1.0e-6)
            bits = wp.cast(w, wp.int32)
            wp.atomic_max(key, v, row, column, (wp.int64(bits) << wp.int64(32)) | wp.int64(triangle))
            if offset >= 0:
                wp.atomic_max(layer_bits, layer_row + column, bits)


@wp.func
def is_outside(centre_m: wp.vec3, radius_m: float, view: View, width: int, height: int) -> bool:
    """Whether a sphere (camera coordinates) misses the view's pyramid."""
    if centre_m[2] + radius_m < view.near_m:
        return True
    tan_x = 0.5 * float(width) / view.focal_px
    if wp.abs(centre_m[0]) - tan_x * centre_m[2] > radius_m * wp.sqrt(1.0 + tan_x * tan_x):
        return True
    tan_y = 0.5 * float(height) / view.focal_px
    return wp.abs(centre_m[1]) - tan_y * centre_m[2] > radius_m * wp.sqrt(1.0 + tan_y * tan_y)


@wp.kernel(enable_backward=False)
def scatter_triangles_kernel(
    # in
    view: wp.array[View],
    scene: Triangles,
    layer_rectangle: wp.array2d[wp.vec4i],
    layer_offset: wp.array2d[wp.int32],
    first_view: int,
    layers_only: int,
    lane_count: int,
    # out
    key: wp.array3d[wp.int64],
    layer_bits: wp.array[wp.int32],
):
    """Scatter every triangle into the key buffer and, where its object has one, into its layer.

    A cluster whose bounding sphere misses the view is skipped whole; a triangle that crosses the near plane is cut to
    one or two. With ``layers_only`` 1, clusters without a layer (the environment) are left out.

    Launch: ``dim=(views of this chunk, cluster_count, lane_count)``; thread (view - first_view, cluster, lane) fills
    the cluster's triangles lane, lane + lane_count, ... Not taped.
    Writes: ``key`` and ``layer_bits`` by atomic maximum; the caller zeroes them.
    """
    chunk_view, cluster, lane = wp.tid()
    v = first_view + chunk_view
    layer = scene.cluster_layer[cluster]
    if layers_only == 1 and layer < 0:
        return
    camera = view[v]
    height = key.shape[1]
    width = key.shape[2]
    sphere = scene.cluster_sphere_ego_m[cluster]
    centre_m = point_in_camera(camera, wp.vec3(sphere[0], sphere[1], sphere[2]))
    if is_outside(centre_m, sphere[3], camera, width, height):
        return
    rectangle = wp.vec4i(0, 0, 0, 0)
    offset = int(-1)
    if layer >= 0:
        rectangle = layer_rectangle[v, layer]
        offset = layer_offset[v, layer]
        if rectangle[2] == 0:
            offset = -1
    near_m = camera.near_m
    first = scene.cluster_first[cluster]
    for k in range(lane, scene.cluster_count[cluster], lane_count):
        triangle = first + k
        corner = scene.triangle[triangle]
        a = point_in_camera(camera, scene.vertex_ego_m[corner[0]])
        b = point_in_camera(camera, scene.vertex_ego_m[corner[1]])
        c = point_in_camera(camera, scene.vertex_ego_m[corner[2]])
        in_front = int(a[2] >= near_m) + int(b[2] >= near_m) + int(c[2] >= near_m)
        if in_front == 3:
            fill_triangle(a, b, c, camera.focal_px, v, triangle, rectangle, offset, key, layer_bits)
        elif in_front == 1:
            # turn the triangle so that p is the corner in front
            p = a
            q = b
            r = c
            if b[2] >= near_m:
                p = b
                q = c
                r = a
            elif c[2] >= near_m:
                p = c
                q = a
                r = b
            q = point_on_near_plane(p, q, near_m)
            r = point_on_near_plane(p, r, near_m)
            fill_triangle(p, q, r, camera.focal_px, v, triangle, rectangle, offset, key, layer_bits)
        elif in_front == 2:
            # turn the triangle so that r is the corner behind
            p = a
            q = b
            r = c
            if a[2] < near_m:
                p = b
                q = c
                r = a
            elif b[2] < near_m:
                p = c
                q = a
                r = b
            s = point_on_near_plane(p, r, near_m)
            t = point_on_near_plane(q, r, near_m)
            fill_triangle(p, q, t, camera.focal_px, v, triangle, rectangle, offset, key, layer_bits)
            fill_triangle(p, t, s, camera.focal_px, v, triangle, rectangle, offset, key, layer_bits)
