"""Taped: from the numbers that are optimised to the pose of every view, through the height map of the mount surface."""

import warp as wp

from warpav_kernels.raster import BROWN_CONRADY, FISHEYE, PANORAMA, SPHERE, Lens, angle_at, radius_and_growth


@wp.func
def bilinear_m(x_m: float, y_m: float, raster_m: wp.array2d[float], origin_m: wp.vec2, cell_m: float) -> float:
    """Bilinear value of a raster over the ground plane [m]; beyond the border, the border's.

    Gradients flow to x and y inside the map, and to the map.
    """
    row = wp.clamp((x_m - origin_m[0]) / cell_m, 0.0, float(raster_m.shape[0] - 1))
    column = wp.clamp((y_m - origin_m[1]) / cell_m, 0.0, float(raster_m.shape[1] - 1))
    i = wp.min(int(wp.floor(row)), raster_m.shape[0] - 2)
    j = wp.min(int(wp.floor(column)), raster_m.shape[1] - 2)
    s = row - float(i)
    t = column - float(j)
    low = (1.0 - t) * raster_m[i, j] + t * raster_m[i, j + 1]
    high = (1.0 - t) * raster_m[i + 1, j] + t * raster_m[i + 1, j + 1]
    return (1.0 - s) * low + s * high


@wp.func
def camera_from_ego_rotation(yaw_rad: float, pitch_rad: float, roll_rad: float) -> wp.mat33:
    """Rotation from ego to camera axes (x right, y down, z forward); ego_from_link is Rz(yaw) Ry(pitch) Rx(roll)."""
    cy = wp.cos(yaw_rad)
    sy = wp.sin(yaw_rad)
    cp = wp.cos(pitch_rad)
    sp = wp.sin(pitch_rad)
    cr = wp.cos(roll_rad)
    sr = wp.sin(roll_rad)
    # columns of ego_from_link: forward, left, up
    forward = wp.vec3(cy * cp, sy * cp, -sp)
    left = wp.vec3(cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr)
    up = wp.vec3(cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr)
    return wp.mat33(-left[0], -left[1], -left[2], -up[0], -up[1], -up[2], forward[0], forward[1], forward[2])


# columns of the numbers that are optimised, one row per camera
X_M = wp.constant(0)
Y_M = wp.constant(1)
YAW_RAD = wp.constant(2)
PITCH_RAD = wp.constant(3)
ROLL_RAD = wp.constant(4)
HEIGHT_DELTA_M = wp.constant(5)  # above the height at which cameras stand as configured
LOG_ZOOM = wp.constant(6)  # logarithm of the focal length over that of the configured camera
MOUNT_POSE_SIZE = wp.constant(7)


@wp.func
def _zone_at(x_m: float, y_m: float, zone_of_cell: wp.array2d[wp.int32], origin_m: wp.vec2, cell_m: float) -> int:
    """Number of the zone at a place of the chart: that of the nearest cell; 0 where there is one zone."""
    if zone_of_cell.shape[0] == 0:
        return 0
    row = wp.clamp(wp.rint((x_m - origin_m[0]) / cell_m), 0.0, float(zone_of_cell.shape[0] - 1))
    column = wp.clamp(wp.rint((y_m - origin_m[1]) / cell_m), 0.0, float(zone_of_cell.shape[1] - 1))
    return zone_of_cell[int(row), int(column)]


@wp.kernel
def place_on_surface_kernel(
    # in
    mount_pose: wp.array2d[float],
    height_m: wp.array2d[float],
    origin_m: wp.vec2,
    cell_m: float,
    zone_of_cell: wp.array2d[wp.int32],
    plane_m: wp.array[wp.vec3],
    axes: wp.array[wp.mat33],
    height_offset_m: float,
    rotation_count: int,
    rotation_step_rad: float,
    # out
    position_ego_m: wp.array[wp.vec3],
    camera_from_ego: wp.array[wp.mat33],
    log_zoom: wp.array[float],
):
    """Pose of every view: each camera on the mount surface, turned by every rotational addition about the vertical.

    All views of a camera have its zoom. The place (x, y) of the chart lies in the zone of the nearest cell of
    ``zone_of_cell``, which is empty where there is one zone; ``plane_m`` and ``axes`` (rows U, V and N) are each zone's
    plane in the ego frame. Gradients flow along the plane.

    Equation: 3 (as printed)

    Launch: ``dim=camera_count``; one thread per camera, so that its pose's gradient is summed in a fixed order; its
    views are camera * rotation_count + rotation.
    Writes: every element of ``position_ego_m``, ``camera_from_ego`` and ``log_zoom`` once.
    """
    camera = wp.tid()
    x_m = mount_pose[camera, X_M]
    y_m = mount_pose[camera, Y_M]
    z_m = bilinear_m(x_m, y_m, height_m, origin_m, cell_m) + height_offset_m + mount_pose[camera, HEIGHT_DELTA_M]
    zone = _zone_at(x_m, y_m, zone_of_cell, origin_m, cell_m)
    point_m = plane_m[zone] + wp.transpose(axes[zone]) * wp.vec3(x_m, y_m, z_m)
    for rotation in range(rotation_count):
        v = camera * rotation_count + rotation
        position_ego_m[v] = point_m
        # Eq. 3: theta_a = a F_closest
        yaw_rad = mount_pose[camera, YAW_RAD] + float(rotation) * rotation_step_rad
        camera_from_ego[v] = camera_from_ego_rotation(
            yaw_rad, mount_pose[camera, PITCH_RAD], mount_pose[camera, ROLL_RAD]
        )
        log_zoom[v] = mount_pose[camera, LOG_ZOOM]


@wp.func
def _angle_at_edge(lens: Lens, radius: float) -> float:
    """Angle from the optical axis to the edge of an image [rad] that is a radius [focal lengths] away.

    Differentiable to the radius, by the lens's growth: the inverse of a lens is found by steps that have no adjoint.
    """
    if lens.kind == FISHEYE:
        return angle_at(lens, wp.min(radius, lens.edge))
    if lens.kind == BROWN_CONRADY:
        return wp.atan(angle_at(lens, wp.min(radius, lens.edge)))
    return wp.atan(radius)


@wp.func_grad(_angle_at_edge)
def _adj_angle_at_edge(lens: Lens, radius: float, adj_angle: float):
    """The adjoint of `_angle_at_edge`: 1 over the growth of the radius."""
    slope = 1.0 / (1.0 + radius * radius)
    if lens.kind == FISHEYE:
        slope = 1.0 / radius_and_growth(lens, angle_at(lens, wp.min(radius, lens.edge)))[1]
    elif lens.kind == BROWN_CONRADY:
        tangent = angle_at(lens, wp.min(radius, lens.edge))
        slope = 1.0 / (radius_and_growth(lens, tangent)[1] * (1.0 + tangent * tangent))
    if (lens.kind == FISHEYE or lens.kind == BROWN_CONRADY) and radius > lens.edge:
        slope = 0.0
    wp.adjoint[radius] += slope * adj_angle


@wp.kernel
def place_windows_kernel(
    # in
    camera_from_ego: wp.array[wp.mat33],
    log_zoom: wp.array[float],
    rotation_count: int,
    lens: Lens,
    half_field: wp.vec2,
    # out
    window_rad: wp.array[wp.vec4],
):
    """The field of view of every camera as a window in each view of its panorama.

    ``half_field`` holds half the width and half the height of the image at zoom 0 [focal lengths]; a zoom divides both.
    A window is the azimuth (to the left) and the elevation of its centre, in the axes of the view, its half width and
    its half height.

    Launch: ``dim=camera_count``; one thread per camera, so that its gradient is summed in a fixed order.
    Writes: every element of ``window_rad`` [view] once.
    """
    camera = wp.tid()
    ahead = camera * rotation_count
    for rotation in range(rotation_count):
        v = ahead + rotation
        # the camera's axis in the axes of the view
        axis = camera_from_ego[v] * (wp.transpose(camera_from_ego[ahead]) * wp.vec3(0.0, 0.0, 1.0))
        level = wp.sqrt(axis[0] * axis[0] + axis[2] * axis[2])
        shrink = wp.exp(-log_zoom[v])
        half_width_rad = half_field[0] * shrink
        half_height_rad = half_field[1] * shrink
        if lens.kind != PANORAMA:
            half_width_rad = _angle_at_edge(lens, half_field[0] * shrink)
        if lens.kind != PANORAMA or lens.formula != SPHERE:
            half_height_rad = _angle_at_edge(lens, half_field[1] * shrink)
        window_rad[v] = wp.vec4(
            wp.atan2(-axis[0], axis[2]),
            wp.atan2(-axis[1], level),
            half_width_rad,
            half_height_rad,
        )
