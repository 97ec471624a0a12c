"""Town scenes: counts, visibility, no overlaps, headings along the lanes, the same bytes for the same seed."""

import itertools

import numpy as np
import pytest
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from warpav.scene.town.placed_vehicle import Sight
from warpav.scene.town.town import EYE_HEIGHT_M, ego_vehicle, town_scene

SEEDS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 1000, 1001)


@pytest.fixture(scope="module")
def scenes():
    return [town_scene(seed) for seed in SEEDS]


class _Caster:
    """Vertical rays through a mesh."""

    def __init__(self, mesh):
        self._corner = mesh.vertex_m[mesh.triangle]
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, self._corner)

    def distance_m(self, point_m, sign):
        """Distance straight up (+1) or down (-1) to the surface, inf where there is none."""
        direction = np.tile(np.array([0.0, 0.0, sign], np.float32), (len(point_m), 1))
        result = self._scene.run(point_m.astype(np.float32), direction, query="DISTANCE")
        return np.where(result > 1e30, np.inf, result)

    def height_above_m(self, point_m):
        """Height of points above the ground straight below them, also of points a little below it."""
        return self.distance_m(point_m + np.array([0.0, 0.0, 0.3]), -1.0) - 0.3


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


def test_five_to_fifteen_vehicles_are_visible_from_the_roof(scenes):
    for scene in scenes:
        eye = np.array([scene.ego.bounds_m()[:, 0].mean(), 0.0, EYE_HEIGHT_M])
        share = Sight([scene.surroundings(), scene.ego], [vehicle.mesh for vehicle in scene.vehicles]).shares(eye)
        assert 5 <= np.count_nonzero(share > 0.0) <= 15, scene.name
        assert share.min() > 0.0, scene.name  # hidden vehicles are left out


def test_no_vehicle_overlaps_another_or_the_ego_vehicle(scenes):
    low, high = ego_vehicle().bounds_m().astype(np.float64)
    ego = _rectangle(0.5 * (low + high), high - low, 0.0)
    for scene in scenes:
        outlines = [ego, *(_rectangle(v.box.center_m, v.box.size_m, v.box.yaw_rad) for v in scene.vehicles)]
        for one, other in itertools.combinations(outlines, 2):
            assert not _rectangles_overlap(one, other), scene.name


def test_no_vehicle_stands_in_a_house_or_on_a_pavement(scenes):
    """The ground below a vehicle is one plane, without a kerb, and nothing is above it but lamps."""
    for scene in scenes:
        caster = _Caster(scene.environment)
        for vehicle in scene.vehicles:
            across, along = np.meshgrid(np.linspace(-0.42, 0.42, 7), np.linspace(-0.48, 0.48, 15))
            c, s = np.cos(vehicle.box.yaw_rad), np.sin(vehicle.box.yaw_rad)
            u, v = along.ravel() * vehicle.box.size_m[0], across.ravel() * vehicle.box.size_m[1]
            bottom = vehicle.box.center_m[2] - 0.5 * vehicle.box.size_m[2]
            point = np.stack([c * u - s * v, s * u + c * v, np.full_like(u, bottom + 0.9)], axis=1)
            point[:, :2] += vehicle.box.center_m[:2]
            ground = point[:, 2] - caster.distance_m(point, -1.0)
            plane = np.c_[np.ones_like(u), u, v]
            rest = ground - plane @ np.linalg.lstsq(plane, ground, rcond=None)[0]
            assert np.abs(rest).max() < 0.05, (scene.name, vehicle.instance_id)  # a kerb is 0.13 m high
            above = caster.distance_m(point, 1.0)
            assert ((above > 4.0) & (above < 6.5) | np.isinf(above)).all(), (scene.name, vehicle.instance_id)


def test_vehicles_stand_on_their_wheels(scenes):
    """On level ground and on grades: the lowest vertices of either end touch the ground."""
    grades = []
    for scene in scenes:
        caster = _Caster(scene.environment)
        for vehicle in scene.vehicles:
            offset = vehicle.mesh.vertex_m.astype(np.float64) - vehicle.box.center_m
            along = np.cos(vehicle.box.yaw_rad) * offset[:, 0] + np.sin(vehicle.box.yaw_rad) * offset[:, 1]
            for end in (along > 0.0, along < 0.0):
                wheel = vehicle.mesh.vertex_m[end].astype(np.float64)
                height = caster.height_above_m(wheel[wheel[:, 2] < wheel[:, 2].min() + 0.4])
                # shadows lie up to 2 cm above the road; wheels of different axles share one plane
                assert -0.05 < height.min() < 0.05, (scene.name, vehicle.instance_id)
            grades.append(vehicle.box.center_m[2] - 0.5 * vehicle.box.size_m[2])
    assert np.ptp(grades) > 0.5  # some streets are on a grade


def test_the_ego_vehicle_stands_level_on_the_ground(scenes):
    for scene in scenes:
        tyre = scene.ego.vertex_m[scene.ego.vertex_m[:, 2] < 0.02]
        height = _Caster(scene.environment).height_above_m(tyre.astype(np.float64))
        np.testing.assert_allclose(height, tyre[:, 2], atol=0.03)


def test_people_stand_on_the_ground_and_in_nothing_else(scenes):
    low, high = ego_vehicle().bounds_m().astype(np.float64)
    for scene in scenes:
        caster = _Caster(scene.environment)
        users = (*scene.vehicles, *scene.others)
        outlines = [_rectangle(user.box.center_m, user.box.size_m, user.box.yaw_rad) for user in users]
        outlines.append(_rectangle(0.5 * (low + high), high - low, 0.0))
        for index, other in enumerate(scene.others, start=len(scene.vehicles)):
            where = (scene.name, other.instance_id)
            for number, outline in enumerate(outlines):
                assert number == index or not _rectangles_overlap(outlines[index], outline), where
            vertex = other.mesh.vertex_m.astype(np.float64)
            sole = vertex[vertex[:, 2] < vertex[:, 2].min() + 0.05]
            assert -0.03 < caster.height_above_m(sole).min() < 0.03, where
            middle = np.array([[*other.box.center_m[:2], vertex[:, 2].min() + 0.3]])
            assert caster.distance_m(middle, 1.0)[0] > 4.0, where  # no roof above
            # nothing of the environment reaches into the person's box above the feet
            corner = scene.environment.vertex_m[scene.environment.triangle].mean(axis=1).astype(np.float64)
            inside = other.box.contains(corner, margin_m=-0.02)
            assert not (inside & (corner[:, 2] > vertex[:, 2].min() + 0.1)).any(), where


def test_negative_seeds_are_refused():
    with pytest.raises(ValueError, match="seed must be 0 or more, got -1"):
        town_scene(-1)
