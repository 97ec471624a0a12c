"""Layers: what single objects cover when each stands alone, in one flat buffer for all views (the atlas).

A layer is a body whose silhouette is wanted alone: every object, and the foreground where it is asked for. The
foreground is one occluder that counts as nearest everywhere, such as the body that carries the cameras. The samples of
a layer are those of the rectangle that holds its image, cut out of the view's sample grid; all rectangles of all views
lie one behind the other.
"""

import warp as wp

from warpav_kernels.raster._lens import PANORAMA, PINHOLE, cone_bounds
from warpav_kernels.raster._view import View, point_in_camera

wp.set_module_options({"enable_backward": False})

# directions from a sample to its neighbours; the opposite of d is 3 - d
TO_LEFT = wp.constant(0)
TO_TOP = wp.constant(1)
TO_BOTTOM = wp.constant(2)
TO_RIGHT = wp.constant(3)

_BOX_PARTS = wp.constant(3)  # along each axis, into which an object's box is cut to bound its image

# Surroundings of an object: its extent in the image, enlarged on every side by this share of its size and so much more.
SURROUNDINGS_SHARE = wp.constant(0.25)
SURROUNDINGS_PX = wp.constant(2)

# 1/z of surfaces farther away [1/m]: 0 is where there are none
LEAST_INVERSE_DEPTH = wp.constant(1.0e-6)

# set in the lower half of an edge crossing's key where the near plane ends the surface
NEAR_CUT = wp.constant(wp.int64(0x80000000))


@wp.struct
class Layers:
    """The atlas of layers."""

    # First column, first row, columns, rows of every layer in every view, [view, layer]; 0 columns where the object is
    # out of sight
    rectangle: wp.array2d[wp.vec4i]
    offset: wp.array2d[wp.int32]  # place of the rectangle's first sample, [view, layer]
    # Bits of 1/z of the object's nearest surface at the sample's centre, 0 where it does not cover it, [sample]
    inverse_depth_bits: wp.array[wp.int32]
    # Where the object's surface ends between the sample's centre and each neighbour's: bits of the offset, 0..1 in
    # samples, solved from the edges of its triangles. In the lower half the bits of 1/z there; where the near plane
    # ends it, which triangle it cuts, with the highest bit set. 0 where all that is unknown, [direction, sample]
    crossing_key: wp.array2d[wp.int64]


@wp.func
def step_of(direction: int) -> wp.vec2i:
    """Row and column step to the neighbour in a direction."""
    if direction == TO_LEFT:
        return wp.vec2i(0, -1)
    if direction == TO_TOP:
        return wp.vec2i(-1, 0)
    if direction == TO_BOTTOM:
        return wp.vec2i(1, 0)
    return wp.vec2i(0, 1)


@wp.func
def place_in(rectangle: wp.vec4i, offset: int, row: int, column: int) -> int:
    """Place in the atlas of a sample of the grid; -1 outside the rectangle."""
    r = row - rectangle[1]
    c = column - rectangle[0]
    if r < 0 or c < 0 or r >= rectangle[3] or c >= rectangle[2]:
        return -1
    return offset + r * rectangle[2] + c


@wp.func
def point_on_near_plane(a: wp.vec3, b: wp.vec3, near_m: float) -> wp.vec3:
    """Where the edge from a to b (camera coordinates) crosses the near plane."""
    crossing = a + (near_m - a[2]) / (b[2] - a[2]) * (b - a)
    return wp.vec3(crossing[0], crossing[1], near_m)


@wp.func
def _grow_rectangle(rectangle: wp.vec4, point_m: wp.vec3, view: View) -> wp.vec4:
    """The rectangle (left, top, right, bottom) in samples, grown to hold the image of a point."""
    u = view.centre[0] + view.focal[0] * point_m[0] / point_m[2]
    v = view.centre[1] + view.focal[1] * point_m[1] / point_m[2]
    return wp.vec4(wp.min(rectangle[0], u), wp.min(rectangle[1], v), wp.max(rectangle[2], u), wp.max(rectangle[3], v))


@wp.func
def _box_corner(low: wp.vec3, high: wp.vec3, corner: int) -> wp.vec3:
    """Corner 0..7 of a box."""
    place = low
    if (corner & 1) != 0:
        place = wp.vec3(high[0], place[1], place[2])
    if (corner & 2) != 0:
        place = wp.vec3(place[0], high[1], place[2])
    if (corner & 4) != 0:
        place = wp.vec3(place[0], place[1], high[2])
    return place


@wp.func
def _pinhole_bounds(camera: View, low: wp.vec3, high: wp.vec3) -> wp.vec4:
    """Bounds (left, top, right, bottom) in samples of the image of a box in the world frame.

    The eight corners and, where the near plane cuts the box, its twelve edges are projected.
    """
    far = 1.0e9
    bounds = wp.vec4(far, far, -far, -far)
    for corner in range(8):
        a = point_in_camera(camera, _box_corner(low, high, corner))
        if a[2] >= camera.near_m:
            bounds = _grow_rectangle(bounds, a, camera)
        for axis in range(3):
            if (corner & (1 << axis)) == 0:
                b = point_in_camera(camera, _box_corner(low, high, corner | (1 << axis)))
                if (a[2] >= camera.near_m) != (b[2] >= camera.near_m):
                    bounds = _grow_rectangle(bounds, point_on_near_plane(a, b, camera.near_m), camera)
    return bounds


@wp.func
def _turned_bounds(left: float, right: float, turn: float, width: float) -> wp.vec2:
    """Columns of a panorama between two, whole turns added; all columns where more than one turn is in the image."""
    # begin at the last turn that lies left of the image
    shift = wp.floor(-right / turn) * turn
    left += shift
    right += shift
    found = wp.vec2(width, 0.0)
    count = int(0)
    for _ in range(3):
        if right >= -1.0 and left <= width + 1.0:
            found = wp.vec2(left, right)
            count += 1
        left += turn
        right += turn
    if count > 1:
        return wp.vec2(0.0, width)
    return found


@wp.func
def _lens_bounds(camera: View, low: wp.vec3, high: wp.vec3, width: float) -> wp.vec4:
    """Bounds (left, top, right, bottom) in samples of the image of a box in the world frame, seen through any lens.

    A box lies in the cone about its centre's direction that holds its corners. The smaller, the better the bounds.
    """
    far = 1.0e9
    bounds = wp.vec4(far, far, -far, -far)
    size = (high - low) / float(_BOX_PARTS)
    for part in range(_BOX_PARTS * _BOX_PARTS * _BOX_PARTS):
        x = float(part % _BOX_PARTS)
        y = float((part / _BOX_PARTS) % _BOX_PARTS)
        z = float(part / (_BOX_PARTS * _BOX_PARTS))
        part_low = low + wp.vec3(x * size[0], y * size[1], z * size[2])
        axis = point_in_camera(camera, part_low + 0.5 * size)
        half_angle = float(0.0)
        for corner in range(8):
            end = point_in_camera(camera, _box_corner(part_low, part_low + size, corner))
            half_angle = wp.max(half_angle, wp.atan2(wp.length(wp.cross(axis, end)), wp.dot(axis, end)))
        if half_angle >= 0.5 * wp.pi or wp.length_sq(axis) == 0.0:  # all about the camera
            return wp.vec4(-far, -far, far, far)
        place = cone_bounds(camera.lens, axis, half_angle)
        left = camera.centre[0] + camera.focal[0] * place[0]
        right = camera.centre[0] + camera.focal[0] * place[2]
        if right - left >= far:
            return wp.vec4(-far, -far, far, far)
        if camera.lens.kind == PANORAMA:
            columns = _turned_bounds(left, right, 2.0 * wp.pi * camera.focal[0], width)
            left = columns[0]
            right = columns[1]
        if left <= right:
            top = camera.centre[1] + camera.focal[1] * place[1]
            bottom = camera.centre[1] + camera.focal[1] * place[3]
            bounds = wp.vec4(
                wp.min(bounds[0], left), wp.min(bounds[1], top), wp.max(bounds[2], right), wp.max(bounds[3], bottom)
            )
    return bounds


@wp.kernel(enable_backward=False)
def place_layers_kernel(
    # in
    view: wp.array[View],
    layer_bounds_world_m: wp.array2d[wp.vec3],
    width: int,
    height: int,
    capacity: wp.int64,
    # out
    layer_rectangle: wp.array2d[wp.vec4i],
    layer_offset: wp.array2d[wp.int32],
    sample_count: wp.array[wp.int64],
    needed_samples: wp.array[wp.int64],
):
    """Rectangle of samples that surely holds each layer's image, one sample wider than needed on every side.

    Rectangles get their places in the atlas in any order; one that goes beyond its capacity is shut.

    Launch: ``dim=(view_count, layer_count)``; one thread per pair. Not taped.
    Writes: every element of ``layer_rectangle`` and ``layer_offset`` once; the samples of this render to
        ``sample_count[0]`` by atomic add, the caller zeroes it; the most samples of any render so far to
        ``needed_samples[0]`` by atomic maximum.
    """
    v, layer = wp.tid()
    camera = view[v]
    low = layer_bounds_world_m[layer, 0]
    high = layer_bounds_world_m[layer, 1]
    box = _pinhole_bounds(camera, low, high)
    if camera.lens.kind != PINHOLE:
        box = _lens_bounds(camera, low, high, float(width))
    # clamp in float: the cast of a huge float to an integer is undefined
    left = int(wp.floor(wp.clamp(box[0] - 1.0, 0.0, float(width))))
    top = int(wp.floor(wp.clamp(box[1] - 1.0, 0.0, float(height))))
    right = int(wp.ceil(wp.clamp(box[2] + 1.0, 0.0, float(width))))
    bottom = int(wp.ceil(wp.clamp(box[3] + 1.0, 0.0, float(height))))
    layer_rectangle[v, layer] = wp.vec4i(0, 0, 0, 0)
    layer_offset[v, layer] = 0
    if right > left and bottom > top:
        size = wp.int64(right - left) * wp.int64(bottom - top)
        offset = wp.atomic_add(sample_count, 0, size)
        wp.atomic_max(needed_samples, 0, offset + size)
        if offset + size <= capacity:
            layer_rectangle[v, layer] = wp.vec4i(left, top, right - left, bottom - top)
            layer_offset[v, layer] = wp.int32(offset)


@wp.kernel(enable_backward=False)
def place_scissors_kernel(
    # in
    layer_rectangle: wp.array2d[wp.vec4i],
    object_count: int,
    is_whole: int,
    width: int,
    height: int,
    supersampling: int,
    # out
    scissor: wp.array[wp.vec4i],
):
    """The part of each view's sample grid that is rendered: all of it, or what surely holds the objects' surroundings.

    As first column, first row, and those after the last; all 0 where no object is in sight.

    Launch: ``dim=view_count``; one thread per view. Not taped.
    Writes: every element of ``scissor`` once.
    """
    v = wp.tid()
    if is_whole == 1:
        scissor[v] = wp.vec4i(0, 0, width, height)
        return
    left = width
    top = height
    right = int(0)
    bottom = int(0)
    for layer in range(object_count):
        rectangle = layer_rectangle[v, layer]
        if rectangle[2] > 0:
            # a pixel more, as colours are those of whole pixels
            margin = (SURROUNDINGS_PX + 1) * supersampling + 1
            wide = margin + int(SURROUNDINGS_SHARE * float(rectangle[2]))
            high = margin + int(SURROUNDINGS_SHARE * float(rectangle[3]))
            left = wp.min(left, rectangle[0] - wide)
            top = wp.min(top, rectangle[1] - high)
            right = wp.max(right, rectangle[0] + rectangle[2] + wide)
            bottom = wp.max(bottom, rectangle[1] + rectangle[3] + high)
    scissor[v] = wp.vec4i(0, 0, 0, 0)
    if left < right:
        scissor[v] = wp.vec4i(wp.max(left, 0), wp.max(top, 0), wp.min(right, width), wp.min(bottom, height))
