"""Primitives are closed and face outwards; normals are smooth where the surface is."""

import numpy as np
import pytest

from tests.scene.town.closed_surface import signed_volume_m3, unmatched_edge_count
from warpav.raster.mesh import Mesh
from warpav.scene.town.surface_builder import SurfaceBuilder


def _mesh(surface):
    return Mesh.create(surface.vertex_m, surface.triangle, [128, 128, 128])


def test_box_is_closed_and_has_its_volume():
    builder = SurfaceBuilder()
    builder.add_box((0.0, 1.0, 2.0), (1.0, 3.0, 5.0), 0)
    mesh = _mesh(builder.finish())
    assert len(mesh.triangle) == 12
    assert len(mesh.vertex_m) == 24  # six sides that share no normals
    assert unmatched_edge_count(mesh) == 0
    assert signed_volume_m3(mesh) == pytest.approx(6.0, rel=1e-6)


def test_ellipsoid_pair_is_closed_with_outward_normals():
    builder = SurfaceBuilder()
    builder.add_ellipsoid_pair((0.0, 2.0, 0.0), (1.0, 0.5, 0.7), 3)
    surface = builder.finish()
    mesh = _mesh(surface)
    assert unmatched_edge_count(mesh) == 0
    sphere_m3 = 4.0 / 3.0 * np.pi * 1.0 * 0.5 * 0.7
    assert 0.7 * 2.0 * sphere_m3 < signed_volume_m3(mesh) < 2.0 * sphere_m3
    center = np.where(surface.vertex_m[:, 1:2] > 0.0, [[0.0, 2.0, 0.0]], [[0.0, -2.0, 0.0]])
    assert np.einsum("ij,ij->i", surface.normal, surface.vertex_m - center).min() > 0.0
    assert (surface.material == 3).all()


def test_lathe_pair_is_closed():
    builder = SurfaceBuilder()
    profile = np.array([[0.0, 0.0], [0.3, 0.0], [0.3, -0.2], [0.0, -0.2]])
    builder.add_lathe_pair((0.0, 1.0, 0.3), profile, np.zeros((3, 24), int))
    mesh = _mesh(builder.finish())
    assert unmatched_edge_count(mesh) == 0
    polygon_m2 = 12.0 * 0.3**2 * np.sin(np.pi / 12.0)
    assert signed_volume_m3(mesh) == pytest.approx(2.0 * 0.2 * polygon_m2, rel=1e-4)


def test_normals_are_smooth_on_gentle_bends_and_split_on_edges():
    x = np.linspace(0.0, 1.0, 5)
    point = np.stack([*np.meshgrid(x, [0.0, 1.0], indexing="ij"), np.zeros((5, 2))], axis=-1)
    gentle, sharp = point.copy(), point.copy()
    gentle[..., 2] = 0.1 * point[..., 0] ** 2
    sharp[..., 2] = 2.0 * np.abs(point[..., 0] - 0.5)
    counts = []
    for sheet in (gentle, sharp):
        builder = SurfaceBuilder()
        builder.add_grid(sheet, 0)
        counts.append(len(builder.finish().vertex_m))
    assert counts == [10, 12]
