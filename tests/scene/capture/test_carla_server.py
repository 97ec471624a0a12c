"""The CARLA server: its world is prepared and restored, and a server that is missing or another one is reported."""

import contextlib
import math
import socket
import sys
import threading
import time

import pytest

from tests.scene.capture import carla_double
from tests.scene.capture.carla_double import Server, first_vehicle, install, view_above
from warpav.core.errors import InputError
from warpav.raster.camera import CameraModel
from warpav.scene import PlanSettings, read_capture
from warpav.scene.capture._carla_simulator import CarlaSimulator
from warpav.scene.capture._folder import check_capture, record_capture


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


def situation():
    """All that a recording does, once."""
    with CarlaSimulator(warm_up_ticks=0) as simulator:
        box = simulator.begin(3)
        vehicle = first_vehicle(simulator)
        simulator.capture(view_above(box, model=CameraModel(16, 16)))
        simulator.remove(vehicle)
        first_vehicle(simulator)


class TestCleanup:
    @pytest.mark.parametrize(
        ("error", "is_before"),
        [
            pytest.param(RuntimeError("time-out of 60000ms"), True, id="error-before"),
            pytest.param(RuntimeError("time-out of 60000ms"), False, id="error-after", marks=pytest.mark.nightly),
            pytest.param(KeyboardInterrupt(), True, id="ctrl-c-before", marks=pytest.mark.nightly),
            pytest.param(KeyboardInterrupt(), False, id="ctrl-c-after"),
        ],
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


MISTAKES = [
    (lambda server: setattr(server, "is_mute", True), r"a CARLA server at 127.0.0.1:2000, got no answer \(time-out"),
    (lambda server: setattr(server, "version", "0.9.15"), r"version 0\.9\.16, got 0\.9\.15;.*carla==0\.9\.15"),
    (lambda server: put_stranger(server), "expected a world without vehicles and walkers.*got 1 of them"),
    (
        lambda server: setattr(server, "wheels_of", lambda wheels: [wheels[0]] * 4),
        "expected the positions of its wheels",
    ),
]


def put_stranger(server):
    server.spawn(server.library().find("vehicle.audi.tt"), carla_double.Transform(carla_double.Location(z=9.0)))
    server.listed = set(server.actors)


@pytest.mark.parametrize(("spoil", "match"), MISTAKES)
def test_mistakes_are_told_in_a_line_and_change_nothing(server, spoil, match):
    spoil(server)
    before = server.state()
    with pytest.raises(InputError, match=match) as caught, CarlaSimulator() as simulator:
        simulator.begin(0)
    assert "\n" not in str(caught.value)
    assert server.state() == before


def test_missing_server_and_package(monkeypatch):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    monkeypatch.setitem(sys.modules, "carla", Server().module())
    begun_s = time.monotonic()
    with pytest.raises(InputError, match=f"a server at 127.0.0.1:{port}, got: connection refused; start it with "):
        CarlaSimulator(port=port).__enter__()
    assert time.monotonic() - begun_s < 5.0
    monkeypatch.setitem(sys.modules, "carla", None)
    with pytest.raises(InputError, match=r'pip install "warpav\[carla\]"'):
        CarlaSimulator().__enter__()


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"port": 0}, "port must lie"),
        ({"timeout_s": math.inf}, "timeout_s must be positive"),
        ({"warm_up_ticks": -1}, "warm_up_ticks must not be negative"),
    ],
)
def test_numbers_out_of_range(options, match):
    with pytest.raises(ValueError, match=match):
        CarlaSimulator(**options)


class TestConnection:
    """The installed client, and what is no server."""

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
