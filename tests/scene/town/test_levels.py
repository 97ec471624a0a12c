"""The levels of the town: easy keeps its bits; in the others nobody overlaps, everybody stands, as many as promised."""

import hashlib
import itertools

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import warpav as wa
from tests.scene.town.digests import digest_of
from tests.scene.town.test_town import _Caster, _rectangle, _rectangles_overlap
from warpav.core.errors import InputError
from warpav.runs.config import load_config
from warpav.scene.town.lanes import HEADWAY_S
from warpav.scene.town.levels import LEVELS, level_scene

HARD = LEVELS[1:]
SEEDS = range(2, 6)  # on average 49, 90 and 28 road users
REACH_M = {"urban": 80.0, "dense": 80.0, "motorway": 200.0}
# SHA-256 of seeds 0 to 11 and some more as they were before there were levels, velocities and all
EASY_SEEDS = (*range(12), 1000, 1001, 5000, 70000)
EASY = "cab417b0b4b3fd257e4696a3ed3a7f491dbfcaebfce1eba99346f764f71b70b3"
EASY_NUMBERS = (
    *(1.681077, -0.726125, 1.378383, 93.373594, 91.018149, 90.717328, 2.016680, -0.187243, 0.864850),
    *(3.504447, 1.646533, 1.738333, -0.021364, -7.940081, -0.025730, 179.388480),
)
GENTLE = settings(max_examples=3, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])


def numbers_of(scene):
    """Means of what is a float: places [m], colours, boxes [m, rad], velocities [m/s]; float64 [16]."""
    meshes = [scene.environment, scene.ego, *(user.mesh for user in scene.road_users)]
    users = [
        [*user.box.center_m, *user.box.size_m, user.box.yaw_rad, *user.velocity_ego_m_s] for user in scene.road_users
    ]
    vertex, colour = (np.concatenate([getattr(mesh, name) for mesh in meshes]) for name in ("vertex_m", "vertex_rgb"))
    sky = np.mean([scene.sky.horizon_rgb, scene.sky.zenith_rgb])
    means = (each.mean(axis=0, dtype=float) for each in (vertex, colour, np.array(users)))
    return np.concatenate([*means, [sky]])


@pytest.fixture(scope="module")
def scenes():
    return {level: [level_scene(seed, level) for seed in SEEDS] for level in HARD}


def outline_of(user):
    return _rectangle(user.box.center_m, user.box.size_m, user.box.yaw_rad)


def ego_outline(scene):
    low, high = scene.ego.bounds_m().astype(np.float64)
    return _rectangle(0.5 * (low + high), high - low, 0.0)


def check_nothing_overlaps(scene):
    outlines = [ego_outline(scene), *map(outline_of, scene.road_users)]
    centre, reach = np.array([o.mean(axis=0) for o in outlines]), [np.ptp(o, axis=0).max() for o in outlines]
    for one, other in itertools.combinations(range(len(outlines)), 2):
        if np.hypot(*(centre[one] - centre[other])) < reach[one] + reach[other]:
            assert not _rectangles_overlap(outlines[one], outlines[other]), (scene.name, one, other)


def check_everybody_stands_free(scene):
    """Feet and wheels are on the ground, and nothing of the environment reaches into anybody above them."""
    caster = _Caster(scene.environment)
    middle = scene.environment.vertex_m[scene.environment.triangle].mean(axis=1).astype(np.float64)
    for user in scene.road_users:
        where = (scene.name, user.instance_id, user.category)
        vertex = user.mesh.vertex_m.astype(np.float64)
        sole = vertex[vertex[:, 2] < vertex[:, 2].min() + (0.05 if user.road_user == "pedestrian" else 0.4)]
        height = caster.height_above_m(sole).min()
        assert -0.06 < height < 0.06, (*where, height)
        above = caster.distance_m(np.array([[*user.box.center_m[:2], user.box.center_m[2]]]), 1.0)[0]
        assert above > 3.0, where  # no roof, but a lamp or a bridge
        inside = user.box.contains(middle, margin_m=-0.03)
        assert not (inside & (middle[:, 2] > vertex[:, 2].min() + 0.35 + 0.06 * user.box.size_m[0])).any(), (
            where
        )  # on a grade


def check_nobody_drives_into_whom_it_follows(scene):
    """Nobody meets whom it follows within the headway at constant speeds, the ego vehicle neither.

    Vehicles stand askew in their lanes by .02 rad, so that long ones pass each other's mirrors by centimetres.
    """
    speed = [(0.0, ego_outline(scene), np.zeros(2))]
    vehicles = [user for user in scene.road_users if user.road_user == "vehicle"]
    slim = np.array([1.0, 0.9, 1.0])
    speed += [
        (
            user.box.yaw_rad,
            _rectangle(user.box.center_m, user.box.size_m * slim, user.box.yaw_rad),
            user.velocity_ego_m_s,
        )
        for user in vehicles
    ]
    later = [(yaw, outline + 0.96 * HEADWAY_S * velocity) for yaw, outline, velocity in speed]
    for (yaw, one), (other_yaw, other) in itertools.combinations(later, 2):
        if np.cos(yaw - other_yaw) > 0.99 and np.hypot(*(one.mean(axis=0) - other.mean(axis=0))) < 16.0:
            assert not _rectangles_overlap(one, other), scene.name


def test_easy_is_what_it_was():
    scenes = [level_scene(seed) for seed in EASY_SEEDS]
    assert hashlib.sha256("".join(map(digest_of, scenes)).encode()).hexdigest() == EASY
    weight = np.arange(1, len(scenes) + 1)  # scenes that change places show
    found = np.average([numbers_of(scene) for scene in scenes], axis=0, weights=weight)
    np.testing.assert_allclose(found, EASY_NUMBERS, rtol=1e-4, atol=2e-3)  # colours 0..255 among them


@pytest.mark.parametrize("level", HARD)
@GENTLE
@given(seed=st.integers(0, 2**31 - 1))
def test_nobody_overlaps_with_anything(level, seed):
    scene = level_scene(seed, level)
    check_nothing_overlaps(scene)
    check_everybody_stands_free(scene)
    check_nobody_drives_into_whom_it_follows(scene)


def test_levels_are_as_full_as_they_are_named(scenes):
    mean = {level: np.mean([len(scene.road_users) for scene in each]) for level, each in scenes.items()}
    assert mean["dense"] > 1.4 * mean["urban"] > 40.0
    assert 15.0 < mean["motorway"] < 60.0
    kinds = {level: {user.road_user for scene in each for user in scene.road_users} for level, each in scenes.items()}
    assert kinds["urban"] == kinds["dense"] == {"vehicle", "pedestrian", "cyclist"}
    assert kinds["motorway"] == {"vehicle"}


@pytest.mark.parametrize("level", HARD)
def test_the_ground_reaches_as_far_as_the_road_users_and_carries_the_ego_vehicle(level, scenes):
    for scene in scenes[level]:
        along = np.linspace(-0.95, 0.95, 60) * (REACH_M[level] + 10.0)
        caster = _Caster(scene.environment)
        below = caster.distance_m(np.c_[along, 0.0 * along, np.full_like(along, 60.0)], -1.0)
        assert np.isfinite(below).all(), scene.name
        tyre = scene.ego.vertex_m[scene.ego.vertex_m[:, 2] < 0.02]
        np.testing.assert_allclose(caster.height_above_m(tyre.astype(np.float64)), tyre[:, 2], atol=0.04)


def test_a_level_that_is_none_is_refused():
    with pytest.raises(InputError, match=r"level: expected one of easy, urban, dense, motorway, got 'dens'; .*dense"):
        wa.town([0], level="dens")
    with pytest.raises(ValueError, match="seed must be 0 or more, got -1"):
        level_scene(-1, "urban")
    with pytest.raises(InputError, match=r"expected no level because scenes\.source is captured"):
        load_config(wa.Config(), ["scenes.source=captured", "scenes.level=urban"])
