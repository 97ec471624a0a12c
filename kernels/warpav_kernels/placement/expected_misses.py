"""Taped: how many of a scene's objects a rig is expected to miss, from the probability that each view finds each.

View ``camera * rotation_count + a`` is the camera turned by a of its rotational additions; a = 0 is where it really
looks. The further ones are a panorama from the camera's place: there an object outside the image has a probability too.
"""

import warp as wp

from warpav_kernels.detection.detection_probability import IN_FRAME_SHARE, VISIBLE_SHARE

_SUREST = wp.constant(0.9999)
"""Greatest probability that counts, so that an object that one camera surely finds still has a gradient."""


@wp.kernel
def box_share_kernel(
    # in
    feature: wp.array3d[float],
    hiding_counts: int,
    # out
    probability: wp.array2d[float],
):
    """Share of an object's whole box that a view shows, for comparison with a fitted probability of detection.

    Its share inside the image, with ``hiding_counts`` times what nothing hides of that; 0 where nothing is visible, at
    most 1, as a pixel may be larger than a far box.

    Launch: ``dim=(view_count, object_count)``.
    Writes: every element of ``probability`` once.
    """
    view, k = wp.tid()
    if hiding_counts != 0:
        share = feature[view, k, IN_FRAME_SHARE] * feature[view, k, VISIBLE_SHARE]
        probability[view, k] = wp.min(share, 1.0)
    else:
        probability[view, k] = feature[view, k, IN_FRAME_SHARE]


@wp.kernel(enable_backward=False)
def find_best_views_kernel(
    # in
    probability: wp.array2d[float],
    rotation_count: int,
    # out
    best_view: wp.array2d[wp.int32],
):
    """The view of every camera's panorama in which an object is most likely to be found; of equal ones the first.

    Launch: ``dim=(camera_count, object_count)``. Not taped.
    Writes: every element of ``best_view`` once.
    """
    camera, k = wp.tid()
    best = int(0)
    for a in range(1, rotation_count):
        if probability[camera * rotation_count + a, k] > probability[camera * rotation_count + best, k]:
            best = a
    best_view[camera, k] = camera * rotation_count + best


@wp.kernel
def sum_over_panorama_kernel(
    # in
    solid_angle_sr: wp.array3d[float],
    rotation_count: int,
    # out
    around_sr: wp.array2d[float],
):
    """Solid angle of every object over all views of every camera's panorama.

    Launch: ``dim=(camera_count, object_count)``.
    Writes: every element of ``around_sr`` [sr] once.
    """
    camera, k = wp.tid()
    around = float(0.0)
    for a in range(rotation_count):
        around += solid_angle_sr[camera * rotation_count + a, k, 0]
    around_sr[camera, k] = around


@wp.kernel
def camera_probability_kernel(
    # in
    probability: wp.array2d[float],
    best_view: wp.array2d[wp.int32],
    in_window_sr: wp.array2d[float],
    around_sr: wp.array2d[float],
    panorama_share: wp.array[float],
    rotation_count: int,
    # out
    found: wp.array2d[float],
):
    """Probability that a camera finds an object: as it looks, blended with what it would find if it turned.

    With p of the view ahead, q of the best view of the panorama, and w the share of the object's visible solid angle
    that lies in the soft window of the camera's field of view: (1 - b) p + b w q, b = ``panorama_share[0]``. What lies
    outside the image adds nothing to p, whatever is done, but pulls through w.

    Launch: ``dim=(camera_count, object_count)``; no gradient is added by two threads.
    Writes: every element of ``found`` once.
    """
    camera, k = wp.tid()
    blend = panorama_share[0]
    ahead = probability[camera * rotation_count, k]
    turned = float(0.0)
    if around_sr[camera, k] > 0.0:
        turned = in_window_sr[camera, k] / around_sr[camera, k] * probability[best_view[camera, k], k]
    found[camera, k] = (1.0 - blend) * ahead + blend * turned


@wp.kernel(enable_backward=False)
def find_surest_cameras_kernel(
    # in
    found: wp.array2d[float],
    detected: wp.array2d[float],
    detector_share: wp.array[float],
    # out
    counted_camera: wp.array[wp.int32],
):
    """The camera that is most likely to find an object, of equal ones the first; p as in `log_missed_kernel`.

    Launch: ``dim=object_count``. Not taped.
    Writes: every element of ``counted_camera`` once.
    """
    k = wp.tid()
    surest = int(0)
    highest = float(-1.0)
    for camera in range(found.shape[0]):
        p = (1.0 - detector_share[0]) * found[camera, k] + detector_share[0] * detected[camera, k]
        if p > highest:
            highest = p
            surest = camera
    counted_camera[k] = surest


@wp.kernel
def log_missed_kernel(
    # in
    found: wp.array2d[float],
    detected: wp.array2d[float],
    detector_share: wp.array[float],
    counted_camera: wp.array[wp.int32],
    # out
    log_missed: wp.array[float],
):
    """Logarithm of the probability that no camera finds an object, if cameras err independently (noisy or).

    The product over cameras of 1 - p, with p = (1 - d) found + d detected, d = ``detector_share[0]``: what the detector
    really found corrects the model, so that the gradient goes to the objects that are really missed.

    A sum of logarithms, for a product that a loop carries has no adjoint. ``counted_camera`` names the one camera that
    counts for an object; -1: all do.

    Launch: ``dim=object_count``; one thread per object.
    Writes: every element of ``log_missed`` once.
    """
    k = wp.tid()
    total = float(0.0)
    for camera in range(found.shape[0]):
        p = (1.0 - detector_share[0]) * found[camera, k] + detector_share[0] * detected[camera, k]
        if counted_camera[k] < 0 or counted_camera[k] == camera:
            total += wp.log(1.0 - wp.min(p, _SUREST))
    log_missed[k] = total


@wp.kernel
def expected_misses_kernel(
    # in
    log_missed: wp.array[float],
    weight: wp.array[float],
    # out
    loss: wp.array[float],
):
    """Expected number of missed objects, each counted as often as its ``weight`` says.

    Launch: ``dim=1``; one thread sums in a fixed order.
    Writes: ``loss[0]`` once.
    """
    total = float(0.0)
    for k in range(log_missed.shape[0]):
        total += weight[k] * wp.exp(log_missed[k])
    loss[0] = total
