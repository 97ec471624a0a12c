"""Decide: which samples of a layer are hidden, and how far away the surface is that hides them.

The result has the layout of the layers: the bits of 1/z of the hiding surface, 0 where nothing hides the layer's
object. It is filled outside the object's silhouette as well, because a boundary needs the depth on both of its sides.
"""

import warp as wp

from warpav_kernels.view import inverse_depth_of

wp.set_module_options({"enable_backward": False})

MEDIAN_STEPS = wp.constant(12)  # bisection of the range of inverse depths: a 4096th of it is enough to compare


@wp.kernel(enable_backward=False)
def hide_by_nearest_surface_kernel(
    # in
    key: wp.array3d[wp.int64],
    triangle_object: wp.array[wp.int32],
    layer_object: wp.array[wp.int32],
    layer_rectangle: wp.array2d[wp.vec4i],
    layer_offset: wp.array2d[wp.int32],
    first_view: int,
    # out
    hiding_bits: wp.array[wp.int32],
):
    """Exact occlusion: whatever is nearest in the joint key buffer and belongs to another object hides the layer.

    Launch: ``dim=(views of this chunk, layer_count)``; one thread per pair. Not taped.
    Writes: every element of the layers of these views once.
    """
    chunk_view, layer = wp.tid()
    v = first_view + chunk_view
    rectangle = layer_rectangle[v, layer]
    offset = layer_offset[v, layer]
    for row in range(rectangle[3]):
        for column in range(rectangle[2]):
            nearest = key[v, rectangle[1] + row, rectangle[0] + column]
            bits = wp.int32(0)
            if nearest != wp.int64(0):
                if triangle_object[wp.int32(nearest & wp.int64(0xFFFFFFFF))] != layer_object[layer]:
                    bits = wp.int32(nearest >> wp.int64(32))
            hiding_bits[offset + row * rectangle[2] + column] = bits


@wp.func
def overlap_rectangle(a: wp.vec4i, b: wp.vec4i) -> wp.vec4i:
    """Samples that two rectangles (first column, first row, columns, rows) share; may have 0 columns or rows."""
    left = wp.max(a[0], b[0])
    top = wp.max(a[1], b[1])
    columns = wp.max(wp.min(a[0] + a[2], b[0] + b[2]) - left, 0)
    rows = wp.max(wp.min(a[1] + a[3], b[1] + b[3]) - top, 0)
    return wp.vec4i(left, top, columns, rows)


@wp.func
def layer_sample(row: int, column: int, rectangle: wp.vec4i, offset: int, layer_bits: wp.array[wp.int32]) -> wp.int32:
    """Bits of a layer at a sample of the grid; 0 outside its rectangle."""
    r = row - rectangle[1]
    c = column - rectangle[0]
    if r < 0 or c < 0 or r >= rectangle[3] or c >= rectangle[2]:
        return wp.int32(0)
    return layer_bits[offset + r * rectangle[2] + c]


@wp.func
def median_inverse_depth(
    own_rectangle: wp.vec4i,
    own_offset: int,
    other_rectangle: wp.vec4i,
    other_offset: int,
    shared: bool,
    layer_bits: wp.array[wp.int32],
) -> float:
    """Median inverse depth of the samples that another object does (``shared``) or does not cover; 0: none."""
    low = float(1.0e9)
    high = float(0.0)
    count = int(0)
    for row in range(own_rectangle[3]):
        for column in range(own_rectangle[2]):
            own = layer_bits[own_offset + row * own_rectangle[2] + column]
            if own != wp.int32(0):
                other = layer_sample(
                    own_rectangle[1] + row, own_rectangle[0] + column, other_rectangle, other_offset, layer_bits
                )
                if (other != wp.int32(0)) == shared:
                    low = wp.min(low, inverse_depth_of(own))
                    high = wp.max(high, inverse_depth_of(own))
                    count += 1
    if count == 0:
        return 0.0
    for _ in range(MEDIAN_STEPS):
        middle = 0.5 * (low + high)
        below = int(0)
        for row in range(own_rectangle[3]):
            for column in range(own_rectangle[2]):
                own = layer_bits[own_offset + row * own_rectangle[2] + column]
                if own != wp.int32(0) and inverse_depth_of(own) < middle:
                    other = layer_sample(
                        own_rectangle[1] + row, own_rectangle[0] + column, other_rectangle, other_offset, layer_bits
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
    layer_rectangle: wp.array2d[wp.vec4i],
    layer_offset: wp.array2d[wp.int32],
    layer_bits: wp.array[wp.int32],
    vehicle_count: int,
    first_view: int,
    # out
    is_hidden_by: wp.array3d[wp.int32],
):
    """The thesis's pairwise occlusion: of two vehicles whose silhouettes overlap, the nearer one hides the other.

    "Nearer" compares the median depths of the areas that do not overlap; where one silhouette lies wholly inside the
    other, the medians inside the overlap (the thesis leaves that case open).

    Launch: ``dim=(views of this chunk, vehicle_count, vehicle_count)``; thread (v, a, b) with b <= a does nothing. Not
    taped.
    Writes: ``is_hidden_by[v, a, b]`` = 1 where a is hidden by b; the caller zeroes it.
    """
    chunk_view, a, b = wp.tid()
    if b <= a:
        return
    v = first_view + chunk_view
    a_rectangle = layer_rectangle[v, a]
    b_rectangle = layer_rectangle[v, b]
    a_offset = layer_offset[v, a]
    b_offset = layer_offset[v, b]
    common = overlap_rectangle(a_rectangle, b_rectangle)
    overlap_count = int(0)
    for row in range(common[3]):
        for column in range(common[2]):
            in_a = layer_sample(common[1] + row, common[0] + column, a_rectangle, a_offset, layer_bits)
            in_b = layer_sample(common[1] + row, common[0] + column, b_rectangle, b_offset, layer_bits)
            if in_a != wp.int32(0) and in_b != wp.int32(0):
                overlap_count += 1
    if overlap_count == 0:
        return
    a_median = median_inverse_depth(a_rectangle, a_offset, b_rectangle, b_offset, False, layer_bits)
    b_median = median_inverse_depth(b_rectangle, b_offset, a_rectangle, a_offset, False, layer_bits)
    if a_median == 0.0 or b_median == 0.0:
        a_median = median_inverse_depth(a_rectangle, a_offset, b_rectangle, b_offset, True, layer_bits)
        b_median = median_inverse_depth(b_rectangle, b_offset, a_rectangle, a_offset, True, layer_bits)
    if a_median > b_median:
        is_hidden_by[v, b, a] = 1
    else:
        is_hidden_by[v, a, b] = 1


@wp.kernel(enable_backward=False)
def hide_by_ordered_layers_kernel(
    # in
    layer_rectangle: wp.array2d[wp.vec4i],
    layer_offset: wp.array2d[wp.int32],
    layer_bits: wp.array[wp.int32],
    is_hidden_by: wp.array3d[wp.int32],
    ego_layer: int,
    first_view: int,
    # out
    hiding_bits: wp.array[wp.int32],
):
    """Pairwise occlusion: the silhouettes of all nearer vehicles and of the ego vehicle hide a vehicle.

    The ego vehicle counts as nearest everywhere, as in the thesis. Buildings hide nothing.

    Launch: ``dim=(views of this chunk, vehicle_count)``; one thread per pair. Not taped.
    Writes: the samples of the vehicle's layer that something hides; the caller zeroes ``hiding_bits``.
    """
    chunk_view, vehicle = wp.tid()
    v = first_view + chunk_view
    rectangle = layer_rectangle[v, vehicle]
    offset = layer_offset[v, vehicle]
    for other in range(layer_rectangle.shape[1]):
        hides = other == ego_layer
        if other != ego_layer:
            hides = is_hidden_by[v, vehicle, other] == 1
        if hides:
            other_rectangle = layer_rectangle[v, other]
            other_offset = layer_offset[v, other]
            common = overlap_rectangle(rectangle, other_rectangle)
            for row in range(common[3]):
                for column in range(common[2]):
                    bits = layer_sample(common[1] + row, common[0] + column, other_rectangle, other_offset, layer_bits)
                    if bits != wp.int32(0):
                        place = (
                            offset + (common[1] + row - rectangle[1]) * rectangle[2] + common[0] + column - rectangle[0]
                        )
                        hiding_bits[place] = wp.max(hiding_bits[place], bits)
