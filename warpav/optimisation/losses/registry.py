"""The losses that a configuration can name. Loading it loads no loss, so that configurations are read without Warp."""

from __future__ import annotations

from typing import NamedTuple


class _Registered(NamedTuple):
    """A loss that has a name."""

    where: str  # its class, as ``module:class``
    description: str  # what its weight weighs, for the configuration
    one_field: bool = False  # whether it takes one field of view for all cameras


LOSSES = {
    "expected_miss_rate": _Registered(
        "warpav.optimisation.losses.expected_miss_rate:ExpectedMissRate",
        "the share of road users that no camera is expected to detect",
    ),
    "in_frame_rotation": _Registered(
        "warpav.thesis.losses:InFrameRotation", "the in-frame rotation loss", one_field=True
    ),
    "detected_area": _Registered("warpav.thesis.losses:DetectedArea", "the detected object area loss", one_field=True),
    "surface_blockage": _Registered(
        "warpav.thesis.losses:SurfaceBlockage", "the surface blockage loss: what the ego vehicle hides", one_field=True
    ),
    "object_visibility": _Registered(
        "warpav.thesis.losses:ObjectVisibility",
        "the object visibility loss: detected_area without a detector",
        one_field=True,
    ),
    "angular_coverage": _Registered(
        "warpav.thesis.losses:AngularCoverage",
        "the angular coverage loss: directions in no camera's view",
        one_field=True,
    ),
    "detector_gradient": _Registered(
        "warpav.thesis.detector_gradient:DetectorGradient",
        "the detection network's own loss, differentiated through it; needs warpav[torch]",
    ),
}
"""By name, in the order in which they are added up."""
