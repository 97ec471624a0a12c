"""Taped: the two ends of the benchmark's gradient: from cameras that stand level to views, and from areas to a loss."""

import warp as wp

from warpav_kernels.placement.mount_pose import camera_from_ego_rotation

ROTATION_COUNT = wp.constant(4)
_QUARTER_TURN_RAD = wp.constant(0.5 * wp.PI)


@wp.kernel
def place_level_cameras_kernel(
    # in
    pose: wp.array[wp.vec3],
    height_m: wp.array[float],
    # out
    position_ego_m: wp.array[wp.vec3],
    camera_from_ego: wp.array[wp.mat33],
):
    """Pose of every view of cameras that stand level at their heights, each turned by four quarters of a circle.

    ``pose`` holds y and x in the ego frame [m] (to the left, then forwards: the order of the workload) and yaw [rad].

    Launch: ``dim=(camera_count, ROTATION_COUNT)``; view = camera * ROTATION_COUNT + rotation.
    Writes: every element of ``position_ego_m`` and ``camera_from_ego`` once.
    """
    camera, rotation = wp.tid()
    v = camera * ROTATION_COUNT + rotation
    at = pose[camera]
    position_ego_m[v] = wp.vec3(at[1], at[0], height_m[camera])
    camera_from_ego[v] = camera_from_ego_rotation(at[2] + float(rotation) * _QUARTER_TURN_RAD, 0.0, 0.0)


@wp.kernel
def sum_target_areas_kernel(
    # in
    area: wp.array3d[float],
    target_weight: wp.array[float],
    # out
    loss: wp.array[float],
):
    """Weighted sum of the areas of all vehicles, [view, vehicle, 1], in every view.

    Launch: ``dim=view_count``; one thread per view, so that the order of the sum is fixed.
    Writes: every element of ``loss`` once.
    """
    v = wp.tid()
    total = float(0.0)
    for vehicle in range(target_weight.shape[0]):
        total += target_weight[vehicle] * area[v, vehicle, 0]
    loss[v] = total
