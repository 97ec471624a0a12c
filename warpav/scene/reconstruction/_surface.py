"""From point clouds to triangle meshes: thinning, normals, surface methods by name, trimming, cleaning, decimation."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from warpav.core.errors import InputError
from warpav.raster.mesh import Mesh
from warpav.scene.reconstruction._poisson import checked_points, poisson_surface
from warpav_kernels.reconstruction import plane_fit

if TYPE_CHECKING:
    from vtkmodules.vtkCommonDataModel import vtkPolyData

_NEIGHBOUR_COUNT = 16  # of a point, that define its plane
_MIN_SUPPORT = 15  # points that a piece of surface needs
_COUNT_TOLERANCE = 0.1  # how far the number of points kept may be off
_MIN_FALL, _MAX_FALL = 0.3, 3.0  # powers of the spacing by which that number falls
_HASH_FACTORS = np.array([73856093, 19349663, 83492791])
_COLOUR_STEP = 0.8  # what white against black weighs in a collapse, in lengths of a final triangle's side
_LIFTED_SHARE = 3  # final triangles times this are left by the first, faster collapse
_BRIGHTNESS = np.array([0.30, 0.59, 0.11])
_COLOUR_SAMPLES = 4  # rows of sample points per triangle for the colour of the dense mesh
_SPLIT_LEVELS = 40  # of 255; corners of one vertex that differ more get vertices of their own
_SIMPLIFYING = threading.Lock()  # fast_simplification keeps the mesh that it works on in variables of the module
_MIN_DENSITY = 0.15  # points per area of a piece, of those of the whole surface


def thin_out(point_m: np.ndarray, count: int, *, seed: int) -> np.ndarray:
    """Choose about ``count`` points, [point, 3], evenly: Poisson disks, none nearer than a spacing that is found."""
    point_m = np.asarray(point_m, np.float64)
    if point_m.ndim != 2 or point_m.shape[1] != 3 or not np.isfinite(point_m).all():
        raise ValueError(f"point_m: expected finite numbers of shape [point, 3], got {list(point_m.shape)}")
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    if len(point_m) <= count:
        return np.arange(len(point_m))
    order = np.random.default_rng(seed).permutation(len(point_m))
    shuffled = point_m[order] - point_m.mean(axis=0)
    spacing_m, exponent = _guessed_spacing_m(shuffled, count)
    best, low_m, high_m = np.arange(1), 0.0, np.inf
    last = (0.0, 0)  # spacing and number of points of the previous try
    for _ in range(12):
        if not low_m < spacing_m < high_m or spacing_m <= 0.0:
            break
        chosen = _spaced(shuffled, spacing_m)
        if abs(len(chosen) - count) < abs(len(best) - count):
            best = chosen
        if abs(len(best) - count) <= max(_COUNT_TOLERANCE * count, 1.0):
            break
        if last[1] not in (0, len(chosen)):
            fall = np.log(last[1] / len(chosen)) / np.log(spacing_m / last[0])
            exponent = float(np.clip(fall, _MIN_FALL, _MAX_FALL))
        last = (spacing_m, len(chosen))
        low_m, high_m = (spacing_m, high_m) if len(chosen) > count else (low_m, spacing_m)
        spacing_m *= (len(chosen) / count) ** (1.0 / exponent)
        if not low_m < spacing_m < high_m:
            spacing_m = 0.5 * (low_m + high_m)
    return np.sort(order[best])


def _guessed_spacing_m(point_m: np.ndarray, count: int) -> tuple[float, float]:
    """A spacing that leaves nearly ``count`` points, by counts of longer cells, and by which power of it they fall."""
    from_corner_m = point_m - point_m.min(axis=0)

    def occupied(cell_m: float) -> int:
        index = (from_corner_m * (1.0 / cell_m)).astype(np.int64)
        is_taken = np.zeros(1 << 22, bool)  # a hash table: that cells fall together matters little
        is_taken[(index @ _HASH_FACTORS) & (len(is_taken) - 1)] = True
        return int(np.count_nonzero(is_taken))

    high_m = float(from_corner_m.max())
    low_m = high_m / 2**20
    if low_m == 0.0:
        return 0.0, 2.0
    while high_m > 1.05 * low_m:
        cell_m = float(np.sqrt(low_m * high_m))
        low_m, high_m = (cell_m, high_m) if occupied(cell_m) > count else (low_m, cell_m)
    fall = np.log(occupied(high_m) / occupied(1.5 * high_m)) / np.log(1.5)
    return high_m / 1.55, float(np.clip(fall, _MIN_FALL, _MAX_FALL))


def _spaced(point_m: np.ndarray, spacing_m: float) -> np.ndarray:
    """Indices of points no two of which are nearer than a spacing, and which leave room for no other."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersPoints import vtkPoissonDiskSampler

    cloud = _vtk_cloud(point_m, {"index": np.arange(len(point_m))})
    sampler = vtkPoissonDiskSampler()
    sampler.SetInputData(cloud)
    sampler.SetRadius(spacing_m)
    sampler.Update()
    return np.array(vtk_to_numpy(sampler.GetOutput().GetPointData().GetArray("index")))


def _vtk_cloud(point_m: np.ndarray, arrays: dict[str, np.ndarray]) -> vtkPolyData:
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkPolyData

    points, cloud = vtkPoints(), vtkPolyData()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(point_m), deep=True))
    cloud.SetPoints(points)
    for name, values in arrays.items():
        array = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
        array.SetName(name)
        cloud.GetPointData().AddArray(array)
    return cloud


def oriented_normals(point_m: np.ndarray, sensor_m: np.ndarray) -> np.ndarray:
    """Normals of the planes through each point's neighbours, [point, 3], towards the sensor that recorded it."""
    point_m, sensor_m = checked_points(point_m, sensor_m, "sensor_m")
    centre_m = point_m.mean(axis=0)
    neighbour = KDTree(point_m).query(point_m, min(_NEIGHBOUR_COUNT, len(point_m)), workers=-1)[1]
    normal = wp.empty(len(point_m), dtype=wp.vec3, device="cpu")  # pyright: ignore[reportArgumentType]
    from_centre = [
        wp.array((place_m - centre_m).astype(np.float32), dtype=wp.vec3, device="cpu")
        for place_m in (point_m, sensor_m)
    ]
    wp.launch(
        plane_fit.fit_normals_kernel,
        dim=len(point_m),
        inputs=[*from_centre, wp.array(np.asarray(neighbour, np.int32), dtype=int, device="cpu")],
        outputs=[normal],
        device="cpu",
        record_tape=False,
    )
    return normal.numpy().astype(np.float64)


def _signed_distance_surface(point_m: np.ndarray, normal: np.ndarray, cell_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Zero level of the distances to the planes of nearby points, by VTK: open where points end; trim it."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersPoints import vtkExtractSurface, vtkSignedDistance

    point_m, normal = checked_points(point_m, normal)
    centre_m = point_m.mean(axis=0)  # VTK computes this filter in single precision
    point_m = point_m - centre_m
    cloud = _vtk_cloud(point_m.astype(np.float32), {"normal": normal.astype(np.float32)})
    cloud.GetPointData().SetActiveNormals("normal")
    reach_m = 3.0 * cell_m
    low_m, high_m = point_m.min(axis=0) - reach_m, point_m.max(axis=0) + reach_m
    distance = vtkSignedDistance()
    distance.SetInputData(cloud)
    distance.SetRadius(reach_m)
    distance.SetBounds(*np.stack([low_m, high_m], axis=1).ravel())
    distance.SetDimensions(*(int(n) for n in np.ceil((high_m - low_m) / cell_m) + 1))
    surface = vtkExtractSurface()
    surface.SetInputConnection(distance.GetOutputPort())
    surface.SetRadius(reach_m)
    surface.ComputeNormalsOff()
    surface.ComputeGradientsOff()
    surface.Update()
    mesh = surface.GetOutput()
    if mesh.GetNumberOfCells() == 0:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
    vertex_m = (vtk_to_numpy(mesh.GetPoints().GetData()) + centre_m).astype(np.float32)
    return vertex_m, np.array(vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()), np.int32).reshape(-1, 3)


def vertex_normals(vertex_m: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Unit normals of vertices, the mean of their triangles' by area, [vertex, 3]; 0 where there is none."""
    corner = vertex_m[triangle].astype(np.float64)
    area_normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    total = np.stack(
        [np.bincount(triangle.ravel(), np.repeat(area_normal[:, k], 3), minlength=len(vertex_m)) for k in range(3)],
        axis=1,
    )
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


def trimmed(
    vertex_m: np.ndarray, triangle: np.ndarray, support_m: np.ndarray, *, reach_m: float, piece_m2: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """The surface without what no point supports.

    Triangles with a corner farther than ``reach_m`` from every point go; then connected pieces on which fewer than 15
    points lie, or per area less than 15 % of the points of the whole. Small true parts such as wing mirrors stay: they
    hold few triangles but as many points per area as the rest.

    Shapes: ``vertex_m`` [vertex, 3], ``triangle`` [triangle, 3], ``support_m`` [point, 3], returns [vertex, 3].
    """
    near = np.isfinite(KDTree(support_m).query(vertex_m, distance_upper_bound=reach_m)[0])
    vertex_m, triangle = _referenced(vertex_m, triangle[near[triangle].all(axis=1)])
    if len(triangle) == 0:
        return vertex_m, triangle
    links = coo_array(
        (np.ones(2 * len(triangle), bool), (triangle[:, [0, 1]].ravel(), triangle[:, [1, 2]].ravel())),
        shape=(len(vertex_m), len(vertex_m)),
    )
    count, piece = connected_components(links, directed=False)
    distance_m, vertex = KDTree(vertex_m).query(support_m, distance_upper_bound=reach_m)
    support = np.bincount(piece[np.asarray(vertex)[np.isfinite(distance_m)]], minlength=count)
    area_m2 = 0.5 * np.bincount(piece[triangle[:, 0]], _double_area_m2(vertex_m, triangle), minlength=count)
    density = support.sum() / area_m2.sum()
    kept = (support >= _MIN_SUPPORT) & (support >= _MIN_DENSITY * density * area_m2) & (area_m2 >= piece_m2)
    return _referenced(vertex_m, triangle[kept[piece[triangle[:, 0]]]])


def _referenced(vertex_m: np.ndarray, triangle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    used, index = np.unique(triangle, return_inverse=True)
    return vertex_m[used].astype(np.float32), index.reshape(-1, 3).astype(np.int32)


def cleaned(mesh: Mesh) -> Mesh:
    """Simplify a mesh without visible change: no duplicate, degenerate or unused vertices and triangles.

    Vertices are merged if position and colour are equal; triangles go when they have no area or when another one has
    the same corners in the same turn.
    """
    key = np.concatenate([mesh.vertex_m + np.float32(0.0), mesh.vertex_rgb.astype(np.float32)], axis=1)
    _, first, merged = np.unique(key, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")  # vertices stay in the order in which they first come
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    first = first[order]
    triangle = rank[merged.reshape(-1)][mesh.triangle]
    triangle = triangle[_double_area_m2(mesh.vertex_m[first], triangle) > 0.0]
    turn = np.argmin(triangle, axis=1)[:, None] if len(triangle) else np.zeros((0, 1), int)
    begun_at_least = np.take_along_axis(triangle, (turn + np.arange(3)) % 3, axis=1)
    _, kept = np.unique(begun_at_least, axis=0, return_index=True)
    triangle = triangle[np.sort(kept)]
    used, index = np.unique(triangle, return_inverse=True)
    vertex = first[used]
    return Mesh(mesh.vertex_m[vertex], index.reshape(-1, 3).astype(np.int32), mesh.vertex_rgb[vertex])


def decimated(mesh: Mesh, triangle_count: int) -> Mesh:
    """The mesh with about ``triangle_count`` triangles, by quadric edge collapse that keeps the borders of colours.

    First geometry alone, with bright surface lifted a little so that borders are steps that the quadrics see; then
    geometry and colour together. At last every triangle's corners get the colours that fit the dense surface inside it;
    where those of one vertex differ much, the vertex is split, so that a border is sharp.
    """
    if triangle_count < 4:
        raise ValueError(f"triangle_count must be at least 4, got {triangle_count}")
    if len(mesh.triangle) <= triangle_count:
        return mesh
    area_m2 = 0.5 * _double_area_m2(mesh.vertex_m, mesh.triangle).sum()
    step_m = _COLOUR_STEP * float(np.sqrt(area_m2 / triangle_count))
    place_m, merged, count = np.unique(
        mesh.vertex_m.astype(np.float64), axis=0, return_inverse=True, return_counts=True
    )
    merged = merged.reshape(-1)
    rgb = np.stack([np.bincount(merged, channel) for channel in mesh.vertex_rgb.T.astype(np.float64)], axis=1)
    vertex_m, triangle, rgb = (place_m, merged[mesh.triangle].astype(np.int32), rgb / count[:, None])
    if len(triangle) > _LIFTED_SHARE * triangle_count:
        vertex_m, triangle, rgb = _collapsed_lifted(vertex_m, triangle, rgb, _LIFTED_SHARE * triangle_count, step_m)
    vertex_m, triangle = _collapsed_coloured(vertex_m, triangle, rgb, triangle_count, step_m)
    return cleaned(_coloured_corners(vertex_m, triangle, mesh))


def _double_area_m2(vertex_m: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    corner_m = vertex_m.astype(np.float64)[triangle]
    return np.linalg.norm(np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0]), axis=1)


def _collapsed_lifted(
    vertex_m: np.ndarray, triangle: np.ndarray, rgb: np.ndarray, count: int, step_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """About ``count`` triangles: collapsed with white lifted by ``step_m`` along the normals, then lowered again."""
    import fast_simplification

    lift_m = vertex_normals(vertex_m, triangle) * (step_m / 255.0 * (rgb @ _BRIGHTNESS))[:, None]
    lifted_m = vertex_m + lift_m
    with _SIMPLIFYING:
        kept_m, kept = fast_simplification.simplify(lifted_m, triangle, target_count=count)[:2]
    nearest = KDTree(lifted_m).query(kept_m, workers=-1)[1]
    return kept_m - lift_m[nearest], kept.astype(np.int32), rgb[nearest]


def _collapsed_coloured(
    vertex_m: np.ndarray, triangle: np.ndarray, rgb: np.ndarray, count: int, step_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """About ``count`` triangles, by quadrics over position and colour: white against black counts as ``step_m``."""
    from vtkmodules.util.numpy_support import numpy_to_vtkIdTypeArray, vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkObject
    from vtkmodules.vtkCommonDataModel import vtkCellArray
    from vtkmodules.vtkFiltersCore import vtkQuadricDecimation

    body, cells = _vtk_cloud(vertex_m, {"rgb": rgb}), vtkCellArray()
    body.GetPointData().SetActiveScalars("rgb")
    cells.SetData(
        numpy_to_vtkIdTypeArray(np.arange(0, triangle.size + 1, 3, dtype=np.int64), deep=True),
        numpy_to_vtkIdTypeArray(triangle.astype(np.int64).ravel(), deep=True),
    )
    body.SetPolys(cells)
    collapse = vtkQuadricDecimation()
    collapse.SetInputData(body)
    collapse.SetTargetReduction(max(0.0, 1.0 - count / len(triangle)))
    collapse.AttributeErrorMetricOn()
    collapse.ScalarsAttributeOn()
    collapse.SetScalarsWeight(step_m * float(np.ptp(rgb)) / 255.0)  # VTK scales the range of the colours to 1
    vtkObject.GlobalWarningDisplayOff()  # it would warn about every flat region, where any point is optimal
    collapse.Update()
    kept = collapse.GetOutput()
    place_m = np.array(vtk_to_numpy(kept.GetPoints().GetData()), np.float32)
    return place_m, np.array(vtk_to_numpy(kept.GetPolys().GetConnectivityArray()), np.int32).reshape(-1, 3)


def _coloured_corners(vertex_m: np.ndarray, triangle: np.ndarray, dense: Mesh) -> Mesh:
    """A mesh with the colours of a dense one: linear within each triangle, fitted to the nearest dense triangles."""
    # Barycentric coordinates of the centroids of the squared parts of a triangle.
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(_COLOUR_SAMPLES) for j in range(_COLOUR_SAMPLES - i)]
    inverted = [(i + 2 / 3, j + 2 / 3) for i in range(_COLOUR_SAMPLES - 1) for j in range(_COLOUR_SAMPLES - 1 - i)]
    centroid = np.array(upright + inverted) / _COLOUR_SAMPLES
    share = np.column_stack([centroid, 1.0 - centroid.sum(axis=1)])
    place_m = np.einsum("sc,tcx->tsx", share, vertex_m.astype(np.float64)[triangle])
    centre_m = dense.vertex_m.astype(np.float64)[dense.triangle].mean(axis=1)
    nearest = KDTree(centre_m).query(place_m.reshape(-1, 3), workers=-1)[1]
    sample_rgb = dense.vertex_rgb.astype(np.float64)[dense.triangle].mean(axis=1)[nearest]
    sample_rgb = sample_rgb.reshape(*place_m.shape)
    corner_rgb = np.einsum("cs,tsx->tcx", np.linalg.pinv(share), sample_rgb)
    corner_rgb = np.clip(corner_rgb, sample_rgb.min(axis=1, keepdims=True), sample_rgb.max(axis=1, keepdims=True))
    corner_rgb, weight = corner_rgb.reshape(-1, 3), np.repeat(_double_area_m2(vertex_m, triangle) + 1e-12, 3)
    vertex = triangle.reshape(-1).astype(np.int64)
    for _ in range(2):  # into up to four colours at one position
        vertex = _split_by_colour(vertex, corner_rgb, weight)
    count = int(vertex.max()) + 1
    rgb = np.stack([np.bincount(vertex, weight * channel, count) for channel in corner_rgb.T], axis=1)
    rgb = np.rint(rgb / np.bincount(vertex, weight, count)[:, None]).astype(np.uint8)
    place = np.empty(count, np.int64)
    place[vertex] = triangle.reshape(-1)
    return Mesh(vertex_m[place].astype(np.float32), vertex.reshape(-1, 3).astype(np.int32), rgb)


def _split_by_colour(vertex: np.ndarray, corner_rgb: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Vertices of corners, those in two whose corners differ by more than `_SPLIT_LEVELS`; numbered from 0 again."""
    count = int(vertex.max()) + 1
    total = np.bincount(vertex, weight, count)[:, None]
    mean = np.stack([np.bincount(vertex, weight * channel, count) for channel in corner_rgb.T], axis=1) / total

    def farthest(distance: np.ndarray) -> np.ndarray:
        """The corner of every vertex at which the distance is largest; the last of several."""
        order = np.lexsort((distance, vertex))
        return order[np.flatnonzero(np.r_[np.diff(vertex[order]) != 0, True])]

    first = farthest(np.abs(corner_rgb - mean[vertex]).max(axis=1))
    to_first = np.abs(corner_rgb - corner_rgb[first][vertex]).max(axis=1)
    second = farthest(to_first)
    to_second = np.abs(corner_rgb - corner_rgb[second][vertex]).max(axis=1)
    moves = (to_first[second] > _SPLIT_LEVELS)[vertex] & (to_second < to_first)
    return np.unique(np.where(moves, vertex + count, vertex), return_inverse=True)[1]


def _nksr(
    point_m: np.ndarray, normal: np.ndarray, sensor_m: np.ndarray, cell_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Neural kernel surface reconstruction (Huang et al., 2023) as installed by the user; the thesis's method."""
    try:
        import nksr  # pyright: ignore[reportMissingImports]
        import torch  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError(
            f"surface method nksr: expected the packages nksr and torch, got {error}; install them as"
            " https://github.com/nv-tlabs/NKSR says (CUDA only, its own licence), or use poisson"
        ) from None
    device = torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
    point, towards, sensor = (
        torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(device) for array in (point_m, normal, sensor_m)
    )
    field = nksr.Reconstructor(device).reconstruct(point, normal=towards, sensor=sensor, voxel_size=cell_m)
    mesh = field.extract_dual_mesh(mise_iter=1)
    return mesh.v.cpu().numpy().astype(np.float32), mesh.f.cpu().numpy().astype(np.int32)


SURFACE_METHODS: dict[str, Callable[[np.ndarray, np.ndarray, np.ndarray, float], tuple[np.ndarray, np.ndarray]]] = {
    "poisson": lambda point_m, normal, sensor_m, cell_m: poisson_surface(point_m, normal, cell_m=cell_m),
    "signed_distance": lambda point_m, normal, sensor_m, cell_m: _signed_distance_surface(point_m, normal, cell_m),
    "nksr": _nksr,
}
"""Ways from points [m], unit normals, sensor positions [m], [point, 3] each, and the length of a cell [m] to a surface,
vertices [m] and triangles, by the name that configurations use."""
