"""Taped: the parts of poses, and measures as a function of them, exact to first order around the rendered poses."""

import warp as wp


@wp.kernel
def split_pose_kernel(
    # in
    camera_from_world: wp.array[wp.mat44],
    # out
    position_world_m: wp.array[wp.vec3],
    rotation: wp.array[wp.mat33],
):
    """Camera centre and rotation of rigid transformations.

    Launch: ``dim=view_count``; one thread per view.
    Writes: every element of ``position_world_m`` and ``rotation`` once.
    """
    v = wp.tid()
    pose = camera_from_world[v]
    # fmt: off
    turn = wp.mat33(
        pose[0, 0], pose[0, 1], pose[0, 2],
        pose[1, 0], pose[1, 1], pose[1, 2],
        pose[2, 0], pose[2, 1], pose[2, 2],
    )
    # fmt: on
    rotation[v] = turn
    position_world_m[v] = -(wp.transpose(turn) * wp.vec3(pose[0, 3], pose[1, 3], pose[2, 3]))


@wp.kernel
def linearise_measures_kernel(
    # in
    position_world_m: wp.array[wp.vec3],
    camera_from_world: wp.array[wp.mat33],
    rendered_position_world_m: wp.array[wp.vec3],
    rendered_camera_from_world: wp.array[wp.mat33],
    log_focal: wp.array[float],
    rendered_log_focal: wp.array[float],
    rendered_measure: wp.array3d[float],
    jac_translation: wp.array3d[wp.vec3],
    jac_rotation: wp.array3d[wp.vec3],
    jac_log_focal: wp.array3d[float],
    # out
    measure: wp.array3d[float],
):
    """The rendered measures plus their Jacobians times the change of pose and of focal length.

    At the rendered poses the value is the rendered one and the gradient is the Jacobian; so plain automatic
    differentiation of what follows sees the whole renderer, and the render's buffers are free again as soon as they
    have been measured. ``log_focal`` is the logarithm of each view's focal length over its lens's,
    ``rendered_log_focal`` that at which it was rendered.

    Launch: ``dim=view_count``; one thread per view, so that a pose's gradient is summed in a fixed order.
    Writes: every element of ``measure`` [view, object, measure] once.
    """
    v = wp.tid()
    shift_m = position_world_m[v] - rendered_position_world_m[v]
    # the rotation from the rendered to the present axes; its antisymmetric part is the spin
    turn = camera_from_world[v] * wp.transpose(rendered_camera_from_world[v])
    spin_rad = 0.5 * wp.vec3(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])
    zoom = log_focal[v] - rendered_log_focal[v]
    for object_index in range(measure.shape[1]):
        for i in range(measure.shape[2]):
            measure[v, object_index, i] = (
                rendered_measure[v, object_index, i]
                + wp.dot(jac_translation[v, object_index, i], shift_m)
                + wp.dot(jac_rotation[v, object_index, i], spin_rad)
                + jac_log_focal[v, object_index, i] * zoom
            )


@wp.kernel
def linearise_window_kernel(
    # in
    window_rad: wp.array[wp.vec4],
    rendered_window_rad: wp.array[wp.vec4],
    still_measure: wp.array3d[float],
    jac_window: wp.array2d[wp.vec4],
    # out
    measure: wp.array3d[float],
):
    """Measures with a still window plus their Jacobian times the change of the window.

    Launch: ``dim=view_count``; one thread per view, so that a window's gradient is summed in a fixed order.
    Writes: every element of ``measure`` [view, object, 0] once.
    """
    v = wp.tid()
    change_rad = window_rad[v] - rendered_window_rad[v]
    for object_index in range(measure.shape[1]):
        measure[v, object_index, 0] = still_measure[v, object_index, 0] + wp.dot(
            jac_window[v, object_index], change_rad
        )


@wp.kernel(enable_backward=False)
def add_pose_gradient_kernel(
    # in
    camera_from_world: wp.array[wp.mat33],
    jac_translation: wp.array3d[wp.vec3],
    jac_rotation: wp.array3d[wp.vec3],
    jac_log_focal: wp.array3d[float],
    # out
    position_gradient: wp.array[wp.vec3],
    rotation_gradient: wp.array[wp.mat33],
    log_focal_gradient: wp.array[float],
):
    """Add the Jacobians of every view's measures, summed, to the gradients to its pose and focal length.

    A rotation R turned by a small spin s is R + [s]x R, so a gradient m to the spin is the gradient [m]x R / 2 to R.

    Launch: ``dim=view_count``; one thread per view. Not taped.
    Writes: adds to every element of the three gradients.
    """
    v = wp.tid()
    translation = wp.vec3(0.0, 0.0, 0.0)
    rotation = wp.vec3(0.0, 0.0, 0.0)
    log_focal = float(0.0)
    for object_index in range(jac_log_focal.shape[1]):
        for i in range(jac_log_focal.shape[2]):
            translation += jac_translation[v, object_index, i]
            rotation += jac_rotation[v, object_index, i]
            log_focal += jac_log_focal[v, object_index, i]
    position_gradient[v] = position_gradient[v] + translation
    rotation_gradient[v] = rotation_gradient[v] + 0.5 * (wp.skew(rotation) * camera_from_world[v])
    log_focal_gradient[v] = log_focal_gradient[v] + log_focal
