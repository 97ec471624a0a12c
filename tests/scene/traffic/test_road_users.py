"""Bodies of recorded road users: of the recorded sizes, closed, with round wheels on the ground."""

import math

import numpy as np
import pytest

from tests.scene.town.closed_surface import unmatched_edge_count
from warpav.scene import road_user_of
from warpav.scene.traffic._road_users import body_mesh, drawn_kind

SIZES = [
    ("hatchback", (3.53, 1.62, math.nan)),
    ("saloon", (4.7, 1.85, 1.45)),
    ("suv", (4.4, 1.95, math.nan)),
    ("van", (5.2, 2.03, 2.5)),
    ("lorry", (6.41, 2.18, math.nan)),
    ("lorry", (19.8, 2.5, 3.9)),
    ("bus", (9.05, 2.39, math.nan)),
    ("bus", (12.25, 2.48, 3.2)),
]


@pytest.mark.parametrize(("kind", "size_m"), SIZES)
def test_bodies_have_the_recorded_length_width_and_height(kind, size_m):
    for seed in range(4):
        mesh = body_mesh(kind, size_m, np.random.default_rng(seed))
        low, high = mesh.bounds_m().astype(np.float64)
        assert high[0] - low[0] == pytest.approx(size_m[0], abs=1e-5)
        assert high[0] + low[0] == pytest.approx(0.0, abs=1e-5)
        assert low[2] == pytest.approx(0.0, abs=2e-3)
        if not math.isnan(size_m[2]):
            assert high[2] == pytest.approx(size_m[2], abs=1e-5)
        # the body without mirrors: in the lower half, where there are none
        beside = np.abs(mesh.vertex_m[mesh.vertex_m[:, 2] < 0.35 * high[2], 1]).max()
        assert 2.0 * beside == pytest.approx(size_m[1], abs=0.05)  # a lorry's guards stand out by .02
        assert unmatched_edge_count(mesh) == 0


def test_kinds_follow_class_and_size():
    def kinds(category, length_m, width_m, height_m=math.nan):
        return {drawn_kind(category, (length_m, width_m, height_m), np.random.default_rng(seed)) for seed in range(80)}

    assert kinds("truck", 8.0, 2.4) == {"lorry"}
    assert kinds("bicycle", 1.8, 0.6) == {"cyclist"}
    assert kinds("car", 12.0, 2.5) == {"lorry"}
    assert kinds("car", 2.2, 0.9) == {"motorcycle"}
    assert kinds("car", 3.8, 1.7) == {"hatchback"}
    assert kinds("car", 4.6, 1.8) == {"saloon", "estate", "suv"}
    assert kinds("car", 4.6, 1.8, 1.68) == {"suv"}
    assert road_user_of("motorcycle") == "vehicle"
