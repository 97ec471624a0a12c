"""Outlines of masks, between the samples: where they cross from one sample to the next, and what lies in front there.

Four neighbouring samples make a cell. Where the mask differs between two of them, its outline crosses the cell's side
between them; where it does, the edge crossing of the surface in front says. The outline of a cell is the straight
segment between two such crossings (the rule of marching squares), so the outline of a mask is a closed polygon.
"""

import warp as wp

from warpav_kernels.raster._layers import NEAR_CUT, TO_BOTTOM, TO_LEFT, TO_RIGHT, TO_TOP, Layers, place_in, step_of
from warpav_kernels.raster._lens import PINHOLE
from warpav_kernels.raster._rasterise import ImageTriangle, front_part, image_triangle, narrowed, slope_of
from warpav_kernels.raster._triangles import Triangles
from warpav_kernels.raster._view import View, inverse_depth_of, point_in_camera, sample_ray, sees

wp.set_module_options({"enable_backward": False})

_SPAN_SLACK = wp.constant(1.0e-3)  # a sample on a triangle's edge is covered by it [samples]

_NEAR_TOLERANCE = wp.constant(1.0e-4)  # of 1/z, by which a surface ends at the near plane

# what a mask is
ALONE = wp.constant(0)  # the samples that the object covers
VISIBLE = wp.constant(1)  # those of them that nothing hides


@wp.struct
class Hiding:
    """What hides the layers, in their layout; see `hide`."""

    bits: wp.array[wp.int32]  # bits of 1/z of the hiding surface; 0 where nothing hides, [sample]
    source: wp.array[wp.int32]  # the hiding triangle, or ``-1 - layer``, [sample]


@wp.struct
class _Pair:
    """One object in one view."""

    view: int  # index of the view
    rectangle: wp.vec4i  # the object's rectangle of samples
    offset: int  # its place in the atlas


@wp.func
def pair_of(v: int, layer: int, layers: Layers) -> _Pair:
    """The pair of a view and a layer."""
    pair = _Pair()
    pair.view = v
    pair.rectangle = layers.rectangle[v, layer]
    pair.offset = layers.offset[v, layer]
    return pair


@wp.struct
class _EdgeCrossing:
    """Where a surface ends between a sample's centre and a neighbour's: a subsample offset, and the depth there."""

    offset: float  # 0..1 in samples
    inverse_depth: float  # 1/z of the surface there [1/m]
    cut_triangle: int  # the triangle that the near plane ends there; -1 where something else does
    is_known: bool  # whether it is solved; else half way stands for it


@wp.func
def _edge_crossing_from(key: wp.int64, bits: wp.int32, near_m: float) -> _EdgeCrossing:
    """An edge crossing from its key; half way, at the depth of the sample's ``bits``, where it is unknown."""
    edge = _EdgeCrossing()
    edge.offset = 0.5
    edge.inverse_depth = inverse_depth_of(bits)
    edge.cut_triangle = -1
    edge.is_known = key != wp.int64(0)
    if edge.is_known:
        edge.offset = wp.cast(wp.int32(key >> wp.int64(32)), float)
        end = wp.int32(key & wp.int64(0x7FFFFFFF))
        if (key & NEAR_CUT) == wp.int64(0):
            edge.inverse_depth = inverse_depth_of(end)
        else:
            edge.inverse_depth = 1.0 / near_m
            edge.cut_triangle = end
    return edge


@wp.func
def _row_span(image: ImageTriangle, y: float) -> wp.vec2:
    """The columns between which a triangle covers a row; the end lies before the start where it does not."""
    span = wp.vec2(-1.0e9, 1.0e9)
    a = image.edge0
    span = narrowed(span, a.u, a.a, a.b, slope_of(a.a, a.b), y - a.v)
    b = image.edge1
    span = narrowed(span, b.u, b.a, b.b, slope_of(b.a, b.b), y - b.v)
    c = image.edge2
    return narrowed(span, c.u, c.a, c.b, slope_of(c.a, c.b), y - c.v)


@wp.func
def _column_span(image: ImageTriangle, x: float) -> wp.vec2:
    """The rows between which a triangle covers a column; the end lies before the start where it does not."""
    span = wp.vec2(-1.0e9, 1.0e9)
    a = image.edge0
    span = narrowed(span, a.v, a.b, a.a, slope_of(a.b, a.a), x - a.u)
    b = image.edge1
    span = narrowed(span, b.v, b.b, b.a, slope_of(b.b, b.a), x - b.u)
    c = image.edge2
    return narrowed(span, c.v, c.b, c.a, slope_of(c.b, c.a), x - c.u)


@wp.func
def _share_inside(start: wp.vec3, end: wp.vec3, normal: wp.vec3) -> float:
    """Share of the way between two rays at which it leaves the half space of a normal; 1 if it does not."""
    here = wp.max(wp.dot(start, normal), 0.0)
    there = wp.dot(end, normal)
    if there >= 0.0:
        return 1.0
    return here / (here - there)


@wp.func
def _traced_triangle_crossing(
    camera: View, scene: Triangles, triangle: int, bits: wp.int32, row: int, column: int, direction: int
) -> _EdgeCrossing:
    """`_triangle_crossing` for a lens that is no pinhole, where straight sides are planes of rays."""
    corner = scene.triangle[triangle]
    a = point_in_camera(camera, scene.vertex_world_m[corner[0]])
    b = point_in_camera(camera, scene.vertex_world_m[corner[1]])
    c = point_in_camera(camera, scene.vertex_world_m[corner[2]])
    step = step_of(direction)
    start = sample_ray(camera, row, column)
    end = sample_ray(camera, row + step[0], column + step[1])
    side = wp.sign(wp.dot(a, wp.cross(b, c)))
    share = _share_inside(start, end, side * wp.cross(a, b))
    share = wp.min(share, _share_inside(start, end, side * wp.cross(b, c)))
    share = wp.min(share, _share_inside(start, end, side * wp.cross(c, a)))
    # 1/depth is linear in the ray
    plane = wp.cross(b - a, c - a)
    plane = plane / wp.dot(plane, a)
    start_w = wp.dot(plane, start)
    end_w = wp.dot(plane, end)
    nearest = 1.0 / camera.near_m
    cut_share = float(1.0)
    if end_w > nearest:
        cut_share = wp.clamp((nearest - start_w) / (end_w - start_w), 0.0, 1.0)
    if wp.min(share, cut_share) >= 1.0:
        return _edge_crossing_from(wp.int64(0), bits, camera.near_m)
    edge = _EdgeCrossing()
    edge.offset = wp.min(share, cut_share)
    edge.inverse_depth = start_w + edge.offset * (end_w - start_w)
    edge.cut_triangle = -1
    edge.is_known = True
    if cut_share < share:
        edge.cut_triangle = triangle
    return edge


@wp.func
def _triangle_crossing(
    camera: View,
    scene: Triangles,
    triangle: int,
    bits: wp.int32,
    row: int,
    column: int,
    direction: int,
    width: int,
    height: int,
) -> _EdgeCrossing:
    """How far one triangle goes on from a sample's centre that it covers; half way where it covers the next as well.

    For surfaces without a layer: their triangles are large, and their neighbours are not asked.
    """
    if camera.lens.kind != PINHOLE:
        return _traced_triangle_crossing(camera, scene, triangle, bits, row, column, direction)
    x = float(column) + 0.5
    y = float(row) + 0.5
    part = front_part(camera, scene, triangle)
    edge = _EdgeCrossing()
    edge.cut_triangle = -1
    edge.is_known = True
    for index in range(part.part_count):
        image = image_triangle(camera, part, index, True, wp.vec4i(0, 0, width, height))
        w = image.w + image.w_per_column * (x - image.a[0]) + image.w_per_row * (y - image.a[1])
        span = wp.vec2(0.0, 0.0)
        here = x
        w_per_step = image.w_per_column
        if direction == TO_LEFT or direction == TO_RIGHT:
            span = _row_span(image, y)
        else:
            span = _column_span(image, x)
            here = y
            w_per_step = image.w_per_row
        if span[0] <= here + _SPAN_SLACK and span[1] >= here - _SPAN_SLACK:
            end = span[1]
            if direction == TO_LEFT or direction == TO_TOP:
                end = span[0]
            if wp.abs(end - here) > edge.offset:
                edge.offset = wp.abs(end - here)
                edge.inverse_depth = w + w_per_step * (end - here)
    if edge.offset <= 0.0 or edge.offset >= 1.0:
        return _edge_crossing_from(wp.int64(0), bits, camera.near_m)
    if not part.is_whole and edge.inverse_depth > (1.0 - _NEAR_TOLERANCE) / camera.near_m:
        edge.cut_triangle = triangle
    return edge


@wp.func
def _hiding_crossing(
    camera: View,
    scene: Triangles,
    layers: Layers,
    source: int,
    bits: wp.int32,
    v: int,
    row: int,
    column: int,
    direction: int,
    width: int,
    height: int,
) -> _EdgeCrossing:
    """How far a hiding surface goes on from a sample's centre that it hides."""
    layer = -1 - source
    if source >= 0:
        layer = scene.body_layer[scene.triangle_body[source]]
    if layer >= 0 and layer < layers.rectangle.shape[1]:
        place = place_in(layers.rectangle[v, layer], layers.offset[v, layer], row, column)
        if place >= 0:
            return _edge_crossing_from(layers.crossing_key[direction, place], bits, camera.near_m)
    if source < 0:
        return _edge_crossing_from(wp.int64(0), bits, camera.near_m)
    return _triangle_crossing(camera, scene, source, bits, row, column, direction, width, height)


@wp.func
def _plane_inverse_depth(camera: View, scene: Triangles, triangle: int, row: int, column: int) -> float:
    """Inverse depth of a triangle's plane at a sample's centre [1/m]; not positive where the camera looks past it."""
    plane = scene.triangle_plane[triangle]
    normal = wp.vec3(plane[0], plane[1], plane[2])
    ray = wp.transpose(camera.camera_from_world) * sample_ray(camera, row, column)
    height_m = plane[3] - wp.dot(normal, camera.position_world_m)
    if height_m == 0.0:
        return 0.0
    return wp.dot(normal, ray) / height_m


@wp.func
def _passing_share(front: float, front_next: float, back: float, back_next: float) -> float:
    """Share of the way from one sample to the next at which the back surface comes through the front one; else -1.

    All four are inverse depths, which are linear in the image.
    """
    before = front - back
    after = back_next - front_next
    if back <= 0.0 or before <= 0.0 or after <= 0.0:
        return -1.0
    return before / (before + after)


@wp.struct
class _OutlineCrossing:
    """Where an outline crosses from one sample's centre to the next."""

    x: float  # column in the grid
    y: float  # row in the grid
    inverse_depth: float  # 1/z of the surface in front, whose outline it is [1/m]
    cut_triangle: int  # its triangle, where the near plane cuts it there; else -1


@wp.func
def _outline_crossing(
    pair: _Pair,
    row: int,
    column: int,
    direction: int,
    kind: int,
    camera: View,
    scene: Triangles,
    layers: Layers,
    hiding: Hiding,
    width: int,
    height: int,
) -> _OutlineCrossing:
    """The crossing next to a sample of the mask whose neighbour in a direction is not of the mask."""
    step = step_of(direction)
    place = place_in(pair.rectangle, pair.offset, row, column)
    other_row = row + step[0]
    other_column = column + step[1]
    other = place_in(pair.rectangle, pair.offset, other_row, other_column)
    edge = _EdgeCrossing()
    edge.offset = 1.0
    edge.cut_triangle = -1
    if layers.inverse_depth_bits[other] == wp.int32(0):
        edge = _edge_crossing_from(
            layers.crossing_key[direction, place], layers.inverse_depth_bits[place], camera.near_m
        )
    if kind == VISIBLE:
        bits = hiding.bits[other]
        if bits != wp.int32(0):
            back = _hiding_crossing(
                camera,
                scene,
                layers,
                hiding.source[other],
                bits,
                pair.view,
                other_row,
                other_column,
                TO_RIGHT - direction,
                width,
                height,
            )
            own_next = inverse_depth_of(layers.inverse_depth_bits[other])
            if own_next > 0.0 and hiding.source[other] >= 0:
                own = inverse_depth_of(layers.inverse_depth_bits[place])
                behind = _plane_inverse_depth(camera, scene, hiding.source[other], row, column)
                share = _passing_share(own, own_next, behind, inverse_depth_of(bits))
                if share >= 0.0 and (share > 1.0 - back.offset or not back.is_known):
                    back.offset = 1.0 - share
                    back.inverse_depth = own + share * (own_next - own)
                    back.cut_triangle = -1
            # what lies behind the object hides nothing; it is only what one sees beside it
            if back.inverse_depth > edge.inverse_depth and 1.0 - back.offset <= edge.offset:
                edge.offset = 1.0 - back.offset
                edge.inverse_depth = back.inverse_depth
                edge.cut_triangle = back.cut_triangle
    crossing = _OutlineCrossing()
    crossing.x = float(column) + 0.5 + edge.offset * float(step[1])
    crossing.y = float(row) + 0.5 + edge.offset * float(step[0])
    crossing.inverse_depth = edge.inverse_depth
    crossing.cut_triangle = edge.cut_triangle
    return crossing


@wp.struct
class _Cell:
    """Four neighbouring samples: which of them are of the mask."""

    row: int  # row of the upper left sample in the grid
    column: int  # its column
    mask: int  # bit 0 for the upper left, 1 upper right, 2 lower right, 3 lower left sample
    segment_count: int  # segments of outline in the cell: 0, 1, or 2 where two opposite corners are of the mask
    is_whole: bool  # whether the lens sees all corners


@wp.func
def own_corners(pair: _Pair, row: int, column: int, layers: Layers) -> int:
    """Which corners of the cell at a place of the pair's rectangle the object covers; see `Cell.mask`."""
    place = pair.offset + row * pair.rectangle[2] + column
    below = place + pair.rectangle[2]
    mask = int(layers.inverse_depth_bits[place] != wp.int32(0))
    mask += 2 * int(layers.inverse_depth_bits[place + 1] != wp.int32(0))
    mask += 4 * int(layers.inverse_depth_bits[below + 1] != wp.int32(0))
    return mask + 8 * int(layers.inverse_depth_bits[below] != wp.int32(0))


@wp.func
def unhidden_corners(pair: _Pair, row: int, column: int, hiding: Hiding) -> int:
    """Which corners of the cell at a place of the pair's rectangle nothing hides; see `Cell.mask`."""
    place = pair.offset + row * pair.rectangle[2] + column
    below = place + pair.rectangle[2]
    mask = int(hiding.bits[place] == wp.int32(0))
    mask += 2 * int(hiding.bits[place + 1] == wp.int32(0))
    mask += 4 * int(hiding.bits[below + 1] == wp.int32(0))
    return mask + 8 * int(hiding.bits[below] == wp.int32(0))


@wp.func
def cell_of(camera: View, pair: _Pair, row: int, column: int, mask: int) -> _Cell:
    """The cell at a place of the pair's rectangle."""
    cell = _Cell()
    cell.row = pair.rectangle[1] + row
    cell.column = pair.rectangle[0] + column
    cell.mask = mask
    cell.segment_count = 1
    if mask == 0 or mask == 15:
        cell.segment_count = 0
    elif mask == 5 or mask == 10:
        cell.segment_count = 2
    is_upper_whole = sees(camera, cell.row, cell.column) and sees(camera, cell.row, cell.column + 1)
    is_lower_whole = sees(camera, cell.row + 1, cell.column) and sees(camera, cell.row + 1, cell.column + 1)
    cell.is_whole = is_upper_whole and is_lower_whole
    return cell


@wp.func
def is_in_mask(pair: _Pair, row: int, column: int, kind: int, layers: Layers, hiding: Hiding) -> bool:
    """Whether the sample at a place of the pair's rectangle is of the mask."""
    place = pair.offset + row * pair.rectangle[2] + column
    if layers.inverse_depth_bits[place] == wp.int32(0):
        return False
    if kind == VISIBLE:
        return hiding.bits[place] == wp.int32(0)
    return True


@wp.func
def mask_corners(pair: _Pair, row: int, column: int, kind: int, layers: Layers, hiding: Hiding) -> int:
    """Which corners of the cell at a place of the pair's rectangle are of the mask; none of the last row and column."""
    if row + 1 >= pair.rectangle[3] or column + 1 >= pair.rectangle[2]:
        return 0
    mask = own_corners(pair, row, column, layers)
    if mask != 0 and kind == VISIBLE:
        mask = mask & unhidden_corners(pair, row, column, hiding)
    return mask


@wp.func
def _side_from(mask: int, first: int, leaving: bool) -> int:
    """The first side of a cell, counted clockwise from ``first``, at which the mask ends (``leaving``) or begins.

    Side k leads from corner k to corner k + 1, clockwise from the upper left corner.
    """
    found = int(-1)
    for k in range(4):
        side = (first + k) % 4
        here = (mask >> side) & 1
        there = (mask >> ((side + 1) % 4)) & 1
        if found < 0 and here != there and (here == 1) == leaving:
            found = side
    return found


@wp.func
def _side_crossing(
    cell: _Cell,
    side: int,
    pair: _Pair,
    kind: int,
    camera: View,
    scene: Triangles,
    layers: Layers,
    hiding: Hiding,
    width: int,
    height: int,
) -> _OutlineCrossing:
    """The outline's crossing of one side of a cell."""
    # corners clockwise: upper left, upper right, lower right, lower left; a side's direction from its first corner
    corner = side
    direction = TO_RIGHT
    if side == 1:
        direction = TO_BOTTOM
    elif side == 2:
        direction = TO_LEFT
    elif side == 3:
        direction = TO_TOP
    if ((cell.mask >> side) & 1) == 0:
        corner = (side + 1) % 4
        direction = TO_RIGHT - direction
    row = cell.row
    if corner >= 2:
        row += 1
    column = cell.column
    if corner == 1 or corner == 2:
        column += 1
    return _outline_crossing(pair, row, column, direction, kind, camera, scene, layers, hiding, width, height)


@wp.struct
class Segment:
    """A piece of outline inside one cell; seen along it, the mask lies on the right."""

    start: wp.vec2  # column and row of its start in the grid
    end: wp.vec2  # column and row of its end
    inverse_depth: float  # 1/z of the surface in front, in its middle [1/m]
    start_cut: int  # the triangle that the near plane cuts at its start; -1 where there is none
    end_cut: int  # the same at its end
    is_fixed: bool  # whether it is the edge of what the lens sees, which stays where it is in the image


@wp.func
def cell_segment(
    cell: _Cell,
    index: int,
    pair: _Pair,
    kind: int,
    camera: View,
    scene: Triangles,
    layers: Layers,
    hiding: Hiding,
    width: int,
    height: int,
) -> Segment:
    """One segment of outline of a cell. Where two opposite corners are of the mask, each is cut off by itself."""
    start_side = _side_from(cell.mask, 0, True)
    if index == 1:
        start_side = _side_from(cell.mask, start_side + 1, True)
    # the outline goes from where the mask ends, clockwise, backwards round its corner to where it begins
    end_side = _side_from(cell.mask, start_side + 1, False)
    if cell.segment_count == 2:
        end_side = (start_side + 3) % 4
    start = _side_crossing(cell, start_side, pair, kind, camera, scene, layers, hiding, width, height)
    end = _side_crossing(cell, end_side, pair, kind, camera, scene, layers, hiding, width, height)
    segment = Segment()
    segment.start = wp.vec2(start.x, start.y)
    segment.end = wp.vec2(end.x, end.y)
    segment.inverse_depth = 0.5 * (start.inverse_depth + end.inverse_depth)
    segment.start_cut = start.cut_triangle
    segment.end_cut = end.cut_triangle
    segment.is_fixed = not cell.is_whole
    return segment


@wp.func
def _sorted_cut(from_value: float, to_value: float, cut: float) -> float:
    """Share of the way from one value to another at which it passes ``cut``; 1 if it does not."""
    if (from_value < cut) == (to_value < cut):
        return 1.0
    return wp.clamp((cut - from_value) / (to_value - from_value), 0.0, 1.0)


@wp.func
def segment_cuts(segment: Segment) -> wp.vec4:
    """Shares of a segment at which it passes from one sample's square to the next: 0, two cuts, 1."""
    # the middle lines of the cell between the sample centres
    column = wp.floor(wp.min(segment.start[0], segment.end[0]) + 0.5)
    row = wp.floor(wp.min(segment.start[1], segment.end[1]) + 0.5)
    a = _sorted_cut(segment.start[0], segment.end[0], column)
    b = _sorted_cut(segment.start[1], segment.end[1], row)
    return wp.vec4(0.0, wp.min(a, b), wp.max(a, b), 1.0)
