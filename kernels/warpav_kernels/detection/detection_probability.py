"""How probable it is that a detector finds an object in a view, from what the view shows of it.

The logit is a constant plus one curve for each feature (a generalised additive model), for each kind of object. A curve
is a uniform cubic B-spline whose coefficients go on along straight lines beyond both ends: so it is natural, twice
continuously differentiable everywhere, and straight outside the range that it was fitted on.
"""

import warp as wp

from warpav_kernels.raster import AMODAL_AREA, BOTTOM, FISHEYE, LEFT, PANORAMA, RIGHT, TOP, VISIBLE_AREA, Lens

# the features of an object in a view, in this order
VISIBLE_SIZE = wp.constant(0)  # ln(1 + visible area / px^2)
VISIBLE_SHARE = wp.constant(1)  # visible area over the area of the object alone, inside the image
IN_FRAME_SHARE = wp.constant(2)  # solid angle of the object alone inside the image, over that of its box
_ASPECT = wp.constant(3)  # ln of (width + 1 px) over (height + 1 px) of the object alone inside the image
_BORDER_DISTANCE = wp.constant(4)  # ln(4 + least distance of that extent from the image's border / px), softly
CONTRAST = wp.constant(5)  # distance of the object's mean colour from that of its surroundings
ELEVATION = wp.constant(6)  # sine of the elevation of the line of sight from the view to the middle of its box
UPRIGHT = wp.constant(7)  # cosine of the angle in the image between a vertical edge there and the image's columns
FEATURE_COUNT = wp.constant(8)


@wp.func
def _corner_solid_angle(depth_m: float, a_m: float, b_m: float) -> float:
    """Signed solid angle of the rectangle from (0, 0) to (a, b) in a plane at a positive depth [sr]."""
    return wp.atan2(a_m * b_m, depth_m * wp.sqrt(depth_m * depth_m + a_m * a_m + b_m * b_m))


@wp.func
def _face_solid_angle(beyond_m: float, a_m: float, b_m: float, half_a_m: float, half_b_m: float) -> float:
    """Solid angle of a box's face from ``beyond_m`` above its plane and (a, b) off its middle [sr]; 0 from behind."""
    if beyond_m <= 0.0:
        return 0.0
    return (
        _corner_solid_angle(beyond_m, half_a_m - a_m, half_b_m - b_m)
        + _corner_solid_angle(beyond_m, half_a_m + a_m, half_b_m - b_m)
        + _corner_solid_angle(beyond_m, half_a_m - a_m, half_b_m + b_m)
        + _corner_solid_angle(beyond_m, half_a_m + a_m, half_b_m + b_m)
    )


@wp.kernel
def box_solid_angle_kernel(
    # in
    position_ego_m: wp.array[wp.vec3],
    centre_ego_m: wp.array[wp.vec3],
    half_size_m: wp.array[wp.vec3],
    along: wp.array[wp.vec2],
    # out
    solid_angle_sr: wp.array2d[float],
):
    """Solid angle of every object's upright box from the centre of every view, in closed form.

    The first axis of a box points along the unit vector ``along`` (ego x, y), the third upwards. Convex bodies cover
    what their faces that look at the eye cover. From within a box it is 0.

    Launch: ``dim=view_count``; one thread per view, so that a pose's gradient is summed in a fixed order.
    Writes: every element of ``solid_angle_sr`` [view, object] once.
    """
    v = wp.tid()
    for k in range(solid_angle_sr.shape[1]):
        away = position_ego_m[v] - centre_ego_m[k]
        x = along[k][0] * away[0] + along[k][1] * away[1]
        y = along[k][0] * away[1] - along[k][1] * away[0]
        z = away[2]
        half = half_size_m[k]
        solid_angle_sr[v, k] = (
            _face_solid_angle(wp.abs(x) - half[0], y, z, half[1], half[2])
            + _face_solid_angle(wp.abs(y) - half[1], x, z, half[0], half[2])
            + _face_solid_angle(wp.abs(z) - half[2], x, y, half[0], half[1])
        )


_LEAST_COSINE = wp.constant(0.05)  # to the optical axis: beyond, a pinhole's image is taken as that there
_NEAR_AXIS = wp.constant(1.0e-4)  # sine of the angle to it, squared, up to which a fisheye's slope is that on it


@wp.func
def _towards_axis(kind: int, d: wp.vec3) -> float:
    """By how much an image at the direction d moves along its radius, over itself, as d_z grows."""
    if kind != FISHEYE:
        return -1.0 / wp.max(d[2], _LEAST_COSINE)
    sine_squared = d[0] * d[0] + d[1] * d[1]
    if sine_squared < _NEAR_AXIS:
        return -1.0 / 3.0
    sine = wp.sqrt(sine_squared)
    angle = wp.atan2(sine, d[2])
    return (angle * d[2] / sine - 1.0) / (sine * angle)


@wp.func
def _edge_in_image(kind: int, d: wp.vec3, up: wp.vec3) -> wp.vec2:
    """Where the image of an edge along ``up``, seen in the unit direction d, runs, both in camera axes; any length.

    Pinholes and polynomials of a low degree, Brown-Conrady's, agree well enough, and so do all fisheyes.
    """
    across = up - wp.dot(up, d) * d
    if kind == PANORAMA:
        radius = wp.sqrt(wp.max(d[0] * d[0] + d[2] * d[2], 1.0e-12))
        return wp.vec2((across[0] * d[2] - d[0] * across[2]) / radius, across[1])
    along = _towards_axis(kind, d) * across[2]
    return wp.vec2(across[0] + along * d[0], across[1] + along * d[1])


@wp.kernel
def line_of_sight_kernel(
    # in
    position_ego_m: wp.array[wp.vec3],
    camera_from_ego: wp.array[wp.mat33],
    lens: wp.array[Lens],
    centre_ego_m: wp.array[wp.vec3],
    # out
    elevation: wp.array2d[float],
    upright: wp.array2d[float],
):
    """Elevation of the line of sight from every view to every place, and how upright a vertical edge there is.

    The sine of the one; the other is the cosine of the edge's angle to the columns of the image, 1 where it stands and
    -1 on its head. One ``lens`` serves all views.

    Launch: ``dim=view_count``; one thread per view, so that a pose's gradient is summed in a fixed order.
    Writes: every element of ``elevation`` and ``upright`` [view, object] once.
    """
    v = wp.tid()
    up = camera_from_ego[v] * wp.vec3(0.0, 0.0, 1.0)
    kind = lens[v % lens.shape[0]].kind
    for k in range(elevation.shape[1]):
        towards = centre_ego_m[k] - position_ego_m[v]
        towards = towards / wp.max(wp.length(towards), 1.0e-6)
        elevation[v, k] = towards[2]
        edge = _edge_in_image(kind, camera_from_ego[v] * towards, up)
        upright[v, k] = -edge[1] / wp.sqrt(edge[0] * edge[0] + edge[1] * edge[1] + 1.0e-12)


@wp.func
def _cubic_spline(
    coefficient: wp.array3d[float], kind: int, curve: int, start: wp.array[float], step: wp.array[float], x: float
) -> float:
    """Value of a curve at x, its knots being ``start[curve] + i step[curve]``."""
    last = coefficient.shape[2] - 1
    u = (x - start[curve]) / step[curve]
    if u <= 0.0:
        return coefficient[kind, curve, 0] + u * (coefficient[kind, curve, 1] - coefficient[kind, curve, 0])
    if u >= float(last):
        slope = coefficient[kind, curve, last] - coefficient[kind, curve, last - 1]
        return coefficient[kind, curve, last] + (u - float(last)) * slope
    i = wp.min(int(u), last - 1)
    t = u - float(i)
    c1 = coefficient[kind, curve, i]
    c2 = coefficient[kind, curve, i + 1]
    c0 = 2.0 * c1 - c2
    if i > 0:
        c0 = coefficient[kind, curve, i - 1]
    c3 = 2.0 * c2 - c1
    if i + 2 <= last:
        c3 = coefficient[kind, curve, i + 2]
    s = 1.0 - t
    return (
        s * s * s * c0
        + (3.0 * t * t * t - 6.0 * t * t + 4.0) * c1
        + (3.0 * s * s * s - 6.0 * s * s + 4.0) * c2
        + t * t * t * c3
    ) / 6.0


@wp.func
def _soft_border_distance_px(
    left: float, right: float, top: float, bottom: float, width: float, height: float
) -> float:
    """Least of four distances from the image's border [px], or up to ln 4 px less: smooth where two are alike."""
    a = left
    b = width - right
    c = top
    d = height - bottom
    least = wp.min(wp.min(a, b), wp.min(c, d))
    return least - wp.log(wp.exp(least - a) + wp.exp(least - b) + wp.exp(least - c) + wp.exp(least - d))


@wp.kernel
def detection_probability_kernel(
    # in
    measure: wp.array3d[float],
    in_frame_sr: wp.array3d[float],
    whole_sr: wp.array2d[float],
    elevation: wp.array2d[float],
    upright: wp.array2d[float],
    contrast: wp.array2d[float],
    kind: wp.array[int],
    width_px: float,
    height_px: float,
    scale_x: float,
    scale_y: float,
    coefficient: wp.array3d[float],
    start: wp.array[float],
    step: wp.array[float],
    constant: wp.array[float],
    # out
    feature: wp.array3d[float],
    probability: wp.array2d[float],
):
    """The features of every object in every view, and the probability that the detector finds it there.

    The curve of feature f has the knots ``start[f] + i step[f]`` and, for objects of kind q, the B-spline coefficients
    ``coefficient[q, f]``; the logit is their sum plus ``constant[q]``. Kinds beyond the last take those of the first.
    Pixels are those of the network's input, ``scale_x`` by ``scale_y`` of them for one of the image. What shows less
    than a pixel fades out: the probability of an object of which nothing is visible is 0, and so are all its features.

    Launch: ``dim=(view_count, object_count)``; no gradient is added by two threads.
    Writes: every element of ``feature`` [view, object, feature] and ``probability`` [view, object] once.
    """
    v, k = wp.tid()
    visible_px = measure[v, k, VISIBLE_AREA] * scale_x * scale_y
    alone_px = measure[v, k, AMODAL_AREA] * scale_x * scale_y
    if visible_px <= 0.0 or alone_px <= 0.0 or whole_sr[v, k] <= 0.0:
        for f in range(FEATURE_COUNT):
            feature[v, k, f] = 0.0
        probability[v, k] = 0.0
        return
    left = measure[v, k, LEFT] * scale_x
    right = measure[v, k, RIGHT] * scale_x
    top = measure[v, k, TOP] * scale_y
    bottom = measure[v, k, BOTTOM] * scale_y
    width = width_px * scale_x
    height = height_px * scale_y
    size = wp.log(1.0 + visible_px)
    visible_share = visible_px / alone_px
    in_frame_share = in_frame_sr[v, k, 0] / whole_sr[v, k]
    aspect = wp.log((right - left + 1.0) / (bottom - top + 1.0))
    # extents that were carried on along their Jacobian may leave the image, where the logarithm would end
    border = wp.log(wp.max(4.0 + _soft_border_distance_px(left, right, top, bottom, width, height), 1.0))
    feature[v, k, VISIBLE_SIZE] = size
    feature[v, k, VISIBLE_SHARE] = visible_share
    feature[v, k, IN_FRAME_SHARE] = in_frame_share
    feature[v, k, _ASPECT] = aspect
    feature[v, k, _BORDER_DISTANCE] = border
    feature[v, k, CONTRAST] = contrast[v, k]
    feature[v, k, ELEVATION] = elevation[v, k]
    feature[v, k, UPRIGHT] = upright[v, k]
    q = int(0)
    if kind[k] < constant.shape[0]:
        q = kind[k]
    logit = (
        constant[q]
        + _cubic_spline(coefficient, q, VISIBLE_SIZE, start, step, size)
        + _cubic_spline(coefficient, q, VISIBLE_SHARE, start, step, visible_share)
        + _cubic_spline(coefficient, q, IN_FRAME_SHARE, start, step, in_frame_share)
        + _cubic_spline(coefficient, q, _ASPECT, start, step, aspect)
        + _cubic_spline(coefficient, q, _BORDER_DISTANCE, start, step, border)
        + _cubic_spline(coefficient, q, CONTRAST, start, step, contrast[v, k])
        + _cubic_spline(coefficient, q, ELEVATION, start, step, elevation[v, k])
        + _cubic_spline(coefficient, q, UPRIGHT, start, step, upright[v, k])
    )
    # the smooth step of fifth order: 0 at nothing, 1 from a pixel on, no kink of the second derivative
    fade = float(1.0)
    if visible_px < 1.0:
        fade = visible_px * visible_px * visible_px * (visible_px * (6.0 * visible_px - 15.0) + 10.0)
    if logit >= 0.0:
        probability[v, k] = fade / (1.0 + wp.exp(-logit))
    else:
        grown = wp.exp(logit)
        probability[v, k] = fade * grown / (1.0 + grown)
