"""The CARLA simulator: against the client's own types where the package is installed, and against a double of it."""

import contextlib
import inspect
import math
import socket
import sys
import threading
import time

import numpy as np
import pytest

from tests.scene.capture import carla_double
from tests.scene.capture.carla_double import Server, install
from warpav.core.errors import InputError
from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll
from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens
from warpav.scene.capture.capture import EGO_INSTANCE, CaptureView, ViewKind
from warpav.scene.capture.carla_frames import lane_places, pose_of, transform_of
from warpav.scene.capture.carla_server import VERSION_REQUEST, clear_noon, unreachable
from warpav.scene.capture.carla_simulator import CarlaSimulator
from warpav.scene.capture.folder import check_capture, read_capture, record_capture
from warpav.scene.capture.plan import PlanSettings
from warpav.scene.capture.simulator import SpawnPoint

MODEL = CameraModel(96, 64, math.radians(80.0))
EGO_SIZE_M, EGO_CENTER_M = [4.9, 2.1, 1.48], [0.05 + 1.35, 0.0, 0.75]  # the double's, from its rear axle


def view_from(position_m, *, yaw_rad=0.0, pitch_rad=0.0, model=MODEL):
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_yaw_pitch_roll(yaw_rad, pitch_rad, 0.0) @ FLU_FROM_RDF
    pose[:3, 3] = position_m
    return CaptureView("view", ViewKind.OTHER, pose, model)


def view_above(box, height_m=9.0, model=MODEL):
    """Straight down, from above a box's middle."""
    return view_from(np.add(box.center_m, [0.0, 0.0, height_m]), pitch_rad=math.pi / 2, model=model)


@pytest.fixture
def server(monkeypatch):
    """The double, where the package would be."""
    one = Server()
    install(monkeypatch, one)
    return one


def points_of(image, instance_id):
    """Ego coordinates of an instance's pixels, from its depths."""
    row, column = np.nonzero((image.instance == instance_id) & np.isfinite(image.depth_m))
    ray = image.view.model.rays(np.stack([column + 0.5, row + 0.5], -1)) @ image.view.ego_from_camera[:3, :3].T
    return image.view.ego_from_camera[:3, 3] + image.depth_m[row, column, None] * ray


def in_box(box, point_m):
    return np.abs((point_m - box.center_m) @ rotation_from_yaw_pitch_roll(box.yaw_rad, 0.0, 0.0)) - 0.5 * box.size_m


def first_vehicle(simulator, radius_m=40.0):
    for point in simulator.spawn_points(radius_m):
        vehicle = simulator.spawn(point)
        if vehicle is not None:
            return vehicle
    raise AssertionError("no place takes a vehicle")


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
        with CarlaSimulator(ego_blueprint="vehicle.audi.tt") as simulator:
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

    def test_same_seed_same_situation(self, monkeypatch):
        seen = []
        for shuffle in (1, 2):
            install(monkeypatch, Server(seed=shuffle))
            with CarlaSimulator() as simulator:
                simulator.begin(8)
                simulator.begin(4)
                points = simulator.spawn_points(50.0)
                vehicles = [simulator.spawn(point) for point in points[:5]]
                seen.append((simulator.name, points, vehicles))
        (name, points, vehicles), (other_name, other_points, other_vehicles) = seen
        assert name == other_name == "carla_Town10HD_Opt_0004"
        assert [p.position_m.tolist() for p in points] == [p.position_m.tolist() for p in other_points]
        kinds = [(v.category, v.box.size_m.tolist()) for v in vehicles if v]
        assert kinds == [(v.category, v.box.size_m.tolist()) for v in other_vehicles if v]
        assert len({category for category, _ in kinds}) > 1

    def test_seeds_choose_places_and_order(self, server):
        with CarlaSimulator() as simulator:
            orders = []
            for seed in range(6):
                simulator.begin(seed)
                orders.append(tuple(np.round(p.position_m, 2).tobytes() for p in simulator.spawn_points(1e3)))
        assert len(set(orders)) == 6

    def test_spawn_points_keep_to_the_radius_and_off_the_ego(self, server):
        with CarlaSimulator() as simulator:
            ego = simulator.begin(2)
            away_m = [np.hypot(*point.position_m[:2]) for point in simulator.spawn_points(25.0)]
            assert away_m
            assert max(away_m) <= 25.0
            assert min(np.hypot(*(p.position_m - ego.center_m)[:2]) for p in simulator.spawn_points(25.0)) > 2.4
            assert len(simulator.spawn_points(200.0)) == len(simulator._place_m) - 1

    def test_frozen_vehicles_do_not_overlap(self, server):
        with CarlaSimulator() as simulator:
            simulator.begin(2)
            point = next(point for point in simulator.spawn_points(50.0) if simulator.spawn(point) is not None)
            before = len(server.made("vehicle.*"))
            assert all(simulator.spawn(point) is None for _ in range(5))
            assert len(server.made("vehicle.*")) == before

    def test_refused_by_the_server(self, server):
        server.frozen_collide = True
        with CarlaSimulator() as simulator:
            simulator.begin(2)
            point = next(point for point in simulator.spawn_points(50.0) if simulator.spawn(point) is not None)
            assert simulator.spawn(point) is None

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

    def test_vehicle_in_a_tunnel_is_known_from_its_sides(self, server):
        roof = carla_double.Transform(carla_double.Location(0.0, 0.0, 8.0))
        server.solids.append((roof, (100.0, 5.0, 0.3), (carla_double.BUILDING_TAG, 902), (9, 9, 9), None))
        server.code = lambda actor: (carla_double.CAR_TAG, actor.id)
        with CarlaSimulator() as simulator:
            simulator.begin(2)
            assert first_vehicle(simulator).instance_rgb[0] == carla_double.CAR_TAG

    def test_number_taken_by_something_of_the_map_far_away(self, server):
        """CARLA's 16 bits come round: a parked car of the map may have a vehicle's colour."""
        with CarlaSimulator() as simulator:
            simulator.begin(2)
            vehicle = first_vehicle(simulator)
            code = server.code(next(a for a in server.made("vehicle.*") if a.attributes["role_name"] == "warpav"))
            place = carla_double.Transform(carla_double.Location(0.0, 10.0, 3.75))
            server.solids.append((place, (60.0, 1.0, 0.75), code, (1, 2, 3), None))
            image = simulator.capture(view_above(vehicle.box, 30.0))
            assert np.any(np.all(image.rgb == (1, 2, 3), axis=-1))
            assert not np.any((image.instance == vehicle.instance_id) & np.all(image.rgb == (1, 2, 3), axis=-1))

    def test_two_vehicles_of_one_colour_are_refused(self, server):
        server.code = lambda _actor: (carla_double.CAR_TAG, 5)
        with CarlaSimulator() as simulator:
            simulator.begin(2)
            assert all(simulator.spawn(point) is None for point in simulator.spawn_points(50.0)[:3])
            assert len(server.made("vehicle.*")) == 1

    def test_late_images_are_waited_for(self, server):
        server.is_late = True
        with CarlaSimulator(warm_up_ticks=2) as simulator:
            box = simulator.begin(2)
            assert np.any(simulator.capture(view_above(box)).instance)

    def test_image_of_another_frame_is_told(self, server):
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

    def test_cameras_are_plain_and_short_lived(self, server):
        configured = []
        spawn = server.spawn
        server.spawn = lambda blueprint, at: configured.append(blueprint) or spawn(blueprint, at)
        with CarlaSimulator() as simulator:
            box = simulator.begin(2)
            configured.clear()
            simulator.capture(view_above(box))
            assert not server.made("sensor.*")
        values = {one.id: {k: v.as_str() for k, v in one._attributes.items()} for one in configured}
        rgb = values["sensor.camera.rgb"]
        assert (rgb["lens_flare_intensity"], rgb["bloom_intensity"], rgb["motion_blur_intensity"]) == ("0.0",) * 3
        assert rgb["exposure_min_bright"] == rgb["exposure_max_bright"] == "11.0"
        for name in ("rgb", "depth", "instance_segmentation"):
            assert float(values[f"sensor.camera.{name}"]["fov"]) == pytest.approx(80.0, abs=1e-12)
            assert values[f"sensor.camera.{name}"]["lens_k"] == "-1.0"  # zeros spoil depth images
        assert not server.faults

    def test_only_central_pinholes(self, server):
        with CarlaSimulator() as simulator:
            simulator.begin(2)
            for model in (
                CameraModel(64, 64, 1.0, lens=Lens.FISHEYE),
                CameraModel(64, 64, focal_px=(60.0, 60.0), centre_px=(30.0, 32.0)),
                CameraModel(64, 64, focal_px=(60.0, 62.0), centre_px=(32.0, 32.0)),
            ):
                with pytest.raises(ValueError, match="CARLA's cameras are pinholes"):
                    simulator.capture(view_from([0.0, 0.0, 2.0], model=model))


def set_frame(image, frame):
    image.frame = frame
    return image


def colour_of(server, actor):
    tag, number = server.code(actor)
    return [tag, number & 255, number >> 8]


class TestWorld:
    def test_prepared_inside_and_restored_outside(self, server):
        before = server.state()
        with CarlaSimulator() as simulator:
            simulator.begin(0)
            first_vehicle(simulator)
            inside = server.state()
            assert inside["settings"]["synchronous_mode"]
            assert inside["settings"]["fixed_delta_seconds"] == 0.05
            assert not inside["settings"]["no_rendering_mode"]
            assert inside["weather"]["sun_altitude_angle"] == 90.0
            assert inside["weather"]["wind_intensity"] == inside["weather"]["fog_density"] == 0.0
            assert not any(inside["plants"].values())
            assert not inside["layers"]
            assert not inside["lights"]
            assert inside["traffic lights"]
            assert not server.sees_through_glass
            vehicles = server.made("vehicle.*")
            assert [one._lamps for one in vehicles] == [carla_double.VehicleLightState.NONE] * 2
            assert not any(one._physics for one in vehicles)
            assert sorted(one.attributes["role_name"] for one in vehicles) == ["hero", "warpav"]
        assert server.state() == before
        assert not server.faults

    def test_map_without_layers(self, monkeypatch):
        server = Server(map_name="Carla/Maps/Town04")
        install(monkeypatch, server)
        before = server.state()
        with CarlaSimulator() as simulator:
            simulator.begin(0)
            assert simulator.name == "carla_Town04_0000"
            assert server.layers  # left alone
        assert server.state() == before

    def test_map_is_loaded_anew(self, server):
        with CarlaSimulator(map_name="Town04") as simulator:
            simulator.begin(0)
            assert simulator.source == "CARLA Town04 seed 0"
        assert server.calls.count("Client.load_world") == 1
        assert not server.settings.synchronous_mode

    def test_begin_again_leaves_one_ego(self, server):
        with CarlaSimulator() as simulator:
            for seed in range(3):
                simulator.begin(seed)
                first_vehicle(simulator)
            simulator.begin(0)
            assert len(server.made("vehicle.*")) == 1

    def test_simulator_serves_twice(self, server):
        simulator = CarlaSimulator()
        for _ in range(2):
            with simulator:
                simulator.begin(0)
        assert not server.made("vehicle.*")

    def test_recorded_to_a_folder(self, server, tmp_path):
        settings = PlanSettings(
            vehicle_count=2, width_px=64, height_px=48, scene_heights_m=(14.0,), rotation_count=2, ego_side_count=0
        )
        with CarlaSimulator(warm_up_ticks=0) as simulator:
            folder = record_capture(simulator, 1, tmp_path / "capture", settings)
        assert list(check_capture(folder)) == []
        capture = read_capture(folder)
        assert capture.name == "carla_Town10HD_Opt_0001"
        assert len(capture.vehicles) == 2
        assert len(capture.images) == 1 + 2 + 2 + 1 + 2

    def test_rear_axle_may_be_stated(self, server):
        with CarlaSimulator(rear_axle_m=(-1.0, 0.0, 0.1)) as simulator:
            np.testing.assert_allclose(simulator.begin(0).center_m, [1.05, 0.0, 0.65], atol=1e-4)

    def test_ego_may_be_chosen(self, server):
        with CarlaSimulator(ego_blueprint="vehicle.audi.tt") as simulator:
            np.testing.assert_allclose(simulator.begin(0).size_m, [4.2, 1.96, 1.38], atol=1e-4)


def use(simulator, then):
    with simulator:
        simulator.begin(0)
        then()


def situation(**options):
    """All that a recording does, once."""
    with CarlaSimulator(warm_up_ticks=0, **options) as simulator:
        box = simulator.begin(3)
        vehicle = first_vehicle(simulator)
        simulator.capture(view_above(box, model=CameraModel(16, 16)))
        simulator.remove(vehicle)
        first_vehicle(simulator)


class TestCleanup:
    @pytest.mark.parametrize("is_before", [True, False], ids=["before", "after"])
    @pytest.mark.parametrize(
        "error", [RuntimeError("time-out of 60000ms"), KeyboardInterrupt()], ids=["error", "ctrl-c"]
    )
    def test_nothing_is_left_wherever_a_call_fails(self, monkeypatch, error, is_before):
        """Every kind of call, the first and the last time it is made, the cleanup's own included."""
        server = Server()
        install(monkeypatch, server)
        situation()
        names = server.calls
        chosen = sorted({names.index(name) for name in names} | {len(names) - 1 - names[::-1].index(n) for n in names})
        assert len(chosen) > 35
        for index in chosen:
            server = Server()
            install(monkeypatch, server)
            before = server.state()
            server.failures[index] = (error, is_before)
            with contextlib.suppress(InputError, RuntimeError, KeyboardInterrupt):
                situation()
            assert len(server.calls) > index
            assert server.state() == before, f"after {names[index]}, call {index}"

    def test_error_of_the_user_passes_through(self, server):
        before = server.state()
        with pytest.raises(ZeroDivisionError):
            use(CarlaSimulator(), lambda: 1 / 0)
        assert server.state() == before

    def test_ctrl_c_while_leaving_is_passed_on_afterwards(self, server):
        before = server.state()
        with pytest.raises(KeyboardInterrupt):
            use(CarlaSimulator(), lambda: server.failures.update({len(server.calls): (KeyboardInterrupt(), True)}))
        assert server.state() == before

    def test_what_cannot_be_restored_is_named(self, server):
        set_weather = carla_double.World.set_weather

        def refuse(world, weather):
            if weather._values["sun_altitude_angle"] < 0.0:
                raise RuntimeError("no such weather")
            set_weather(world, weather)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(carla_double.World, "set_weather", refuse)
            with pytest.raises(RuntimeError, match=r"was left changed: weather \(no such weather\)"), CarlaSimulator():
                pass
        assert not server.settings.synchronous_mode  # the rest is restored all the same

    def test_dead_server_is_not_waited_for_at_every_step(self, server):
        calls = []

        def die():
            server.is_mute = True
            calls.append(len(server.calls))
            server.failures |= {calls[0] + index: (RuntimeError("time-out"), True) for index in range(100)}
            raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError) as caught:
            use(CarlaSimulator(), die)
        assert len(server.calls) - calls[0] == 2  # one that times out, and one that asks whether there is anybody
        (note,) = caught.value.__notes__
        assert "was left changed: actors (time-out); " in note
        assert note.endswith("lights; settings; restart the server")

    def test_used_outside_a_with_statement(self, server):
        simulator = CarlaSimulator()
        with pytest.raises(RuntimeError, match="with statement"):
            simulator.begin(0)
        with simulator, pytest.raises(RuntimeError, match=r"begin\(seed\) comes first"):
            simulator.spawn_points(10.0)
        with pytest.raises(RuntimeError, match="with statement"):
            simulator.begin(0)


class TestMistakes:
    def told(self, match, simulator):
        with pytest.raises(InputError, match=match) as caught, simulator:
            simulator.begin(0)
        assert "\n" not in str(caught.value)

    @pytest.fixture
    def closed_port(self):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            return probe.getsockname()[1]

    def test_missing_server(self, monkeypatch, closed_port):
        monkeypatch.setitem(sys.modules, "carla", Server().module())
        begun_s = time.monotonic()
        self.told(
            rf"expected a server at 127.0.0.1:{closed_port}, got: connection refused; start it with .*CarlaUE4",
            CarlaSimulator(port=closed_port),
        )
        assert time.monotonic() - begun_s < 5.0

    def test_unknown_host(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "carla", Server().module())
        self.told("the host's name is not known", CarlaSimulator(host="no host"))

    def test_server_that_speaks_is_reached(self):
        with listener(b"\x94\x01\x01\xc0\x92\x00") as port:
            assert unreachable("127.0.0.1", port) is None

    def test_answer_of_no_use(self, server):
        server.is_mute = True
        self.told(r"expected a CARLA server at 127.0.0.1:2000, got no answer \(time-out", CarlaSimulator())

    def test_missing_package(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "carla", None)
        self.told(r'pip install "warpav\[carla\]"', CarlaSimulator())

    def test_other_version(self, server):
        server.version = "0.9.15"
        self.told(r"client's version 0\.9\.16, got 0\.9\.15;.*pip install carla==0\.9\.15", CarlaSimulator())

    def test_build_from_source_is_of_its_release(self, server):
        server.version = "0.9.16-12-gabcdef0"
        with CarlaSimulator() as simulator:
            simulator.begin(0)

    def test_unknown_map(self, server):
        before = server.state()
        self.told(r"got 'Town10HD'; did you mean Town10HD_Opt", CarlaSimulator(map_name="Town10HD"))
        assert server.state() == before

    def test_unknown_ego(self, server):
        self.told("did you mean vehicle.lincoln.mkz_2020", CarlaSimulator(ego_blueprint="vehicle.lincoln.mkz_2021"))

    def test_traffic_of_others(self, server):
        server.spawn(server.library().find("vehicle.audi.tt"), carla_double.Transform(carla_double.Location(z=9.0)))
        server.listed = set(server.actors)
        before = server.state()
        self.told("expected a world without vehicles and walkers.*got 1 of them", CarlaSimulator())
        assert server.state() == before
        server.settings.synchronous_mode = server.was_synchronous = True  # as a program that was killed leaves it
        self.told("got 1 of them", CarlaSimulator())
        assert server.settings.synchronous_mode

    def test_wheels_nowhere(self, server):
        before = server.state()
        server.wheels_of = lambda wheels: [wheels[0]] * 4
        self.told("state rear_axle_m", CarlaSimulator())
        assert server.state() == before

    def test_no_place_for_the_ego(self, server):
        server.spawn = lambda _blueprint, _at: None
        self.told("expected a free spawn point for vehicle.lincoln.mkz_2020 on the map Town10HD_Opt", CarlaSimulator())

    def test_numbers(self, server):
        for options, match in (
            ({"port": 0}, "port must lie"),
            ({"rear_axle_m": (1.0, 2.0)}, "rear_axle_m must be three"),
            ({"waypoint_spacing_m": 0.0}, "waypoint_spacing_m must be positive"),
            ({"exposure": -1.0}, "exposure must be positive"),
            ({"timeout_s": math.inf}, "timeout_s must be positive"),
            ({"warm_up_ticks": -1}, "warm_up_ticks must not be negative"),
        ):
            with pytest.raises(ValueError, match=match):
                CarlaSimulator(**options)
        with CarlaSimulator() as simulator, pytest.raises(ValueError, match="seed must not be negative"):
            simulator.begin(-1)


class TestWheel:
    """What the installed client offers without a server."""

    @pytest.fixture
    def carla(self):
        return pytest.importorskip("carla")

    def test_known_pose_both_ways(self, carla):
        pose = np.eye(4)
        pose[:3, :3] = rotation_from_yaw_pitch_roll(*np.radians([45.0, 5.0, 2.0]))
        pose[:3, 3] = 1.7, 0.5, 1.6
        transform = transform_of(carla, pose)
        turn, at = transform.rotation, transform.location
        np.testing.assert_allclose([at.x, at.y, at.z], [1.7, -0.5, 1.6], atol=1e-6)
        np.testing.assert_allclose([turn.pitch, turn.yaw, turn.roll], [-5.0, -45.0, 2.0], atol=1e-5)
        np.testing.assert_allclose(pose_of(transform), pose, atol=2e-7)  # single precision

    def test_any_pose_is_the_mirror_of_carlas_matrix(self, carla, rng):
        mirror = np.diag([1.0, -1.0, 1.0, 1.0])
        for _ in range(50):
            pitch, yaw, roll = rng.uniform([-89, -180, -180], [89, 180, 180])
            location = carla.Location(*rng.uniform(-500.0, 500.0, 3))
            transform = carla.Transform(location, carla.Rotation(pitch=pitch, yaw=yaw, roll=roll))
            matrix = np.array(transform.get_matrix())
            np.testing.assert_allclose(pose_of(transform), mirror @ matrix @ mirror, atol=1e-6)
            np.testing.assert_allclose(
                np.array(transform_of(carla, pose_of(transform)).get_matrix()), matrix, atol=4e-5
            )
            double = carla_double.Transform(transform.location, transform.rotation)
            np.testing.assert_allclose(np.array(double.get_matrix()), matrix, atol=1e-6)

    def test_weather(self, carla):
        weather = clear_noon(carla)
        assert weather.sun_altitude_angle == 90.0
        for name in (
            "cloudiness",
            "precipitation",
            "precipitation_deposits",
            "wind_intensity",
            "fog_density",
            "wetness",
        ):
            assert getattr(weather, name) == 0.0
        assert weather.dust_storm == 0.0

    def test_places_of_an_opendrive_map(self, carla):
        position_m, yaw_rad = lane_places(carla.Map("hill", _OPENDRIVE), spacing_m=20.0)
        assert len(position_m) == 10  # 100 m, two lanes
        heading, left = np.array([math.cos(0.5), math.sin(0.5)]), np.array([-math.sin(0.5), math.cos(0.5)])
        along_m, aside_m = (position_m[:, :2] - [10.0, 20.0]) @ heading, (position_m[:, :2] - [10.0, 20.0]) @ left
        np.testing.assert_allclose(np.abs(aside_m), 1.75, atol=1e-3)
        np.testing.assert_allclose(position_m[:, 2], 2.0 + 0.05 * along_m, atol=1e-3)
        # right-hand traffic: who drives along the road keeps to its right, who comes back is turned
        same = np.cos(yaw_rad - 0.5)
        np.testing.assert_allclose(same, -np.sign(aside_m), atol=1e-6)

    def test_double_has_no_more_than_the_client(self, carla):
        """What the double offers exists under the same name, and takes as many arguments, in the package."""
        checked = 0
        for name, double in vars(carla_double).items():
            if not inspect.isclass(double) or name in ("Server", "ModuleType", "SimpleNamespace"):
                continue
            real = carla.command.DestroyActor if name == "DestroyActor" else getattr(carla, name)
            public = {key for key in vars(double) if not key.startswith("_")}
            with contextlib.suppress(TypeError):
                public |= {key for key in vars(double()) if not key.startswith("_")}
            for key in public:
                assert hasattr(real, key), f"carla.{name}.{key}"
                checked += 1
        assert checked > 60

    def test_something_that_is_no_server(self, carla):
        """The real client would wait for the silent one, and end the process at the talkative one."""
        for answer, match in (
            (None, "no answer within 2.5 s"),
            (b"HTTP/1.1 400 \r\n", "an answer that is not CARLA's"),
        ):
            with listener(answer) as port:
                begun_s = time.monotonic()
                with pytest.raises(InputError, match=rf"a server at 127.0.0.1:{port}, got: {match}") as caught:
                    CarlaSimulator(port=port).__enter__()
                assert time.monotonic() - begun_s < 5.0
                assert "\n" not in str(caught.value)

    def test_server_is_asked_as_the_client_asks(self, carla):
        heard = []
        with listener(None, heard) as port:
            client = carla.Client("127.0.0.1", port)
            client.set_timeout(0.5)
            with pytest.raises(RuntimeError, match="time-out"):
                client.get_server_version()
        assert heard == [VERSION_REQUEST]


@contextlib.contextmanager
def listener(answer, heard=None):
    """A port behind which something says one thing, or nothing, to the first who asks."""
    with socket.socket() as waiting:
        waiting.bind(("127.0.0.1", 0))
        waiting.listen()
        is_over = threading.Event()

        def serve():
            with waiting.accept()[0] as connection:
                question = connection.recv(4096)
                if heard is not None:
                    heard.append(question)
                if answer is not None:
                    connection.sendall(answer)
                is_over.wait(10.0)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield waiting.getsockname()[1]
        is_over.set()
        thread.join(10.0)


_OPENDRIVE = """<?xml version="1.0"?>
<OpenDRIVE>
  <header revMajor="1" revMinor="4" name="hill" version="1" north="0" south="0" east="0" west="0"/>
  <road name="street" length="100" id="1" junction="-1">
    <link/>
    <planView><geometry s="0" x="10" y="20" hdg="0.5" length="100"><line/></geometry></planView>
    <elevationProfile><elevation s="0" a="2" b="0.05" c="0" d="0"/></elevationProfile>
    <lateralProfile/>
    <lanes><laneSection s="0">
      <left>
        <lane id="2" type="sidewalk" level="false"><width sOffset="0" a="2" b="0" c="0" d="0"/></lane>
        <lane id="1" type="driving" level="false"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>
      </left>
      <center><lane id="0" type="none" level="false"/></center>
      <right><lane id="-1" type="driving" level="false"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></right>
    </laneSection></lanes>
  </road>
</OpenDRIVE>"""
