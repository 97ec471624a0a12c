"""Measure: how areas change with the numbers of a calibration: focal lengths, principal point, distortion.

The rays of an outline stay where they are and their images move, so the change of an area is again a sum over the
segments of its outline, see `measure`; only the flow is another. It is asked for seldom, and so has a pass of its own.
"""

import warp as wp

from warpav_kernels.raster._layers import Layers
from warpav_kernels.raster._lens import BROWN_CONRADY, EUCM, FISHEYE, Lens, radial_factor, sphere_terms
from warpav_kernels.raster._measure import frame_weight
from warpav_kernels.raster._outline import Hiding, cell_of, cell_segment, mask_corners, pair_of, segment_cuts
from warpav_kernels.raster._triangles import Triangles
from warpav_kernels.raster._view import View, ray_in_camera

wp.set_module_options({"enable_backward": False})

CALIBRATION_SIZE = wp.constant(12)  # fx, fy, cx, cy and eight coefficients of the distortion, in OpenCV's order

_vec12 = wp.types.vector(length=12, dtype=float)
_mat28 = wp.types.matrix(shape=(2, 8), dtype=float)


@wp.func
def _radius_change(lens: Lens, angle: float) -> wp.vec4:
    """Derivatives of a fisheye's radius at an angle to its coefficients."""
    squared = angle * angle
    power = squared * angle
    if lens.formula == 0:
        return power * wp.vec4(1.0, squared, squared * squared, squared * squared * squared)
    sine = wp.sin(angle)
    cosine = wp.cos(angle)
    terms = sphere_terms(lens, angle)
    across = terms[0]
    shrink = -sine / (terms[1] * terms[1])
    if lens.formula == EUCM:
        alpha = lens.distortion[0]
        return shrink * wp.vec4(across - cosine, 0.5 * alpha * sine * sine / across, 0.0, 0.0)
    xi = lens.distortion[0]
    alpha = lens.distortion[1]
    return shrink * wp.vec4(alpha * (xi + cosine) / across + 1.0 - alpha, across - xi - cosine, 0.0, 0.0)


@wp.func
def _distortion_flow(lens: Lens, ray: wp.vec3) -> _mat28:
    """Derivatives of the image place of a ray [focal lengths] to the coefficients of the distortion."""
    flow = _mat28()
    if lens.kind == BROWN_CONRADY:
        x = ray[0] / ray[2]
        y = ray[1] / ray[2]
        squared = x * x + y * y
        factor = radial_factor(lens, squared)
        k = lens.distortion
        below = 1.0 + squared * (k[5] + squared * (k[6] + squared * k[7]))
        power = squared / below
        for i in range(3):
            above_place = i
            if i == 2:
                above_place = 4
            flow[0, above_place] = power * x
            flow[1, above_place] = power * y
            flow[0, 5 + i] = -factor.value * power * x
            flow[1, 5 + i] = -factor.value * power * y
            power *= squared
        flow[0, 2] = 2.0 * x * y
        flow[1, 2] = squared + 2.0 * y * y
        flow[0, 3] = squared + 2.0 * x * x
        flow[1, 3] = 2.0 * x * y
    if lens.kind == FISHEYE:
        across = wp.sqrt(ray[0] * ray[0] + ray[1] * ray[1])
        if across > 0.0:
            angle = wp.atan2(across, ray[2])
            change = _radius_change(lens, angle)
            for i in range(4):
                flow[0, i] = change[i] * ray[0] / across
                flow[1, i] = change[i] * ray[1] / across
    return flow


@wp.kernel(enable_backward=False)
def measure_calibration_kernel(
    # in
    view: wp.array[View],
    scene: Triangles,
    layers: Layers,
    hiding: Hiding,
    kind: wp.array[wp.int32],
    width: int,
    height: int,
    supersampling: int,
    first_view: int,
    # out
    jacobian: wp.array4d[float],
):
    """Jacobians of an object's areas in one view to fx, fy, cx, cy [px] and the distortion.

    ``kind`` are the areas, ALONE or VISIBLE. The edge of what a lens sees moves with the first four alone.

    Launch: ``dim=(views of this chunk, object_count, area_count)``; one thread per area. Not taped.
    Writes: every element of ``jacobian`` [view, object, area, CALIBRATION_SIZE] of these views once.
    """
    chunk_view, object_index, i = wp.tid()
    v = first_view + chunk_view
    camera = view[v]
    pair = pair_of(v, object_index, layers)
    total = _vec12()
    for row in range(pair.rectangle[3]):
        for column in range(pair.rectangle[2]):
            mask = mask_corners(pair, row, column, kind[i], layers, hiding)
            if mask != 0 and mask != 15:
                cell = cell_of(camera, pair, row, column, mask)
                for index in range(cell.segment_count):
                    segment = cell_segment(cell, index, pair, kind[i], camera, scene, layers, hiding, width, height)
                    cut = segment_cuts(segment)
                    extent = segment.end - segment.start
                    inside = float(0.0)
                    for k in range(3):
                        middle = segment.start + 0.5 * (cut[k] + cut[k + 1]) * extent
                        inside += (cut[k + 1] - cut[k]) * frame_weight(middle[0], middle[1], width, height)
                    across_columns = inside * extent[1]
                    across_rows = -inside * extent[0]
                    x = 0.5 * (segment.start[0] + segment.end[0])
                    y = 0.5 * (segment.start[1] + segment.end[1])
                    # per sample; a pixel of focal length or principal point is ``supersampling`` samples
                    total[0] += across_columns * (x - camera.centre[0]) / camera.focal[0]
                    total[1] += across_rows * (y - camera.centre[1]) / camera.focal[1]
                    total[2] += across_columns
                    total[3] += across_rows
                    if not segment.is_fixed:
                        flow = _distortion_flow(camera.lens, ray_in_camera(camera, x, y))
                        for n in range(8):
                            total[4 + n] += (
                                across_columns * camera.focal[0] * flow[0, n]
                                + across_rows * camera.focal[1] * flow[1, n]
                            )
    per_sample = 1.0 / (float(supersampling) * float(supersampling))
    for n in range(CALIBRATION_SIZE):
        scale = per_sample
        if n < 4:
            scale = per_sample * float(supersampling)
        jacobian[v, object_index, i, n] = scale * total[n]
