"""What losses are made from: the sections of a configuration, and what it takes besides."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from warpav.detection.differentiable import DifferentiableDetector
from warpav.optimisation.settings import LossSettings
from warpav.raster.areas import AMODAL_AREA, VISIBLE_AREA


class Reference(Enum):
    """What a vehicle's detected area is compared with, over all directions of its camera."""

    NON_OCCLUDED = VISIBLE_AREA  # Eq. 14 as printed: hiding a vehicle costs nothing, both areas shrink together
    ALONE = AMODAL_AREA  # the vehicle alone: being hidden costs as much as being missed


class LossOptions(NamedTuple):
    """What losses are made from.

    Attributes:
        settings: Their parameters.
        reference: What the detected area is compared with.
        differentiable_detector: The network of the loss ``detector_gradient``.
    """

    settings: LossSettings
    reference: Reference
    differentiable_detector: DifferentiableDetector | None = None
