"""Planes through the neighbourhoods of points: the direction in which a neighbourhood is thinnest."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def fit_normals_kernel(
    # in
    point_m: wp.array[wp.vec3],
    sensor_m: wp.array[wp.vec3],
    neighbour: wp.array2d[int],
    # out
    normal: wp.array[wp.vec3],
):
    """Normal of the plane through a point's neighbours (principal components), turned towards the sensor.

    Launch: ``dim=point_count``. Not taped.
    Writes: every element of ``normal``.
    """
    p = wp.tid()
    count = neighbour.shape[1]
    mean_m = wp.vec3(0.0, 0.0, 0.0)
    for k in range(count):
        mean_m += (point_m[neighbour[p, k]] - point_m[p]) / float(count)
    spread_m2 = wp.mat33(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for k in range(count):
        offset_m = point_m[neighbour[p, k]] - point_m[p] - mean_m
        spread_m2 += wp.outer(offset_m, offset_m)
    # eigenvectors turn in single precision where the matrix is as small as squared millimetres
    axes, size = wp.eig3(spread_m2 / wp.max(wp.trace(spread_m2), 1.0e-30))
    thinnest = int(0)
    for axis in range(1, 3):
        if size[axis] < size[thinnest]:
            thinnest = axis
    found = wp.vec3(axes[0, thinnest], axes[1, thinnest], axes[2, thinnest])
    if wp.dot(found, sensor_m[p] - point_m[p]) < 0.0:
        found = -found
    normal[p] = found
