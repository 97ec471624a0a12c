"""Taped: measures as a function of the views' poses, exact to first order around the rendered poses."""

import warp as wp


@wp.kernel
def linearise_measures_kernel(
    # in
    position_ego_m: wp.array[wp.vec3],
    camera_from_ego: wp.array[wp.mat33],
    rendered_position_ego_m: wp.array[wp.vec3],
    rendered_camera_from_ego: wp.array[wp.mat33],
    log_zoom: wp.array[float],
    rendered_log_zoom: wp.array[float],
    rendered_measure: wp.array3d[float],
    per_shift: wp.array3d[wp.vec3],
    per_spin: wp.array3d[wp.vec3],
    per_zoom: wp.array3d[float],
    # out
    measure: wp.array3d[float],
):
    """The rendered measures plus their Jacobians times the change of pose and of focal length.

    At the rendered poses the value is the rendered one and the gradient is the Jacobian; so plain automatic
    differentiation of what follows sees the whole renderer, and the render's buffers are free again as soon as they
    have been measured. ``log_zoom`` is the logarithm of each view's focal length over its lens's,
    ``rendered_log_zoom`` that at which it was rendered.

    Launch: ``dim=view_count``; one thread per view, so that a pose's gradient is summed in a fixed order.
    Writes: every element of ``measure`` [view, vehicle, measure] once.
    """
    v = wp.tid()
    shift_m = position_ego_m[v] - rendered_position_ego_m[v]
    # the rotation from the rendered to the present axes; its antisymmetric part is the spin
    turn = camera_from_ego[v] * wp.transpose(rendered_camera_from_ego[v])
    spin_rad = 0.5 * wp.vec3(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])
    zoom = log_zoom[v] - rendered_log_zoom[v]
    for vehicle in range(measure.shape[1]):
        for i in range(measure.shape[2]):
            measure[v, vehicle, i] = (
                rendered_measure[v, vehicle, i]
                + wp.dot(per_shift[v, vehicle, i], shift_m)
                + wp.dot(per_spin[v, vehicle, i], spin_rad)
                + per_zoom[v, vehicle, i] * zoom
            )


@wp.kernel
def linearise_window_kernel(
    # in
    window_rad: wp.array[wp.vec4],
    rendered_window_rad: wp.array[wp.vec4],
    still_measure: wp.array3d[float],
    per_window: wp.array2d[wp.vec4],
    # out
    measure: wp.array3d[float],
):
    """Measures with a still window plus their Jacobian times the change of the window.

    Launch: ``dim=view_count``; one thread per view, so that a window's gradient is summed in a fixed order.
    Writes: every element of ``measure`` [view, vehicle, 0] once.
    """
    v = wp.tid()
    change_rad = window_rad[v] - rendered_window_rad[v]
    for vehicle in range(measure.shape[1]):
        measure[v, vehicle, 0] = still_measure[v, vehicle, 0] + wp.dot(per_window[v, vehicle], change_rad)
