"""Taped: constraint losses on camera centres."""

import warp as wp

from warpav_kernels.mount_pose import X_M, Y_M


@wp.func
def bound_violation(excess_m: float) -> float:
    """Penalty for one coordinate beyond one bound by ``excess_m``; 0 inside.

    Equation: 5 (as printed)
    """
    return wp.exp(wp.max(excess_m, 0.0)) - 1.0


@wp.kernel
def out_of_bounds_loss_kernel(
    # in
    mount_pose: wp.array2d[float],
    low_m: wp.vec2,
    high_m: wp.vec2,
    # out
    loss: wp.array[float],
):
    """Add every camera's penalty for leaving the mount surface's bounding rectangle.

    Equation: 6 (as printed)

    Launch: ``dim=camera_count``; one thread per camera.
    Writes: ``loss[0]`` by atomic add; the caller zeroes it.
    """
    camera = wp.tid()
    x_m = mount_pose[camera, X_M]
    y_m = mount_pose[camera, Y_M]
    along_x = bound_violation(low_m[0] - x_m) + bound_violation(x_m - high_m[0])
    along_y = bound_violation(low_m[1] - y_m) + bound_violation(y_m - high_m[1])
    wp.atomic_add(loss, 0, along_x + along_y)  # Eq. 6


@wp.func
def spacing_violation(distance_m: float, min_spacing_m: float) -> float:
    """Relative shortfall of one camera pair; 0 when far enough apart.

    Equation: 8 (as printed)
    """
    return wp.max(min_spacing_m - distance_m, 0.0) / min_spacing_m


@wp.kernel
def camera_spacing_loss_kernel(
    # in
    position_ego_m: wp.array[wp.vec3],
    view_stride: int,
    min_spacing_m: float,
    # out
    loss: wp.array[float],
):
    """Add every camera pair's share of the spacing loss.

    Equation: 7, 9 (as printed)

    Launch: ``dim=(camera_count, camera_count)``; thread (i, j) with j <= i does nothing. Camera i stands where view
    ``i * view_stride`` does.
    Writes: ``loss[1]`` by atomic add; the caller zeroes it.
    """
    i, j = wp.tid()
    if j <= i:
        return
    camera_count = position_ego_m.shape[0] / view_stride
    pair_count = 0.5 * float(camera_count * (camera_count - 1))
    between_m = position_ego_m[i * view_stride] - position_ego_m[j * view_stride]
    distance_m = wp.length(between_m)  # Eq. 7
    wp.atomic_add(loss, 1, spacing_violation(distance_m, min_spacing_m) / pair_count)  # Eq. 9
