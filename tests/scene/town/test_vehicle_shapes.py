"""Vehicles: size, faces, closedness, repeatability."""

import numpy as np
import pytest

from tests.scene.town.closed_surface import back_face_share, signed_volume_m3, unmatched_edge_count
from warpav.scene.town.vehicle_shapes import VARIANT_COUNT, ego_mesh, vehicle_mesh

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
