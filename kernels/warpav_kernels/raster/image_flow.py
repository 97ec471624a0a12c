"""Measure: how colour and depth images change with their views, from the gradient to an image to that of the views.

A static scene, coloured alike from all sides, is carried along in the image by the image flow. At every place

    dI/dt = -(grad I . flow) + dI/dt of the surface's point itself,

jumps of I included, if the flow there is that of the nearer surface. Colours stay with their points; depths change
with them. For a loss with gradient A to the image, summed over neighbouring samples p and q = p + step,

    dL/dt = sum over pairs of (I_p - I_q) . (A_p + A_q) / 2 x (flow at the middle of the pair along its step)
            + sum over samples of A_p x (change of the depth of the point seen at p), for depths only.

Outlines are no special case: a pair across one holds a large difference and little else. A and I are those of samples,
so a pixel's gradient is shared equally by its samples. The sky is infinitely far: it flows under rotation and zoom
only. Where the near plane cuts a surface the cut is taken for a part of the surface.

Perturbations, Jacobians and sums in a fixed order are those of `measure`.
"""

import warp as wp

from warpav_kernels.raster._measure import BoundaryDerivative, derivative_of_lanes
from warpav_kernels.raster._shade import Patch, patch_under, rgb_along
from warpav_kernels.raster._triangles import Triangles
from warpav_kernels.raster._view import (
    GUARD,
    View,
    column_gradient,
    depth_gradient,
    inverse_depth_of,
    ray_in_camera,
    row_gradient,
    sample_ray,
    sees,
)

wp.set_module_options({"enable_backward": False})

_LARGEST_GROWTH = wp.constant(0.1)  # of 1/z from one sample to the next on one surface


@wp.func
def _inverse_depth_at(key: wp.array3d[wp.int64], v: int, row: int, column: int) -> float:
    """1/z of the nearest surface at a sample [1/m]; 0 for the sky."""
    return inverse_depth_of(wp.int32(key[v, row, column] >> wp.int64(32)))


@wp.func
def _front_inverse_depth(key: wp.array3d[wp.int64], v: int, row: int, column: int, step: wp.vec2i) -> float:
    """1/z of the nearer surface at the middle between a sample and the next in a direction (rows, columns) [1/m].

    1/z is linear on a plane: it is the nearer sample's, carried on by half of its growth from the sample before.
    """
    near = _inverse_depth_at(key, v, row, column)
    before_row = row - step[0]
    before_column = column - step[1]
    there = _inverse_depth_at(key, v, row + step[0], column + step[1])
    if there > near:
        near = there
        before_row = row + 2 * step[0]
        before_column = column + 2 * step[1]
    if before_row < 0 or before_column < 0 or before_row >= key.shape[1] or before_column >= key.shape[2]:
        return near
    growth = near - _inverse_depth_at(key, v, before_row, before_column)
    return near + 0.5 * wp.clamp(growth, -_LARGEST_GROWTH * near, _LARGEST_GROWTH * near)


@wp.func
def _with_pair(
    derivative: BoundaryDerivative,
    camera: View,
    key: wp.array3d[wp.int64],
    v: int,
    row: int,
    column: int,
    step: wp.vec2i,
    change: float,
) -> BoundaryDerivative:
    """The derivative with the pair of a sample and the next in a direction; ``change`` weighs the flow along the step.

    The edge of what a lens sees stays where it is in the image.
    """
    if change == 0.0:
        return derivative
    if not sees(camera, row, column) or not sees(camera, row + step[0], column + step[1]):
        return derivative
    x = float(column) + 0.5 + 0.5 * float(step[1])
    y = float(row) + 0.5 + 0.5 * float(step[0])
    ray = ray_in_camera(camera, x, y)
    # the gradient at the point of depth 1 on the ray; it falls off with the depth
    g = change * column_gradient(camera, ray)
    away = x - camera.centre[0]
    if step[0] != 0:
        g = change * row_gradient(camera, ray)
        away = y - camera.centre[1]
    moved = derivative
    moved.gradient += _front_inverse_depth(key, v, row, column, step) * g
    moved.moment += wp.cross(ray, g)
    moved.log_focal += change * away
    return moved


@wp.func
def _pixel_of(sample: int, size: int, samples_per_px: int) -> int:
    """Row (or column) of the pixels that holds a row of samples; -1 in the guard band. ``size`` is the grid's."""
    if sample < GUARD or sample >= size - GUARD:
        return -1
    return (sample - GUARD) / samples_per_px


@wp.func
def _rgb_gradient_at(gradient: wp.array3d[wp.vec3], image: int, row_px: int, column_px: int) -> wp.vec3:
    """The gradient to a pixel's colour; 0 in the guard band."""
    if row_px < 0 or column_px < 0:
        return wp.vec3(0.0, 0.0, 0.0)
    return gradient[image, row_px, column_px]


@wp.func
def _depth_gradient_at(gradient: wp.array3d[float], v: int, row_px: int, column_px: int) -> float:
    """The gradient to a pixel's depth; 0 in the guard band."""
    if row_px < 0 or column_px < 0:
        return 0.0
    return gradient[v, row_px, column_px]


@wp.func
def _depth_at(key: wp.array3d[wp.int64], v: int, row: int, column: int, background_m: float) -> float:
    """Depth of the nearest surface at a sample [m]."""
    w = _inverse_depth_at(key, v, row, column)
    if w == 0.0:
        return background_m
    return 1.0 / w


@wp.kernel(enable_backward=False)
def flow_colours_kernel(
    # in
    view: wp.array[View],
    scene: Triangles,
    vertex_rgb: wp.array[wp.vec3],
    horizon_rgb: wp.vec3,
    zenith_rgb: wp.vec3,
    key: wp.array3d[wp.int64],
    shown_view: wp.array[wp.int32],
    rgb_gradient: wp.array3d[wp.vec3],
    supersampling: int,
    first_image: int,
    row_lanes: int,
    column_lanes: int,
    # out
    derivative: wp.array4d[BoundaryDerivative],
):
    """What the gradient to a colour image says about its view, over one lane's samples and their next ones.

    A lane walks along its part of every ``row_lanes``-th row: the colour to the right is the next one's own.

    Launch: ``dim=(images of this chunk, row_lanes * column_lanes)``. Not taped.
    Writes: ``derivative`` [image, 0, 0, lane] of these images.
    """
    chunk_image, lane = wp.tid()
    image = first_image + chunk_image
    v = shown_view[image]
    camera = view[v]
    width = key.shape[2]
    height = key.shape[1]
    run = (width + column_lanes - 1) / column_lanes
    first_column = (lane % column_lanes) * run
    total = BoundaryDerivative()
    patch = Patch()
    patch.triangle = -1
    below_patch = Patch()
    below_patch.triangle = -1
    right_rgb = wp.vec3(0.0, 0.0, 0.0)
    right_gradient = wp.vec3(0.0, 0.0, 0.0)
    for row in range(lane / column_lanes, height, row_lanes):
        row_px = _pixel_of(row, height, supersampling)
        below_px = _pixel_of(row + 1, height, supersampling)
        for column in range(first_column, wp.min(first_column + run, width)):
            column_px = _pixel_of(column, width, supersampling)
            rgb = right_rgb
            gradient = right_gradient
            if column == first_column:
                patch = patch_under(patch, key[v, row, column], camera, scene, vertex_rgb)
                ray = sample_ray(camera, row, column)
                rgb = rgb_along(camera, ray, key[v, row, column], patch, horizon_rgb, zenith_rgb)
                gradient = _rgb_gradient_at(rgb_gradient, image, row_px, column_px)
            if row + 1 < height:
                nearest = key[v, row + 1, column]
                below_patch = patch_under(below_patch, nearest, camera, scene, vertex_rgb)
                ray = sample_ray(camera, row + 1, column)
                below_rgb = rgb_along(camera, ray, nearest, below_patch, horizon_rgb, zenith_rgb)
                below_gradient = _rgb_gradient_at(rgb_gradient, image, below_px, column_px)
                change = 0.5 * wp.dot(rgb - below_rgb, gradient + below_gradient)
                total = _with_pair(total, camera, key, v, row, column, wp.vec2i(1, 0), change)
            if column + 1 < width:
                nearest = key[v, row, column + 1]
                patch = patch_under(patch, nearest, camera, scene, vertex_rgb)
                ray = sample_ray(camera, row, column + 1)
                right_rgb = rgb_along(camera, ray, nearest, patch, horizon_rgb, zenith_rgb)
                right_px = _pixel_of(column + 1, width, supersampling)
                right_gradient = _rgb_gradient_at(rgb_gradient, image, row_px, right_px)
                change = 0.5 * wp.dot(rgb - right_rgb, gradient + right_gradient)
                total = _with_pair(total, camera, key, v, row, column, wp.vec2i(0, 1), change)
    derivative[image, 0, 0, lane] = total


@wp.kernel(enable_backward=False)
def flow_depths_kernel(
    # in
    view: wp.array[View],
    key: wp.array3d[wp.int64],
    depth_gradient_px: wp.array3d[float],
    background_m: float,
    supersampling: int,
    first_view: int,
    row_lanes: int,
    column_lanes: int,
    # out
    derivative: wp.array4d[BoundaryDerivative],
):
    """What the gradient to a depth image says about its view, over one lane's samples and their next ones.

    Launch: ``dim=(views of this chunk, row_lanes * column_lanes)``. Not taped.
    Writes: ``derivative`` [view, 0, 0, lane] of these views.
    """
    chunk_view, lane = wp.tid()
    v = first_view + chunk_view
    camera = view[v]
    width = key.shape[2]
    height = key.shape[1]
    run = (width + column_lanes - 1) / column_lanes
    first_column = (lane % column_lanes) * run
    total = BoundaryDerivative()
    for row in range(lane / column_lanes, height, row_lanes):
        row_px = _pixel_of(row, height, supersampling)
        below_px = _pixel_of(row + 1, height, supersampling)
        for column in range(first_column, wp.min(first_column + run, width)):
            column_px = _pixel_of(column, width, supersampling)
            gradient = _depth_gradient_at(depth_gradient_px, v, row_px, column_px)
            depth_m = _depth_at(key, v, row, column, background_m)
            if gradient != 0.0 and key[v, row, column] != wp.int64(0):
                point_m = depth_m * sample_ray(camera, row, column)
                g = gradient * depth_gradient(camera, point_m)
                total.gradient += g
                total.moment += wp.cross(point_m, g)
            if row + 1 < height:
                below_m = _depth_at(key, v, row + 1, column, background_m)
                below_gradient = _depth_gradient_at(depth_gradient_px, v, below_px, column_px)
                change = 0.5 * (depth_m - below_m) * (gradient + below_gradient)
                total = _with_pair(total, camera, key, v, row, column, wp.vec2i(1, 0), change)
            if column + 1 < width:
                right_m = _depth_at(key, v, row, column + 1, background_m)
                right_px = _pixel_of(column + 1, width, supersampling)
                right_gradient = _depth_gradient_at(depth_gradient_px, v, row_px, right_px)
                change = 0.5 * (depth_m - right_m) * (gradient + right_gradient)
                total = _with_pair(total, camera, key, v, row, column, wp.vec2i(0, 1), change)
    derivative[v, 0, 0, lane] = total


@wp.kernel(enable_backward=False)
def add_view_gradient_kernel(
    # in
    view: wp.array[View],
    shown_view: wp.array[wp.int32],
    derivative: wp.array4d[BoundaryDerivative],
    supersampling: int,
    # out
    position_gradient: wp.array[wp.vec3],
    rotation_gradient: wp.array[wp.mat33],
    log_focal_gradient: wp.array[float],
):
    """Sum what the lanes have found, in their order, and add it to the gradients to every view's pose and focal length.

    A rotation R turned by a small spin s is R + [s]x R, so a gradient m to the spin is the gradient [m]x R / 2 to R.

    Launch: ``dim=view_count``; one thread per view. Not taped.
    Writes: adds to the elements of the three gradients of the views that an image shows.
    """
    v = wp.tid()
    per_sample = 1.0 / (float(supersampling) * float(supersampling))
    rotation = view[v].camera_from_world
    for image in range(shown_view.shape[0]):
        if shown_view[image] == v:
            total = derivative_of_lanes(derivative, image, 0, 0, 0, derivative.shape[3])
            position_gradient[v] = position_gradient[v] - per_sample * (wp.transpose(rotation) * total.gradient)
            rotation_gradient[v] = rotation_gradient[v] + 0.5 * per_sample * (wp.skew(total.moment) * rotation)
            log_focal_gradient[v] = log_focal_gradient[v] + per_sample * total.log_focal
