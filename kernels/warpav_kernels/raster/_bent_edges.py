"""Where the edges of triangles cross the lines between neighbouring samples of a view with a bent lens.

The rays of an edge lie in a plane through the camera's centre, and so do those between two samples: where both meet is
solved, not searched for.
"""

import warp as wp

from warpav_kernels.raster._candidates import (
    LEAST_DISTANCE_M,
    LEAST_VOLUME,
    STEEP,
    TABLE_ERROR,
    WHOLE,
    WIDE,
    Candidate,
    wide_bounds,
    with_bounds,
)
from warpav_kernels.raster._layers import TO_BOTTOM, TO_LEFT, TO_RIGHT, Layers, place_in, step_of
from warpav_kernels.raster._lens import BROWN_CONRADY, PANORAMA, SPHERE, moved_place
from warpav_kernels.raster._rasterise import line_after, raise_crossing
from warpav_kernels.raster._rays import SPARE_RAD, Rays, table_entry
from warpav_kernels.raster._triangles import Triangles, faces, is_behind, may_be_outline, shows_no_back
from warpav_kernels.raster._view import View, point_in_camera, ray_between, sample_ray

wp.set_module_options({"enable_backward": False})

_PIECE = wp.constant(0.05)  # chord of the directions of a piece of an edge
_PIECE_SAMPLES = wp.constant(8.0)  # its length
_MAX_PIECES = wp.constant(256)  # of an edge
_PLACE_SLACK = wp.constant(0.02)  # by which a place in the image may be off by rounding [samples]
_END_SLACK = wp.constant(2.0e-6)  # by which an edge may reach beyond its ends [rad]


@wp.struct
class _Corner:
    """The direction of an end of an edge, or of a piece of one, as a view with a bent lens sees it."""

    direction: wp.vec3  # direction, of unit length
    # Place in the image [focal lengths]; of a Brown-Conrady lens beyond its limit without what moves sideways
    place: wp.vec2
    # Greatest curvature of the image of a great circle near there [focal lengths/rad^2]; of a PANORAMA the sine of the
    # elevation, without its sign
    bend: float


@wp.func
def _squared_secant(cosine: float) -> float:
    """The square of the secant of an angle; very large from a right angle on."""
    cosine = wp.max(cosine, 1.0e-3)
    return 1.0 / (cosine * cosine)


@wp.func
def _corner_of(camera: View, rays: Rays, table: int, point: wp.vec3) -> _Corner:
    """A point in camera coordinates, at any distance, as the view sees it."""
    corner = _Corner()
    direction = wp.normalize(point)
    corner.direction = direction
    if camera.lens.kind == PANORAMA:
        level = wp.sqrt(direction[0] * direction[0] + direction[2] * direction[2])
        corner.place = wp.vec2(wp.atan2(direction[0], direction[2]), direction[1] / wp.max(level, 1.0e-6))
        if camera.lens.formula == SPHERE:
            corner.place[1] = wp.atan2(direction[1], level)
        corner.bend = wp.abs(direction[1])
    else:
        entry = table_entry(rays, table, direction[2])
        corner.place = wp.vec2(entry[0] * direction[0], entry[0] * direction[1])
        corner.bend = entry[1]
        if (
            camera.lens.kind == BROWN_CONRADY
            and _squared_secant(direction[2]) <= 1.0 + camera.lens.limit * camera.lens.limit
        ):
            corner.place = moved_place(camera.lens, direction[0] / direction[2], direction[1] / direction[2])
    return corner


@wp.func
def _short_bounds(camera: View, widest_cosine: float, a: _Corner, b: _Corner, c: _Corner) -> wp.vec4:
    """Bounds (left, top, right, bottom) in focal lengths of the image of a small triangle, or of an arc where b is c.

    As `find_candidates` bounds them. Columns of a panorama may lie a turn or two beside its image.
    """
    squared = wp.max(wp.length_sq(b.direction - a.direction), wp.length_sq(c.direction - b.direction))
    squared = wp.max(squared, wp.length_sq(a.direction - c.direction))
    bend = wp.max(a.bend, wp.max(b.bend, c.bend))
    if camera.lens.kind == PANORAMA and bend > STEEP:
        return wide_bounds(camera, a.direction, b.direction, c.direction)
    bulge = 0.14 * squared * bend + TABLE_ERROR
    u1 = b.place[0]
    u2 = c.place[0]
    if camera.lens.kind == PANORAMA:
        level = wp.sqrt(1.0 - bend * bend)
        bulge = 0.5 * squared / (level * level * level)
        u1 -= 2.0 * wp.pi * wp.round((u1 - a.place[0]) / (2.0 * wp.pi))
        u2 -= 2.0 * wp.pi * wp.round((u2 - a.place[0]) / (2.0 * wp.pi))
    elif wp.max(a.direction[2], wp.max(b.direction[2], c.direction[2])) < widest_cosine:
        return wp.vec4(WHOLE, WHOLE, -WHOLE, -WHOLE)
    if camera.lens.kind == BROWN_CONRADY:
        sideways = 3.0 * (wp.abs(camera.lens.distortion[2]) + wp.abs(camera.lens.distortion[3]))
        limit = camera.lens.limit * camera.lens.limit
        widest = _squared_secant(wp.min(a.direction[2], wp.min(b.direction[2], c.direction[2])))
        if widest <= 1.0 + limit:
            bulge += 0.84 * squared * sideways * widest * (1.0 + limit)
        else:
            bulge += 2.0 * sideways * limit
    return wp.vec4(
        wp.min(a.place[0], wp.min(u1, u2)) - bulge,
        wp.min(a.place[1], wp.min(b.place[1], c.place[1])) - bulge,
        wp.max(a.place[0], wp.max(u1, u2)) + bulge,
        wp.max(a.place[1], wp.max(b.place[1], c.place[1])) + bulge,
    )


@wp.func
def _edge_plane(p: wp.vec3, q: wp.vec3, side: float) -> wp.vec3:
    """Normal of the plane through the camera's centre and an edge, turned by ``side`` [m^2].

    It is computed from the same end whichever way the edge runs: triangles that share it share every bit of it.
    """
    is_turned = p[0] > q[0] or (p[0] == q[0] and (p[1] > q[1] or (p[1] == q[1] and p[2] > q[2])))
    if is_turned:
        return wp.cross(q, p - q) * -side
    return wp.cross(p, q - p) * side


@wp.func(inline=False)
def _candidate_of(
    camera: View,
    rays: Rays,
    table: int,
    widest_cosine: float,
    triangle: int,
    p: wp.vec3,
    q: wp.vec3,
    r: wp.vec3,
    frame: wp.vec4i,
) -> Candidate:
    """One triangle of corners p, q and r as `find_candidates` finds it for its outline; numbered -1 where unseen."""
    found = Candidate()
    found.triangle = -1
    depth = wp.vec3(wp.length(p), wp.length(q), wp.length(r))
    volume = wp.dot(p, wp.cross(q - p, r - p))
    if wp.min(depth) < LEAST_DISTANCE_M or wp.abs(volume) < LEAST_VOLUME * depth[0] * depth[1] * depth[2]:
        return found
    if camera.lens.kind == BROWN_CONRADY:
        depth = wp.vec3(p[2], q[2], r[2])
    if wp.max(depth) < camera.near_m:
        return found
    a = _corner_of(camera, rays, table, p)
    b = _corner_of(camera, rays, table, q)
    c = _corner_of(camera, rays, table, r)
    chord = wp.max(wp.length_sq(b.direction - a.direction), wp.length_sq(c.direction - b.direction))
    chord = wp.max(chord, wp.length_sq(a.direction - c.direction))
    if chord > WIDE * WIDE:
        found = with_bounds(camera, found, wide_bounds(camera, a.direction, b.direction, c.direction), frame)
    else:
        found = with_bounds(camera, found, _short_bounds(camera, widest_cosine, a, b, c), frame)
    has_column = found.first_column <= found.last_column
    has_row = found.first_row <= found.last_row
    if has_column or has_row:
        side = wp.sign(volume)
        found.triangle = triangle
        found.edge0 = _edge_plane(p, q, side)
        found.edge1 = _edge_plane(q, r, side)
        found.edge2 = _edge_plane(r, p, side)
        found.inverse_depth = wp.cross(q - p, r - p) / volume
    return found


@wp.func
def _cross_pair(
    camera: View,
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
    here = sample_ray(camera, row, column)
    there = sample_ray(camera, row + step[0], column + step[1])
    height = wp.dot(edge, here)
    other_height = wp.dot(edge, there)
    if (height >= 0.0) == (other_height >= 0.0) or wp.length_sq(here) == 0.0 or wp.length_sq(there) == 0.0:
        return
    share = height / (height - other_height)
    crossing = ray_between(here, there, share)
    slack = -_END_SLACK * wp.length(crossing)
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
def _cross_bent_edge(
    camera: View,
    rays: Rays,
    table: int,
    widest_cosine: float,
    p: _Corner,
    q: _Corner,
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
    length = wp.length(q.direction - p.direction) / _PIECE
    if length < 1.0:
        # of a short edge the table knows the length in the image
        length = wp.max(camera.focal[0], camera.focal[1]) * wp.length(q.place - p.place) / _PIECE_SAMPLES
    else:
        length *= wp.max(1.0, wp.max(camera.focal[0], camera.focal[1]) * _PIECE / _PIECE_SAMPLES)
    pieces = wp.clamp(int(wp.ceil(length)), 1, _MAX_PIECES)
    # what is spared for a whole triangle is too much for a piece
    if widest_cosine > -1.0:
        widest_cosine = wp.cos(wp.max(wp.acos(widest_cosine) - SPARE_RAD + 1.1 * _PIECE, 0.0))
    a = p
    for piece in range(pieces):
        b = q
        if piece + 1 < pieces:
            share = float(piece + 1) / float(pieces)
            b = _corner_of(camera, rays, table, (1.0 - share) * p.direction + share * q.direction)
        bounds = _short_bounds(camera, widest_cosine, a, b, b)
        turn = int(0)
        if camera.lens.kind == PANORAMA:
            turn = 1
        first_row = line_after(camera.centre[1] + camera.focal[1] * bounds[1] - _PLACE_SLACK, rectangle[1], bottom)
        last_row = line_after(camera.centre[1] + camera.focal[1] * bounds[3] + _PLACE_SLACK, rectangle[1], bottom) - 1
        for n in range(-turn, turn + 1):
            if first_row <= last_row + 1:  # it may cross columns alone
                shift = 2.0 * wp.pi * camera.focal[0] * float(n)
                first_column = line_after(
                    camera.centre[0] + camera.focal[0] * bounds[0] + shift - _PLACE_SLACK, rectangle[0], right
                )
                last_column = (
                    line_after(
                        camera.centre[0] + camera.focal[0] * bounds[2] + shift + _PLACE_SLACK, rectangle[0], right
                    )
                    - 1
                )
                for row in range(wp.max(first_row - 1, 0), last_row + 1):
                    for column in range(wp.max(first_column - 1, 0), last_column + 1):
                        if column + 1 < camera.ray.shape[2] and row >= first_row:
                            _cross_pair(
                                camera, row, column, TO_RIGHT, edge, start, end, inverse_depth, farthest,
                                rectangle, offset, layers,
                            )  # fmt: skip
                        if row + 1 < camera.ray.shape[1] and column >= first_column:
                            _cross_pair(
                                camera, row, column, TO_BOTTOM, edge, start, end, inverse_depth, farthest,
                                rectangle, offset, layers,
                            )  # fmt: skip
        a = b


@wp.func(inline=False)
def _cross_near_cut(
    image: Candidate,
    camera: View,
    rectangle: wp.vec4i,
    offset: int,
    layers: Layers,
):
    """Scatter where the near cut ends a triangle between a sample and its neighbours."""
    nearest = 1.0 / camera.near_m
    for r in range(rectangle[3]):
        for c in range(rectangle[2]):
            here = sample_ray(camera, rectangle[1] + r, rectangle[0] + c)
            w = wp.dot(image.inverse_depth, here)
            if w > 0.0 and w <= nearest:
                for direction in range(4):
                    step = step_of(direction)
                    row = rectangle[1] + r + step[0]
                    column = rectangle[0] + c + step[1]
                    if row >= 0 and column >= 0 and row < camera.ray.shape[1] and column < camera.ray.shape[2]:
                        there = sample_ray(camera, row, column)
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
def _least_depth(camera: View, p: wp.vec3, q: wp.vec3, r: wp.vec3) -> float:
    """The least depth of three points in camera coordinates [m]."""
    if camera.lens.kind == BROWN_CONRADY:
        return wp.min(p[2], wp.min(q[2], r[2]))
    return wp.min(wp.length(p), wp.min(wp.length(q), wp.length(r)))


@wp.func(inline=False)
def cross_outline(
    image: Candidate,
    p: wp.vec3,
    q: wp.vec3,
    r: wp.vec3,
    camera: View,
    scene: Triangles,
    rays: Rays,
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
        a = _corner_of(camera, rays, table, p)
        b = _corner_of(camera, rays, table, q)
        c = _corner_of(camera, rays, table, r)
        if is_outline0:
            _cross_bent_edge(
                camera, rays, table, widest_cosine, a, b, image.edge0, image.inverse_depth, rectangle, offset,
                layers,
            )  # fmt: skip
        if is_outline1:
            _cross_bent_edge(
                camera, rays, table, widest_cosine, b, c, image.edge1, image.inverse_depth, rectangle, offset,
                layers,
            )  # fmt: skip
        if is_outline2:
            _cross_bent_edge(
                camera, rays, table, widest_cosine, c, a, image.edge2, image.inverse_depth, rectangle, offset,
                layers,
            )  # fmt: skip
    if not is_front_only and _least_depth(camera, p, q, r) < camera.near_m:
        _cross_near_cut(image, camera, rectangle, offset, layers)


@wp.kernel(enable_backward=False)
def scatter_bent_crossings_kernel(
    # in
    view: wp.array[View],
    scene: Triangles,
    rays: Rays,
    bent_view: wp.array[wp.int32],
    layer_count: int,
    scissor: wp.array[wp.vec4i],
    lane_count: int,
    # out
    layers: Layers,
):
    """The edge crossings of the layers below ``layer_count`` in the views whose lenses are no pinholes, on a GPU.

    Launch: ``dim=(such views, cluster_count, lane_count)``; thread (view, cluster, lane) takes the cluster's triangles
    lane, lane + lane_count, ... Not taped.
    Writes: ``layers.crossing_key`` by atomic maximum; the caller zeroes it.
    """
    i, cluster, lane = wp.tid()
    v = bent_view[i]
    layer = scene.cluster_layer[cluster]
    if layer < 0 or layer >= layer_count:
        return
    rectangle = layers.rectangle[v, layer]
    if rectangle[2] == 0:
        return
    camera = view[v]
    frame = scissor[v]
    is_front_only = shows_no_back(camera, scene, cluster, frame)
    first = scene.cluster_first[cluster]
    for triangle in range(first + lane, first + scene.cluster_count[cluster], lane_count):
        plane = scene.triangle_plane[triangle]
        if is_front_only and is_behind(camera, plane):
            continue
        neighbour = scene.neighbour[triangle]
        is_facing = faces(camera, plane)
        is_outline = may_be_outline(camera, scene, is_facing, neighbour[0])
        is_outline = is_outline or may_be_outline(camera, scene, is_facing, neighbour[1])
        is_outline = is_outline or may_be_outline(camera, scene, is_facing, neighbour[2])
        if is_outline or not is_front_only:
            corner = scene.triangle[triangle]
            p = point_in_camera(camera, scene.vertex_world_m[corner[0]])
            q = point_in_camera(camera, scene.vertex_world_m[corner[1]])
            r = point_in_camera(camera, scene.vertex_world_m[corner[2]])
            if is_outline or _least_depth(camera, p, q, r) < camera.near_m:
                table = rays.table_of_view[v]
                widest_cosine = rays.widest_cosine[rays.set_of_view[v]]
                image = _candidate_of(camera, rays, table, widest_cosine, triangle, p, q, r, frame)
                if image.triangle >= 0:
                    cross_outline(
                        image, p, q, r, camera, scene, rays, table, widest_cosine, is_front_only, rectangle,
                        layers.offset[v, layer], layers,
                    )  # fmt: skip
