"""Primitives, vehicles, people and furniture: closed, facing outwards, of credible size, repeatable."""

import numpy as np
import pytest

from tests.scene.town.closed_surface import back_face_share, signed_volume_m3, unmatched_edge_count
from warpav.raster.mesh import Mesh
from warpav.scene import person_mesh, vehicle_mesh
from warpav.scene.town._furniture import FOOTPRINT_M, furniture_mesh
from warpav.scene.town._surface_builder import SurfaceBuilder
from warpav.scene.town._vehicle_shapes import VARIANT_COUNT, ego_mesh


def mesh_of(surface):
    return Mesh.create(surface.vertex_m, surface.triangle, [128, 128, 128])


def test_box_is_closed_and_has_its_volume():
    builder = SurfaceBuilder()
    builder.add_box((0.0, 1.0, 2.0), (1.0, 3.0, 5.0), 0)
    mesh = mesh_of(builder.finish())
    assert len(mesh.triangle) == 12
    assert len(mesh.vertex_m) == 24  # six sides that share no normals
    assert unmatched_edge_count(mesh) == 0
    assert signed_volume_m3(mesh) == pytest.approx(6.0, rel=1e-6)


def test_ellipsoid_pair_is_closed_with_outward_normals():
    builder = SurfaceBuilder()
    builder.add_ellipsoid_pair((0.0, 2.0, 0.0), (1.0, 0.5, 0.7), 3)
    surface = builder.finish()
    mesh = mesh_of(surface)
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
    mesh = mesh_of(builder.finish())
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


GREY = np.array([0.4, 0.4, 0.4])
SIZE_M = {  # length, width with mirrors, height: lowest and highest that a stranger would accept
    "hatchback": ((3.7, 1.8, 1.35), (4.4, 2.2, 1.65)),
    "saloon": ((4.4, 1.8, 1.35), (5.0, 2.3, 1.55)),
    "estate": ((4.4, 1.8, 1.35), (5.0, 2.3, 1.60)),
    "suv": ((4.2, 1.8, 1.55), (4.9, 2.3, 1.90)),
    "van": ((4.8, 1.9, 1.85), (5.8, 2.5, 2.50)),
    "lorry": ((6.0, 2.3, 2.80), (9.0, 2.9, 3.60)),
    "bus": ((9.0, 2.5, 2.70), (13.0, 3.1, 3.30)),
}


@pytest.mark.parametrize("variant", range(VARIANT_COUNT))
@pytest.mark.parametrize("kind", sorted(SIZE_M))
def test_vehicle_is_closed_and_of_credible_size(kind, variant, rng):
    mesh = vehicle_mesh(kind, GREY, variant=variant)
    assert 2000 <= len(mesh.triangle) <= 8000
    low, high = mesh.bounds_m()
    smallest, largest = SIZE_M[kind]
    assert (high - low >= smallest).all()
    assert (high - low <= largest).all()
    assert low[2] == pytest.approx(0.0, abs=1e-3)  # the wheels touch the ground
    assert low[:2] + high[:2] == pytest.approx([0.0, 0.0], abs=1e-3)
    assert unmatched_edge_count(mesh) == 0
    assert signed_volume_m3(mesh) > 0.0
    assert back_face_share(mesh, rng) == 0.0


def test_ego_vehicle_is_closed_and_of_credible_size(rng):
    mesh = ego_mesh()
    low, high = mesh.bounds_m()
    assert high[0] - low[0] == pytest.approx(4.7, abs=0.1)
    assert high[2] == pytest.approx(1.55, abs=0.02)
    assert low[0] < -0.6  # the origin is below the rear axle
    assert high[0] > 3.3
    assert unmatched_edge_count(mesh) == 0
    assert back_face_share(mesh, rng) == 0.0


def test_ego_roof_and_bonnet_are_finely_meshed_and_smooth():
    mesh = ego_mesh()
    corner = mesh.vertex_m[mesh.triangle].astype(np.float64)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = 0.5 * np.linalg.norm(normal, axis=1)
    up = normal[:, 2] / np.maximum(2.0 * area, 1e-12)
    middle = corner.mean(axis=1)
    inside = np.abs(middle[:, 1]) < 0.5
    roof = inside & (up > 0.9) & (middle[:, 2] > 1.45) & (middle[:, 0] > -0.5) & (middle[:, 0] < 1.2)
    bonnet = inside & (up > 0.9) & (middle[:, 0] > 2.7) & (middle[:, 0] < 3.4) & (middle[:, 2] > 0.8)
    for part, extent_m2 in ((roof, 1.7), (bonnet, 0.7)):
        edge = np.linalg.norm(corner[part] - np.roll(corner[part], 1, axis=1), axis=-1)
        assert edge.max() < 0.16
        assert area[part].sum() == pytest.approx(extent_m2, rel=0.05)  # one layer, no holes
    assert np.ptp(middle[roof, 2]) < 0.08


def test_motorcyclists_are_closed_and_of_credible_size(rng):
    for seed in range(12):
        mesh = person_mesh("motorcyclist", np.random.default_rng(seed))
        low, high = mesh.bounds_m()
        assert len(mesh.triangle) <= 1_300
        assert low[2] == pytest.approx(0.0, abs=1e-3)
        assert 1.8 < high[0] - low[0] < 2.1
        assert 0.6 < high[1] - low[1] < 0.9
        assert 1.5 < high[2] < 1.8
        assert unmatched_edge_count(mesh) == 0
        assert signed_volume_m3(mesh) > 0.1
    assert back_face_share(mesh, rng, ray_count=40_000, hit_share_min=0.1) == 0.0


@pytest.mark.parametrize("category", ["pedestrian", "cyclist"])
def test_people_are_closed_and_of_credible_size(category):
    height = []
    for seed in range(24):
        mesh = person_mesh(category, np.random.default_rng(seed))
        low, high = mesh.bounds_m()
        assert 300 <= len(mesh.triangle) <= 800
        assert low[2] == pytest.approx(0.0, abs=1e-3)
        assert high[0] - low[0] < (1.2 if category == "pedestrian" else 1.9)
        assert high[1] - low[1] < 0.85
        assert unmatched_edge_count(mesh) == 0
        assert signed_volume_m3(mesh) > 0.02
        height.append(high[2])
    assert 1.0 < min(height) < max(height) < 2.05
    assert np.ptp(height) > 0.05


@pytest.mark.parametrize("kind", sorted(FOOTPRINT_M))
def test_furniture_is_closed_and_within_its_footprint(kind, rng):
    mesh = furniture_mesh(kind, rng)
    corner = mesh.vertex_m[mesh.triangle].astype(np.float64)
    low, high = corner[corner[..., 2].max(axis=1) < 2.6].min(axis=(0, 1)), corner[..., 2].max()
    assert unmatched_edge_count(mesh) == 0
    assert signed_volume_m3(mesh) > 0.0
    assert len(mesh.triangle) <= 500
    length, width = FOOTPRINT_M[kind]
    below_heads = mesh.vertex_m[mesh.vertex_m[:, 2] < 2.6]
    assert np.abs(below_heads[:, 0]).max() <= 0.5 * length + 1e-3
    assert np.abs(below_heads[:, 1]).max() <= 0.5 * width + 1e-3
    assert -0.2 < low[2] < 0.0  # the foot reaches into the ground
    assert high < 6.6
