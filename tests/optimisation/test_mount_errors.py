"""Cameras with errors of mounting: means over renders of cameras that are off, one by one, and searches with them."""

import itertools
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest

from tests.optimisation.calls import pool_search
from tests.optimisation.test_ghost_scene import scene as ghosts
from tests.optimisation.test_modules import SMALL as SMALL_MIX
from tests.optimisation.test_modules import columns, symmetric_cameras, symmetric_chart
from tests.optimisation.test_polish import zone_of
from tests.optimisation.test_pool import cameras_of, drawn, mount_of, poses_of, streets
from tests.optimisation.test_pool_search import SMALL
from warpav.detection import expected_miss_rate
from warpav.optimisation import HEIGHT_DELTA_M, LOG_ZOOM, MountErrors, RigLimits, ZoneAndSpacing, highest_mount_pose
from warpav.optimisation._mount import MIRROR
from warpav.optimisation._mount_errors import COLUMNS
from warpav.optimisation._pool import spread_mount_poses
from warpav.optimisation._single_cameras import MisplacedCameras
from warpav.raster.camera import CameraModel

ERRORS = MountErrors(0.05, 0.04)
FINE = CameraModel(256, 256, math.pi / 2)


def detected(cameras, pose, scenes=None):
    scenes = streets() if scenes is None else scenes
    return np.concatenate([cameras.detection_probability(np.float32(pose), scene) for scene in scenes], axis=1)


def in_the_mean(cameras, pose, errors=ERRORS, scenes=None):
    """One camera and one error at a time; inwards errors end at the skin."""
    found = []
    for camera in np.asarray(pose, np.float64):
        rows = []
        for draw in errors.draws:
            off = camera + draw
            skin_m = -cameras.mount.height_offset_m
            off[HEIGHT_DELTA_M] = max(off[HEIGHT_DELTA_M], min(camera[HEIGHT_DELTA_M], skin_m))
            rows.append(detected(cameras, off[None], scenes)[0])
        found.append(np.mean(rows, axis=0))
    return np.array(found)


def test_draws_have_the_moments_of_even_errors_up_to_the_third_degree():
    draws = ERRORS.draws
    assert (np.abs(draws) <= np.where(np.isin(np.arange(7), list(COLUMNS.values())), 0.05, 0.0)).all()
    share = draws[:, list(COLUMNS.values())] / ERRORS.tolerance
    assert not draws[:, LOG_ZOOM].any()
    for degree in (1, 2, 3):
        for chosen in itertools.combinations_with_replacement(range(6), degree):
            moment = np.prod(share[:, list(chosen)], axis=1).mean()
            even = 1.0 / 3.0 if degree == 2 and len(set(chosen)) == 1 else 0.0
            assert moment == pytest.approx(even, abs=1e-12)


def test_a_camera_detects_the_mean_of_its_renders_that_are_off():
    cameras = cameras_of()
    pose = poses_of(4)
    pose[0, HEIGHT_DELTA_M] = -0.25  # flush with the skin
    pose[1, HEIGHT_DELTA_M] = -0.24
    found = detected(MisplacedCameras.of(cameras, ERRORS), pose)
    expected = in_the_mean(cameras, pose)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert np.abs(found - detected(cameras, pose)).max() > 0.02


def test_the_mean_of_few_draws_is_near_that_of_many():
    cameras = cameras_of(mount=mount_of(model=FINE))
    pose, rng = poses_of(12, cameras.mount), np.random.default_rng(0)
    every = np.tile(pose.astype(np.float64), (200, 1, 1))
    every[..., list(COLUMNS.values())] += ERRORS.tolerance * rng.uniform(-1.0, 1.0, (200, 12, 6))
    many = detected(cameras, every.reshape(-1, 7)).reshape(200, 12, -1).mean(axis=0)
    few, plain = detected(MisplacedCameras.of(cameras, ERRORS), pose), detected(cameras, pose)
    assert np.sqrt(np.mean((few - many) ** 2)) < 0.5 * np.sqrt(np.mean((plain - many) ** 2))


def test_of_a_pair_each_camera_has_errors_of_its_own():
    cameras, pose = symmetric_cameras(), columns(12)
    left, right = cameras.sides
    is_pair = cameras.mount.is_pair(pose)
    assert 0 < is_pair.sum() < len(pose)
    own, image = in_the_mean(left, pose), in_the_mean(right, pose * MIRROR)
    expected = np.where(is_pair[:, None], 1.0 - (1.0 - own) * (1.0 - image), own)
    misplaced = MisplacedCameras.of(cameras, ERRORS)
    np.testing.assert_allclose(detected(misplaced, pose), expected, atol=1e-6)
    np.testing.assert_allclose(misplaced.with_jacobian(pose, streets())[0], expected, atol=1e-5)
    for plain, side in zip((own, image), misplaced.sides, strict=True):
        mirror = MIRROR if side is misplaced.sides[1] else 1.0
        np.testing.assert_allclose(detected(side, pose * mirror), plain, atol=1e-6)


def test_the_jacobian_is_the_mean_of_those_that_are_off():
    cameras = cameras_of()
    misplaced = MisplacedCameras.of(cameras, ERRORS)
    pose = poses_of(3)
    probability, jacobian = misplaced.with_jacobian(pose, streets())
    np.testing.assert_allclose(probability, detected(misplaced, pose), atol=1e-5)
    each = [cameras.with_jacobian(np.float32(pose + draw), streets())[1] for draw in ERRORS.draws]
    np.testing.assert_allclose(jacobian, np.mean(each, axis=0), atol=1e-6)
    assert np.abs(jacobian).max() > 0.1


def test_the_jacobian_is_that_of_differences():
    mount = mount_of(model=FINE)
    misplaced = MisplacedCameras.of(cameras_of(mount=mount, supersampling=2), ERRORS)
    pose = poses_of(3, mount).astype(np.float64)
    _, jacobian = misplaced.with_jacobian(pose, streets())
    for column in COLUMNS.values():
        ahead, behind = pose.copy(), pose.copy()
        ahead[:, column], behind[:, column] = pose[:, column] + 0.01, pose[:, column] - 0.01
        difference = (detected(misplaced, ahead) - detected(misplaced, behind)).ravel() / 0.02
        found = jacobian[..., column].ravel()
        assert np.corrcoef(found, difference)[0, 1] > 0.95, column


def test_points_of_requirements_are_seen_without_errors():
    cameras, pose = symmetric_cameras(), columns(6)
    misplaced, together = MisplacedCameras.of(cameras, ERRORS), [*streets(), ghosts()]
    np.testing.assert_array_equal(detected(misplaced, pose, [ghosts()]), detected(cameras, pose, [ghosts()]))
    found, slope = misplaced.with_jacobian(pose, together)
    plain, plain_slope = cameras.with_jacobian(pose, together)
    count = ghosts().vehicle_count
    np.testing.assert_array_equal(found[:, -count:], plain[:, -count:])
    np.testing.assert_array_equal(slope[:, -count:], plain_slope[:, -count:])
    assert np.abs(found[:, :-count] - plain[:, :-count]).max() > 0.02


def test_caches_keep_errors_apart_and_processes_agree(tmp_path):
    plain, wide = cameras_of(), MisplacedCameras.of(cameras_of(), ERRORS)
    narrow = MisplacedCameras.of(cameras_of(), MountErrors(0.05, 0.03))
    assert len({each.identity["camera"] for each in (plain, wide, narrow)}) == 3
    pools = [drawn(4, cameras=each, cache=tmp_path) for each in (plain, wide, narrow)]
    assert [pool.cached_count for pool in pools] == [0, 0, 0]
    again = drawn(4, cameras=wide, cache=tmp_path)
    assert again.drawn_count == 0
    np.testing.assert_array_equal(again.detection_probability, pools[1].detection_probability)
    travelled = pickle.loads(pickle.dumps(wide))
    assert travelled.identity == wide.identity
    np.testing.assert_array_equal(detected(travelled, poses_of(4)), pools[1].detection_probability)


def searched(errors, count=3, settings=SMALL, **options):
    mount = mount_of(free=None)
    cameras, constraints = cameras_of(mount=mount), zone_of(mount, count)
    return list(pool_search(cameras, streets(), constraints, count, settings=settings, mount_errors=errors, **options))


def over_all_errors(cameras, pose, errors):
    """The expected miss rate over every combination of the errors of all cameras: the definition itself."""
    off = (pose[:, None].astype(np.float64) + errors.draws).astype(np.float32)
    found = [detected(cameras, each) for each in off]
    rigs = [found[0][:, None], found[1][None]]
    return float(np.mean(np.prod(np.broadcast_arrays(*(1.0 - each for each in rigs)), axis=0)))


def test_the_objective_is_the_mean_over_all_combinations_of_errors():
    [*_, last] = searched(ERRORS, count=2)
    cameras = cameras_of(mount=mount_of(free=None))
    assert last.objective == pytest.approx(over_all_errors(cameras, last.mount_pose, ERRORS), abs=1e-4)
    assert last.bound <= last.objective or last.stage == "settled"


def test_no_rig_of_a_tiny_pool_is_below_the_bound():
    mount = mount_of(free=None)
    constraints, cameras = zone_of(mount), MisplacedCameras.of(cameras_of(mount=mount), ERRORS)
    [chosen, _] = searched(ERRORS, settings=replace(SMALL, polishes=False))
    pose = spread_mount_poses(mount, constraints, SMALL.pool_cameras, seed=0)
    found = in_the_mean(cameras_of(mount=mount), pose)
    point = np.c_[pose[:, :2], mount.surface.height_at_m(pose[:, :2])]
    best = min(
        expected_miss_rate(found[list(rig)])
        for rig in itertools.combinations(range(len(pose)), 3)
        if all(np.linalg.norm(point[i] - point[j]) > 0.3 + 1e-6 for i, j in itertools.combinations(rig, 2))
    )
    assert chosen.objective == pytest.approx(best, abs=1e-6)
    assert chosen.bound <= best + 1e-6
    assert chosen.objective == pytest.approx(expected_miss_rate(detected(cameras, chosen.mount_pose)), abs=1e-6)


def test_a_symmetric_search_counts_the_errors_of_both_cameras_of_a_pair():
    surface, cameras, scenes = symmetric_chart(), symmetric_cameras(), streets()[:1]
    kinds = [(name, 1 + pair) for name, pair in zip(surface.modules, surface.pairs, strict=True)]
    limits = RigLimits.of({"narrow": (0, 1), "wide": (2, 2), "fisheye": (0, 2)}, count=(3, 5), kinds=kinds)
    constraints = ZoneAndSpacing(surface, camera_count=1, margin_m=0.02, module=limits.first_kinds())
    start = highest_mount_pose(constraints, len(limits.first_kinds()))
    options = {
        "start": start,
        "settings": replace(SMALL_MIX, pool_cameras=18, rounds=0),
        "limits": limits,
        "mount_errors": ERRORS,
    }
    *_, last = pool_search(cameras, scenes, constraints, 5, **options)
    pose, side = cameras.apart(last.mount_pose)
    found = [in_the_mean(cameras.sides[k], pose[side == k], scenes=scenes) for k in (0, 1)]
    assert last.objective == pytest.approx(expected_miss_rate(np.concatenate(found)), abs=1e-4)
