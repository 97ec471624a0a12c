"""Poisson surfaces of bodies that are known exactly, and the solver against a sparse one."""

import numpy as np
import pytest
import trimesh
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import spsolve

from warpav.scene.reconstruction import _poisson as poisson
from warpav.scene.reconstruction._poisson import poisson_surface


def sphere_points(count, radius_m, rng, noise_m=0.0):
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return normal * (radius_m + rng.normal(0.0, noise_m, (count, 1))), normal


def box_points(count, size_m, rng):
    """Evenly over the faces of a box around the origin; distances to it are `box_distance_m`."""
    half_m = 0.5 * np.array(size_m)
    area = np.repeat([half_m[1] * half_m[2], half_m[0] * half_m[2], half_m[0] * half_m[1]], 2)
    face = rng.choice(6, count, p=area / area.sum())
    axis, sign = face // 2, np.where(face % 2, 1.0, -1.0)
    point_m, normal = rng.uniform(-1.0, 1.0, (count, 3)) * half_m, np.zeros((count, 3))
    normal[np.arange(count), axis] = sign
    point_m[np.arange(count), axis] = sign * half_m[axis]
    return point_m, normal


def box_distance_m(point_m, size_m):
    outside_m = np.abs(point_m) - 0.5 * np.array(size_m)
    return np.linalg.norm(np.maximum(outside_m, 0.0), axis=1) + np.minimum(outside_m.max(axis=1), 0.0)


def as_trimesh(surface):
    return trimesh.Trimesh(*surface, process=False)


@pytest.mark.parametrize("noise_m", [0.0, 0.01])
def test_sphere(device, rng, noise_m):
    point_m, normal = sphere_points(20_000, 0.6, rng, noise_m)
    mesh = as_trimesh(poisson_surface(point_m, normal, cell_m=0.03, device=device))
    assert mesh.is_watertight
    distance_m = np.linalg.norm(mesh.vertices, axis=1) - 0.6
    # worst seen: mean .2 mm, largest 1.4 mm; with 10 mm of noise .4 mm and 6.7 mm
    assert abs(distance_m.mean()) < 0.001
    assert np.abs(distance_m).max() < (0.002 if noise_m == 0.0 else 0.012)
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 0.6**3, rel=0.002)  # positive: triangles turn outwards
    assert mesh.area == pytest.approx(4 * np.pi * 0.6**2, rel=0.002 if noise_m == 0.0 else 0.01)


def test_box(device, rng):
    size_m = (1.2, 0.8, 0.5)
    mesh = as_trimesh(poisson_surface(*box_points(30_000, size_m, rng), cell_m=0.025, device=device))
    distance_m = np.abs(box_distance_m(mesh.vertices, size_m))
    assert np.median(distance_m) < 0.0003  # worst seen .1 mm
    assert distance_m.max() < 0.0125  # corners are rounded by half a cell; worst seen 7.2 mm
    assert mesh.area == pytest.approx(2 * (1.2 * 0.8 + 1.2 * 0.5 + 0.8 * 0.5), rel=0.03)


def test_plane_ends_at_the_border_undisturbed(rng):
    point_m = np.column_stack([rng.uniform(-2.0, 2.0, (20_000, 2)), np.zeros(20_000)])
    slope = np.array([0.2, -0.1])
    point_m[:, 2] = point_m[:, :2] @ slope
    normal = np.tile(np.array([-0.2, 0.1, 1.0]) / np.linalg.norm([-0.2, 0.1, 1.0]), (20_000, 1))
    vertex_m, _ = poisson_surface(point_m, normal, cell_m=0.1)
    inside = np.abs(vertex_m[:, :2]).max(axis=1) < 1.9
    assert np.abs(vertex_m[inside, 2] - vertex_m[inside, :2] @ slope).max() < 0.01


def test_points_of_uneven_density_make_one_sheet(rng):
    point_m, normal = sphere_points(30_000, 1.0, rng)
    kept = (point_m[:, 0] < 0.0) | (rng.random(30_000) < 0.01)  # about 24 points per square metre on one side
    mesh = as_trimesh(poisson_surface(point_m[kept], normal[kept], cell_m=0.05))
    assert mesh.is_watertight
    assert len(mesh.split()) == 1
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1.0).max() < 0.1


def equation_matrix(shape, screen):
    """Screen minus Laplacian with fields mirrored at the border, as a sparse matrix."""
    index = np.arange(np.prod(shape)).reshape(shape)
    rows, columns = [], []
    for axis, count in enumerate(shape):
        for step in (-1, 1):
            neighbour = np.arange(count) + step
            neighbour[neighbour < 0], neighbour[neighbour == count] = 1, count - 2
            rows.append(index.ravel())
            columns.append(np.take(index, neighbour, axis=axis).ravel())
    links = coo_array((np.ones(6 * index.size), (np.concatenate(rows), np.concatenate(columns))))
    return (diags_array(6.0 + screen.ravel()) - links).tocsc()


def solved(rng, device):
    """The field by multigrid, and the exact one."""
    point_m, normal = sphere_points(2000, 0.3, rng)
    grids, lower_m = poisson._grids_around(point_m, 0.08, 0.48, device)
    poisson._state_equation(grids, (point_m - lower_m) / 0.08, normal, 4.0)
    source, screen = (array.numpy().astype(np.float64) for array in (grids[0].source, grids[0].screen))
    exact = spsolve(equation_matrix(grids[0].shape, screen), source.ravel())
    assert len(grids) > 2
    poisson._solve(grids)
    return grids[0].field.numpy(), exact.reshape(grids[0].shape)


def test_multigrid_comes_near_the_exact_solution(device, rng):
    field, exact = solved(rng, device)
    near = np.abs(exact) < 0.25  # within about half a cell of the surface; the field rises by .55 per cell
    assert near.sum() > 100
    np.testing.assert_allclose(field[near], exact[near], atol=0.005)  # worst seen .0020
    np.testing.assert_allclose(field, exact, atol=0.02)  # worst seen .013


@pytest.mark.parametrize(
    ("point_m", "normal", "arguments", "message"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3)), {}, r"point_m: expected shape \[4 or more, 3\], got \[0, 3\]"),
        (np.zeros((3, 3)), np.zeros((3, 3)), {}, r"got \[3, 3\]"),
        (np.zeros((9, 2)), np.zeros((9, 2)), {}, r"got \[9, 2\]"),
        (np.eye(5, 3), np.full((5, 3), np.nan), {}, r"normal\[0\] is \[nan, nan, nan\]; 5 of 5"),
        (np.full((5, 3), np.inf), np.eye(5, 3), {}, r"point_m\[0\] is \[inf, inf, inf\]"),
        (np.eye(5, 3), np.eye(6, 3), {}, "normal: expected one for each of 5 points, got 6"),
        (np.eye(5, 3), np.eye(5, 3), {"cell_m": 0.0}, "cell_m must be positive, got 0"),
        (np.eye(5, 3), np.eye(5, 3), {"screening": -1.0}, "screening must be at least 0, got -1"),
    ],
)
def test_bad_input_is_named(point_m, normal, arguments, message):
    with pytest.raises(ValueError, match=message):
        poisson_surface(point_m, normal, **{"cell_m": 0.1, **arguments})
