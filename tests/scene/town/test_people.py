"""People and furniture: closed, of credible size, repeatable."""

import numpy as np
import pytest

from tests.scene.town.closed_surface import back_face_share, signed_volume_m3, unmatched_edge_count
from warpav.scene.town.furniture import FOOTPRINT_M, furniture_mesh
from warpav.scene.town.people import person_mesh


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
