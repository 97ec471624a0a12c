"""Rasterisation: triangles to samples, areas, extents and their derivatives."""

# fmt: off
# isort: off
from warpav_kernels.raster._bent_edges import scatter_bent_crossings_kernel
from warpav_kernels.raster._candidates import Candidate
from warpav_kernels.raster._layers import Layers, place_layers_kernel, place_scissors_kernel
from warpav_kernels.raster._lens import (
    BROWN_CONRADY, DOUBLE_SPHERE, EUCM, FISHEYE, PANORAMA, PINHOLE, SPHERE, Lens, angle_at, radius_and_growth, vec8,
)
from warpav_kernels.raster._measure import (
    AMODAL_AREA, AREA_COUNT, BOTTOM, BOX_AREA, EXTENT_COUNT, LEFT, MEASURE_COUNT, RIGHT, TOP, VISIBLE_AREA,
    BoundaryDerivative, gather_jacobian_kernel, measure_areas_kernel, measure_weighted_area_kernel,
    sum_derivatives_kernel, sum_lanes_kernel,
)
from warpav_kernels.raster._outline import ALONE, VISIBLE, Hiding
from warpav_kernels.raster._rasterise import clear_keys_kernel, fill_strips_kernel, scatter_triangles_kernel
from warpav_kernels.raster._ray_space import scatter_bent_triangles_kernel
from warpav_kernels.raster._rays import BLOCK, Rays, bound_rays_kernel, place_blocks_kernel, place_rays_kernel
from warpav_kernels.raster._shade import (
    measure_contrast_kernel, resolve_depth_kernel, resolve_incidence_kernel, resolve_rgb_kernel,
    resolve_silhouettes_kernel,
)
from warpav_kernels.raster._trace import trace_keys_kernel, trace_layers_kernel
from warpav_kernels.raster._triangles import Triangles
from warpav_kernels.raster._view import GUARD, View, place_views_kernel
# isort: on

__all__ = [
    "ALONE", "AMODAL_AREA", "AREA_COUNT", "BLOCK", "BOTTOM", "BOX_AREA", "BROWN_CONRADY", "DOUBLE_SPHERE", "EUCM",
    "EXTENT_COUNT", "FISHEYE", "GUARD", "LEFT", "MEASURE_COUNT", "PANORAMA", "PINHOLE", "RIGHT", "SPHERE", "TOP",
    "VISIBLE", "VISIBLE_AREA", "BoundaryDerivative", "Candidate", "Hiding", "Layers", "Lens", "Rays", "Triangles",
    "View", "angle_at", "bound_rays_kernel", "clear_keys_kernel", "fill_strips_kernel", "gather_jacobian_kernel",
    "measure_areas_kernel", "measure_contrast_kernel", "measure_weighted_area_kernel", "place_blocks_kernel",
    "place_layers_kernel", "place_rays_kernel", "place_scissors_kernel", "place_views_kernel", "radius_and_growth",
    "resolve_depth_kernel", "resolve_incidence_kernel", "resolve_rgb_kernel", "resolve_silhouettes_kernel",
    "scatter_bent_crossings_kernel", "scatter_bent_triangles_kernel", "scatter_triangles_kernel",
    "sum_derivatives_kernel", "sum_lanes_kernel", "trace_keys_kernel", "trace_layers_kernel", "vec8",
]
# fmt: on
