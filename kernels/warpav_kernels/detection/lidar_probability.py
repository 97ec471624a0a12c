"""How probable it is that a LiDAR or a radar finds an object, from how much of it shows and how far it is."""

import warp as wp

_SOFT_RANGE = wp.constant(0.05)  # of the range, over which returns fade


@wp.kernel
def lidar_probability_kernel(
    # in
    points: wp.array3d[float],
    distance_m: wp.array2d[float],
    points_for_half: wp.array[float],
    steepness: float,
    range_m: wp.array[float],
    most: wp.array2d[float],
    # out
    returned: wp.array2d[float],
    probability: wp.array2d[float],
):
    """Points of which a return is expected, and the probability that an object with so many is found.

    Of the points on an object at the distance r the share ``1 / (1 + exp((r - R) / .05 R))`` returns, with R the range.
    With n returned points, h of which give an even chance, and the steepness k the probability is
    ``m (1 - exp(-n)) q / (1 + q)`` with ``q = ((1 + n) / (1 + h))^k``: 0 where nothing returns, m at ``most``. Of a
    radar points are percent of the object's box.

    Launch: ``dim=(view_count, object_count)``; no gradient is added by two threads.
    Writes: every element of ``returned`` and ``probability`` [view, object] once.
    """
    v, k = wp.tid()
    beyond = (distance_m[v, k] - range_m[k]) / (_SOFT_RANGE * range_m[k])
    n = wp.max(points[v, k, 0], 0.0) / (1.0 + wp.exp(wp.min(beyond, 80.0)))
    logit = steepness * (wp.log(1.0 + n) - wp.log(1.0 + points_for_half[k]))
    returned[v, k] = n
    probability[v, k] = most[v, k] * (1.0 - wp.exp(-n)) / (1.0 + wp.exp(wp.clamp(-logit, -80.0, 80.0)))
