"""Poisson surface reconstruction on a grid: from oriented points to a field that is 0 on the surface.

Lengths are in cells of the grid at hand; grids are vertex-centred, and the one that is a level coarser keeps every
second node. At the border every field is mirrored. Where threads write into the same nodes, they are launched in turns
(colours), so that sums run in a fixed order on every device.
"""

import warp as wp

# loops over three neighbours stay loops: as fast, and compiled in 3.7 s instead of 4.5
wp.set_module_options({"enable_backward": False, "max_unroll": 2})

_SHEET_PEAK = wp.constant(
    0.55
)  # of a sheet of points, splat and read again with `_spline_weights`: share at its middle
_JUMP_SLOPE = wp.constant(0.55)  # slope per cell of the field's blurred jump at the surface
_HALF_JUMP = wp.constant(0.5)


@wp.func
def _mirrored(index: int, count: int) -> int:
    """An index at most one step outside a row of nodes, mirrored at the row's end."""
    if index < 0:
        return 1
    if index == count:
        return count - 2
    return index


@wp.func
def _spline_weights(distance: float) -> wp.vec3:
    """Quadratic B-spline at a node's neighbours and itself, for a point so many cells (up to 1/2) after the node."""
    before = 0.5 - distance
    after = 0.5 + distance
    return wp.vec3(0.5 * before * before, 0.75 - distance * distance, 0.5 * after * after)


@wp.kernel
def splat_density_kernel(
    # in
    place: wp.array[wp.vec3],
    nearest_node: wp.array[wp.vec3i],
    group_start: wp.array[int],
    first_group: int,
    # out
    density: wp.array3d[float],
):
    """Number of points near every node.

    Launch: ``dim=groups of one colour``; thread g takes the points ``group_start[first_group + g]`` up to the next
    start, which share their nearest node; nearest nodes within a launch are 3 or more apart along some axis. Not taped.
    Writes: 27 nodes around each group, added to; the caller zeroes them.
    """
    group = first_group + wp.tid()
    middle = nearest_node[group_start[group]]
    i = middle[0] - 1
    j = middle[1] - 1
    k = middle[2] - 1
    for p in range(group_start[group], group_start[group + 1]):
        x = _spline_weights(place[p][0] - float(middle[0]))
        y = _spline_weights(place[p][1] - float(middle[1]))
        z = _spline_weights(place[p][2] - float(middle[2]))
        for a in range(3):
            for b in range(3):
                for c in range(3):
                    density[i + a, j + b, k + c] = density[i + a, j + b, k + c] + x[a] * y[b] * z[c]


@wp.kernel
def read_density_kernel(
    # in
    place: wp.array[wp.vec3],
    nearest_node: wp.array[wp.vec3i],
    density: wp.array3d[float],
    # out
    points_per_face: wp.array[float],
):
    """How many points the surface holds around every point, per area of a cell's face.

    Launch: ``dim=point_count``. Not taped.
    Writes: every element of ``points_per_face``.
    """
    p = wp.tid()
    middle = nearest_node[p]
    x = _spline_weights(place[p][0] - float(middle[0]))
    y = _spline_weights(place[p][1] - float(middle[1]))
    z = _spline_weights(place[p][2] - float(middle[2]))
    total = float(0.0)
    for a in range(3):
        for b in range(3):
            for c in range(3):
                total += x[a] * y[b] * z[c] * density[middle[0] - 1 + a, middle[1] - 1 + b, middle[2] - 1 + c]
    points_per_face[p] = total / _SHEET_PEAK


@wp.kernel
def splat_normals_kernel(
    # in
    place: wp.array[wp.vec3],
    nearest_node: wp.array[wp.vec3i],
    area_normal: wp.array[wp.vec3],
    group_start: wp.array[int],
    first_group: int,
    # out
    flux: wp.array3d[wp.vec3],
    area: wp.array3d[float],
    height: wp.array3d[float],
):
    """Oriented points as a vector field, and how high every node lies above the points' planes.

    ``area_normal`` is a normal times the area that its point stands for [faces of a cell].

    Launch: as `splat_density_kernel`. Not taped.
    Writes: 27 nodes around each group, added to; the caller zeroes them. ``height`` is weighted by ``area``.
    """
    group = first_group + wp.tid()
    middle = nearest_node[group_start[group]]
    i = middle[0] - 1
    j = middle[1] - 1
    k = middle[2] - 1
    for p in range(group_start[group], group_start[group + 1]):
        x = _spline_weights(place[p][0] - float(middle[0]))
        y = _spline_weights(place[p][1] - float(middle[1]))
        z = _spline_weights(place[p][2] - float(middle[2]))
        to_first = wp.vec3(float(i), float(j), float(k)) - place[p]
        above = wp.dot(area_normal[p], to_first)
        size = wp.length(area_normal[p])
        for a in range(3):
            for b in range(3):
                for c in range(3):
                    weight = x[a] * y[b] * z[c]
                    rise = above + float(a) * area_normal[p][0] + float(b) * area_normal[p][1]
                    rise += float(c) * area_normal[p][2]
                    flux[i + a, j + b, k + c] = flux[i + a, j + b, k + c] + weight * area_normal[p]
                    area[i + a, j + b, k + c] = area[i + a, j + b, k + c] + weight * size
                    height[i + a, j + b, k + c] = height[i + a, j + b, k + c] + weight * rise


@wp.kernel
def state_equation_kernel(
    # in
    flux: wp.array3d[wp.vec3],
    area: wp.array3d[float],
    height: wp.array3d[float],
    screening: float,
    scale: float,
    lanes: int,
    # out
    source: wp.array3d[float],
    screen: wp.array3d[float],
):
    """The equation ``screen x - laplacian x = source`` of the screened Poisson problem.

    Near points the field is asked to rise as their planes do, with ``screening`` times the points' area as weight.

    Launch: ``dim=(nodes along x, nodes along y, lanes)``; lanes share a column of nodes. Not taped.
    Writes: every element of ``source`` and ``screen``, added to, times ``scale``.
    """
    i, j, lane = wp.tid()
    before_i = _mirrored(i - 1, area.shape[0])
    after_i = _mirrored(i + 1, area.shape[0])
    before_j = _mirrored(j - 1, area.shape[1])
    after_j = _mirrored(j + 1, area.shape[1])
    for k in range(lane, area.shape[2], lanes):
        x = flux[after_i, j, k][0] - flux[before_i, j, k][0]
        y = flux[i, after_j, k][1] - flux[i, before_j, k][1]
        z = flux[i, j, _mirrored(k + 1, area.shape[2])][2] - flux[i, j, _mirrored(k - 1, area.shape[2])][2]
        weight = screening * area[i, j, k]
        wanted = float(0.0)
        if weight > 0.0:
            rise = _JUMP_SLOPE * height[i, j, k] / area[i, j, k]
            wanted = weight * wp.clamp(rise, -_HALF_JUMP, _HALF_JUMP)
        source[i, j, k] = source[i, j, k] + scale * (wanted - 0.5 * (x + y + z))
        screen[i, j, k] = screen[i, j, k] + scale * weight


@wp.kernel
def relax_field_kernel(
    # in
    source: wp.array3d[float],
    screen: wp.array3d[float],
    cell: float,
    colour: int,
    lanes: int,
    # out
    field: wp.array3d[float],
):
    """Half a step of red-black Gauss-Seidel.

    Launch: ``dim=(nodes along x, nodes along y, lanes)``, for colour 0, then 1; ``cell`` is the cell's length in cells
    of the finest grid. Not taped.
    Writes: the nodes of one colour of ``field``, whose neighbours have the other.
    """
    i, j, lane = wp.tid()
    before_i = _mirrored(i - 1, field.shape[0])
    after_i = _mirrored(i + 1, field.shape[0])
    before_j = _mirrored(j - 1, field.shape[1])
    after_j = _mirrored(j + 1, field.shape[1])
    squared = cell * cell
    for k in range(((i + j + colour) & 1) + 2 * lane, field.shape[2], 2 * lanes):
        around = field[before_i, j, k] + field[after_i, j, k] + field[i, before_j, k] + field[i, after_j, k]
        around += field[i, j, _mirrored(k - 1, field.shape[2])] + field[i, j, _mirrored(k + 1, field.shape[2])]
        field[i, j, k] = (around + squared * source[i, j, k]) / (6.0 + squared * screen[i, j, k])


@wp.kernel
def find_residual_kernel(
    # in
    source: wp.array3d[float],
    screen: wp.array3d[float],
    field: wp.array3d[float],
    cell: float,
    lanes: int,
    # out
    residual: wp.array3d[float],
):
    """What the field leaves of the source.

    Launch: ``dim=(nodes along x, nodes along y, lanes)``; ``cell`` as in `relax_field_kernel`. Not taped.
    Writes: every element of ``residual``.
    """
    i, j, lane = wp.tid()
    before_i = _mirrored(i - 1, field.shape[0])
    after_i = _mirrored(i + 1, field.shape[0])
    before_j = _mirrored(j - 1, field.shape[1])
    after_j = _mirrored(j + 1, field.shape[1])
    for k in range(lane, field.shape[2], lanes):
        around = field[before_i, j, k] + field[after_i, j, k] + field[i, before_j, k] + field[i, after_j, k]
        around += field[i, j, _mirrored(k - 1, field.shape[2])] + field[i, j, _mirrored(k + 1, field.shape[2])]
        here = field[i, j, k]
        residual[i, j, k] = source[i, j, k] - screen[i, j, k] * here + (around - 6.0 * here) / (cell * cell)


@wp.kernel
def restrict_field_kernel(
    # in
    fine: wp.array3d[float],
    factor: float,
    lanes: int,
    # out
    coarse: wp.array3d[float],
):
    """A field on the grid that is a level coarser: mean of 27 nodes, weighted 1/2 for each step away, times ``factor``.

    Launch: ``dim=(coarse nodes along x, coarse nodes along y, lanes)``. Not taped.
    Writes: every element of ``coarse``.
    """
    i, j, lane = wp.tid()
    for k in range(lane, coarse.shape[2], lanes):
        total = float(0.0)
        for a in range(-1, 2):
            x = _mirrored(2 * i + a, fine.shape[0])
            for b in range(-1, 2):
                y = _mirrored(2 * j + b, fine.shape[1])
                row = 2.0 * fine[x, y, 2 * k]
                row += fine[x, y, _mirrored(2 * k - 1, fine.shape[2])] + fine[x, y, _mirrored(2 * k + 1, fine.shape[2])]
                total += float((2 - wp.abs(a)) * (2 - wp.abs(b))) * row
        coarse[i, j, k] = factor * total / 64.0


@wp.kernel
def add_prolonged_kernel(
    # in
    coarse: wp.array3d[float],
    lanes: int,
    # out
    fine: wp.array3d[float],
):
    """Add a field of the grid that is a level coarser, interpolated.

    Launch: ``dim=(fine nodes along x, fine nodes along y, lanes)``. Not taped.
    Writes: every element of ``fine``, added to.
    """
    i, j, lane = wp.tid()
    low_i = i / 2
    low_j = j / 2
    high_i = (i + 1) / 2
    high_j = (j + 1) / 2
    for k in range(lane, fine.shape[2], lanes):
        low = k / 2
        high = (k + 1) / 2
        total = coarse[low_i, low_j, low] + coarse[high_i, low_j, low]
        total += coarse[low_i, high_j, low] + coarse[high_i, high_j, low]
        total += coarse[low_i, low_j, high] + coarse[high_i, low_j, high]
        total += coarse[low_i, high_j, high] + coarse[high_i, high_j, high]
        fine[i, j, k] = fine[i, j, k] + 0.125 * total
