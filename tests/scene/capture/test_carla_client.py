"""What the installed CARLA client offers without a server, and that the double offers no more."""

import contextlib
import inspect

import numpy as np

from tests.scene.capture import carla_double
from warpav.scene.capture.carla_client import pose_of, transform_of


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
