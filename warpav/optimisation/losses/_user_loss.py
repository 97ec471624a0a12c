"""A loss of one's own: any function of the detection probabilities and the objects."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpav.core.errors import InputError
from warpav.optimisation.losses._loss import HostLoss, LossSchedule, Needs
from warpav.optimisation.losses._scene_on_tape import SceneOnTape
from warpav.scene import DeviceScene


@dataclass(frozen=True, eq=False)
class Objects:
    """The road users of a scene that a rig is optimised for, in the order of the columns of the probabilities.

    Attributes:
        scene: The scene's name.
        category: What each is, such as ``car``, [object].
        from_ego_m: Where each is in the plane, from the middle of the ego vehicle: forward and left [m], float
            [object, 2].
        weight: Of each, as the section ``importance`` of the configuration says; 1 where nothing is set, float64
            [object].
    """

    scene: str
    category: tuple[str, ...]
    from_ego_m: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, scene: DeviceScene, weight: np.ndarray) -> Objects:
        return cls(scene.name, tuple(scene.category), np.asarray(scene.from_ego_m), np.asarray(weight, np.float64))


LossFunction = Callable[[np.ndarray, Objects], tuple[float, np.ndarray]]
"""Gets the probability that each camera detects each object, float64 [camera, object], 0..1, and the objects; returns a
finite number and its gradient to the probabilities, of their shape."""


@dataclass(frozen=True)
class UserLoss(HostLoss):
    """The mean of a function over the scenes; NumPy computes it on the host, so there is no CUDA graph with one.

    Attributes:
        function: See `LossFunction`.
        name: Under this name it is reported.
    """

    function: LossFunction
    name: str

    @classmethod
    def of(cls, function: LossFunction) -> UserLoss:
        """A loss of the function's name.

        Raises:
            TypeError: It is no function.
        """
        if not callable(function):
            raise TypeError(f"losses: expected losses or functions, got {function!r}")
        return cls(function, getattr(function, "__name__", type(function).__name__))

    def needs(self, schedule: LossSchedule) -> Needs:
        """The detection probability, with the panorama while it has a share."""
        return Needs(panorama=schedule.panorama_share > 0.0, detection_probability=True)

    def on_host(
        self, scene: SceneOnTape, weight: float | None, tape: wp.Tape | None
    ) -> tuple[float, Mapping[wp.array, wp.array]]:
        """As in `HostLoss`.

        Raises:
            InputError: The function returns something else than a finite number and finite gradients.
        """
        del tape
        if scene.scene.vehicle_count == 0:
            return 0.0, {}
        probability = scene.detection_probability
        value, gradient = self._called(
            probability.numpy().astype(np.float64), Objects.of(scene.scene, scene.object_weight.numpy())
        )
        if weight is None:
            return value, {}
        return value, {probability: wp.array(weight * gradient, dtype=float, device=probability.device)}

    def _called(self, probability: np.ndarray, objects: Objects) -> tuple[float, np.ndarray]:
        result = self.function(probability, objects)
        if not isinstance(result, tuple) or len(result) != 2:
            raise InputError(f"losses: {self.name}: expected a number and its gradient, got {type(result).__name__}")
        value, gradient = float(result[0]), np.asarray(result[1], np.float64)
        if gradient.shape != probability.shape:
            raise InputError(
                f"losses: {self.name}: expected a gradient of shape {probability.shape}, [camera, object], got "
                f"{gradient.shape}"
            )
        if not (np.isfinite(value) and np.isfinite(gradient).all()):
            raise InputError(
                f"losses: {self.name}: expected finite numbers, got a loss of {value:g} on {objects.scene}"
            )
        return value, gradient
