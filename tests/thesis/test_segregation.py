"""Orientations against brute force, assignment, informed batches."""

import itertools
import math

import numpy as np
import pytest

from tests.driving_scene import packed_street
from warpav.optimisation import AssignedScene
from warpav.raster.camera import CameraModel
from warpav.thesis import BatchChooser, areas_around, cameras_of, choose_orientations

MODEL = CameraModel(48, 48, math.pi / 2)
ORIGIN = np.array([1.2, 0.0, 1.0])


def brute_force(areas, camera_count, rotation_count):
    """Best number of vehicles seen, fewest duplicates, and all sets that reach both."""
    visible = [row > 0 for area in areas for row in area]
    best = []
    for chosen in itertools.combinations(range(rotation_count), camera_count):
        times = [sum(bool(row[a]) for a in chosen) for row in visible]
        seen, duplicates = sum(t > 0 for t in times), sum(t - 1 for t in times if t > 1)
        best.append((-seen, duplicates, chosen))
    seen, duplicates, _ = min(best)
    return -seen, duplicates, {chosen for s, d, chosen in best if (s, d) == (seen, duplicates)}


def random_areas(rng, rotation_count, density=0.15):
    scenes = [rng.uniform(0, 50, (rng.integers(0, 8), rotation_count)) for _ in range(6)]
    return [area * (rng.random(area.shape) < density) for area in scenes]


@pytest.mark.parametrize(("camera_count", "rotation_count"), [(1, 5), (2, 8), (4, 9), (8, 8), (4, 16)])
def test_orientations_equal_brute_force(rng, camera_count, rotation_count):
    areas = random_areas(rng, rotation_count)
    seen, duplicates, winners = brute_force(areas, camera_count, rotation_count)
    chosen = choose_orientations(areas, camera_count, rotation_count, rng)
    assert (chosen.seen_instances, chosen.duplicates) == (seen, duplicates)
    assert tuple(np.round(chosen.yaw_rad / (2 * math.pi / rotation_count)).astype(int)) in winners


def test_areas_around_look_the_way_they_say(device):
    scene = packed_street(device)
    yaw = np.array([0.0, 0.5, 1.0, -0.5]) * math.pi
    area = areas_around([scene.raster], yaw, ORIGIN, MODEL, device=device)[0]
    assert area.shape == (10, 4)
    # the cars of the street: ahead (0), to the left (6), behind (5), to the right (7)
    assert area[[0, 6, 5, 7]].argmax(axis=1).tolist() == [0, 1, 2, 3]


def test_segregation_and_assignment_of_rendered_scenes(device):
    scenes = [packed_street(device, *which).raster for which in ((), (4, 1), (2, 2))]
    areas = areas_around(scenes, np.arange(8) * math.pi / 4, ORIGIN, MODEL, device=device)
    result = choose_orientations(areas, 3, 8, np.random.default_rng(0))
    seen, duplicates, winners = brute_force(areas, 3, 8)
    assert (result.seen_instances, result.duplicates) == (seen, duplicates)
    chosen = tuple(np.round(result.yaw_rad / (math.pi / 4)).astype(int))
    assert chosen in winners
    assert tuple(result.rotation) == chosen
    assigned = [cameras_of(area[:, result.rotation]) for area in areas]
    # what cameras in these directions alone would see
    alone = areas_around(scenes, result.yaw_rad, ORIGIN, MODEL, device=device)
    for one, area in zip(assigned, alone, strict=True):
        np.testing.assert_array_equal(one, cameras_of(area))
    for area, camera in zip(areas, assigned, strict=True):
        mine = area[:, chosen]
        expected = [int(row.argmax()) if row.any() else -1 for row in mine]
        assert camera.tolist() == expected
        assert camera.dtype == np.int32
    everyone = np.concatenate(assigned)
    assert np.count_nonzero(everyone >= 0) == seen


def fake_scenes(*assigned):
    return [AssignedScene(None, np.array(cameras, np.int32)) for cameras in assigned]


def test_every_camera_gets_a_scene_of_its_own(rng):
    scenes = fake_scenes([0, 0], [1, -1], [2, 0], [-1, -1], [1, 2])
    chooser = BatchChooser(scenes, 3, rng)
    picked = set()
    for batch_size in (3, 4, 7):
        for _ in range(100):
            batch = chooser.choose(batch_size)
            assert len(batch) == batch_size
            for camera in range(3):
                assert any((scenes[k].assigned_camera == camera).any() for k in batch)
            picked |= set(batch)
    assert picked == {0, 1, 2, 4}  # the scene without assigned vehicles never
