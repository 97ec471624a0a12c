"""What the installed CARLA client offers without a server, and that the double offers no more."""

import contextlib
import inspect
import math

import numpy as np

from tests.scene.capture import carla_double
from warpav.core.frames import rotation_from_yaw_pitch_roll
from warpav.scene.capture.carla_frames import lane_places, pose_of, transform_of
from warpav.scene.capture.carla_server import clear_noon


def test_known_pose_both_ways(carla):
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_yaw_pitch_roll(*np.radians([45.0, 5.0, 2.0]))
    pose[:3, 3] = 1.7, 0.5, 1.6
    transform = transform_of(carla, pose)
    turn, at = transform.rotation, transform.location
    np.testing.assert_allclose([at.x, at.y, at.z], [1.7, -0.5, 1.6], atol=1e-6)
    np.testing.assert_allclose([turn.pitch, turn.yaw, turn.roll], [-5.0, -45.0, 2.0], atol=1e-5)
    np.testing.assert_allclose(pose_of(transform), pose, atol=2e-7)  # single precision


def test_any_pose_is_the_mirror_of_carlas_matrix(carla, rng):
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    for _ in range(50):
        pitch, yaw, roll = rng.uniform([-89, -180, -180], [89, 180, 180])
        location = carla.Location(*rng.uniform(-500.0, 500.0, 3))
        transform = carla.Transform(location, carla.Rotation(pitch=pitch, yaw=yaw, roll=roll))
        matrix = np.array(transform.get_matrix())
        np.testing.assert_allclose(pose_of(transform), mirror @ matrix @ mirror, atol=1e-6)
        np.testing.assert_allclose(np.array(transform_of(carla, pose_of(transform)).get_matrix()), matrix, atol=4e-5)
        double = carla_double.Transform(transform.location, transform.rotation)
        np.testing.assert_allclose(np.array(double.get_matrix()), matrix, atol=1e-6)


def test_weather(carla):
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


def test_places_of_an_opendrive_map(carla):
    position_m, yaw_rad = lane_places(carla.Map("hill", _OPENDRIVE), spacing_m=20.0)
    assert len(position_m) == 10  # 100 m, two lanes
    heading, left = np.array([math.cos(0.5), math.sin(0.5)]), np.array([-math.sin(0.5), math.cos(0.5)])
    along_m, aside_m = (position_m[:, :2] - [10.0, 20.0]) @ heading, (position_m[:, :2] - [10.0, 20.0]) @ left
    np.testing.assert_allclose(np.abs(aside_m), 1.75, atol=1e-3)
    np.testing.assert_allclose(position_m[:, 2], 2.0 + 0.05 * along_m, atol=1e-3)
    # right-hand traffic: who drives along the road keeps to its right, who comes back is turned
    same = np.cos(yaw_rad - 0.5)
    np.testing.assert_allclose(same, -np.sign(aside_m), atol=1e-6)


def test_double_has_no_more_than_the_client(carla):
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
