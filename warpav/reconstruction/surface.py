"""From point clouds to triangle meshes: thinning, normals, surface methods by name, trimming, cleaning, decimation."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from warpav.errors import InputError
from warpav.geometry.mesh import Mesh
from warpav.reconstruction.poisson import checked_points, poisson_surface

if TYPE_CHECKING:
    from vtkmodules.vtkCommonDataModel import vtkPolyData

_LEAST_SUPPORT = 15  # points that a piece of surface needs
_LEAST_DENSITY = 0.15  # points per area of a piece, of those of the whole surface


def thin_out(point_m: np.ndarray, count: int, *, seed: int) -> np.ndarray:
    """Choose about ``count`` points evenly: no two nearer than a spacing that is found by halving (Poisson disks).

    Args:
        point_m: Points [m], shape [point, 3].
        count: How many to keep, at least 1; missed by 3 % at most, unless points coincide.
        seed: Chooses among the possible choices.

    Returns:
        Indices of the points kept, ascending, int64. All of them when there are no more than ``count``.

    Raises:
        ValueError: A count below 1, or values that are not finite.
    """
    point_m = np.asarray(point_m, np.float64).reshape(-1, 3)
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    if not np.isfinite(point_m).all():
        raise ValueError("point_m has values that are not finite")
    if len(point_m) <= count:
        return np.arange(len(point_m))
    order = np.random.default_rng(seed).permutation(len(point_m))
    shuffled = point_m[order]
    low_m, high_m = 0.0, float(np.linalg.norm(np.ptp(point_m, axis=0)))
    spacing_m = high_m / np.sqrt(count)
    chosen = np.arange(1)
    for _ in range(20):
        chosen = _spaced(shuffled, spacing_m)
        if abs(len(chosen) - count) <= 0.03 * count:
            break
        if len(chosen) > count:
            low_m = spacing_m
        else:
            high_m = spacing_m
        guess_m = spacing_m * np.sqrt(len(chosen) / count)  # exact for a surface much denser than the spacing
        spacing_m = guess_m if low_m < guess_m < high_m else 0.5 * (low_m + high_m)
    return np.sort(order[chosen])


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
    """VTK's points with an array of values for each."""
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


def oriented_normals(point_m: np.ndarray, sensor_m: np.ndarray, *, neighbour_count: int = 24) -> np.ndarray:
    """Normals of the planes through each point's neighbours, turned towards the sensor that recorded the point.

    Args:
        point_m: Points [m] in any frame, shape [point, 3].
        sensor_m: Where the sensor was when it recorded each point [m], shape [point, 3].
        neighbour_count: How many nearest points make a plane, the point itself included; at least 3.

    Returns:
        Unit normals, float64 [point, 3].

    Raises:
        ValueError: Fewer than 4 points, values that are not finite, or shapes that do not fit.
    """
    point_m, sensor_m = checked_points(point_m, sensor_m)
    if neighbour_count < 3:
        raise ValueError(f"neighbour_count must be at least 3, got {neighbour_count}")
    neighbour = KDTree(point_m).query(point_m, min(neighbour_count, len(point_m)), workers=-1)[1]
    offset_m = point_m[neighbour] - point_m[:, None, :]
    offset_m -= offset_m.mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.swapaxes(offset_m, 1, 2) @ offset_m)
    normal = axes[:, :, 0]
    away = np.sum((sensor_m - point_m) * normal, axis=1) < 0.0
    return np.where(away[:, None], -normal, normal)


def signed_distance_surface(point_m: np.ndarray, normal: np.ndarray, *, cell_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Surface as the zero level of the distances to the planes of nearby points, by VTK; open where points end.

    Args:
        point_m: Points [m] in any frame, shape [point, 3].
        normal: Unit normals that point out of the body, shape [point, 3].
        cell_m: Length of the grid's cells [m].

    Returns:
        Vertices [m], float32 [vertex, 3], and triangles, int32 [triangle, 3], counter-clockwise seen from outside.

    Raises:
        ValueError: As `poisson_surface`.
    """
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersPoints import vtkExtractSurface, vtkSignedDistance

    point_m, normal = checked_points(point_m, normal)
    cloud = _vtk_cloud(point_m, {"normal": normal})
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
    vertex_m = np.array(vtk_to_numpy(mesh.GetPoints().GetData()), np.float32)
    return vertex_m, np.array(vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()), np.int32).reshape(-1, 3)


def trimmed(
    vertex_m: np.ndarray, triangle: np.ndarray, support_m: np.ndarray, *, reach_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """The surface without what no point supports.

    Triangles with a corner farther than ``reach_m`` from every point go; then connected pieces on which fewer than 15
    points lie, or per area less than 15 % of the points of the whole. Small true parts such as wing mirrors stay: they
    hold few triangles but as many points per area as the rest.

    Args:
        vertex_m: Vertices [m], shape [vertex, 3].
        triangle: Vertex indices, shape [triangle, 3].
        support_m: The points that the surface goes through [m], shape [point, 3], in the same frame.
        reach_m: How far from the nearest point surface may lie [m].

    Returns:
        Vertices that are left, float32 [vertex, 3], and triangles, int32 [triangle, 3]; both may be empty.
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
    corner_m = vertex_m[triangle].astype(np.float64)
    double_area_m2 = np.linalg.norm(np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0]), axis=1)
    area_m2 = 0.5 * np.bincount(piece[triangle[:, 0]], double_area_m2, minlength=count)
    density = support.sum() / area_m2.sum()
    kept = (support >= _LEAST_SUPPORT) & (support >= _LEAST_DENSITY * density * area_m2)
    return _referenced(vertex_m, triangle[kept[piece[triangle[:, 0]]]])


def _referenced(vertex_m: np.ndarray, triangle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Only the vertices that triangles use."""
    used = np.zeros(len(vertex_m), bool)
    used[triangle] = True
    renumbered = np.cumsum(used) - 1
    return vertex_m[used].astype(np.float32), renumbered[triangle].astype(np.int32)


def cleaned(mesh: Mesh) -> Mesh:
    """The same picture with less: no duplicate vertices and triangles, none that are degenerate or unused.

    Vertices are merged when place and colour are equal; triangles go when they have no area or when another one has the
    same corners in the same turn.
    """
    key = np.concatenate([mesh.vertex_m + np.float32(0.0), mesh.vertex_rgb.astype(np.float32)], axis=1)
    _, first, merged = np.unique(key, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")  # vertices stay in the order in which they first come
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    first = first[order]
    triangle = rank[merged.reshape(-1)][mesh.triangle]
    corner_m = mesh.vertex_m[first].astype(np.float64)[triangle]
    flat = np.linalg.norm(np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0]), axis=1) == 0.0
    triangle = triangle[~flat]
    turn = np.argmin(triangle, axis=1)[:, None] if len(triangle) else np.zeros((0, 1), int)
    begun_at_least = np.take_along_axis(triangle, (turn + np.arange(3)) % 3, axis=1)
    _, kept = np.unique(begun_at_least, axis=0, return_index=True)
    triangle = triangle[np.sort(kept)]
    used = np.zeros(len(first), bool)
    used[triangle] = True
    renumbered = np.cumsum(used) - 1
    vertex = first[used]
    return Mesh(mesh.vertex_m[vertex], renumbered[triangle].astype(np.int32).reshape(-1, 3), mesh.vertex_rgb[vertex])


def decimated(mesh: Mesh, triangle_count: int) -> Mesh:
    """The mesh with about ``triangle_count`` triangles or fewer, by quadric edge collapse.

    Raises:
        ValueError: A target below 4.
    """
    import fast_simplification

    if triangle_count < 4:
        raise ValueError(f"triangle_count must be at least 4, got {triangle_count}")
    if len(mesh.triangle) <= triangle_count:
        return mesh
    vertex_m, triangle = fast_simplification.simplify(mesh.vertex_m, mesh.triangle, target_count=triangle_count)[:2]
    nearest = KDTree(mesh.vertex_m).query(vertex_m)[1]
    return Mesh(vertex_m.astype(np.float32), triangle.astype(np.int32), mesh.vertex_rgb[nearest])


SurfaceMethod = Callable[[np.ndarray, np.ndarray, np.ndarray, float], tuple[np.ndarray, np.ndarray]]
"""From points [m], unit normals, sensor positions [m] (each [point, 3]) and the length of a cell [m] to vertices [m]
and triangles."""


def _poisson(
    point_m: np.ndarray, normal: np.ndarray, sensor_m: np.ndarray, cell_m: float
) -> tuple[np.ndarray, np.ndarray]:
    return poisson_surface(point_m, normal, cell_m=cell_m)


def _signed_distance(
    point_m: np.ndarray, normal: np.ndarray, sensor_m: np.ndarray, cell_m: float
) -> tuple[np.ndarray, np.ndarray]:
    return signed_distance_surface(point_m, normal, cell_m=cell_m)


def _nksr(
    point_m: np.ndarray, normal: np.ndarray, sensor_m: np.ndarray, cell_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Neural kernel surface reconstruction (Huang et al., 2023) as installed by the user; the thesis's method."""
    try:
        import nksr  # pyright: ignore[reportMissingImports]
        import torch
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


SURFACE_METHODS: dict[str, SurfaceMethod] = {
    "poisson": _poisson,
    "signed_distance": _signed_distance,
    "nksr": _nksr,
}
"""Ways from oriented points to a surface, by the name that configurations use."""
