"""Rigs by hand: where they stand and look, and that a search is never behind them."""

import functools
import math

import numpy as np
import pytest

from tests.driving_scene import flat_surface
from tests.optimisation.test_polish import zone_of
from tests.optimisation.test_pool import cameras_of, mount_of, streets
from warpav.core.progress import NullProgress
from warpav.detection import expected_miss_rate
from warpav.optimisation import (
    PITCH_RAD,
    X_M,
    Y_M,
    YAW_RAD,
    CameraMount,
    Drawing,
    FreeRanges,
    PoolSearchSettings,
    PoolTask,
    by_hand,
    mount_pose_by_hand,
)
from warpav.optimisation import _hand_rigs as hand_rigs
from warpav.optimisation._hand_rigs import directions_rad
from warpav.optimisation._pool_search import PoolSearch
from warpav.raster.camera import CameraModel
from warpav.runs import Optimisation, Placement
from warpav.runs.config import load_config

MODEL = CameraModel(64, 64, math.radians(100.0), near_m=0.05)


@functools.cache
def flat(free=FreeRanges(pitch_rad=(-0.2, 0.5))):  # noqa: B008 (frozen)
    return CameraMount(flat_surface([-1.0, -0.6], [1.0, 0.6]), camera=MODEL, height_offset_m=0.25, free=free)


@pytest.mark.parametrize(
    ("name", "count", "first_deg", "expected_deg"),
    [
        ("corners", 4, 42, [42, -42, 138, -138]),
        ("corners", 6, 42, [42, -42, 138, -138, 0, 180]),
        ("corners", 8, 42, [42, -42, 138, -138, 0, 180, 90, -90]),
        ("corners", 3, 42, [0, 120, -120]),
        ("cross", 4, 0, [0, 90, 180, -90]),
        ("cross", 6, 30, [30, 90, 150, -150, -90, -30]),
    ],
)
def test_where_they_look(name, count, first_deg, expected_deg):
    turn = directions_rad(name, count, first_deg) - np.radians(expected_deg)
    np.testing.assert_allclose(np.exp(1j * turn), 1.0, atol=1e-9)


def test_corners_stand_at_the_corners_and_the_front_pair_is_set_back():
    pose = mount_pose_by_hand("corners", flat(), zone_of(flat(), 4), 4)
    corner_m = [[0.7, 0.6], [0.7, -0.6], [-1.0, 0.6], [-1.0, -0.6]]
    np.testing.assert_allclose(pose[:, [X_M, Y_M]], corner_m, atol=0.08)  # cells, and the border's margin
    np.testing.assert_allclose(np.degrees(pose[:, YAW_RAD]), [44, -44, 136, -136], rtol=1e-5)
    np.testing.assert_allclose(np.degrees(pose[:, PITCH_RAD]), 12.0, rtol=1e-5)


def test_the_best_by_hand_is_the_best_of_what_was_tried():
    """An objective of one number each: 46 degrees, 0.6 m back, pitch 6 is best, and is found one after the other."""
    tried = []

    def value_of(pose):
        front = pose[:, X_M].max()
        tried.append(pose)
        yaw_deg = abs(math.degrees(pose[0, YAW_RAD]))
        return 1.0 + (yaw_deg - 46) ** 2 + (front - 0.4) ** 2 + abs(math.degrees(pose[0, PITCH_RAD]) - 6)

    found = by_hand(flat(), zone_of(flat(), 4), 4, lambda rigs: [value_of(rig) for rig in rigs])
    assert found[0].name == "corners"
    assert found[0].numbers == "46 deg, front pair 0.6 m back, pitch 6 deg"
    assert [rig.value for rig in found] == sorted(rig.value for rig in found)
    assert {rig.name for rig in found} == {"corners", "cross", "edge", "highest"}
    assert len(tried) <= 20
    six = by_hand(flat(), zone_of(flat(), 6), 6, lambda rigs: [1.0] * len(rigs))
    assert {"pitch 12 deg", "30 deg, pitch 12 deg"} <= {rig.numbers for rig in six if rig.name == "cross"}


def test_a_search_is_never_behind_a_rig_by_hand():
    mount = mount_of(free=FreeRanges(pitch_rad=(-0.1, 0.4)), model=MODEL)
    cameras = cameras_of(mount=mount)
    task = PoolTask(cameras, streets(), zone_of(mount, 4), 4, starts_by_hand=True)
    search = PoolSearch(task, PoolSearchSettings(pool_cameras=16, rounds=0))
    objectives = [found.objective for found in search if found.stage != "settled"]
    assert objectives == sorted(objectives, reverse=True)
    share = np.full(10, 0.1)
    for each in search.hand_rigs:
        found = np.concatenate([cameras.detection_probability(each.mount_pose, scene) for scene in streets()], axis=1)
        assert each.value == pytest.approx(expected_miss_rate(found, share), abs=1e-6)
        assert objectives[-1] <= each.value


@pytest.mark.slow
@pytest.mark.parametrize("cameras", [4, 6])
@pytest.mark.parametrize(
    "traffic",
    [[], ["scenes.ego=panel_van"], ["scenes.ego=bus"], ["scenes.level=dense"], ["scenes.source=traffic"]],
    ids=["car", "van", "bus", "dense", "sind"],
)
def test_the_rig_of_the_trial_polished_is_never_ahead(traffic, cameras, short_polish):
    """Four corners at 42 degrees, of six pairs at 30, 90 and 150, pitch 18, those at the front .5 m set back."""
    short_polish.undo()
    small = ["scenes.train_seeds=0..11", "scenes.test_seeds=[5000]", "optimiser.pool_cameras=48", *traffic]
    config = load_config("quick", [*small, f"rig.cameras={cameras}", "camera.width_px=128", "camera.height_px=128"])
    placement = Placement.from_config(config).prepare(NullProgress())
    run = Optimisation.begin(placement, drawing=Drawing()).descent
    while run.stop_reason is None:
        run.step()
    found, mount = run.objective, run.cameras.mount
    layout = hand_rigs._layout("corners", mount, run.task.constraints, cameras, 42.0)
    pose = hand_rigs._hand_mount_pose(mount, run.task.constraints, layout, set_back_m=0.5, pitch_deg=18.0)
    run.pool = run.pool.extended(pose)
    assert not run._keeps_rules(pose) or found <= run._value_of(pose)
    run.objective = np.inf
    list(run._polish(pose.tolist(), 12, 1.0))
    assert found <= run.objective
