"""Where images are taken, and which vehicles stay."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warpav.scene import Box, CapturedImage, PlanSettings, ViewKind
from warpav.scene.capture._capture import (
    CapturedVehicle,
    SpawnPoint,
    _eye_position_m,
    capture_plan,
    spawn_visible_traffic,
)

EGO_BOX = Box(np.array([1.3, 0.0, 0.75]), np.array([4.7, 2.0, 1.5]), 0.0)
PLAN = PlanSettings()


def car(instance_id, x_m, y_m, yaw_rad, size_m=(4.5, 1.8, 1.5)):
    box = Box(np.array([x_m, y_m, 0.5 * size_m[2]]), np.array(size_m), yaw_rad)
    return CapturedVehicle(instance_id, "car", box, box.center_m, yaw_rad, np.zeros(3, np.uint8))


def image_px(view, point_m):
    local = (point_m - view.ego_from_camera[:3, 3]) @ view.ego_from_camera[:3, :3]
    assert (local[:, 2] > 0.0).all()
    return view.model.project(local)


places = st.tuples(st.floats(4.0, 30.0), st.floats(-math.pi, math.pi), st.floats(-math.pi, math.pi))


@settings(max_examples=60)
@given(st.lists(places, min_size=1, max_size=5))
def test_every_vehicle_fits_into_its_two_images(polar):
    vehicles = [
        car(k + 1, 1.3 + radius * math.cos(angle), radius * math.sin(angle), yaw)
        for k, (radius, angle, yaw) in enumerate(polar)
    ]
    views = {view.name: view for view in capture_plan(EGO_BOX, vehicles, PLAN)}
    assert len(views) == 1 + 2 * len(vehicles) + 3 + 4 + 4  # the names are unique
    for vehicle in vehicles:
        kinds = {
            f"towards_vehicle_{vehicle.instance_id:03d}": ViewKind.TOWARDS_VEHICLE,
            f"vehicle_top_{vehicle.instance_id:03d}": ViewKind.VEHICLE_TOP,
        }
        for name, kind in kinds.items():
            view = views[name]
            assert view.kind is kind
            if kind is ViewKind.TOWARDS_VEHICLE and np.hypot(*(vehicle.box.center_m - [1.3, 0, 0])[:2]) < 8.0:
                continue  # corners beside the camera; the view is as wide as it gets
            place_px = image_px(view, vehicle.box.corners_m())
            assert (place_px > 0.0).all()
            assert (place_px < [640.0, 480.0]).all()


def test_the_ego_vehicle_fits_into_the_images_of_its_sides():
    lorry = car(1, 5.2, 2.4, 0.0, (8.0, 2.5, 3.2))  # where the first of them would be taken from
    views = [view for view in capture_plan(EGO_BOX, [lorry], PLAN) if view.kind is ViewKind.EGO_SIDE]
    assert len(views) == PLAN.ego_side_count
    for view, side in zip(views, ([1, 1], [-1, 1], [-1, -1], [1, -1]), strict=True):
        position_m = view.ego_from_camera[:3, 3]
        outside_m = np.abs(position_m - EGO_BOX.center_m)[:2] - 0.5 * EGO_BOX.size_m[:2]
        np.testing.assert_allclose(outside_m, PLAN.ego_side_m / math.sqrt(2.0))
        np.testing.assert_array_equal(np.sign(position_m - EGO_BOX.center_m)[:2], side)
        assert position_m[2] == pytest.approx(3.5 if side == [1, 1] else 1.5)
        place_px = image_px(view, EGO_BOX.corners_m())
        assert (place_px > 0.0).all()
        assert (place_px < [640.0, 480.0]).all()


def test_rotations_see_all_around():
    views = [view for view in capture_plan(EGO_BOX, [], PLAN) if view.kind is ViewKind.ROTATION]
    assert len(views) == PLAN.rotation_count
    bearing = np.linspace(-math.pi, math.pi, 721)
    far = _eye_position_m(EGO_BOX, PLAN) + 50.0 * np.stack([np.cos(bearing), np.sin(bearing), 0 * bearing], axis=1)
    seen = np.zeros(len(far), int)
    for view in views:
        local = (far - view.ego_from_camera[:3, 3]) @ view.ego_from_camera[:3, :3]
        column = np.where(local[:, 2] > 0.1, view.model.project(local)[:, 0], -1.0)
        seen += (column >= 0.0) & (column <= view.model.width_px)
    assert seen.min() >= 1


class ScriptedSimulator:
    """Spawns at every point but those that are refused; shows only those that are not hidden."""

    name, source, world = "scripted", "test", "paper"

    def __init__(self, hidden=(), refused=()):
        self.hidden, self.refused = set(hidden), set(refused)
        self.there = []

    def spawn_points(self, radius_m):
        return [SpawnPoint(np.array([5.0 * k, 0.0, 0.0]), 0.0) for k in range(1, 9)]

    def spawn(self, point):
        number = round(point.position_m[0] / 5.0)
        if number in self.refused:
            return None
        self.there.append(number)
        return car(number, point.position_m[0], 0.0, 0.0)

    def remove(self, vehicle):
        self.there.remove(vehicle.instance_id)

    def capture(self, view):
        instance = np.zeros((view.model.height_px, view.model.width_px), np.uint16)
        for column, number in enumerate(n for n in self.there if n not in self.hidden):
            instance[0, column] = number
        return CapturedImage(view, np.zeros((*instance.shape, 3), np.uint8), np.ones(instance.shape), instance)


def test_only_vehicles_that_bring_a_new_instance_stay():
    simulator = ScriptedSimulator(hidden={2, 5}, refused={3})
    vehicles = spawn_visible_traffic(simulator, EGO_BOX, PLAN)
    assert [vehicle.instance_id for vehicle in vehicles] == [1, 4, 6, 7, 8]
    assert simulator.there == [1, 4, 6, 7, 8]  # the hidden ones were taken out again
