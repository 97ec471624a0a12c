"""`warpav.losses`: what an optimisation can lower, and what a loss of one's own derives from."""

from warpav.optimisation import (
    DeviceLoss,
    ExpectedMissRate,
    HostLoss,
    Loss,
    LossSchedule,
    Needs,
    Objects,
    Reference,
    UserLoss,
)
from warpav.thesis import (
    AngularCoverage,
    DetectedArea,
    DetectorGradient,
    InFrameRotation,
    ObjectVisibility,
    SurfaceBlockage,
)

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
