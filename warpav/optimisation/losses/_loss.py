"""What a loss is: what it needs, and how it is computed for one scene."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import TYPE_CHECKING, NamedTuple

import warp as wp

from warpav.core.errors import InputError
from warpav.optimisation._settings import LOSSES, LossSettings
from warpav.raster.areas import AMODAL_AREA, VISIBLE_AREA

if TYPE_CHECKING:
    from warpav.detection import DifferentiableDetector
    from warpav.optimisation.losses._scene_on_tape import SceneOnTape
    from warpav.scene import DeviceScene


@dataclass(frozen=True)
class LossSchedule:
    """How losses change over an optimisation: the shares at one point of it.

    Attributes:
        panorama_share: How much of a camera's probability is what it would find if it turned to the object, weighted
            by the object's share in the soft window of its field of view, in [0, 1]; 0 takes its image alone.
        detector_share: How much of it is what the detector really found, in [0, 1).
    """

    panorama_share: float = 0.0
    detector_share: float = 0.0


class DetectedImages(IntEnum):
    """Whose images a loss sends to the detector."""

    NONE = 0
    ASSIGNED = 1  # those that show an object to the camera that it is assigned to
    ALL = 2  # those that show any object


@dataclass(frozen=True)
class Needs:
    """What has to be there for a loss.

    Attributes:
        panorama: All rotational additions of every camera; without, each has only the view ahead.
        detections: DetectedImages in the images ahead.
        true_boxes: The true visible boxes of the objects ahead.
        detection_probability: The model of detection probability.
        unblocked_area: What the ego vehicle leaves free of every vehicle.
        one_field: One field of view for all cameras.
    """

    panorama: bool = False
    detections: DetectedImages = DetectedImages.NONE
    true_boxes: bool = False
    detection_probability: bool = False
    unblocked_area: bool = False
    one_field: bool = False

    def __or__(self, other: Needs) -> Needs:
        return Needs(**{name: max(value, getattr(other, name)) for name, value in vars(self).items()})


class Loss(ABC):
    """A number that says how badly a rig does on a scene; a batch's is the sum over its scenes over the sum of `count`.

    Derive from `DeviceLoss` or `HostLoss`.

    Attributes:
        name: Under this name it is reported.
        detector_share: How much of it is what the detector really found, at the end of an optimisation, in [0, 1).
        weighs_objects: Whether it is a sum over objects, each times its weight (`SceneOnTape.object_weight`). Where
            weights are set, the batch's mean is then over the sum of the weights instead of `count`.
    """

    name: str
    detector_share: float = 0.0
    weighs_objects: bool = False

    @abstractmethod
    def needs(self, schedule: LossSchedule) -> Needs:
        """What has to be there at a point of the optimisation."""

    def count(self, scene: DeviceScene) -> int:
        """How many things of a scene the batch's mean is over: the scene itself, unless said otherwise."""
        del scene
        return 1


class DeviceLoss(Loss):
    """A loss that kernels compute, so that it can be part of a CUDA graph."""

    @abstractmethod
    def on_tape(self, scene: SceneOnTape) -> wp.array:
        """The loss of a scene, recorded on the active tape.

        It only launches kernels: it neither reads arrays on the host nor depends on numbers that change.

        Returns:
            float [1] with a gradient.
        """


class HostLoss(Loss):
    """A loss that is computed on the host, from arrays on the tape; where one takes part, no CUDA graph is recorded."""

    @abstractmethod
    def on_host(
        self, scene: SceneOnTape, weight: float | None, tape: wp.Tape | None
    ) -> tuple[float, Mapping[wp.array, wp.array]]:
        """The loss of a scene.

        Args:
            scene: The scene, on the active tape.
            weight: Of the loss in the gradient; None: no gradient is wanted.
            tape: The active tape; None: there is none.

        Returns:
            The loss, and ``weight`` times its gradient to arrays on the tape; empty without a weight.
        """


class Reference(Enum):
    """What a vehicle's detected area is compared with, over all directions of its camera."""

    NON_OCCLUDED = VISIBLE_AREA  # Eq. 14 as printed: hiding a vehicle costs nothing, both areas shrink together
    ALONE = AMODAL_AREA  # the vehicle alone: being hidden costs as much as being missed


class LossOptions(NamedTuple):
    """What losses are made from."""

    settings: LossSettings  # their parameters
    reference: Reference  # what the detected area is compared with
    differentiable_detector: DifferentiableDetector | None = None  # the network of the loss ``detector_gradient``


def losses_of(options: LossOptions) -> list[tuple[float, Loss]]:
    """The objective of a configuration: every loss of weight above 0, with its weight."""
    found: list[tuple[float, Loss]] = []
    for name, weight in options.settings.weights.items():
        if weight == 0.0:
            continue
        module, _, kind = LOSSES[name].where.partition(":")
        try:
            found.append((weight, getattr(importlib.import_module(module), kind).of(options)))
        except ValueError as error:
            raise InputError(f"losses.{name}: {error}") from None
    return found
