"""Situations of the CARLA simulator, against a double of the client: vehicles, boxes, images."""

import math

import numpy as np
import pytest

from tests.scene.capture import carla_double
from tests.scene.capture.carla_double import Server, first_vehicle, install, view_above, view_from
from warpav.core.frames import rotation_from_yaw_pitch_roll
from warpav.scene import EGO_INSTANCE
from warpav.scene.capture._capture import SpawnPoint
from warpav.scene.capture._carla_simulator import CarlaSimulator

EGO_SIZE_M, EGO_CENTER_M = [4.9, 2.1, 1.48], [0.05 + 1.35, 0.0, 0.75]  # the double's, from its rear axle


def points_of(image, instance_id):
    """Ego coordinates of an instance's pixels, from its depths."""
    row, column = np.nonzero((image.instance == instance_id) & np.isfinite(image.depth_m))
    ray = image.view.model.rays(np.stack([column + 0.5, row + 0.5], -1)) @ image.view.ego_from_camera[:3, :3].T
    return image.view.ego_from_camera[:3, 3] + image.depth_m[row, column, None] * ray


def in_box(box, point_m):
    return np.abs((point_m - box.center_m) @ rotation_from_yaw_pitch_roll(box.yaw_rad, 0.0, 0.0)) - 0.5 * box.size_m


class TestSituation:
    @pytest.mark.parametrize(("slope", "turn"), [(0.0, 0.0), (0.06, 0.0), (0.06, 35.0)])
    def test_ego_frame_lies_on_the_ground_below_the_rear_axle(self, monkeypatch, slope, turn):
        install(monkeypatch, Server(slope=slope, turn=turn))
        with CarlaSimulator() as simulator:
            for seed in range(4):  # both lanes: up and down the slope
                box = simulator.begin(seed)
                np.testing.assert_allclose(box.center_m, EGO_CENTER_M, atol=1e-4)
                np.testing.assert_allclose(box.size_m, EGO_SIZE_M, atol=1e-4)
                assert abs(box.yaw_rad) < 1e-6

    @pytest.mark.parametrize(("slope", "turn"), [(0.0, 0.0), (0.06, 0.0), (0.06, 35.0)])
    def test_images_agree_with_the_boxes(self, monkeypatch, slope, turn):
        server = Server(slope=slope, turn=turn)
        install(monkeypatch, server)
        with CarlaSimulator(warm_up_ticks=0) as simulator:
            ego_box = simulator.begin(1)
            vehicles = [one for one in map(simulator.spawn, simulator.spawn_points(30.0)[:4]) if one is not None]
            assert len(vehicles) >= 2
            for vehicle in vehicles:
                above = view_above(vehicle.box)
                image = simulator.capture(above)
                point_m = points_of(image, vehicle.instance_id)
                beyond_m = in_box(vehicle.box, point_m)
                assert len(point_m) > 200
                assert beyond_m.max() < 1e-4  # worst seen 3e-5: a step of the depth's 24 bits is 6e-5
                assert abs(point_m[:, 2].max() - vehicle.box.center_m[2] - 0.5 * vehicle.box.size_m[2]) < 1e-4
                colour = image.rgb[image.instance == vehicle.instance_id]
                actor = next(
                    a for a in server.made("vehicle.*") if colour_of(server, a) == vehicle.instance_rgb.tolist()
                )
                wanted = [int(one) for one in actor.attributes.get("color", "250,250,250").split(",")]
                np.testing.assert_array_equal(np.unique(colour, axis=0), [wanted])
            image = simulator.capture(view_above(ego_box))
            assert in_box(ego_box, points_of(image, EGO_INSTANCE)).max() < 1e-4
            ground_m = points_of(image, 0)
            assert np.abs(ground_m[:, 2]).max() < 1e-4  # the road is the ego frame's plane, on the slope too

    @pytest.mark.parametrize("turn", [0.0, 35.0, -120.0])
    def test_spawned_where_and_as_the_point_says(self, monkeypatch, turn):
        install(monkeypatch, Server(turn=turn))
        with CarlaSimulator() as simulator:
            for seed in range(3):
                simulator.begin(seed)
                for point in simulator.spawn_points(60.0):  # in the ego vehicle's lane, in the other, or in the bay
                    side = point.position_m[1]
                    heading_deg = (
                        0.0 if abs(side) < 1.0 else 180.0 if 3.0 < side < 4.0 else -50.0 if side < 0.0 else 130.0
                    )
                    assert abs(math.remainder(math.degrees(point.yaw_rad) - heading_deg, 360.0)) < 1e-3
                    assert abs(point.position_m[2]) < 1e-3
                wanted = SpawnPoint(np.array([9.0, 7.0, 0.0]), 0.6)
                vehicle = simulator.spawn(wanted)
                assert vehicle is not None
                assert vehicle.box.yaw_rad == pytest.approx(0.6, abs=1e-6)
                middle = vehicle.box.center_m - wanted.position_m
                aside = middle @ [-math.sin(0.6), math.cos(0.6), 0.0]
                assert abs(aside) < 1e-4
                assert -1e-4 < middle @ [math.cos(0.6), math.sin(0.6), 0.0] < 0.21  # the shapes' own middles
                assert vehicle.spawn_yaw_rad == 0.6

    def test_left_is_left_and_sky_is_infinite(self, server):
        with CarlaSimulator() as simulator:
            simulator.begin(1)
            vehicle = first_vehicle(simulator)
            x, y, _ = vehicle.box.center_m
            yaw_rad = math.atan2(y, x - 1.0)
            for turn_rad, is_left in ((-0.5, True), (0.5, False)):  # it is to the left of who looks past its right
                beside = simulator.capture(view_from([1.0, 0.0, 2.5], yaw_rad=yaw_rad + turn_rad))
                column = np.nonzero(beside.instance == vehicle.instance_id)[1]
                assert len(column) > 20
                assert (column.mean() < 47.5) == is_left
            up = simulator.capture(view_from([1.0, 0.0, 2.5], pitch_rad=-1.0))
            assert np.all(np.isinf(up.depth_m[0]))
            assert np.all(up.rgb[0] == (120, 170, 230))
            assert up.rgb.dtype == np.uint8
            assert up.depth_m.dtype == np.float32
            assert up.instance.dtype == np.uint16

    def test_spawn_points_keep_to_the_radius_and_off_the_ego(self, server):
        with CarlaSimulator() as simulator:
            ego = simulator.begin(2)
            away_m = [np.hypot(*point.position_m[:2]) for point in simulator.spawn_points(25.0)]
            assert away_m
            assert max(away_m) <= 25.0
            assert min(np.hypot(*(p.position_m - ego.center_m)[:2]) for p in simulator.spawn_points(25.0)) > 2.4
            assert len(simulator.spawn_points(200.0)) == len(simulator._place_m) - 1

    @pytest.mark.parametrize("accident", ["roll", "slide"])
    def test_what_does_not_stand_is_taken_away(self, server, monkeypatch, accident):
        step = carla_double.Vehicle._step

        def stumble(vehicle):
            step(vehicle)
            if vehicle.attributes["role_name"] == "warpav" and vehicle._physics:
                if accident == "roll":
                    vehicle._at.rotation.roll = 85.0
                elif vehicle.id not in slid:
                    slid.add(vehicle.id)
                    vehicle._at.location.x += 3.0

        slid = set()
        with CarlaSimulator() as simulator:
            simulator.begin(2)
            point = simulator.spawn_points(50.0)[0]
            monkeypatch.setattr(carla_double.Vehicle, "_step", stumble)
            assert simulator.spawn(point) is None
            assert len(server.made("vehicle.*")) == 1

    def test_remove(self, server):
        with CarlaSimulator() as simulator:
            simulator.begin(2)
            vehicle = first_vehicle(simulator)
            view = view_above(vehicle.box)
            assert np.any(simulator.capture(view).instance == vehicle.instance_id)
            simulator.remove(vehicle)
            assert not np.any(simulator.capture(view).instance == vehicle.instance_id)
            assert len(server.made("vehicle.*")) == 1
            with pytest.raises(ValueError, match="no vehicle with instance id"):
                simulator.remove(vehicle)
            assert first_vehicle(simulator).instance_id == vehicle.instance_id + 1

    def test_image_of_another_frame_is_reported(self, server):
        with CarlaSimulator(timeout_s=0.2, warm_up_ticks=0) as simulator:
            box = simulator.begin(2)
            picture = server.picture
            server.picture = lambda sensor: set_frame(picture(sensor), server.frame + 1)
            with pytest.raises(RuntimeError, match="another program ticks it"):
                simulator.capture(view_above(box))
            server.picture = lambda sensor: set_frame(picture(sensor), server.frame - 1)
            with pytest.raises(RuntimeError, match=r"sent no image of frame \d+ within 0.2 s"):
                simulator.capture(view_above(box))
            assert not server.made("sensor.*")


def set_frame(image, frame):
    image.frame = frame
    return image


def colour_of(server, actor):
    tag, number = server.code(actor)
    return [tag, number & 255, number >> 8]
