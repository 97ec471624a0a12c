"""Lenses other than the pinhole: rays of image places, and how the image of a point moves.

Image places are in focal lengths from the principal point, x to the right and y down. Rays are in camera axes; they
have z = 1 for pinhole and Brown-Conrady lenses and unit length for the others. The inverse of a lens has no closed
form; it is solved by Newton's steps.

What others ask for is kept out of line, so that kernels for pinholes stay small.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

# kinds of lenses
PINHOLE = wp.constant(0)
BROWN_CONRADY = wp.constant(1)
FISHEYE = wp.constant(2)  # any whose radius is a function of the angle from the axis
PANORAMA = wp.constant(3)
# formulas of a FISHEYE, but for the polynomial 0
EUCM = wp.constant(1)
DOUBLE_SPHERE = wp.constant(2)
# formula of a PANORAMA, but for the cylinder 0
SPHERE = wp.constant(1)

# Newton's steps at most, and the step after which the error is far below single precision, being that step's square
_RADIUS_STEPS = wp.constant(32)
_PLACE_STEPS = wp.constant(8)
_LAST_STEP = wp.constant(3.0e-5)
_PLACE_TOLERANCE = wp.constant(1.0e-4)  # of a place that is undistorted and distorted again [focal lengths]
_UNBOUNDED = wp.constant(1.0e9)  # beyond any image
_LEAST_ACROSS = wp.constant(1.0e-6)  # of a fisheye's ray: nearer to the axis it is a pinhole

vec8 = wp.types.vector(length=8, dtype=float)
mat23 = wp.types.matrix(shape=(2, 3), dtype=float)


@wp.struct
class Lens:
    """A lens without its focal length."""

    kind: int  # PINHOLE, BROWN_CONRADY, FISHEYE or PANORAMA
    formula: int  # which FISHEYE or PANORAMA
    # Up to which the radius grows: the angle from the axis of a FISHEYE [rad], its tangent for BROWN_CONRADY
    limit: float
    edge: float  # the radius there; places beyond see nothing
    # k1 k2 p1 p2 k3 k4 k5 k6 of BROWN_CONRADY, k1 k2 k3 k4 of a FISHEYE by polynomial, alpha beta of EUCM, xi alpha of
    # DOUBLE_SPHERE
    distortion: vec8


@wp.struct
class _Factor:
    """By how much a Brown-Conrady lens moves places along the radius."""

    value: float  # new radius over old
    slope: float  # its derivative to the old radius squared


@wp.func
def radial_factor(lens: Lens, squared: float) -> _Factor:
    """The factor of a Brown-Conrady lens at a squared radius."""
    k = lens.distortion
    above = 1.0 + squared * (k[0] + squared * (k[1] + squared * k[4]))
    below = 1.0 + squared * (k[5] + squared * (k[6] + squared * k[7]))
    above_slope = k[0] + squared * (2.0 * k[1] + squared * 3.0 * k[4])
    below_slope = k[5] + squared * (2.0 * k[6] + squared * 3.0 * k[7])
    factor = _Factor()
    factor.value = above / below
    factor.slope = (above_slope - factor.value * below_slope) / below
    return factor


@wp.func
def sphere_terms(lens: Lens, angle: float) -> wp.vec2:
    """Of EUCM or DOUBLE_SPHERE at an angle from the axis: its root d, and what the angle's sine is divided by."""
    sine = wp.sin(angle)
    cosine = wp.cos(angle)
    if lens.formula == EUCM:
        alpha = lens.distortion[0]
        across = wp.sqrt(lens.distortion[1] * sine * sine + cosine * cosine)
        return wp.vec2(across, alpha * across + (1.0 - alpha) * cosine)
    alpha = lens.distortion[1]
    ahead = lens.distortion[0] + cosine
    across = wp.sqrt(sine * sine + ahead * ahead)
    return wp.vec2(across, alpha * across + (1.0 - alpha) * ahead)


@wp.func(inline=False)
def _radius_by_spheres(lens: Lens, angle: float) -> wp.vec2:
    """Radius of an image by EUCM or DOUBLE_SPHERE at an angle from the axis, and its derivative."""
    cosine = wp.cos(angle)
    terms = sphere_terms(lens, angle)
    below = terms[1]
    growth = float(0.0)
    if lens.formula == EUCM:
        alpha = lens.distortion[0]
        growth = alpha * cosine / terms[0] + 1.0 - alpha
    else:
        xi = lens.distortion[0]
        alpha = lens.distortion[1]
        growth = (1.0 + xi * cosine) * (alpha * (cosine + xi) / terms[0] + 1.0 - alpha)
    return wp.vec2(wp.sin(angle) / below, growth / (below * below))


@wp.func
def radius_and_growth(lens: Lens, angle: float) -> wp.vec2:
    """Radius of the image at an angle from the axis (FISHEYE) or at its tangent, and its derivative."""
    squared = angle * angle
    if lens.kind == FISHEYE and lens.formula != 0:
        return _radius_by_spheres(lens, angle)
    if lens.kind == FISHEYE:
        k = lens.distortion
        series = 1.0 + squared * (k[0] + squared * (k[1] + squared * (k[2] + squared * k[3])))
        slope = k[0] + squared * (2.0 * k[1] + squared * (3.0 * k[2] + squared * 4.0 * k[3]))
        return wp.vec2(series * angle, series + 2.0 * squared * slope)
    factor = radial_factor(lens, squared)
    return wp.vec2(factor.value * angle, factor.value + 2.0 * squared * factor.slope)


@wp.func
def angle_at(lens: Lens, radius: float) -> float:
    """The inverse of `radius_and_growth`: Newton's steps, or halvings of the bracket where these do not settle."""
    low = float(0.0)
    high = lens.limit
    last = lens.limit
    angle = wp.min(radius, high)
    for _ in range(_RADIUS_STEPS):
        reached = radius_and_growth(lens, angle)
        if reached[0] <= radius:
            low = angle
        else:
            high = angle
        step = (reached[0] - radius) / reached[1]
        if angle - step < low or angle - step > high or wp.abs(step) > 0.5 * last:
            step = angle - 0.5 * (low + high)
        angle -= step
        last = wp.abs(step)
        if wp.abs(step) < _LAST_STEP:
            break
    return angle


@wp.func
def moved_place(lens: Lens, x: float, y: float) -> wp.vec2:
    """Where a Brown-Conrady lens moves the image of a pinhole."""
    p1 = lens.distortion[2]
    p2 = lens.distortion[3]
    squared = x * x + y * y
    factor = radial_factor(lens, squared)
    return wp.vec2(
        factor.value * x + 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x),
        factor.value * y + p1 * (squared + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


@wp.func
def _moved_place_jacobian(lens: Lens, x: float, y: float) -> wp.mat22:
    """Derivative of `moved_place` to the image of the pinhole."""
    p1 = lens.distortion[2]
    p2 = lens.distortion[3]
    factor = radial_factor(lens, x * x + y * y)
    mixed = 2.0 * factor.slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    return wp.mat22(
        factor.value + 2.0 * factor.slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        mixed,
        mixed,
        factor.value + 2.0 * factor.slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
    )


@wp.func
def _brown_conrady_ray(lens: Lens, x: float, y: float) -> wp.vec3:
    """Ray with z = 1 of a place in a Brown-Conrady image; zero where nothing is seen."""
    radius = wp.sqrt(x * x + y * y)
    place = wp.vec2(x, y)
    pinhole = place
    if radius > 0.0:
        pinhole = angle_at(lens, wp.min(radius, lens.edge)) / radius * place
    if lens.distortion[2] != 0.0 or lens.distortion[3] != 0.0:
        for _ in range(_PLACE_STEPS):
            slope = _moved_place_jacobian(lens, pinhole[0], pinhole[1])
            step = wp.inverse(slope) * (moved_place(lens, pinhole[0], pinhole[1]) - place)
            pinhole -= step
            if wp.length(step) < _LAST_STEP:
                break
    error = wp.length(moved_place(lens, pinhole[0], pinhole[1]) - place)
    # a place that has run away is not a number, and no comparison of it holds
    if error < _PLACE_TOLERANCE and wp.length(pinhole) <= lens.limit:
        return wp.vec3(pinhole[0], pinhole[1], 1.0)
    return wp.vec3(0.0, 0.0, 0.0)


@wp.func
def _fisheye_ray(lens: Lens, x: float, y: float) -> wp.vec3:
    """Ray of unit length of a place in a fisheye's image; zero where nothing is seen."""
    radius = wp.sqrt(x * x + y * y)
    if radius > lens.edge:
        return wp.vec3(0.0, 0.0, 0.0)
    if radius < _LEAST_ACROSS:
        growth = radius_and_growth(lens, 0.0)[1]
        return wp.vec3(x / growth, y / growth, 1.0)
    angle = angle_at(lens, radius)
    share = wp.sin(angle) / radius
    return wp.vec3(share * x, share * y, wp.cos(angle))


@wp.func(inline=False)
def lens_ray(lens: Lens, x: float, y: float) -> wp.vec3:
    """Ray of an image place; zero where nothing is seen."""
    if lens.kind == BROWN_CONRADY:
        return _brown_conrady_ray(lens, x, y)
    if lens.kind == FISHEYE:
        return _fisheye_ray(lens, x, y)
    if lens.formula == SPHERE:
        if wp.abs(y) > 0.5 * wp.pi:
            return wp.vec3(0.0, 0.0, 0.0)
        return wp.vec3(wp.sin(x) * wp.cos(y), wp.sin(y), wp.cos(x) * wp.cos(y))
    return wp.vec3(wp.sin(x), y, wp.cos(x)) / wp.sqrt(1.0 + y * y)


@wp.func
def _fisheye_gradient(lens: Lens, point: wp.vec3) -> mat23:
    """Gradients (rows) of a fisheye's image place to the point."""
    x = point[0]
    y = point[1]
    z = point[2]
    across = wp.sqrt(x * x + y * y)
    if across < _LEAST_ACROSS * z:
        growth = radius_and_growth(lens, 0.0)[1]
        return growth * mat23(1.0 / z, 0.0, -x / (z * z), 0.0, 1.0 / z, -y / (z * z))
    squared = across * across + z * z
    radius = radius_and_growth(lens, wp.atan2(across, z))
    # along the radius the angle turns, across it the image goes round the principal point
    x = x / across
    y = y / across
    along = radius[1] * z / squared
    round_about = radius[0] / across
    back = -radius[1] * across / squared
    return mat23(
        along * x * x + round_about * y * y,
        (along - round_about) * x * y,
        back * x,
        (along - round_about) * x * y,
        along * y * y + round_about * x * x,
        back * y,
    )


@wp.func(inline=False)
def place_gradient(lens: Lens, point: wp.vec3) -> mat23:
    """Gradients (rows) of the image place of a point in camera coordinates to the point [1/m]."""
    x = point[0]
    y = point[1]
    z = point[2]
    if lens.kind == FISHEYE:
        return _fisheye_gradient(lens, point)
    if lens.kind == PANORAMA:
        squared = x * x + z * z
        level = wp.sqrt(squared)
        if lens.formula == SPHERE:
            whole = squared + y * y
            drop = -y / (whole * level)
            return mat23(z / squared, 0.0, -x / squared, drop * x, level / whole, drop * z)
        drop = -y / (squared * level)
        return mat23(z / squared, 0.0, -x / squared, drop * x, 1.0 / level, drop * z)
    w = 1.0 / z
    a = x * w
    b = y * w
    turn = w * _moved_place_jacobian(lens, a, b)
    return mat23(
        turn[0, 0],
        turn[0, 1],
        -turn[0, 0] * a - turn[0, 1] * b,
        turn[1, 0],
        turn[1, 1],
        -turn[1, 0] * a - turn[1, 1] * b,
    )


@wp.func
def _largest_cosine(low: float, high: float) -> float:
    """The largest cosine of the angles between two, which may go round."""
    if wp.floor(high / (2.0 * wp.pi)) >= wp.ceil(low / (2.0 * wp.pi)):
        return 1.0
    return wp.max(wp.cos(low), wp.cos(high))


@wp.func
def _farthest_place(low: float, high: float, least_radius: float, radius: float) -> float:
    """How far right a ring's sector reaches, from angle ``low`` to ``high``."""
    cosine = _largest_cosine(low, high)
    if cosine > 0.0:
        return radius * cosine
    return least_radius * cosine


@wp.func(inline=False)
def cone_bounds(lens: Lens, axis: wp.vec3, half_angle: float) -> wp.vec4:
    """Bounds (left, top, right, bottom) of the image places of a cone of directions; right < left: none.

    The columns of a PANORAMA are those of the turn about azimuth 0, and may reach beyond half a turn.
    """
    x = axis[0]
    y = axis[1]
    z = axis[2]
    everything = wp.vec4(-_UNBOUNDED, -_UNBOUNDED, _UNBOUNDED, _UNBOUNDED)
    if lens.kind == PANORAMA:
        level = wp.sqrt(x * x + z * z)
        drop = wp.atan2(y, level)
        if wp.abs(drop) + half_angle >= 0.5 * wp.pi:
            return everything
        azimuth = wp.atan2(x, z)
        half = wp.asin(wp.min(wp.sin(half_angle) / wp.cos(drop), 1.0))
        if lens.formula == SPHERE:
            return wp.vec4(azimuth - half, drop - half_angle, azimuth + half, drop + half_angle)
        return wp.vec4(azimuth - half, wp.tan(drop - half_angle), azimuth + half, wp.tan(drop + half_angle))
    angle = wp.atan2(wp.sqrt(x * x + y * y), z)
    low = angle - half_angle
    high = angle + half_angle
    limit = lens.limit
    if lens.kind == BROWN_CONRADY:
        limit = wp.atan(lens.limit)
    if low >= limit:
        return wp.vec4(_UNBOUNDED, _UNBOUNDED, -_UNBOUNDED, -_UNBOUNDED)
    low = wp.max(low, 0.0)
    is_all_round = low <= 0.0 or high >= wp.pi
    half = wp.pi
    if not is_all_round:
        half = wp.asin(wp.min(wp.sin(half_angle) / wp.sin(angle), 1.0))
    high = wp.min(high, limit)
    margin = float(0.0)
    if lens.kind == BROWN_CONRADY:
        low = wp.tan(low)
        high = wp.min(wp.tan(high), lens.limit)
        margin = 3.0 * (wp.abs(lens.distortion[2]) + wp.abs(lens.distortion[3])) * high * high
    least_radius = radius_and_growth(lens, low)[0]
    radius = radius_and_growth(lens, high)[0]
    turn = wp.atan2(y, x)
    # left is right after half a turn; down is right after a quarter of a turn back
    left = -_farthest_place(turn - half + wp.pi, turn + half + wp.pi, least_radius, radius)
    right = _farthest_place(turn - half, turn + half, least_radius, radius)
    top = -_farthest_place(turn - half + 0.5 * wp.pi, turn + half + 0.5 * wp.pi, least_radius, radius)
    bottom = _farthest_place(turn - half - 0.5 * wp.pi, turn + half - 0.5 * wp.pi, least_radius, radius)
    return wp.vec4(left - margin, top - margin, right + margin, bottom + margin)
