"""Losses of the thesis that say how well a rig sees the vehicles of a scene, those of its appendix IX included.

A vehicle is assigned to one camera (-1: to none, and then it does not count). View ``camera * rotation_count + a`` is
the camera turned by the rotational addition a; a = 0 is where it really looks.
"""

import warp as wp

from warpav_kernels.placement.mount_pose import X_M, Y_M, YAW_RAD
from warpav_kernels.raster import AMODAL_AREA, BOX_AREA, LEFT, RIGHT, VISIBLE_AREA

_ALIGNED_RAD = wp.constant(1.0e-6)  # ranges whose ends are this close touch: neither overlap nor gap, no gradient

# what is known of a vehicle's bearing
NEVER_SEEN = wp.constant(0)
SEEN_OUT_OF_FRAME = wp.constant(1)
IN_FRAME = wp.constant(2)


@wp.func
def in_frame_bearing_rad(view_yaw_rad: float, column_px: float, width_px: float, fov_rad: float) -> float:
    """Bearing of an image column, linear in the column; yaw is left-positive, columns run to the right.

    Equation: 10 (changed: the sign, because yaw is left-positive here)
    """
    return view_yaw_rad - fov_rad * (column_px / width_px - 0.5)


@wp.func
def circular_distance_rad(a_rad: float, b_rad: float) -> float:
    """Shortest angle between two bearings, 0..pi.

    Equation: 11 (same value: for bearings of any number of turns)
    """
    turns = (a_rad - b_rad) / (2.0 * wp.pi)
    return wp.abs(turns - wp.round(turns)) * 2.0 * wp.pi


@wp.kernel(enable_backward=False)
def find_vehicle_bearings_kernel(
    # in
    measure: wp.array3d[float],
    assigned_camera: wp.array[wp.int32],
    mount_pose: wp.array2d[float],
    rotation_count: int,
    rotation_step_rad: float,
    width_px: float,
    fov_rad: float,
    # out
    bearing_rad: wp.array[wp.vec2],
    frame_state: wp.array[wp.int32],
):
    """Bearings of every vehicle's left and right end from its assigned camera, over all rotational additions.

    The silhouette of the vehicle alone counts. Where it crosses the seam between neighbouring views, the views'
    intervals are one: the left end comes from the last, the right end from the first view of the run that holds the
    largest part.

    Launch: ``dim=vehicle_count``; one thread per vehicle. Not taped: the bearings are held fixed while the camera
    turns.
    Writes: every element of ``bearing_rad`` (left, right) and ``frame_state`` (NEVER_SEEN, SEEN_OUT_OF_FRAME,
    IN_FRAME) once.
    """
    vehicle = wp.tid()
    camera = assigned_camera[vehicle]
    bearing_rad[vehicle] = wp.vec2(0.0, 0.0)
    frame_state[vehicle] = NEVER_SEEN
    if camera < 0:
        return
    best = int(-1)
    best_area = float(0.0)
    for a in range(rotation_count):
        area = measure[camera * rotation_count + a, vehicle, AMODAL_AREA]
        if area > best_area:
            best_area = area
            best = a
    if best < 0:
        return
    # walk both ways round the circle while the neighbouring view sees the vehicle too
    last = best
    first = best
    growing_left = int(1)
    growing_right = int(1)
    for step in range(1, rotation_count):
        to_left = camera * rotation_count + (best + step) % rotation_count
        if growing_left == 1 and measure[to_left, vehicle, AMODAL_AREA] > 0.0:
            last = best + step
        else:
            growing_left = 0
        to_right = camera * rotation_count + (best - step + rotation_count) % rotation_count
        if growing_right == 1 and measure[to_right, vehicle, AMODAL_AREA] > 0.0:
            first = best - step
        else:
            growing_right = 0
    yaw_rad = mount_pose[camera, YAW_RAD]
    last_view = camera * rotation_count + last % rotation_count
    first_view = camera * rotation_count + (first + rotation_count) % rotation_count
    bearing_rad[vehicle] = wp.vec2(
        in_frame_bearing_rad(
            yaw_rad + float(last) * rotation_step_rad, measure[last_view, vehicle, LEFT], width_px, fov_rad
        ),
        in_frame_bearing_rad(
            yaw_rad + float(first) * rotation_step_rad, measure[first_view, vehicle, RIGHT], width_px, fov_rad
        ),
    )
    if measure[camera * rotation_count, vehicle, AMODAL_AREA] > 0.0:
        frame_state[vehicle] = IN_FRAME
    else:
        frame_state[vehicle] = SEEN_OUT_OF_FRAME


@wp.kernel
def in_frame_rotation_loss_kernel(
    # in
    mount_pose: wp.array2d[float],
    assigned_camera: wp.array[wp.int32],
    bearing_rad: wp.array[wp.vec2],
    frame_state: wp.array[wp.int32],
    epsilon: float,
    # out
    vehicle_loss: wp.array[float],
):
    """In-frame rotation loss of every assigned vehicle: how far its camera must turn to see it.

    A vehicle that the camera sees in no direction counts 1, the largest loss, and gives no gradient (the thesis leaves
    that case open). Gradients flow to the cameras' yaw only, because the bearings are held fixed.

    Equation: 12, 13 (as printed)

    Launch: ``dim=camera_count``; one thread per camera, so that a yaw's gradient is summed in a fixed order.
    Writes: ``vehicle_loss[vehicle]`` of every assigned vehicle once; the caller zeroes it.
    """
    camera = wp.tid()
    for vehicle in range(assigned_camera.shape[0]):
        if assigned_camera[vehicle] == camera:
            if frame_state[vehicle] == NEVER_SEEN:
                vehicle_loss[vehicle] = 1.0
            else:
                yaw_rad = mount_pose[camera, YAW_RAD]
                ends_rad = bearing_rad[vehicle]
                turn_rad = wp.min(
                    circular_distance_rad(ends_rad[0], yaw_rad), circular_distance_rad(ends_rad[1], yaw_rad)
                )
                if frame_state[vehicle] == IN_FRAME:
                    vehicle_loss[vehicle] = epsilon * turn_rad / wp.pi  # Eq. 12, 13
                else:
                    vehicle_loss[vehicle] = turn_rad / wp.pi  # Eq. 13


@wp.func
def soft_masked_area(inside: float, whole: float, epsilon: float) -> float:
    """Area under a box mask that never drops to 0: the part inside counts fully, the rest ``epsilon``.

    Equation: 4 (same value: the mask summed over the silhouette)
    """
    return inside * (1.0 - epsilon) + whole * epsilon


@wp.func
def visibility_shortfall(visibility: float, min_visibility: float) -> float:
    """How much of the wanted visibility is missing, relative to it, 0..1; 0 where there is enough.

    Equation: 15, 18 (as printed)
    """
    return wp.max(min_visibility - visibility, 0.0) / min_visibility


@wp.kernel
def detected_area_loss_kernel(
    # in
    measure: wp.array3d[float],
    area_around: wp.array[float],
    assigned_camera: wp.array[wp.int32],
    rotation_count: int,
    min_visibility: float,
    epsilon: float,
    # out
    vehicle_loss: wp.array[float],
):
    """Detected-area loss of every assigned vehicle.

    The visibility is the silhouette inside the matched detection's box where the camera really looks, over
    ``area_around``; with the non-occluded silhouette in all directions that is what Eq. 14 reduces to. BOX_AREA is 0
    where no detection matched. A vehicle of which its camera sees nothing in any direction counts 1 and gives no
    gradient.

    Equation: 14 (same value: sum - (sum - S_dm) is S_dm)
    Equation: 16 (as printed)

    Launch: ``dim=vehicle_count``; one thread per vehicle.
    Writes: ``vehicle_loss[vehicle]`` of every assigned vehicle once; the caller zeroes it.
    """
    vehicle = wp.tid()
    camera = assigned_camera[vehicle]
    if camera < 0:
        return
    around = area_around[vehicle]
    if around < 0.5:
        vehicle_loss[vehicle] = 1.0
        return
    ahead = camera * rotation_count
    detected = soft_masked_area(measure[ahead, vehicle, BOX_AREA], measure[ahead, vehicle, VISIBLE_AREA], epsilon)
    visibility = detected / around  # Eq. 14
    vehicle_loss[vehicle] = visibility_shortfall(visibility, min_visibility)  # Eq. 15, 16


@wp.kernel
def object_visibility_loss_kernel(
    # in
    measure: wp.array3d[float],
    area_around: wp.array[float],
    assigned_camera: wp.array[wp.int32],
    rotation_count: int,
    min_visibility: float,
    # out
    vehicle_loss: wp.array[float],
):
    """Object-visibility loss of every assigned vehicle: the detected-area loss of a detector that misses nothing.

    The visibility is the non-occluded silhouette where the camera really looks, over ``area_around``. A vehicle of
    which its camera sees nothing in any direction counts 1 and gives no gradient.

    Equation: 24 (same value: sum - (sum - S_bm) is S_bm, which is S_um at the rotational addition 0)

    Launch: ``dim=vehicle_count``; one thread per vehicle.
    Writes: ``vehicle_loss[vehicle]`` of every assigned vehicle once; the caller zeroes it.
    """
    vehicle = wp.tid()
    camera = assigned_camera[vehicle]
    if camera < 0:
        return
    around = area_around[vehicle]
    if around < 0.5:
        vehicle_loss[vehicle] = 1.0
        return
    visibility = measure[camera * rotation_count, vehicle, VISIBLE_AREA] / around  # Eq. 24
    vehicle_loss[vehicle] = visibility_shortfall(visibility, min_visibility)


@wp.kernel(enable_backward=False)
def find_clearest_cameras_kernel(
    # in
    measure: wp.array3d[float],
    unblocked_area: wp.array3d[float],
    assigned_camera: wp.array[wp.int32],
    camera_count: int,
    rotation_count: int,
    # out
    clearest_camera: wp.array[wp.int32],
):
    """The camera from which the ego vehicle hides the smallest share of a vehicle; of equal ones the first.

    Launch: ``dim=vehicle_count``; one thread per vehicle. Not taped.
    Writes: every element of ``clearest_camera`` once; -1 where no camera has the vehicle in its frame, and where the
    vehicle is not assigned.
    """
    vehicle = wp.tid()
    clearest_camera[vehicle] = -1
    if assigned_camera[vehicle] < 0:
        return
    best = float(-1.0)
    for camera in range(camera_count):
        alone = measure[camera * rotation_count, vehicle, AMODAL_AREA]
        if alone > 0.0:
            visibility = unblocked_area[camera * rotation_count, vehicle, 0] / alone
            if visibility > best:
                best = visibility
                clearest_camera[vehicle] = camera


@wp.kernel
def surface_blockage_loss_kernel(
    # in
    measure: wp.array3d[float],
    unblocked_area: wp.array3d[float],
    assigned_camera: wp.array[wp.int32],
    clearest_camera: wp.array[wp.int32],
    rotation_count: int,
    min_visibility: float,
    # out
    vehicle_loss: wp.array[float],
):
    """Surface-blockage loss of every assigned vehicle: how much of it the ego vehicle hides, where it hides least.

    ``unblocked_area`` is the vehicle alone outside the ego vehicle's silhouette. A vehicle in no camera's frame counts
    1 and gives no gradient: turning away from a blocked vehicle must not pay.

    Equation: 17 (same value: the pixels of m + e without those of e are those of m outside e)

    Launch: ``dim=vehicle_count``; one thread per vehicle.
    Writes: ``vehicle_loss[vehicle]`` of every assigned vehicle once; the caller zeroes it.
    """
    vehicle = wp.tid()
    if assigned_camera[vehicle] < 0:
        return
    camera = clearest_camera[vehicle]
    if camera < 0:
        vehicle_loss[vehicle] = 1.0
        return
    ahead = camera * rotation_count
    visibility = unblocked_area[ahead, vehicle, 0] / measure[ahead, vehicle, AMODAL_AREA]  # Eq. 17
    vehicle_loss[vehicle] = visibility_shortfall(visibility, min_visibility)  # Eq. 18


@wp.func
def _turn_count(yaw_rad: float) -> int:
    """Whole turns below a yaw."""
    return int(wp.floor(yaw_rad / (2.0 * wp.pi)))


@wp.kernel(enable_backward=False)
def find_next_cameras_kernel(
    # in
    mount_pose: wp.array2d[float],
    # out
    next_camera: wp.array[wp.int32],
    next_turns: wp.array[wp.int32],
):
    """Sort the cameras round the circle: the next to the left of each, and the turns to add to reach its yaw.

    Cameras of equal yaw follow each other by number, and the last is followed by the first, a turn further.

    Launch: ``dim=camera_count``; one thread per camera. Not taped.
    Writes: every element of ``next_camera`` and ``next_turns`` once.
    """
    camera = wp.tid()
    yaw_rad = mount_pose[camera, YAW_RAD]
    own = yaw_rad - float(_turn_count(yaw_rad)) * 2.0 * wp.pi
    nearest = float(1.0e9)
    found = int(camera)
    turns = int(0)
    for other in range(mount_pose.shape[0]):
        other_yaw_rad = mount_pose[other, YAW_RAD]
        place = other_yaw_rad - float(_turn_count(other_yaw_rad)) * 2.0 * wp.pi
        further = int(0)
        if place < own or (place == own and other <= camera):
            place += 2.0 * wp.pi
            further = 1
        if place < nearest:
            nearest = place
            found = other
            turns = _turn_count(yaw_rad) - _turn_count(other_yaw_rad) + further
    next_camera[camera] = found
    next_turns[camera] = turns


@wp.func
def covered_rad(gap_rad: float, fov_rad: float) -> float:
    """What a range of width ``fov_rad`` adds to the union if the next one starts ``gap_rad`` further.

    Equation: 21, 22 (same value: all ranges are equally wide, so each covers up to its end or to the next one's start)
    """
    if gap_rad < fov_rad - _ALIGNED_RAD:
        return gap_rad
    return fov_rad


@wp.kernel
def angular_coverage_loss_kernel(
    # in
    mount_pose: wp.array2d[float],
    next_camera: wp.array[wp.int32],
    next_turns: wp.array[wp.int32],
    fov_rad: float,
    # out
    loss: wp.array[float],
):
    """Angular-coverage loss of a rig: the share of the angle that it could cover, beyond one camera's, and does not.

    A rig that cannot cover more than one of its cameras does costs 0 (the thesis divides 0 by 0).

    Equation: 20, 23 (as printed)

    Launch: ``dim=1``; cameras are few, and one thread sums them in a fixed order.
    Writes: ``loss[0]`` once.
    """
    camera_count = mount_pose.shape[0]
    most_rad = wp.min(float(camera_count) * fov_rad, 2.0 * wp.pi)  # Eq. 20
    spare_rad = most_rad - fov_rad
    total = float(0.0)
    if spare_rad > _ALIGNED_RAD:
        for camera in range(camera_count):
            further_rad = float(next_turns[camera]) * 2.0 * wp.pi
            gap_rad = mount_pose[next_camera[camera], YAW_RAD] - mount_pose[camera, YAW_RAD] + further_rad
            total += (most_rad / float(camera_count) - covered_rad(gap_rad, fov_rad)) / spare_rad  # Eq. 23
    loss[0] = total


@wp.kernel
def mean_vehicle_loss_kernel(
    # in
    vehicle_loss: wp.array[float],
    assigned_count: int,
    # out
    loss: wp.array[float],
):
    """Mean of a loss over the assigned vehicles, summed in a fixed order.

    Equation: 13, 16, 19 (as printed)

    Launch: ``dim=1``; vehicles that are not assigned hold 0.
    Writes: ``loss[0]`` once.
    """
    total = float(0.0)
    for vehicle in range(vehicle_loss.shape[0]):
        total += vehicle_loss[vehicle] / float(assigned_count)
    loss[0] = total


# the thesis's losses, in the order of their array
_OUT_OF_BOUNDS = wp.constant(0)
_CAMERA_SPACING = wp.constant(1)


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
    """Sum of all cameras' penalties for leaving the mount surface's bounding rectangle.

    Equation: 6 (as printed)

    Launch: ``dim=1``; cameras are few, and one thread sums them in a fixed order.
    Writes: ``loss[OUT_OF_BOUNDS]`` once.
    """
    total = float(0.0)
    for camera in range(mount_pose.shape[0]):
        x_m = mount_pose[camera, X_M]
        y_m = mount_pose[camera, Y_M]
        along_x = bound_violation(low_m[0] - x_m) + bound_violation(x_m - high_m[0])
        along_y = bound_violation(low_m[1] - y_m) + bound_violation(y_m - high_m[1])
        total += along_x + along_y
    loss[_OUT_OF_BOUNDS] = total  # Eq. 6


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
    """Mean over all pairs of cameras of the spacing violation.

    Equation: 7, 9 (as printed)

    Launch: ``dim=1``; cameras are few, and one thread sums them in a fixed order. Camera i stands where view
    ``i * view_stride`` does.
    Writes: ``loss[CAMERA_SPACING]`` once.
    """
    camera_count = position_ego_m.shape[0] / view_stride
    pair_count = 0.5 * float(camera_count * (camera_count - 1))
    total = float(0.0)
    for pair in range(camera_count * camera_count):
        i = pair / camera_count
        j = pair % camera_count
        if j > i:
            between_m = position_ego_m[i * view_stride] - position_ego_m[j * view_stride]
            distance_m = wp.length(between_m)  # Eq. 7
            total += spacing_violation(distance_m, min_spacing_m) / pair_count
    loss[_CAMERA_SPACING] = total  # Eq. 9


@wp.kernel
def sum_area_around_kernel(
    # in
    measure: wp.array3d[float],
    assigned_camera: wp.array[wp.int32],
    rotation_count: int,
    summed_measure: int,
    # out
    area_around: wp.array[float],
):
    """Area of every vehicle over all directions of its assigned camera; 0 where it has none.

    ``summed_measure`` says which area: VISIBLE_AREA for the denominator of Eq. 14 as printed, AMODAL_AREA for that of
    the vehicle alone.

    A kernel of its own: the backward pass does not run the loop again, so nothing in the same kernel may use the sum.

    Launch: ``dim=vehicle_count``; one thread per vehicle.
    Writes: every element of ``area_around`` [px^2] once.
    """
    vehicle = wp.tid()
    camera = assigned_camera[vehicle]
    around = float(0.0)
    if camera >= 0:
        for a in range(rotation_count):
            around += measure[camera * rotation_count + a, vehicle, summed_measure]
    area_around[vehicle] = around
