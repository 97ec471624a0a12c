"""Town scenes: counts, visibility, no overlaps, headings along the lanes, the same bytes for the same seed."""

import hashlib
import itertools
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from warpav.scene.town import EYE_HEIGHT_M, ego_vehicle, town_scene, visible_shares
from warpav.scene.town_layout import town_layout

SEEDS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 1000, 1001)
HEADING_TOLERANCE_RAD = 0.03


@pytest.fixture(scope="module")
def scenes():
    return [town_scene(seed) for seed in SEEDS]


def _digest(scene):
    digest = hashlib.sha256()
    for mesh in (scene.environment, scene.ego, *(vehicle.mesh for vehicle in scene.vehicles)):
        for array in (mesh.vertex_m, mesh.triangle, mesh.vertex_rgb):
            digest.update(np.ascontiguousarray(array).tobytes())
    digest.update(repr([(v.instance_id, v.category, v.box.yaw_rad) for v in scene.vehicles]).encode())
    return digest.hexdigest()


def _rectangle(center_m, size_m, yaw_rad):
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    corner = 0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * size_m[:2]
    return center_m[:2] + corner @ np.array([[c, s], [-s, c]])


def _rectangles_overlap(one, other):
    """Separating axes of two convex polygons, written apart from the code under test."""
    for polygon in (one, other):
        for start, end in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
            axis = np.array([end[1] - start[1], start[0] - end[0]])
            if (one @ axis).max() <= (other @ axis).min() or (other @ axis).max() <= (one @ axis).min():
                return False
    return True


def test_same_seed_gives_the_same_bytes_in_another_process(scenes):
    code = "from tests.scene.test_town import _digest, town_scene; print(_digest(town_scene(3)))"
    root = Path(__file__).parents[2]
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert run.stdout.strip() == _digest(scenes[SEEDS.index(3)])


def test_other_seeds_give_other_scenes(scenes):
    assert len({_digest(scene) for scene in scenes}) == len(SEEDS)


def test_triangle_counts(scenes):
    for scene in scenes:
        vehicles = [len(vehicle.mesh.triangle) for vehicle in scene.vehicles]
        total = len(scene.environment.triangle) + len(scene.ego.triangle) + sum(vehicles)
        assert 45_000 <= total <= 75_000, scene.name
        assert min(vehicles) >= 2000
        assert max(vehicles) <= 8000


def test_five_to_fifteen_vehicles_are_visible_from_the_roof(scenes):
    for scene in scenes:
        eye = np.array([scene.ego.bounds_m()[:, 0].mean(), 0.0, EYE_HEIGHT_M])
        share = visible_shares(eye, [scene.environment, scene.ego], [vehicle.mesh for vehicle in scene.vehicles])
        assert 5 <= np.count_nonzero(share > 0.0) <= 15, scene.name
        assert share.min() > 0.0, scene.name  # hidden vehicles are left out


def test_a_wall_hides_vehicles(scenes):
    scene = scenes[0]
    eye = np.array([scene.ego.bounds_m()[:, 0].mean(), 0.0, EYE_HEIGHT_M])
    meshes = [vehicle.mesh for vehicle in scene.vehicles]
    shell = ego_vehicle().transformed(np.eye(3), np.array([0.0, 0.0, EYE_HEIGHT_M - 0.7]))
    assert visible_shares(eye, [shell], meshes).max() == 0.0


def test_no_vehicle_overlaps_another_or_the_ego_vehicle(scenes):
    low, high = ego_vehicle().bounds_m().astype(np.float64)
    ego = _rectangle(0.5 * (low + high), high - low, 0.0)
    for scene in scenes:
        outlines = [ego, *(_rectangle(v.box.center_m, v.box.size_m, v.box.yaw_rad) for v in scene.vehicles)]
        for one, other in itertools.combinations(outlines, 2):
            assert not _rectangles_overlap(one, other), scene.name


def test_no_vehicle_stands_in_a_house_or_on_a_pavement(scenes):
    for scene in scenes:
        corner = scene.environment.vertex_m[scene.environment.triangle].astype(np.float64)
        raised = corner[corner[:, :, 2].min(axis=1) > 0.1]
        for vehicle in scene.vehicles:
            size = vehicle.box.size_m * [1.0, 0.85, 1.0]  # without mirrors
            outline = _rectangle(vehicle.box.center_m, size, vehicle.box.yaw_rad)
            near = raised[np.abs(raised[..., :2].mean(axis=1) - vehicle.box.center_m[:2]).max(axis=1) < 12.0]
            for triangle in near[..., :2]:
                assert not _rectangles_overlap(outline, triangle), (scene.name, vehicle.instance_id)


def test_headings_follow_the_lanes(scenes):
    """Streets run along x or y; in a lane or bay a vehicle points along it, either way."""
    for scene in scenes:
        for vehicle in scene.vehicles:
            quarter = vehicle.box.yaw_rad / (0.5 * np.pi)
            assert abs(quarter - round(quarter)) * 0.5 * np.pi < HEADING_TOLERANCE_RAD, scene.name


@pytest.mark.parametrize("seed", range(30))
def test_lanes_keep_to_one_side(seed):
    """Seen along its heading, every lane lies on the same side of its street; mirrored plans on the other."""
    layout = town_layout(np.random.default_rng(seed))
    if layout.template == "car_park":
        return
    sides = {
        float(np.sign(np.cos(slot.yaw_rad) * slot.y_m))
        for slot in layout.slots
        if not slot.parked and abs(np.sin(slot.yaw_rad)) < 0.5
    }
    assert sides == {float(np.sign(layout.ego.y_m))}


def test_all_road_templates_and_both_sides_occur():
    layouts = [town_layout(np.random.default_rng(seed)) for seed in range(80)]
    assert {layout.template for layout in layouts} == {
        "parking_street", "avenue", "crossroads", "t_junction", "car_park"
    }  # fmt: skip
    left = np.mean([layout.ego.y_m > 0.0 for layout in layouts])
    assert 0.3 < left < 0.7


def test_boxes_fit_their_meshes(scenes):
    for vehicle in scenes[1].vehicles:
        c, s = np.cos(vehicle.box.yaw_rad), np.sin(vehicle.box.yaw_rad)
        offset = vehicle.mesh.vertex_m - vehicle.box.center_m
        local = np.stack([c * offset[:, 0] + s * offset[:, 1], -s * offset[:, 0] + c * offset[:, 1], offset[:, 2]], 1)
        np.testing.assert_allclose(local.max(axis=0), 0.5 * vehicle.box.size_m, atol=2e-3)
        np.testing.assert_allclose(local.min(axis=0), -0.5 * vehicle.box.size_m, atol=2e-3)


def test_the_ego_vehicle_is_the_same_everywhere(scenes):
    for scene in scenes[1:]:
        np.testing.assert_array_equal(scene.ego.vertex_m, scenes[0].ego.vertex_m)
        np.testing.assert_array_equal(scene.ego.vertex_rgb, scenes[0].ego.vertex_rgb)


def test_traffic_stands_on_all_sides(scenes):
    position = np.array([vehicle.box.center_m[:2] for scene in scenes for vehicle in scene.vehicles])
    position[:, 0] -= ego_vehicle().bounds_m()[:, 0].mean()
    assert np.hypot(*position.T).max() < 40.0
    assert 0.3 < np.mean(position[:, 0] > 0.0) < 0.7
    assert 0.3 < np.mean(position[:, 1] > 0.0) < 0.7


def test_contact_shadows_darken_the_road_below_vehicles(scenes):
    scene = scenes[2]
    road = np.abs(scene.environment.vertex_m[:, 2]) < 0.03
    ground, colour = scene.environment.vertex_m[road], scene.environment.vertex_rgb[road].mean(axis=1)
    for vehicle in scene.vehicles:
        below = np.hypot(*(ground[:, :2] - vehicle.box.center_m[:2]).T) < 0.05
        assert below.any()
        assert colour[below].min() < 0.3 * np.percentile(colour, 75)


def test_negative_seeds_are_refused():
    with pytest.raises(ValueError, match="seed must be 0 or more, got -1"):
        town_scene(-1)
