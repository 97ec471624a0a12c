"""Settings of losses and optimiser: sections of the configuration, and what the code takes."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BeforeValidator, Field, PlainSerializer, WithJsonSchema, create_model, model_validator

from warpav.core.section import (
    DEGREES_PER_UNIT,
    METRES_PER_UNIT,
    NUMBER_OR_TEXT,
    SECONDS_PER_UNIT,
    Degrees,
    Expectation,
    Metres,
    Section,
    mistake,
    number_in,
    shown,
)


class _Registered(NamedTuple):
    """A loss that has a name."""

    where: str  # its class, as ``module:class``
    description: str  # what its weight weighs, for the configuration
    one_field: bool = False  # whether it takes one field of view for all cameras


LOSSES = {
    "expected_miss_rate": _Registered(
        "warpav.optimisation.losses._expected_miss_rate:ExpectedMissRate",
        "the share of road users that no camera is expected to detect",
    ),
    "in_frame_rotation": _Registered(
        "warpav.thesis._losses:InFrameRotation", "the in-frame rotation loss", one_field=True
    ),
    "detected_area": _Registered("warpav.thesis._losses:DetectedArea", "the detected object area loss", one_field=True),
    "surface_blockage": _Registered(
        "warpav.thesis._losses:SurfaceBlockage", "the surface blockage loss: what the ego vehicle hides", one_field=True
    ),
    "object_visibility": _Registered(
        "warpav.thesis._losses:ObjectVisibility",
        "the object visibility loss: detected_area without a detector",
        one_field=True,
    ),
    "angular_coverage": _Registered(
        "warpav.thesis._losses:AngularCoverage",
        "the angular coverage loss: directions in no camera's view",
        one_field=True,
    ),
    "detector_gradient": _Registered(
        "warpav.thesis._detector_gradient:DetectorGradient",
        "the detection network's own loss, differentiated through it; needs warpav[torch]",
    ),
}
"""By name, in the order in which they are added up."""

METHOD_LOSSES: dict[str, dict[str, Any]] = {
    "thesis": {"in_frame_rotation": 1.0, "detected_area": 10.0},
    "default": {"expected_miss_rate": 1.0},
}
"""Weights of the losses where the configuration says nothing, by method."""

if TYPE_CHECKING:
    from warpav.detection import Fusion, LidarCurve
    from warpav.optimisation._camera_loss import RobustObjective
    from warpav.optimisation._mount_errors import MountErrors
    from warpav.sight import Rules

    LossWeights = Section
else:
    LossWeights = create_model(
        "LossWeights",
        __base__=Section,
        **{
            name: (float, Field(default=0.0, ge=0.0, description=f"weight of {loss.description}"))
            for name, loss in LOSSES.items()
        },
    )


class ThesisSettings(Section):
    """What the method of the thesis alone needs: which camera is responsible for which vehicle."""

    rotations: int = Field(default=16, ge=2, le=360, description="orientations tried around the origin")


class LossSettings(LossWeights):
    """Weights of the objectives, and the numbers inside them."""

    min_detected_area: float = Field(
        default=0.5,
        gt=0.0,
        le=1.0,
        description="detected (object_visibility: visible) share of a vehicle's area from which more brings nothing",
    )
    min_unblocked_area: float = Field(
        default=0.5,
        gt=0.0,
        le=1.0,
        description="share of a vehicle's area that the ego vehicle leaves free, from which more brings nothing",
    )
    epsilon: float = Field(default=1e-5, gt=0.0, le=0.1, description="weight of pixels outside the detected boxes")
    window_softness_deg: Degrees = Field(
        default=10.0, gt=0.0, le=90.0, description="expected_miss_rate: softness of a field of view over the panorama"
    )
    detector_share: float = Field(
        default=0.0,
        ge=0.0,
        lt=1.0,
        description="expected_miss_rate: how much of a probability is what the detector really found, at the end of "
        "a run",
    )
    combine: Literal["any", "best"] = Field(
        default="any",
        description="expected_miss_rate: any camera may find an object (noisy or), or the surest one alone counts",
    )
    false_alarms: float = Field(
        default=0.0,
        ge=0.0,
        le=10.0,
        description="expected_miss_rate, in the search by a pool without robust.camera_loss: what the false alarms at "
        "doubtful sightings cost: so many missed road users for each p (1 - p); 0.5 if not only vehicles are targets",
    )
    probability: Literal["fitted", "visible_share", "in_frame_share"] = Field(
        default="fitted",
        description=(
            "expected_miss_rate: fitted to the detector, or plainly the share of an object's whole box that is "
            "visible, or that is in the image, be it hidden there or not"
        ),
    )

    @model_validator(mode="after")
    def _check(self) -> LossSettings:
        if not any(self.weights.values()):
            mistake("expected at least one weight above 0, got only zeros", *self.weights)
        return self

    @property
    def window_softness_rad(self) -> float:
        """Softness of the fields of view over the panorama [rad]."""
        return math.radians(self.window_softness_deg)

    @property
    def weights(self) -> dict[str, float]:
        """Weight of every loss by its name."""
        return {name: getattr(self, name) for name in LOSSES}

    @property
    def is_by_single_cameras(self) -> bool:
        """Whether a pool of single cameras knows the objective; of its objects `single_cameras_of` says the same."""
        taking_part = [name for name, weight in self.weights.items() if weight]
        return taking_part == ["expected_miss_rate"] and self.combine == "any" and self.detector_share == 0.0

    @property
    def one_field(self) -> list[str]:
        """Names of the losses that take part and take one field of view for all cameras."""
        return [name for name, weight in self.weights.items() if weight and LOSSES[name].one_field]


@dataclass(frozen=True)
class _Sector:
    """A range of azimuths with a weight; 0 is straight ahead, left positive [deg]."""

    from_deg: float  # its right edge, which belongs to it [deg]
    to_deg: float  # its left edge, above the other by at most 360, which does not [deg]
    weight: float  # of what is in it, at least 0

    @property
    def width_deg(self) -> float:
        return self.to_deg - self.from_deg

    def contains(self, azimuth_deg: np.ndarray) -> np.ndarray:
        """Whether azimuths [deg] are in it, whatever whole turns they are off; bool of their shape."""
        turned_deg = np.mod(np.asarray(azimuth_deg, np.float64) - self.from_deg, 360.0)
        return (turned_deg < self.width_deg) | (self.width_deg >= 360.0)  # rounding gives a whole turn for -1e-17

    def overlaps(self, other: _Sector) -> bool:
        return bool(self.contains(np.array(other.from_deg)) or other.contains(np.array(self.from_deg)))


_CATEGORY_TEXT = "a table of categories and weights, such as {pedestrian: 2.0}"
_DISTANCE_TEXT = "a table of rising distances from 0 m on and weights, such as {0: 2.0, 20: 1.0, 50: 0.5}"
_TIME_TEXT = "a table of rising times from 0 s on and weights, such as {0: 3.0, 2: 2.0, 4: 1.0}"
_SECTOR_TEXT = "a list of sectors, such as [{from: -30, to: 30, weight: 2.0}]"
_TABLE_SCHEMA = {"type": "object", "additionalProperties": {"type": "number", "minimum": 0}}


def _weight(value: object, of: str) -> float:
    """A weight of a table; ``of`` is what it is of."""
    number = number_in(value, {})
    if number is None or not 0.0 <= number < math.inf:
        mistake(f"expected a finite weight of at least 0 for {of}, got {shown(value)}")
    return number


def _read_categories(value: object) -> dict[str, float]:
    if not isinstance(value, dict) or not all(isinstance(name, str) and name for name in value):
        mistake(f"expected {_CATEGORY_TEXT}, got {shown(value)}")
    return {name.lower(): _weight(weight, name) for name, weight in value.items()}


def _steps(quantity: str, expected: str, unit_factor: Mapping[str, float]) -> Any:  # noqa: ANN401 (an annotation)
    """A table of steps: each weight holds from its key, in the first of the units, up to the next.

    As files have it its names are text, so they carry the unit.
    """
    unit = next(iter(unit_factor))

    def written(weights: dict[float, float]) -> dict[str, float]:
        return {f"{int(each) if each.is_integer() else each} {unit}": weight for each, weight in weights.items()}

    return Annotated[
        dict[float, float],
        BeforeValidator(partial(_read_steps, quantity=quantity, expected=expected, unit_factor=unit_factor)),
        PlainSerializer(written),
        Expectation(expected),
        WithJsonSchema(_TABLE_SCHEMA),
    ]


def _read_steps(value: object, quantity: str, expected: str, unit_factor: Mapping[str, float]) -> dict[float, float]:
    if not isinstance(value, dict):
        mistake(f"expected {expected}, got {shown(value)}")
    unit, weights = next(iter(unit_factor)), dict[float, float]()
    for key, weight in value.items():
        first = number_in(f"{key} {unit}" if re.fullmatch(r"-?[0-9.]+", str(key)) else key, unit_factor)
        if first is None:
            mistake(f"expected {expected}, got {shown(key)} as a {quantity}")
        last = next(reversed(weights), None)
        if last is None and first != 0.0:
            mistake(f"expected 0 as the first {quantity}, got {first:g}")
        if last is not None and not last < first < math.inf:
            mistake(f"expected rising {quantity}s, got {first:g} after {last:g}")
        weights[first] = _weight(weight, f"{first:g} {unit}")
    if weights and not any(weights.values()):
        mistake(f"expected a weight above 0 at some {quantity}, got only zeros")
    return weights


def _read_sectors(value: object) -> tuple[_Sector, ...]:
    sectors: list[_Sector] = []
    for item in value if isinstance(value, (list, tuple)) else [value]:
        if isinstance(item, _Sector):
            item = _written_sector(item)  # noqa: PLW2901
        if not isinstance(item, dict) or item.keys() != {"from", "to", "weight"}:
            mistake(f"expected {_SECTOR_TEXT}, got {shown(item)}")
        low, high = (number_in(item[end], DEGREES_PER_UNIT) for end in ("from", "to"))
        if low is None or high is None or not math.isfinite(low + high):
            mistake(f"expected angles in degrees as from and to, got {shown([item['from'], item['to']])}")
        if not low < high <= low + 360.0:
            hint = f"; write {low:g} to {high + 360.0:g}" if low - 360.0 < high < low else ""
            mistake(f"expected sectors that end above their start, by at most 360, got {low:g} to {high:g}{hint}")
        sectors.append(_Sector(low, high, _weight(item["weight"], f"the sector from {low:g} to {high:g} deg")))
    for one, other in itertools.combinations(sectors, 2):
        if one.overlaps(other):
            edges = f"{one.from_deg:g} to {one.to_deg:g} and {other.from_deg:g} to {other.to_deg:g}"
            mistake(f"expected sectors that do not overlap, got {edges}")
    if sum(each.width_deg for each in sectors) >= 360.0 and not any(each.weight for each in sectors):
        mistake("expected a weight above 0 in some direction, got only zeros all around")
    return tuple(sectors)


def _written_sector(sector: _Sector) -> dict[str, float]:
    return {"from": sector.from_deg, "to": sector.to_deg, "weight": sector.weight}


class ImportanceSettings(Section):
    """What matters: weights of road users in objective and metrics, relative to their mean; theirs is the product."""

    category: Annotated[
        dict[str, float], BeforeValidator(_read_categories), Expectation(_CATEGORY_TEXT), WithJsonSchema(_TABLE_SCHEMA)
    ] = Field(
        default={},
        description="by category, such as lorry, or by kind: vehicle, pedestrian, cyclist; of both the category "
        "counts; 1 for others",
    )
    distance_m: _steps("distance", _DISTANCE_TEXT, METRES_PER_UNIT) = Field(  # pyright: ignore[reportInvalidTypeForm]
        default={},
        description="by horizontal distance of the box's centre from the ego frame's origin, in steps: each weight "
        "holds from its distance up to the next",
    )
    time_to_collision_s: _steps("time", _TIME_TEXT, SECONDS_PER_UNIT) = Field(  # pyright: ignore[reportInvalidTypeForm]
        default={},
        description="by the time until the box meets the ego vehicle's at constant velocities, in steps as distances "
        "are; 1 where they never meet, or where the velocity is unknown",
    )
    sector_deg: Annotated[
        tuple[_Sector, ...],
        BeforeValidator(_read_sectors),
        PlainSerializer(lambda sectors: [_written_sector(each) for each in sectors]),
        Expectation(_SECTOR_TEXT),
        WithJsonSchema({"type": "array", "items": {"type": "object"}}),
    ] = Field(
        default=(),
        description="by azimuth of the box's centre in the ego frame, 0 ahead, left positive; a sector includes its "
        "start; 1 outside of all",
    )

    @property
    def is_set(self) -> bool:
        return bool(self.category or self.distance_m or self.time_to_collision_s or self.sector_deg)


class RobustSettings(Section):
    """What the rigs of a search by a pool are to bear: the loss of a camera, and errors of mounting."""

    camera_loss: Annotated[Literal["mean", "worst"] | None, Expectation("mean, worst or null")] = Field(
        default=None,
        description="minimise also what the rig is expected to miss without one camera: the mean over all, or without "
        "the one that is worst to lose; null: with all cameras alone",
    )
    weight: float = Field(
        default=0.5, gt=0.0, le=1.0, description="of what is missed without one camera; the whole rig has the rest"
    )
    mount_error_m: Metres | None = Field(
        default=None,
        gt=0.0,
        le=0.25,
        description="minimise what is missed in the mean over errors of mounting: greatest error of a camera's place "
        "in each direction; null: none",
    )
    mount_error_deg: Degrees | None = Field(
        default=None, gt=0.0, le=30.0, description="the same of its yaw, pitch and roll; null: none"
    )

    @model_validator(mode="after")
    def _check(self) -> RobustSettings:
        if self.camera_loss is None and self.weight != type(self).model_fields["weight"].default:
            mistake("expected robust.camera_loss beside a weight, got none; set mean or worst", "camera_loss", "weight")
        return self

    @property
    def objective(self) -> RobustObjective | None:
        """What is minimised; None: the expected miss rate."""
        from warpav.optimisation._camera_loss import RobustObjective  # it needs scipy, which configurations do not

        return None if self.camera_loss is None else RobustObjective(self.camera_loss, self.weight)

    @property
    def mount_errors(self) -> MountErrors | None:
        """The errors of mounting that the mean is over; None: there are none."""
        from warpav.optimisation._mount_errors import MountErrors

        if self.mount_error_m is None and self.mount_error_deg is None:
            return None
        return MountErrors(self.mount_error_m or 0.0, math.radians(self.mount_error_deg or 0.0))

    @property
    def asked_for(self) -> str | None:
        """The first option that asks for something; None: nothing is."""
        names = ("camera_loss", "mount_error_m", "mount_error_deg")
        return next((f"robust.{name}" for name in names if getattr(self, name) is not None), None)


_FUSION_TEXT = "any, both, or a distance in metres within which both must find a road user, such as 60"


def _read_fusion(value: object) -> str:
    if value in ("any", "both"):
        return str(value)
    number = number_in(value, METRES_PER_UNIT)
    if number is None or not 0.0 < number < math.inf:
        mistake(f"expected {_FUSION_TEXT}, got {shown(value)}")
    return f"{number:g} m"


class LidarSettings(Section):
    """How many points it takes to find a road user: a curve per kind, see `warpav.detection._lidar.LidarCurve`."""

    vehicle: float = Field(default=5.0, gt=0.0, le=10_000.0, description="points on a vehicle for an even chance")
    pedestrian: float = Field(default=5.0, gt=0.0, le=10_000.0, description="points on a pedestrian for an even chance")
    cyclist: float = Field(default=5.0, gt=0.0, le=10_000.0, description="points on a cyclist for an even chance")
    steepness: float = Field(
        default=2.7, gt=0.0, le=20.0, description="how fast the chance rises with the logarithm of one and the points"
    )
    incidence: Literal["ignored", "lambert"] = Field(
        default="ignored",
        description="whether a point counts by the cosine of its incidence, as diffuse surfaces return",
    )
    fusion: Annotated[str, BeforeValidator(_read_fusion), Expectation(_FUSION_TEXT), WithJsonSchema(NUMBER_OR_TEXT)] = (
        Field(
            default="any",
            description="who must find a road user: any sensor; both a camera and a LiDAR (or radar); or both nearer "
            "than so many metres from the ego frame's origin, any beyond",
        )
    )

    @property
    def fused(self) -> Fusion:
        """Which road users a camera and a LiDAR must find."""
        from warpav.detection import Fusion

        within_m = {"any": 0.0, "both": math.inf}.get(self.fusion)
        return Fusion(number_in(self.fusion, METRES_PER_UNIT) or 0.0 if within_m is None else within_m)

    @property
    def curve(self) -> LidarCurve:
        from warpav.detection import LidarCurve

        halves = {name: getattr(self, name) for name in ("vehicle", "pedestrian", "cyclist")}
        return LidarCurve(halves, self.steepness, self.incidence == "lambert")


class RuleSettings(Section):
    """Design rules, so that a rig can be mounted; a limit of null: no such rule.

    ``rules: default`` and ``rules: none`` say the same as ``enforced`` true and false.
    """

    enforced: bool | None = Field(
        default=None,
        description="whether rigs keep the rules, which the search by a pool alone knows; null: where it is that one",
    )
    own_body: float | None = Field(
        default=0.3, gt=0.0, le=1.0, description="largest share of an image that the own body may fill"
    )
    own_body_wide: float | None = Field(
        default=0.6, gt=0.0, le=1.0, description="the same of cameras of 150 degrees and more"
    )
    horizon: float | None = Field(
        default=0.1, ge=0.0, le=1.0, description="least share of an image's height above the horizon"
    )
    azimuth_gap_deg: Degrees | None = Field(
        default=3.0,
        ge=3.0,
        le=60.0,
        description="widest gap of directions in which no camera sees a road user at 15 m, of rigs whose fields of "
        "view go all round; wider where the cameras cannot, which is said",
    )
    near_ground: bool = Field(
        default=True, description="see the ground all round from as near to the body as the cameras can"
    )
    housing: float | None = Field(
        default=0.01, gt=0.0, le=1.0, description="largest share of an image that another camera may fill"
    )
    crossing_deg: Degrees | None = Field(
        default=60.0,
        ge=0.0,
        le=180.0,
        description="least angle between where a camera looks and the line to the vehicle's middle",
    )

    @model_validator(mode="before")
    @classmethod
    def _by_word(cls, data: object) -> object:
        if not isinstance(data, str):
            return data
        if data not in ("default", "none"):
            mistake(f"expected default, none or its limits, got {shown(data)}")
        return {"enforced": data == "default"}

    @property
    def limits(self) -> Rules:
        """The limits, in radians."""
        from warpav.sight import Rules

        angles = (None if each is None else math.radians(each) for each in (self.azimuth_gap_deg, self.crossing_deg))
        gap_rad, crossing_rad = angles
        return Rules(
            self.own_body, self.own_body_wide, self.horizon, gap_rad, self.near_ground, self.housing, crossing_rad
        )


class VisibilitySettings(Section):
    """What hides a vehicle."""

    occlusion: Literal["pairwise", "exact"] = Field(
        default="exact", description="pairwise: whole vehicles by their relative depth; exact: per pixel, by everything"
    )


class OptimiserSettings(Section):
    """Step sizes, multipliers, and which iterate is kept."""

    learning_rate_position_m: Metres = Field(default=0.02, gt=0.0, le=10.0, description="AdamW step of a position")
    learning_rate_yaw_deg: Degrees = Field(default=1.0, gt=0.0, le=180.0, description="AdamW step of a yaw angle")
    learning_rate_pitch_deg: Degrees = Field(
        default=2.0, gt=0.0, le=180.0, description="AdamW step of a pitch, where rig.free.pitch_deg frees it"
    )
    learning_rate_height_m: Metres = Field(
        default=0.02, gt=0.0, le=2.0, description="AdamW step of a height, where rig.free.height_m frees it"
    )
    learning_rate_zoom: float = Field(
        default=0.02,
        gt=0.0,
        le=1.0,
        description="AdamW step of the logarithm of a focal length, where rig.free.fov_deg frees it",
    )
    schedule: Literal["constant", "cosine"] = Field(default="cosine", description="how the steps shrink over the run")
    weight_decay: float = Field(default=0.0, ge=0.0, le=1.0, description="pull of positions and angles towards zero")
    multiplier_learning_rate: float | None = Field(
        default=None,
        ge=0.0,
        le=100.0,
        description="step of a multiplier, AdamW's (thesis) or of plain ascent (default); null: the method's",
    )
    multiplier_weight_decay: float = Field(
        default=1e-3, ge=0.0, le=1.0, description="pull of the multipliers towards zero (method: thesis)"
    )
    multiplier_damping: float | None = Field(
        default=None, ge=0.0, description="damping of the multipliers, 0 is the plain method; null: the method's"
    )
    keep: Literal["last", "best"] = Field(default="best", description="the iterate that becomes the result")
    check_every: int = Field(
        default=10, ge=1, description="iterations between two evaluations on all validation scenes"
    )
    panorama_until: float = Field(
        default=0.0,
        ge=0.0,
        le=1.0,
        description="expected_miss_rate: share of the run over which what lies outside the images ceases to pull",
    )
    detector_from: float = Field(
        default=0.7, ge=0.0, le=1.0, description="expected_miss_rate: share of the run from which the detector counts"
    )
    search: Literal["auto", "pool", "descent"] = Field(
        default="auto",
        description="pool: the best rig of a pool of single cameras, with a bound, polished on all scenes; descent: "
        "gradient steps on batches from the best of some starts; auto: pool where expected_miss_rate is the only loss, "
        "else descent",
    )
    pool_cameras: int = Field(default=112, ge=16, le=1_000_000, description="search=pool: single cameras at first")
    pool_rounds: int = Field(default=0, ge=0, le=1000, description="search=pool: rounds of pricing further cameras")
    pool_refinements: int = Field(
        default=0,
        ge=0,
        le=1_000_000,
        description="search=pool: how often other places for single cameras and places near the rig's are looked at, "
        "once rounds bring nothing more",
    )
    pool_gap: float = Field(
        default=5e-4, ge=0.0, le=1.0, description="search=pool: expected miss rate to which a selection is solved"
    )
    selection_time_s: float = Field(
        default=20.0, gt=0.0, description="search=pool: seconds after which a selection ends at the latest"
    )
    starts: int = Field(
        default=16, ge=1, le=100_000, description="starting rigs that are evaluated; the run begins with the best"
    )
    descents: int = Field(
        default=1, ge=1, le=1000, description="descents of the run, each from the next best of the starting rigs"
    )
    patience: int | None = Field(
        default=None, ge=1, description="evaluations without a better rig after which a descent ends; null: unlimited"
    )

    @model_validator(mode="after")
    def _check(self) -> OptimiserSettings:
        if self.descents > self.starts:
            text = f"expected at most one for each of the {self.starts} optimiser.starts, got {self.descents}"
            mistake(text, "descents", "starts")
        if self.descents > 1 and self.keep != "best":
            mistake(f"expected 1 with optimiser.keep={self.keep}, got {self.descents}", "descents", "keep")
        return self

    def multiplier_step(self, *, are_inequalities: bool) -> float:
        """Step of a multiplier; where none is given, the one of inequalities or of the thesis's penalties."""
        usual = 1.0 if are_inequalities else 0.25
        return usual if self.multiplier_learning_rate is None else self.multiplier_learning_rate

    def damping(self, *, are_inequalities: bool) -> float:
        """Damping of the multipliers; where none is given, the one of inequalities or of the thesis's penalties."""
        usual = 10.0 if are_inequalities else 0.0
        return usual if self.multiplier_damping is None else self.multiplier_damping
