"""Decide: which samples of a layer are hidden, and by which surface.

The result has the layout of the layers: the bits of 1/z of the hiding surface, 0 where nothing hides the layer's
object, and which surface it is: a triangle, or ``-1 - layer``. It is filled outside the object's silhouette as well,
because a boundary needs the surfaces on both of its sides.
"""

import warp as wp

from warpav_kernels.raster._layers import Layers, place_in
from warpav_kernels.raster._triangles import Triangles
from warpav_kernels.raster._view import inverse_depth_of

wp.set_module_options({"enable_backward": False})

_MEDIAN_STEPS = wp.constant(12)  # bisection of the range of inverse depths: a 4096th of it is enough to compare


@wp.kernel(enable_backward=False)
def hide_by_nearest_surface_kernel(
    # in
    key: wp.array3d[wp.int64],
    scene: Triangles,
    layer_body: wp.array[wp.int32],
    layers: Layers,
    first_view: int,
    row_lanes: int,
    column_lanes: int,
    # out
    hiding_bits: wp.array[wp.int32],
    hiding_source: wp.array[wp.int32],
):
    """Whatever is nearest in the key buffer and belongs to another object hides the layer where that is not nearer.

    A joint key buffer (exact occlusion) has nothing behind the layer; one of the occluders alone may have.

    Launch: ``dim=(views of this chunk, layer_count, row_lanes * column_lanes)``; the lanes of a pair share its samples.
    Not taped.
    Writes: every sample of the layers of these views once; ``hiding_source`` where something hides.
    """
    chunk_view, layer, lane = wp.tid()
    v = first_view + chunk_view
    rectangle = layers.rectangle[v, layer]
    offset = layers.offset[v, layer]
    for row in range(lane / column_lanes, rectangle[3], row_lanes):
        for column in range(lane % column_lanes, rectangle[2], column_lanes):
            nearest = key[v, rectangle[1] + row, rectangle[0] + column]
            bits = wp.int32(0)
            if nearest != wp.int64(0):
                triangle = wp.int32(nearest & wp.int64(0xFFFFFFFF))
                depth_bits = wp.int32(nearest >> wp.int64(32))
                is_nearer = layers.inverse_depth_bits[offset + row * rectangle[2] + column] > depth_bits
                if not is_nearer and scene.triangle_body[triangle] != layer_body[layer]:
                    bits = depth_bits
                    hiding_source[offset + row * rectangle[2] + column] = triangle
            hiding_bits[offset + row * rectangle[2] + column] = bits


@wp.func
def _overlap_rectangle(a: wp.vec4i, b: wp.vec4i) -> wp.vec4i:
    """Samples that two rectangles (first column, first row, columns, rows) share; may have 0 columns or rows."""
    left = wp.max(a[0], b[0])
    top = wp.max(a[1], b[1])
    columns = wp.max(wp.min(a[0] + a[2], b[0] + b[2]) - left, 0)
    rows = wp.max(wp.min(a[1] + a[3], b[1] + b[3]) - top, 0)
    return wp.vec4i(left, top, columns, rows)


@wp.func
def _layer_sample(row: int, column: int, rectangle: wp.vec4i, offset: int, layers: Layers) -> wp.int32:
    """Bits of a layer at a sample of the grid; 0 outside its rectangle."""
    place = place_in(rectangle, offset, row, column)
    if place < 0:
        return wp.int32(0)
    return layers.inverse_depth_bits[place]


@wp.func
def _median_inverse_depth(
    own_rectangle: wp.vec4i,
    own_offset: int,
    other_rectangle: wp.vec4i,
    other_offset: int,
    shared: bool,
    layers: Layers,
) -> float:
    """Median inverse depth of the samples that another object does (``shared``) or does not cover; 0: none."""
    low = float(1.0e9)
    high = float(0.0)
    count = int(0)
    for row in range(own_rectangle[3]):
        for column in range(own_rectangle[2]):
            own = layers.inverse_depth_bits[own_offset + row * own_rectangle[2] + column]
            if own != wp.int32(0):
                other = _layer_sample(
                    own_rectangle[1] + row, own_rectangle[0] + column, other_rectangle, other_offset, layers
                )
                if (other != wp.int32(0)) == shared:
                    low = wp.min(low, inverse_depth_of(own))
                    high = wp.max(high, inverse_depth_of(own))
                    count += 1
    if count == 0:
        return 0.0
    for _ in range(wp.int32(_MEDIAN_STEPS)):  # a loop, which Warp does not unroll
        middle = 0.5 * (low + high)
        below = int(0)
        for row in range(own_rectangle[3]):
            for column in range(own_rectangle[2]):
                own = layers.inverse_depth_bits[own_offset + row * own_rectangle[2] + column]
                if own != wp.int32(0) and inverse_depth_of(own) < middle:
                    other = _layer_sample(
                        own_rectangle[1] + row, own_rectangle[0] + column, other_rectangle, other_offset, layers
                    )
                    if (other != wp.int32(0)) == shared:
                        below += 1
        if 2 * below < count:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


@wp.kernel(enable_backward=False)
def order_overlapping_layers_kernel(
    # in
    layers: Layers,
    object_count: int,
    first_view: int,
    # out
    is_hidden_by: wp.array3d[wp.int32],
):
    """The thesis's pairwise occlusion: of two objects whose silhouettes overlap, the nearer one hides the other.

    "Nearer" compares the median depths of the areas that do not overlap; where one silhouette lies wholly inside the
    other, the medians inside the overlap (the thesis leaves that case open).

    Launch: ``dim=(views of this chunk, object_count, object_count)``; thread (v, a, b) with b <= a does nothing. Not
    taped.
    Writes: ``is_hidden_by[v, a, b]`` = 1 where a is hidden by b; the caller zeroes it.
    """
    chunk_view, a, b = wp.tid()
    if b <= a:
        return
    v = first_view + chunk_view
    a_rectangle = layers.rectangle[v, a]
    b_rectangle = layers.rectangle[v, b]
    a_offset = layers.offset[v, a]
    b_offset = layers.offset[v, b]
    common = _overlap_rectangle(a_rectangle, b_rectangle)
    overlap_count = int(0)
    for row in range(common[3]):
        for column in range(common[2]):
            in_a = _layer_sample(common[1] + row, common[0] + column, a_rectangle, a_offset, layers)
            in_b = _layer_sample(common[1] + row, common[0] + column, b_rectangle, b_offset, layers)
            if in_a != wp.int32(0) and in_b != wp.int32(0):
                overlap_count += 1
    if overlap_count == 0:
        return
    a_median = _median_inverse_depth(a_rectangle, a_offset, b_rectangle, b_offset, False, layers)
    b_median = _median_inverse_depth(b_rectangle, b_offset, a_rectangle, a_offset, False, layers)
    if a_median == 0.0 or b_median == 0.0:
        a_median = _median_inverse_depth(a_rectangle, a_offset, b_rectangle, b_offset, True, layers)
        b_median = _median_inverse_depth(b_rectangle, b_offset, a_rectangle, a_offset, True, layers)
    if a_median > b_median:
        is_hidden_by[v, b, a] = 1
    else:
        is_hidden_by[v, a, b] = 1


@wp.kernel(enable_backward=False)
def hide_by_ordered_layers_kernel(
    # in
    layers: Layers,
    is_hidden_by: wp.array3d[wp.int32],
    foreground_layer: int,
    first_view: int,
    # out
    hiding_bits: wp.array[wp.int32],
    hiding_source: wp.array[wp.int32],
):
    """Pairwise occlusion: the silhouettes of all nearer objects and of the foreground hide an object.

    The foreground counts as nearest everywhere, as the ego vehicle in the thesis. Other occluders hide nothing.

    Launch: ``dim=(views of this chunk, object_count)``; one thread per pair. Not taped.
    Writes: the samples of the object's layer that something hides; the caller zeroes ``hiding_bits``.
    """
    chunk_view, object_index = wp.tid()
    v = first_view + chunk_view
    rectangle = layers.rectangle[v, object_index]
    offset = layers.offset[v, object_index]
    for other in range(layers.rectangle.shape[1]):
        hides = other == foreground_layer
        if other != foreground_layer:
            hides = is_hidden_by[v, object_index, other] == 1
        if hides:
            other_rectangle = layers.rectangle[v, other]
            other_offset = layers.offset[v, other]
            common = _overlap_rectangle(rectangle, other_rectangle)
            for row in range(common[3]):
                for column in range(common[2]):
                    bits = _layer_sample(common[1] + row, common[0] + column, other_rectangle, other_offset, layers)
                    if bits != wp.int32(0):
                        place = (
                            offset + (common[1] + row - rectangle[1]) * rectangle[2] + common[0] + column - rectangle[0]
                        )
                        if bits > hiding_bits[place]:
                            hiding_bits[place] = bits
                            hiding_source[place] = -1 - other
