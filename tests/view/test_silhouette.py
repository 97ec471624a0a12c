"""Outlines: of a block they are its rectangle, holes and loose parts count, and a fine mesh stays within the raster."""

import numpy as np
import pytest

from tests.view.stand_ins import block, ego
from warpav.raster.mesh import merge
from warpav.view.outlines import STEP_M, silhouette_m

X, Y, Z = np.eye(3)


def area_m2(line):
    x, y = line.T
    return 0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))


@pytest.mark.parametrize(("right", "up"), [(X, Z), (-X, Z), (Y, Z), (-X, -Y)])
def test_a_block_is_its_rectangle_from_every_side(right, up):
    [line] = silhouette_m(ego(), right, up)
    corner = ego().vertex_m @ np.stack([right, up], axis=1)
    assert len(line) == 4
    np.testing.assert_allclose(line.min(axis=0), corner.min(axis=0), atol=STEP_M)
    np.testing.assert_allclose(line.max(axis=0), corner.max(axis=0), atol=STEP_M)


def test_a_gap_between_two_posts_is_a_hole_only_where_it_is_closed():
    posts = [block((0, 0, 0), (0.2, 1, 1), (9, 9, 9)), block((0.8, 0, 0), (1, 1, 1), (9, 9, 9))]
    lintel = block((0, 0, 0.8), (1, 1, 1), (9, 9, 9))
    sill = block((0, 0, 0), (1, 1, 0.2), (9, 9, 9))
    assert len(silhouette_m(merge(posts), X, Z)) == 2
    [gate] = silhouette_m(merge([*posts, lintel]), X, Z)
    assert area_m2(gate) == pytest.approx(1.0 - 0.6 * 0.8, abs=0.01)
    outer, hole = silhouette_m(merge([*posts, lintel, sill]), X, Z)
    assert area_m2(outer) == pytest.approx(1.0, abs=0.01)
    assert area_m2(hole) == pytest.approx(0.36, abs=0.01)


def test_a_disc_is_round_within_two_steps():
    turn = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    rim = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    from warpav.raster.mesh import Mesh

    fan = [[200, k, (k + 1) % 200] for k in range(200)]
    [line] = silhouette_m(Mesh.create(np.vstack([rim, [[0, 0, 0]]]), fan, (9, 9, 9)), X, Y)
    assert np.abs(np.linalg.norm(line, axis=1) - 1.0).max() < 2.0 * STEP_M  # worst seen 0.0016
