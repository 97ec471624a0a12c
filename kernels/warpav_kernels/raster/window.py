"""Measure: solid angles of objects inside a soft window of directions, with their Jacobians.

A window is the field of view of another camera at the same place, made soft: in azimuth a and elevation e, counted from
the axis of the view (a to its left, e upwards),

    W = s((w + a') / t) s((w - a') / t) s((h + e') / t) s((h - e') / t),   s(x) = 1 / (1 + exp(-x)),

with a' and e' from the window's centre, a' wrapped to half a turn on either side, half width w, half height h, and
softness t. The measure is the integral of W over the directions in which a mask is seen: the sum over its samples of W
times the sample's own solid angle. So it neither depends on the lens nor, as long as the mask lies in the image, on
where the view looks.

To the pose, the Jacobian is that of an area weighted by W times the solid angle of a sample (see `measure`). To the
window it is the sum of the derivatives of W. A zoom moves no direction: only what the image's border cuts changes, by
what the border sweeps.
"""

import warp as wp

from warpav_kernels.raster._layers import Layers
from warpav_kernels.raster._measure import BoundaryDerivative, frame_weight, with_step
from warpav_kernels.raster._outline import (
    Hiding,
    cell_of,
    cell_segment,
    is_in_mask,
    mask_corners,
    pair_of,
    segment_cuts,
)
from warpav_kernels.raster._triangles import Triangles
from warpav_kernels.raster._view import GUARD, View, ray_in_camera, solid_angle

wp.set_module_options({"enable_backward": False})

_vec5 = wp.types.vector(length=5, dtype=float)

_FAR_EDGE = wp.constant(20.0)  # softnesses away, where a logistic edge is 1 to the last bit


@wp.func
def _soft_edges(offset: float, half: float, softness: float) -> wp.vec3:
    """Product of two logistic edges at -half and half: its value, and its derivatives to the offset and to half."""
    low = 1.0 / (1.0 + wp.exp(-(half + offset) / softness))
    high = 1.0 / (1.0 + wp.exp(-(half - offset) / softness))
    value = low * high
    return wp.vec3(value, value * (high - low) / softness, value * (2.0 - high - low) / softness)


@wp.func
def _window_density(camera: View, column: float, row: float, window_rad: wp.vec4, softness_rad: float) -> _vec5:
    """Weighted solid angle of a sample at a place of the grid [sr], and its derivatives to the window [sr/rad].

    A window is the azimuth and the elevation of its centre, its half width and its half height.
    """
    ray = ray_in_camera(camera, column, row)
    if wp.length_sq(ray) == 0.0:
        return _vec5(0.0, 0.0, 0.0, 0.0, 0.0)
    if wp.min(window_rad[2], window_rad[3]) > 2.0 * wp.pi + _FAR_EDGE * softness_rad:
        return _vec5(solid_angle(camera, ray), 0.0, 0.0, 0.0, 0.0)
    azimuth = wp.atan2(-ray[0], ray[2]) - window_rad[0]
    azimuth -= 2.0 * wp.pi * wp.floor(azimuth / (2.0 * wp.pi) + 0.5)
    elevation = wp.atan2(-ray[1], wp.sqrt(ray[0] * ray[0] + ray[2] * ray[2])) - window_rad[1]
    wide = _soft_edges(azimuth, window_rad[2], softness_rad)
    high = _soft_edges(elevation, window_rad[3], softness_rad)
    return solid_angle(camera, ray) * _vec5(
        wide[0] * high[0], -wide[1] * high[0], -wide[0] * high[1], wide[2] * high[0], wide[0] * high[2]
    )


@wp.func
def _border_sweep(
    camera: View, column: int, row: int, width: int, height: int, window_rad: wp.vec4, softness_rad: float
) -> float:
    """What the image's border takes from the measure in a sample under a relative zoom [sr]; 0 away from the border."""
    x = float(column) + 0.5
    y = float(row) + 0.5
    swept = float(0.0)
    for side in range(2):
        border_column = GUARD + side * (width - 2 * GUARD)
        if column == border_column - side:
            density = _window_density(camera, float(border_column), y, window_rad, softness_rad)
            swept += density[0] * wp.abs(float(border_column) - camera.centre[0])
        border_row = GUARD + side * (height - 2 * GUARD)
        if row == border_row - side:
            density = _window_density(camera, x, float(border_row), window_rad, softness_rad)
            swept += density[0] * wp.abs(float(border_row) - camera.centre[1])
    return swept


@wp.kernel(enable_backward=False)
def measure_window_kernel(
    # in
    view: wp.array[View],
    scene: Triangles,
    layers: Layers,
    hiding: Hiding,
    window_rad: wp.array[wp.vec4],
    softness_rad: float,
    kind: int,
    width: int,
    height: int,
    first_view: int,
    row_lanes: int,
    column_lanes: int,
    # out
    derivative: wp.array4d[BoundaryDerivative],
    window_derivative: wp.array3d[wp.vec4],
):
    """Solid angle of one object in one view inside the view's window, and its derivatives, over one lane's samples.

    Launch: ``dim=(views of this chunk, object_count, row_lanes * column_lanes)``. Not taped.
    Writes: ``derivative`` [view, object, 0, lane] and ``window_derivative`` [view, object, lane] of these views.
    """
    chunk_view, object_index, lane = wp.tid()
    v = first_view + chunk_view
    camera = view[v]
    pair = pair_of(v, object_index, layers)
    window = window_rad[v]
    seen = BoundaryDerivative()
    jac_window = wp.vec4(0.0, 0.0, 0.0, 0.0)
    zoom = float(0.0)
    for row in range(lane / column_lanes, pair.rectangle[3], row_lanes):
        for column in range(lane % column_lanes, pair.rectangle[2], column_lanes):
            if is_in_mask(pair, row, column, kind, layers, hiding):
                grid_row = pair.rectangle[1] + row
                grid_column = pair.rectangle[0] + column
                x = float(grid_column) + 0.5
                y = float(grid_row) + 0.5
                if frame_weight(x, y, width, height) > 0.0:
                    density = _window_density(camera, x, y, window, softness_rad)
                    seen.area += density[0]
                    jac_window += wp.vec4(density[1], density[2], density[3], density[4])
                    zoom -= _border_sweep(camera, grid_column, grid_row, width, height, window, softness_rad)
            mask = mask_corners(pair, row, column, kind, layers, hiding)
            if mask != 0 and mask != 15:
                cell = cell_of(camera, pair, row, column, mask)
                for index in range(cell.segment_count):
                    segment = cell_segment(cell, index, pair, kind, camera, scene, layers, hiding, width, height)
                    cut = segment_cuts(segment)
                    extent = segment.end - segment.start
                    weight = float(0.0)
                    for k in range(3):
                        middle = segment.start + 0.5 * (cut[k] + cut[k + 1]) * extent
                        if frame_weight(middle[0], middle[1], width, height) > 0.0:
                            density = _window_density(camera, middle[0], middle[1], window, softness_rad)
                            weight += (cut[k + 1] - cut[k]) * density[0]
                    seen = with_step(seen, camera, scene, segment, weight * extent[1], -weight * extent[0])
    # an outline keeps its directions; only the image's border does not
    seen.log_focal = zoom
    derivative[v, object_index, 0, lane] = seen
    window_derivative[v, object_index, lane] = jac_window


@wp.kernel(enable_backward=False)
def sum_window_derivatives_kernel(
    # in
    window_derivative: wp.array3d[wp.vec4],
    # out
    jac_window: wp.array2d[wp.vec4],
):
    """Sum the derivatives to the window over the lanes, in their order.

    Launch: ``dim=(view_count, object_count)``; one thread per sum. Not taped.
    Writes: every element of ``jac_window`` [sr/rad] once.
    """
    v, object_index = wp.tid()
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for lane in range(window_derivative.shape[2]):
        total += window_derivative[v, object_index, lane]
    jac_window[v, object_index] = total
