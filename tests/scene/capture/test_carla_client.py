"""What the installed CARLA client offers without a server, and that the double offers no more."""

import contextlib
import inspect

from tests.scene.capture import carla_double


def test_double_has_no_more_than_the_client(carla):
    """What the double offers exists under the same name, and takes as many arguments, in the package."""
    checked = 0
    for name, double in vars(carla_double).items():
        if (
            getattr(double, "__module__", "") != carla_double.__name__
            or not inspect.isclass(double)
            or name == "Server"
        ):
            continue
        real = carla.command.DestroyActor if name == "DestroyActor" else getattr(carla, name)
        public = {key for key in vars(double) if not key.startswith("_")}
        with contextlib.suppress(TypeError):
            public |= {key for key in vars(double()) if not key.startswith("_")}
        for key in public:
            assert hasattr(real, key), f"carla.{name}.{key}"
            checked += 1
    assert checked > 60
