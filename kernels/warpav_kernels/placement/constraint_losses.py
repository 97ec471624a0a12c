"""Taped: constraints on camera centres, the thesis's losses and inequalities."""

import warp as wp

from warpav_kernels.placement.mount_pose import X_M, Y_M, bilinear_m


@wp.func
def _zone_distance_m(
    x_m: float, y_m: float, border_distance_m: wp.array2d[float], origin_m: wp.vec2, cell_m: float
) -> float:
    """Signed distance to the border of the mountable zone [m], positive inside.

    Bilinear between the cells' centres; beyond the raster that of its nearest point, less the distance to it.
    Gradients flow to x, y and the raster.
    """
    distance_m = bilinear_m(x_m, y_m, border_distance_m, origin_m, cell_m)
    last_x_m = origin_m[0] + cell_m * float(border_distance_m.shape[0] - 1)
    last_y_m = origin_m[1] + cell_m * float(border_distance_m.shape[1] - 1)
    beyond_x_m = wp.max(origin_m[0] - x_m, 0.0) + wp.max(x_m - last_x_m, 0.0)
    beyond_y_m = wp.max(origin_m[1] - y_m, 0.0) + wp.max(y_m - last_y_m, 0.0)
    if beyond_x_m + beyond_y_m > 0.0:
        return distance_m - wp.length(wp.vec2(beyond_x_m, beyond_y_m))
    return distance_m


@wp.kernel
def zone_excess_kernel(
    # in
    mount_pose: wp.array2d[float],
    border_distance_m: wp.array2d[float],
    origin_m: wp.vec2,
    cell_m: float,
    margin_m: float,
    # out
    excess_m: wp.array[float],
):
    """How far every camera is from the inside of the mountable zone; negative where it is inside.

    Launch: ``dim=camera_count``.
    Writes: ``excess_m[camera]`` of every camera once.
    """
    camera = wp.tid()
    x_m = mount_pose[camera, X_M]
    y_m = mount_pose[camera, Y_M]
    excess_m[camera] = margin_m - _zone_distance_m(x_m, y_m, border_distance_m, origin_m, cell_m)


@wp.kernel
def spacing_excess_kernel(
    # in
    position_ego_m: wp.array[wp.vec3],
    view_stride: int,
    min_spacing_m: float,
    # out
    excess_m: wp.array[float],
):
    """By how much every pair of cameras is too close; negative where the two are far enough apart.

    Launch: ``dim=1``; cameras are few, and one thread sums each one's gradient in a fixed order. Camera i stands where
    view ``i * view_stride`` does.
    Writes: ``excess_m[camera_count + pair]`` of every pair once; pairs are (0, 1), (0, 2), ... (1, 2), ...
    """
    camera_count = position_ego_m.shape[0] / view_stride
    for i in range(camera_count):
        for j in range(i + 1, camera_count):
            pair = i * (2 * camera_count - i - 1) / 2 + j - i - 1
            between_m = position_ego_m[i * view_stride] - position_ego_m[j * view_stride]
            excess_m[camera_count + pair] = min_spacing_m - wp.length(between_m)


@wp.kernel
def keep_excess_kernel(
    # in
    excess_m: wp.array[float],
    kept: wp.array[wp.int32],
    # out
    kept_excess_m: wp.array[float],
):
    """Of all inequalities those that count: a frozen camera cannot repair what it breaks by itself.

    Launch: ``dim=kept.shape[0]``; one thread per inequality that counts.
    Writes: every element of ``kept_excess_m`` once.
    """
    k = wp.tid()
    kept_excess_m[k] = excess_m[kept[k]]
