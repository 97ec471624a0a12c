"""What an optimisation lowers: one file a loss or family of losses, one line in `registry.LOSSES` each."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from warpav.optimisation.losses.angular_coverage import AngularCoverage
    from warpav.optimisation.losses.detected_area import DetectedArea, ObjectVisibility
    from warpav.optimisation.losses.detector_gradient import DetectorGradient
    from warpav.optimisation.losses.expected_miss_rate import ExpectedMissRate
    from warpav.optimisation.losses.in_frame_rotation import InFrameRotation
    from warpav.optimisation.losses.loss import DeviceLoss, HostLoss, Loss, LossSchedule, Needs
    from warpav.optimisation.losses.options import Reference
    from warpav.optimisation.losses.surface_blockage import SurfaceBlockage
    from warpav.optimisation.losses.user_loss import Objects, UserLoss

__all__ = [
    "AngularCoverage",
    "DetectedArea",
    "DetectorGradient",
    "DeviceLoss",
    "ExpectedMissRate",
    "HostLoss",
    "InFrameRotation",
    "Loss",
    "LossSchedule",
    "Needs",
    "ObjectVisibility",
    "Objects",
    "Reference",
    "SurfaceBlockage",
    "UserLoss",
]

_MODULE_OF = {
    "AngularCoverage": "angular_coverage",
    "DetectedArea": "detected_area",
    "DetectorGradient": "detector_gradient",
    "DeviceLoss": "loss",
    "ExpectedMissRate": "expected_miss_rate",
    "HostLoss": "loss",
    "InFrameRotation": "in_frame_rotation",
    "Loss": "loss",
    "LossSchedule": "loss",
    "Needs": "loss",
    "ObjectVisibility": "detected_area",
    "Objects": "user_loss",
    "Reference": "options",
    "SurfaceBlockage": "surface_blockage",
    "UserLoss": "user_loss",
}


def __getattr__(name: str) -> Any:  # noqa: ANN401 (classes of many kinds)
    # the configuration asks for the registry alone, and must not load Warp
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
