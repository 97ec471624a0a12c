"""The ground of recorded scenes: road where lanes are, without gaps, kerbs where it ends."""

import numpy as np
import pytest
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from warpav.scene.town._houses import KERB_HEIGHT_M, SceneryBuilder
from warpav.scene.town._surface_builder import StreetGround
from warpav.scene.traffic._road import Roadside, road_of
from warpav.scene.traffic.recording import Lanelet

HALF_M, END_M = 4.0, 40.0


def lane(x, low, high, *kinds):
    return Lanelet(np.array([[each, high] for each in x], float), np.array([[each, low] for each in x], float), kinds)


def straight_road(*more, heavy=(), light=(), driven=(), walked=(), end_m=END_M):
    lanes = [lane((-end_m, end_m), -HALF_M, 0.0), lane((end_m, -end_m), HALF_M, 0.0), *more]
    place = np.array([[2.5, 1.0], [-2.5, 1.0], [-2.5, -1.0], [2.5, -1.0]])
    return road_of(lanes, [place, *heavy], list(light), driven, walked, 3.0)


def built(road, seed=0):
    rng = np.random.default_rng(seed)
    builder = SceneryBuilder(rng, StreetGround())
    return road.ground(builder, rng), builder


def heights_m(mesh, point_m):
    """Height of the highest surface below points, NaN where a ray falls through."""
    caster = EmbreeScene()
    TriangleMesh(caster, mesh.vertex_m[mesh.triangle])
    origin = np.c_[point_m, np.full(len(point_m), 5.0)].astype(np.float32)
    down = np.broadcast_to(np.array([0, 0, -1], np.float32), origin.shape)
    away = caster.run(origin, np.ascontiguousarray(down), query="DISTANCE")
    return np.where(away < 1e6, 5.0 - away, np.nan)


def test_distances_are_those_from_the_straight_road():
    road = straight_road()
    y = np.linspace(-12.0, 12.0, 49)
    for x in (-20.0, 0.0, 20.0):
        point = np.c_[np.full_like(y, x), y]
        # cells of .15 m, and smoothing of .25 m where the distance bends; worst seen .18
        assert np.abs(road.distance_m(point) - (np.abs(y) - HALF_M)).max() < 0.22
        near = np.abs(np.abs(y) - HALF_M) < 1.5
        assert np.abs(road.distance_m(point) - (np.abs(y) - HALF_M))[near].max() < 0.2  # worst seen .18
    assert road.height_m(np.array([[0.0, 3.8], [0.0, 4.2], [500.0, 0.0]])).tolist() == [
        0.0,
        KERB_HEIGHT_M,
        KERB_HEIGHT_M,
    ]


@pytest.mark.parametrize("seed", range(3))
def test_the_ground_has_no_gap_and_one_height_everywhere(seed, rng):
    road = straight_road(
        lane((5.0, 9.0), -30.0, 0.0), heavy=[np.array([[10.0, 9.0], [14.0, 9.0], [14.0, 6.0], [10.0, 6.0]])]
    )
    mesh, _ = built(road, seed)
    point = rng.uniform(road.low_m + 0.05, road.high_m - 0.05, (60_000, 2))
    height = heights_m(mesh, point)
    assert not np.isnan(height).any()
    away = np.abs(road.distance_m(point)) > 0.25  # kerbs and their stones
    assert np.abs(height - road.height_m(point))[away].max() < 5e-3
    # seen from above, triangles cover the area once, and walls and stones lie upon it
    corner = mesh.vertex_m[mesh.triangle].astype(np.float64)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    flat = (np.ptp(corner[..., 2], axis=1) < 1e-6) & (np.abs(corner[:, 0, 2] - KERB_HEIGHT_M - 0.004) > 1e-3)
    assert (normal[flat, 2] > 0.0).all()
    assert 0.5 * normal[flat, 2].sum() == pytest.approx(np.prod(road.high_m - road.low_m), rel=1e-5)


def test_whoever_stands_outside_the_lanes_stands_on_road_and_riders_not_across_a_kerb():
    away = np.array([[22.0, 15.0], [18.0, 15.0], [18.0, 13.0], [22.0, 13.0]])
    assert (straight_road(heavy=[away]).distance_m(away * 0.5 + away.mean(axis=0) * 0.5) < 0.0).all()
    assert (straight_road(light=[away]).distance_m(away) > 0.0).all()
    across = away - [0.0, 10.0]  # 3 to 5 m from the middle
    assert (straight_road(light=[across]).distance_m(across * 0.5 + across.mean(axis=0) * 0.5) < 0.0).all()


def test_there_is_road_where_somebody_drives_and_nothing_stands_where_somebody_walks():
    yard = np.array([[0.0, 0.0], [0.0, 15.0], [8.0, 20.0]])
    path = np.array([[-30.0, 7.0], [-20.0, 9.0], [30.0, 9.0]])
    road = straight_road(driven=[(yard, 2.6)], walked=[(path, 1.0)])
    assert (road.distance_m(yard) < 0.0).all()
    assert road.distance_m(np.array([3.0, 12.0])) > 1.0
    assert road.is_walked(path)
    assert not road.is_walked(path + np.array([0.0, 1.0]))
    roadside = Roadside(road, [], np.random.default_rng(0))
    _, builder = built(road)
    roadside.build(builder)
    corner = np.concatenate([builder.finish().vertex_m, *(mesh.vertex_m for mesh in roadside.furniture)])
    low = corner[(corner[:, 2] > 0.3) & (corner[:, 2] < 3.0), :2]
    assert len(low) > 1000
    along = np.concatenate(
        [
            path[0] + (path[1] - path[0]) * np.linspace(0, 1, 50)[:, None],
            np.c_[np.arange(-20, 30, 0.2), np.full(250, 9.0)],
        ]
    )
    assert np.linalg.norm(low[:, None] - along, axis=2).min() > 0.3
