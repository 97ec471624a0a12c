"""A view: one image of the scene, and the geometry that every kernel shares.

Depth is z for pinhole and Brown-Conrady lenses and distance for the others, see `lens`: a ray times a depth is a point.

Sample grid of a view: the image's pixels, each cut into supersampling x supersampling samples, inside a frame of one
guard sample on every side. Sample (row, column) has its centre at (column + 0.5, row + 0.5). The guard band has weight
0 in every measure; it is there so that outlines within half a sample of the image's edge still carry a gradient.
"""

import warp as wp

from warpav_kernels.raster._lens import (
    BROWN_CONRADY,
    FISHEYE,
    PANORAMA,
    PINHOLE,
    SPHERE,
    Lens,
    lens_ray,
    place_gradient,
    radius_and_growth,
)

wp.set_module_options({"enable_backward": False})

GUARD = wp.constant(1)


@wp.struct
class View:
    """Pose and lens of one view."""

    position_world_m: wp.vec3  # camera centre in the world frame [m]
    camera_from_world: wp.mat33  # rotation from world axes to camera axes (x right, y down, z forward)
    focal: wp.vec2  # focal lengths along columns and rows, in samples of the grid
    centre: wp.vec2  # principal point (column, row), in samples of the grid
    near_m: float  # depth below which nothing is seen [m]
    lens: Lens  # the lens without its focal lengths
    # x, y and z of the ray of depth 1 in camera coordinates through the centre of every sample, 0 where nothing is
    # seen, [axis, row, column]; empty for a pinhole, and on a GPU, where it is computed when it is asked for
    ray: wp.array3d[float]


@wp.func
def point_in_camera(view: View, point_world_m: wp.vec3) -> wp.vec3:
    """A point of the world frame in camera coordinates [m]."""
    return view.camera_from_world * (point_world_m - view.position_world_m)


@wp.func
def ray_in_camera(view: View, column: float, row: float) -> wp.vec3:
    """Ray of depth 1 through a place of the sample grid, in camera coordinates; zero where the lens sees nothing."""
    x = (column - view.centre[0]) / view.focal[0]
    y = (row - view.centre[1]) / view.focal[1]
    if view.lens.kind == PINHOLE:
        return wp.vec3(x, y, 1.0)
    return lens_ray(view.lens, x, y)


@wp.func
def ray_between(start: wp.vec3, end: wp.vec3, share: float) -> wp.vec3:
    """The ray at a share of the way between two neighbouring samples' rays, of the same depth as theirs."""
    ray = (1.0 - share) * start + share * end
    length = (1.0 - share) * wp.length(start) + share * wp.length(end)
    if wp.abs(start[2] - 1.0) + wp.abs(end[2] - 1.0) == 0.0:
        return ray
    return length / wp.length(ray) * ray


@wp.func
def sample_ray(view: View, row: int, column: int) -> wp.vec3:
    """Ray of depth 1 through a sample's centre, in camera coordinates; zero where the lens sees nothing."""
    if view.ray.shape[0] > 0:
        return wp.vec3(view.ray[0, row, column], view.ray[1, row, column], view.ray[2, row, column])
    return ray_in_camera(view, float(column) + 0.5, float(row) + 0.5)


@wp.func
def sees(view: View, row: int, column: int) -> bool:
    """Whether the lens sees anything at a sample."""
    if view.lens.kind == PINHOLE or (view.lens.kind == PANORAMA and view.lens.formula != SPHERE):
        return True
    return wp.length_sq(sample_ray(view, row, column)) > 0.0


@wp.func
def column_gradient(view: View, point_m: wp.vec3) -> wp.vec3:
    """Gradient of the image column to a point in camera coordinates [samples/m]."""
    if view.lens.kind != PINHOLE:
        return view.focal[0] * place_gradient(view.lens, point_m)[0]
    w = 1.0 / point_m[2]
    return wp.vec3(view.focal[0] * w, 0.0, -view.focal[0] * point_m[0] * w * w)


@wp.func
def row_gradient(view: View, point_m: wp.vec3) -> wp.vec3:
    """Gradient of the image row to a point in camera coordinates [samples/m]."""
    if view.lens.kind != PINHOLE:
        return view.focal[1] * place_gradient(view.lens, point_m)[1]
    w = 1.0 / point_m[2]
    return wp.vec3(0.0, view.focal[1] * w, -view.focal[1] * point_m[1] * w * w)


@wp.func
def depth_gradient(view: View, point_m: wp.vec3) -> wp.vec3:
    """Gradient of the depth of a point to the point, in camera coordinates; of unit length."""
    if view.lens.kind == FISHEYE or view.lens.kind == PANORAMA:
        return point_m / wp.length(point_m)
    return wp.vec3(0.0, 0.0, 1.0)


@wp.func
def solid_angle(view: View, ray: wp.vec3) -> float:
    """Solid angle of one square sample, seen along the ray through its centre [sr].

    On the unit sphere the image's gradients are tangents, and their cross product is samples per solid angle; on a ray
    they fall off with its length. For a pinhole it is the cubed cosine of the angle to the axis over the focal lengths.
    """
    samples = wp.length(wp.cross(column_gradient(view, ray), row_gradient(view, ray)))
    return 1.0 / (samples * wp.dot(ray, ray))


@wp.func
def inverse_depth_of(bits: wp.int32) -> float:
    """Inverse depth [1/m] from its bit pattern; positive floats sort like their bits."""
    return wp.cast(bits, float)


@wp.func(inline=False)
def _used_lens(view: View, width: int, height: int) -> Lens:
    """The view's lens, one of BROWN_CONRADY with its limit no farther out than the corners of a grid of that size.

    Its polynomial may go on for long where there is no image, and all bounds grow with the limit.
    """
    lens = view.lens
    if lens.kind != BROWN_CONRADY:
        return lens
    farthest = float(0.0)
    for corner in range(4):
        ray = ray_in_camera(view, float(width * (corner % 2)), float(height * (corner / 2)))
        if ray[2] == 0.0:
            return lens
        farthest = wp.max(farthest, wp.sqrt(ray[0] * ray[0] + ray[1] * ray[1]))
    sideways = 6.0 * (wp.abs(lens.distortion[2]) + wp.abs(lens.distortion[3]))
    used = Lens()
    used.kind = lens.kind
    used.formula = lens.formula
    used.distortion = lens.distortion
    used.limit = wp.min(1.02 * farthest + sideways * farthest * farthest, lens.limit)
    used.edge = radius_and_growth(lens, used.limit)[0]
    return used


@wp.kernel(enable_backward=False)
def place_views_kernel(
    # in
    position_world_m: wp.array[wp.vec3],
    camera_from_world: wp.array[wp.mat33],
    intrinsics_px: wp.array[wp.vec4],
    near_m: wp.array[float],
    lens: wp.array[Lens],
    log_focal: wp.array[float],
    ray: wp.array4d[float],
    ray_set: wp.array[wp.int32],
    supersampling: int,
    width: int,
    height: int,
    # out
    view: wp.array[View],
):
    """Gather each view's pose and lens into one struct.

    ``intrinsics_px`` holds the focal lengths and the principal point (fx, fy, cx, cy) in pixels; ``log_focal`` is the
    logarithm of what the focal lengths are multiplied by; ``ray_set`` which of the rays ``ray`` are each view's, -1
    where it has none; ``width`` and ``height`` are of the grid.

    Launch: ``dim=view_count``; one thread per view. Not taped.
    Writes: every element of ``view`` once.
    """
    i = wp.tid()
    scale = float(supersampling)
    intrinsics = intrinsics_px[i]
    placed = View()
    placed.position_world_m = position_world_m[i]
    placed.camera_from_world = camera_from_world[i]
    focal_scale = scale * wp.exp(log_focal[i])
    placed.focal = wp.vec2(intrinsics[0] * focal_scale, intrinsics[1] * focal_scale)
    placed.centre = wp.vec2(intrinsics[2] * scale + float(GUARD), intrinsics[3] * scale + float(GUARD))
    placed.near_m = near_m[i]
    placed.lens = lens[i]
    placed.lens = _used_lens(placed, width, height)
    if ray_set[i] >= 0:
        placed.ray = ray[ray_set[i]]
    view[i] = placed
