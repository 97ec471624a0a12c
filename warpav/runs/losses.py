"""`warpav.losses`: what an optimisation can lower, and what a loss of one's own derives from."""

from warpav.optimisation.losses.expected_miss_rate import ExpectedMissRate
from warpav.optimisation.losses.loss import DeviceLoss, HostLoss, Loss, LossSchedule, Needs, Reference
from warpav.optimisation.losses.user_loss import Objects, UserLoss
from warpav.thesis.detector_gradient import DetectorGradient
from warpav.thesis.losses import AngularCoverage, DetectedArea, InFrameRotation, ObjectVisibility, SurfaceBlockage

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
