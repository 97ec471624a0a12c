"""Measure: images read from the key buffer: depth, object and colour of every pixel."""

import warp as wp

from warpav_kernels.raster._layers import SURROUNDINGS_PX, SURROUNDINGS_SHARE, Layers
from warpav_kernels.raster._measure import BOTTOM, LEFT, RIGHT, TOP, VISIBLE_AREA
from warpav_kernels.raster._outline import Hiding, is_in_mask, pair_of
from warpav_kernels.raster._triangles import Triangles
from warpav_kernels.raster._view import GUARD, View, point_in_camera, sample_ray

wp.set_module_options({"enable_backward": False})

# Points along each side of the grid on which colours are compared: the same work for large objects and for small ones.
_COLOUR_POINTS = wp.constant(24)


# Rows mostly lie in one piece, so a compiler uses its vectors; images that were handed over may have any strides.
_RESOLVE_ROW = """
    const wp::int64* nearest = &wp::index(key, v, middle + row * supersampling, middle);
    const int* body = scene.triangle_body.data;
    float* depth = &wp::index(depth_m, v, row, 0);
    int* id = &wp::index(object_id, v, row, 0);
    const int width = depth_m.shape[2];
    const int depth_step = depth_m.strides[2] / int64_t(sizeof(float));
    const int id_step = object_id.strides[2] / int64_t(sizeof(wp::int32));
    for (int column = lane; column < width; column += lane_count) {
        const wp::int64 found = nearest[column * supersampling];
        const bool is_hit = found != 0;
        const int bits = found >> 32, triangle = found;
        float w;
        memcpy(&w, &bits, sizeof(float));
        depth[column * depth_step] = is_hit ? 1.0f / w : background_m;
        const int k = is_hit ? body[triangle] : -1;
        id[column * id_step] = is_hit ? (k >= first_object ? k - first_object : -2 - k) : -1;
    }
"""


@wp.func_native(_RESOLVE_ROW)
def _resolve_row(
    key: wp.array3d[wp.int64],
    scene: Triangles,
    v: int,
    row: int,
    middle: int,
    supersampling: int,
    background_m: float,
    first_object: int,
    lane: int,
    lane_count: int,
    depth_m: wp.array3d[float],
    object_id: wp.array3d[wp.int32],
):
    """Depth and object of every ``lane_count``-th pixel of a row.

    Writes: ``depth_m`` and ``object_id``.
    """
    ...


@wp.kernel(enable_backward=False)
def resolve_depth_kernel(
    # in
    key: wp.array3d[wp.int64],
    scene: Triangles,
    background_m: float,
    first_object: int,
    supersampling: int,
    first_view: int,
    lane_count: int,
    # out
    depth_m: wp.array3d[float],
    object_id: wp.array3d[wp.int32],
):
    """Depth and object at the sample nearest to every pixel's centre.

    ``first_object`` is the number of occluders: the bodies from there on are objects.

    Launch: ``dim=(views of this chunk, height_px, lane_count)``; the lanes share the pixels of a row. Not taped.
    Writes: every element of ``depth_m`` [m], ``background_m`` where nothing is hit, and of ``object_id`` of these
        views: k for object k, -1 where nothing is hit, ``-2 - j`` for occluder j.
    """
    chunk_view, row, lane = wp.tid()
    v = first_view + chunk_view
    _resolve_row(
        key, scene, v, row, GUARD + supersampling / 2, supersampling, background_m, first_object, lane, lane_count,
        depth_m, object_id,
    )  # fmt: skip


@wp.kernel(enable_backward=False)
def resolve_incidence_kernel(
    # in
    view: wp.array[View],
    key: wp.array3d[wp.int64],
    scene: Triangles,
    supersampling: int,
    first_view: int,
    lane_count: int,
    # out
    cosine: wp.array3d[float],
):
    """Cosine of the angle between the ray of every pixel's middle sample and the normal of what it hits, 0..1.

    Launch: ``dim=(views of this chunk, height_px, lane_count)``; the lanes share the pixels of a row. Not taped.
    Writes: every element of ``cosine`` of these views once, 0 where nothing is hit.
    """
    chunk_view, row, lane = wp.tid()
    v = first_view + chunk_view
    camera = view[v]
    middle = GUARD + supersampling / 2
    for column in range(lane, cosine.shape[2], lane_count):
        found = key[v, middle + row * supersampling, middle + column * supersampling]
        along = float(0.0)
        if found != wp.int64(0):
            plane = scene.triangle_plane[wp.int32(found & wp.int64(0xFFFFFFFF))]
            normal = camera.camera_from_world * wp.vec3(plane[0], plane[1], plane[2])
            ray = sample_ray(camera, middle + row * supersampling, middle + column * supersampling)
            along = wp.abs(wp.dot(normal, wp.normalize(ray)))
        cosine[v, row, column] = wp.min(along, 1.0)


@wp.kernel(enable_backward=False)
def resolve_silhouettes_kernel(
    # in
    layers: Layers,
    hiding: Hiding,
    kind: int,
    supersampling: int,
    first_view: int,
    lane_count: int,
    # out
    silhouette: wp.array4d[float],
):
    """Share of every pixel that an object covers, alone or unhidden as ``kind`` says.

    Launch: ``dim=(views of this chunk, object_count, lane_count)``; the lanes share the rows of an image. Not taped.
    Writes: every element of ``silhouette`` [view, object, row, column], 0..1, of these views once.
    """
    chunk_view, object_index, lane = wp.tid()
    v = first_view + chunk_view
    pair = pair_of(v, object_index, layers)
    share = 1.0 / float(supersampling * supersampling)
    for row in range(lane, silhouette.shape[2], lane_count):
        for column in range(silhouette.shape[3]):
            covered = int(0)
            for sample in range(supersampling * supersampling):
                r = GUARD + row * supersampling + sample / supersampling - pair.rectangle[1]
                c = GUARD + column * supersampling + sample % supersampling - pair.rectangle[0]
                if r >= 0 and c >= 0 and r < pair.rectangle[3] and c < pair.rectangle[2]:
                    if is_in_mask(pair, r, c, kind, layers, hiding):
                        covered += 1
            silhouette[v, object_index, row, column] = share * float(covered)


@wp.func
def _sky_rgb(horizon_rgb: wp.vec3, zenith_rgb: wp.vec3, elevation_sine: float) -> wp.vec3:
    """Colour of the sky in a direction: the horizon's below and at the horizon, the zenith's overhead."""
    t = wp.clamp(elevation_sine, 0.0, 1.0)
    share = 1.0 - (1.0 - t) * (1.0 - t)
    return (1.0 - share) * horizon_rgb + share * zenith_rgb


@wp.struct
class Patch:
    """The colours of one triangle, as a camera sees them along a ray of its own axes.

    The colour along a ray d is ``rgb + change d / whole . d``.
    """

    triangle: int  # the triangle; -1 at first
    rgb: wp.vec3  # colour of the first corner
    change: wp.mat33  # growth of the colour from there, times ``whole . d``
    whole: wp.vec3  # normal of the triangle's plane, of any length


@wp.func
def _patch_of(camera: View, scene: Triangles, vertex_rgb: wp.array[wp.vec3], triangle: int) -> Patch:
    """The colours of a triangle, seen by a camera."""
    corner = scene.triangle[triangle]
    a = point_in_camera(camera, scene.vertex_world_m[corner[0]])
    b = point_in_camera(camera, scene.vertex_world_m[corner[1]])
    c = point_in_camera(camera, scene.vertex_world_m[corner[2]])
    share_b = wp.cross(c, a)
    share_c = wp.cross(a, b)
    patch = Patch()
    patch.triangle = triangle
    patch.rgb = vertex_rgb[corner[0]]
    patch.change = wp.outer(vertex_rgb[corner[1]] - patch.rgb, share_b) + wp.outer(
        vertex_rgb[corner[2]] - patch.rgb, share_c
    )
    patch.whole = wp.cross(b, c) + share_b + share_c
    return patch


@wp.func
def _patch_rgb(patch: Patch, ray: wp.vec3) -> wp.vec3:
    """Colour of a triangle where a ray hits it."""
    return patch.rgb + (1.0 / wp.dot(patch.whole, ray)) * (patch.change * ray)


@wp.func
def patch_under(
    patch: Patch, nearest: wp.int64, camera: View, scene: Triangles, vertex_rgb: wp.array[wp.vec3]
) -> Patch:
    """The patch of the triangle of a key; the given one again where that is the same, or there is none."""
    triangle = wp.int32(nearest & wp.int64(0xFFFFFFFF))
    if nearest == wp.int64(0) or triangle == patch.triangle:
        return patch
    return _patch_of(camera, scene, vertex_rgb, triangle)


@wp.func
def rgb_along(
    camera: View, ray: wp.vec3, nearest: wp.int64, patch: Patch, horizon_rgb: wp.vec3, zenith_rgb: wp.vec3
) -> wp.vec3:
    """What a camera sees along a ray of its axes: the patch of the key, or the sky where the key is empty.

    Black along a ray of zero, where the lens sees nothing.
    """
    if wp.length_sq(ray) == 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    if nearest == wp.int64(0):
        r = camera.camera_from_world
        up = r[0, 2] * ray[0] + r[1, 2] * ray[1] + r[2, 2] * ray[2]
        return _sky_rgb(horizon_rgb, zenith_rgb, up / wp.length(ray))
    return _patch_rgb(patch, ray)


@wp.func
def _mean_rgb(total: wp.vec3, supersampling: int) -> wp.vec3:
    """Colour of a pixel, 0..1, from the sum over its samples."""
    colour = (1.0 / float(supersampling * supersampling)) * total
    return wp.vec3(wp.clamp(colour[0], 0.0, 1.0), wp.clamp(colour[1], 0.0, 1.0), wp.clamp(colour[2], 0.0, 1.0))


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
    lane_count: int,
    # out
    rgb: wp.array3d[wp.vec3],
):
    """Unlit vertex colours, interpolated in perspective at every sample and averaged over the pixel.

    Launch: ``dim=(images of this chunk, height_px, lane_count)``; the lanes share the pixels of a row. Image i shows
    view ``shown_view[i]``. Not taped.
    Writes: every element of ``rgb`` [image, row, column], 0..1, of these images once.
    """
    chunk_image, row, lane = wp.tid()
    image = first_image + chunk_image
    v = shown_view[image]
    camera = view[v]
    # neighbouring samples often see the same triangle
    patch = Patch()
    patch.triangle = -1
    for column in range(lane, rgb.shape[2], lane_count):
        total = wp.vec3(0.0, 0.0, 0.0)
        for sample in range(supersampling * supersampling):
            grid_row = GUARD + row * supersampling + sample / supersampling
            grid_column = GUARD + column * supersampling + sample % supersampling
            ray = sample_ray(camera, grid_row, grid_column)
            nearest = key[v, grid_row, grid_column]
            patch = patch_under(patch, nearest, camera, scene, vertex_rgb)
            total += rgb_along(camera, ray, nearest, patch, horizon_rgb, zenith_rgb)
        rgb[image, row, column] = _mean_rgb(total, supersampling)


@wp.kernel(enable_backward=False)
def measure_contrast_kernel(
    # in
    view: wp.array[View],
    scene: Triangles,
    vertex_rgb: wp.array[wp.vec3],
    horizon_rgb: wp.vec3,
    zenith_rgb: wp.vec3,
    key: wp.array3d[wp.int64],
    layer_body: wp.array[wp.int32],
    measure: wp.array3d[float],
    width_px: int,
    height_px: int,
    supersampling: int,
    first_view: int,
    # out
    contrast: wp.array2d[float],
):
    """Distance between the mean colour of what is seen of an object and that of what surrounds it (RGB in 0..1).

    The surroundings are what else is seen in the object's extent inside the image, enlarged, see
    `layers.SURROUNDINGS_SHARE`. A grid of pixels stands for them; only these get colours, those of
    `resolve_rgb_kernel`. 0 where either is not seen.

    Launch: ``dim=(views of this chunk, object_count)``. Not taped: colours are held fixed while the camera moves.
    Writes: every element of ``contrast`` of these views once.
    """
    chunk_view, k = wp.tid()
    v = first_view + chunk_view
    contrast[v, k] = 0.0
    wide = measure[v, k, RIGHT] - measure[v, k, LEFT]
    high = measure[v, k, BOTTOM] - measure[v, k, TOP]
    if wide <= 0.0 or high <= 0.0 or measure[v, k, VISIBLE_AREA] <= 0.0:
        return
    more = float(SURROUNDINGS_PX)
    left = wp.max(measure[v, k, LEFT] - SURROUNDINGS_SHARE * wide - more, 0.0)
    right = wp.min(measure[v, k, RIGHT] + SURROUNDINGS_SHARE * wide + more, float(width_px))
    top = wp.max(measure[v, k, TOP] - SURROUNDINGS_SHARE * high - more, 0.0)
    bottom = wp.min(measure[v, k, BOTTOM] + SURROUNDINGS_SHARE * high + more, float(height_px))
    camera = view[v]
    own = wp.vec3(0.0, 0.0, 0.0)
    other = wp.vec3(0.0, 0.0, 0.0)
    own_count = float(0.0)
    other_count = float(0.0)
    patch = Patch()
    patch.triangle = -1
    for i in range(_COLOUR_POINTS):
        for j in range(_COLOUR_POINTS):
            row = int(top + (float(i) + 0.5) / float(_COLOUR_POINTS) * (bottom - top))
            column = int(left + (float(j) + 0.5) / float(_COLOUR_POINTS) * (right - left))
            total = wp.vec3(0.0, 0.0, 0.0)
            for sample in range(supersampling * supersampling):
                grid_row = GUARD + row * supersampling + sample / supersampling
                grid_column = GUARD + column * supersampling + sample % supersampling
                ray = sample_ray(camera, grid_row, grid_column)
                nearest = key[v, grid_row, grid_column]
                patch = patch_under(patch, nearest, camera, scene, vertex_rgb)
                total += rgb_along(camera, ray, nearest, patch, horizon_rgb, zenith_rgb)
            middle = supersampling / 2
            nearest = key[v, GUARD + row * supersampling + middle, GUARD + column * supersampling + middle]
            is_own = False
            if nearest != wp.int64(0):
                is_own = scene.triangle_body[wp.int32(nearest & wp.int64(0xFFFFFFFF))] == layer_body[k]
            if is_own:
                own += _mean_rgb(total, supersampling)
                own_count += 1.0
            else:
                other += _mean_rgb(total, supersampling)
                other_count += 1.0
    if own_count > 0.0 and other_count > 0.0:
        contrast[v, k] = wp.length(own / own_count - other / other_count)
