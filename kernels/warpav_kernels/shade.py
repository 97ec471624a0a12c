"""Measure: images read from the key buffer: depth, object and colour of every pixel."""

import warp as wp

from warpav_kernels.rasterise import Triangles
from warpav_kernels.view import GUARD, View, inverse_depth_of, ray_in_camera

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def resolve_depth_kernel(
    # in
    key: wp.array3d[wp.int64],
    scene: Triangles,
    supersampling: int,
    first_view: int,
    # out
    depth_m: wp.array3d[float],
    object_index: wp.array3d[wp.int32],
):
    """Depth and object at the sample nearest to every pixel's centre.

    Launch: ``dim=(views of this chunk, height_px, width_px)``; one thread per pixel. Not taped.
    Writes: every element of ``depth_m`` [m], +inf where nothing is hit, and of ``object_index``, -1 there, of these
    views.
    """
    chunk_view, row, column = wp.tid()
    v = first_view + chunk_view
    nearest = key[
        v,
        GUARD + row * supersampling + supersampling / 2,
        GUARD + column * supersampling + supersampling / 2,
    ]
    if nearest == wp.int64(0):
        depth_m[v, row, column] = wp.inf
        object_index[v, row, column] = -1
    else:
        depth_m[v, row, column] = 1.0 / inverse_depth_of(wp.int32(nearest >> wp.int64(32)))
        object_index[v, row, column] = scene.triangle_object[wp.int32(nearest & wp.int64(0xFFFFFFFF))]


@wp.func
def sky_rgb(horizon_rgb: wp.vec3, zenith_rgb: wp.vec3, elevation_sine: float) -> wp.vec3:
    """Colour of the sky in a direction: the horizon's below and at the horizon, the zenith's overhead."""
    t = wp.clamp(elevation_sine, 0.0, 1.0)
    share = 1.0 - (1.0 - t) * (1.0 - t)
    return (1.0 - share) * horizon_rgb + share * zenith_rgb


@wp.kernel(enable_backward=False)
def resolve_rgb_kernel(
    # in
    view: wp.array[View],
    scene: Triangles,
    vertex_rgb: wp.array[wp.vec3],
    horizon_rgb: wp.vec3,
    zenith_rgb: wp.vec3,
    key: wp.array3d[wp.int64],
    shown_view: wp.array[wp.int32],
    supersampling: int,
    first_image: int,
    # out
    rgb: wp.array3d[wp.vec3],
):
    """Unlit vertex colours, interpolated in perspective at every sample and averaged over the pixel.

    Launch: ``dim=(images of this chunk, height_px, width_px)``; one thread per pixel. Image i shows view
    ``shown_view[i]``. Not taped.
    Writes: every element of ``rgb`` [image, row, column], 0..1, of these images once.
    """
    chunk_image, row, column = wp.tid()
    image = first_image + chunk_image
    v = shown_view[image]
    camera = view[v]
    total = wp.vec3(0.0, 0.0, 0.0)
    ego_from_camera = wp.transpose(camera.camera_from_ego)
    for sample in range(supersampling * supersampling):
        grid_row = GUARD + row * supersampling + sample / supersampling
        grid_column = GUARD + column * supersampling + sample % supersampling
        # one ray turned into ego axes is cheaper than three corners turned into camera axes
        ray = ego_from_camera * ray_in_camera(camera, float(grid_column) + 0.5, float(grid_row) + 0.5)
        nearest = key[v, grid_row, grid_column]
        if nearest == wp.int64(0):
            total += sky_rgb(horizon_rgb, zenith_rgb, ray[2] / wp.length(ray))
        else:
            corner = scene.triangle[wp.int32(nearest & wp.int64(0xFFFFFFFF))]
            a = scene.vertex_ego_m[corner[0]] - camera.position_ego_m
            b = scene.vertex_ego_m[corner[1]] - camera.position_ego_m
            c = scene.vertex_ego_m[corner[2]] - camera.position_ego_m
            # barycentric coordinates of the ray's hit, up to a common factor
            share_a = wp.dot(ray, wp.cross(b, c))
            share_b = wp.dot(ray, wp.cross(c, a))
            share_c = wp.dot(ray, wp.cross(a, b))
            whole = share_a + share_b + share_c
            total += (
                share_a * vertex_rgb[corner[0]] + share_b * vertex_rgb[corner[1]] + share_c * vertex_rgb[corner[2]]
            ) / whole
    colour = total / float(supersampling * supersampling)
    rgb[image, row, column] = wp.vec3(
        wp.clamp(colour[0], 0.0, 1.0), wp.clamp(colour[1], 0.0, 1.0), wp.clamp(colour[2], 0.0, 1.0)
    )
