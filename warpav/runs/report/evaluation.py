"""What a run folder holds, checked: what report and terminal show has the form that a run writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, field_validator, model_validator

from warpav.core.errors import InputError
from warpav.core.yaml_file import read_yaml
from warpav.evaluation.metrics import ObjectOutcome
from warpav.evaluation.rig_evaluation import TABLE_ROWS
from warpav.optimisation.further_camera import FurtherCameras
from warpav.rig.rig import Rig
from warpav.rig.zone import Zone, read_zones
from warpav.runs.config import Config
from warpav.runs.events import Certificate, Event
from warpav.runs.run_folder import RunFolder

_BoxPx = tuple[float, float, float, float]
Content = TypeVar("Content")


class _Part(BaseModel):
    """A part of a file; what nobody shows is left out, and what older versions did not write is None or empty."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Difference(_Part):
    """How the first arm differs from another in a metric, see `warpav.evaluation.statistics.Difference`."""

    mean: float | None
    low: float | None
    high: float | None
    scenes: int


class Group(_Part):
    """Recall of a group of objects, see `warpav.evaluation.metrics.GroupRecall`."""

    objects: int = Field(ge=0)
    detected: int = Field(ge=0)
    recall: float | None

    @model_validator(mode="after")
    def _has_a_recall(self) -> Group:
        if self.objects and self.recall is None:
            raise ValueError("a group with objects has a recall")
        return self


class Arm(_Part):
    """Metrics of a rig, see `warpav.evaluation.metrics.ArmMetrics`; ``numbers`` are those of `TABLE_ROWS`."""

    numbers: dict[str, float | None]
    objects: int | None = None
    recall_by: dict[str, dict[str, Group]] | None = None

    @model_validator(mode="before")
    @classmethod
    def _gathered(cls, data: Any) -> Any:  # noqa: ANN401 (JSON)
        return {**data, "numbers": {name: data.get(name) for name in TABLE_ROWS}} if isinstance(data, dict) else data

    @property
    def recall(self) -> float | None:
        """Of the rig."""
        return self.numbers["tp_detection_rate"]

    @property
    def detected(self) -> int | None:
        """Number of objects that some camera detects."""
        return None if self.objects is None or self.recall is None else round(self.recall * self.objects)


class _StartAndEnd(_Part):
    """A number before and after."""

    start: float | None
    optimised: float | None


class _SearchEnd(_Part):
    """How a search ended: its steps, why it took no more (None: it took all), and those after which the rig stood."""

    iterations: int
    planned: int
    ended: str | None
    kept: int


class Margin(_Part):
    """How far a rig is from breaking a constraint, see `warpav.optimisation.constraints.Margin`."""

    kind: Literal["border", "spacing"]
    cameras: list[str]
    value_m: float
    limit_m: float
    slack_m: float
    is_kept: bool


class _ReportedObject(_Part):
    """An object of a test scene, and what becomes of it by arm."""

    scene: str
    category: str
    distance_m: float
    bearing_deg: float
    outcome: dict[str, ObjectOutcome]


class _GroundTable(_Part):
    """Cells of the ground by sector and band, see `warpav.evaluation.blind_ground.BlindGround.table`."""

    scenes: int = Field(ge=1)
    heights_m: list[float]
    cell_m: float
    radius_m: float
    sectors: list[str]
    bands_m: list[str]
    cells: list[list[list[int]]]
    blind: dict[str, list[list[list[int]]]]

    @model_validator(mode="after")
    def _has_its_shape(self) -> _GroundTable:
        shape = len(self.heights_m), len(self.sectors), len(self.bands_m)
        for name, counts in (("cells", self.cells), *self.blind.items()):
            sizes = {(len(counts), len(layer), len(row)) for layer in counts for row in layer}
            if sizes != {shape}:
                raise ValueError(f"{name} must count cells of {shape} heights, sectors and bands")
        return self

    def share(self, arm: str, height: int, sector: int | None = None, band: int | None = None) -> float | None:
        """Share of the cells that no camera of an arm sees, all or some; None where there are no cells."""
        place = (height, slice(None) if sector is None else sector, slice(None) if band is None else band)
        cells = int(np.array(self.cells)[place].sum())
        return int(np.array(self.blind[arm])[place].sum()) / cells if cells else None

    def area_m2(self, arm: str, height: int) -> float:
        """Area that no camera of an arm sees, mean of the scenes [m^2]."""
        return float(np.array(self.blind[arm])[height].sum()) * self.cell_m**2 / self.scenes


class CameraOutage(_Part):
    """A rig without one camera, see `warpav.evaluation.perturbations.CameraOutage`."""

    camera: str
    expected_misses_per_100: float
    difference_per_100: float
    weighted_expected_misses_per_100: float | None = None
    weighted_difference_per_100: float | None = None


class _Outage(_Part):
    """A rig without each of its cameras, see `warpav.evaluation.perturbations.CameraOutages`."""

    expected_misses_per_100: float
    weighted_expected_misses_per_100: float | None = None
    worst: str
    cameras: list[CameraOutage] = Field(min_length=1)

    @model_validator(mode="after")
    def _is_weighted_or_not(self) -> _Outage:
        weighted = [self.weighted_expected_misses_per_100]
        for each in self.cameras:
            weighted += [each.weighted_expected_misses_per_100, each.weighted_difference_per_100]
        if len({number is None for number in weighted}) > 1:
            raise ValueError("weighted numbers must be there for all cameras or for none")
        return self


class MountEffect(_Part):
    """The camera and degree of freedom that cost most."""

    camera: str
    degree: Literal["x", "y", "z", "yaw", "pitch", "roll"]
    change_per_100: float


class _Tolerance(_Part):
    """What errors of mounting cost, see `warpav.evaluation.perturbations.MountTolerance`."""

    position_m: float = Field(gt=0.0)
    angle_rad: float = Field(gt=0.0)
    scenes: int
    worst: MountEffect


class _Need(_Part):
    """What a requirement asks for, see `warpav.sight.requirement.Requirement`."""

    object: str
    visible_share: float
    pixels: float
    cameras: int
    share: float | None = 1.0


class Point(_Part):
    """A point that is not met, see `warpav.sight.check.WorstPoint`."""

    position_m: tuple[float, float]
    camera: str | None
    visible_share: float
    pixels: float


class Gap(_Part):
    """The largest connected ground that does not meet a requirement."""

    area_m2: float
    sector: str


class Requirement(_Part):
    """What a rig meets of a requirement, see `warpav.sight.check.RequirementOutcome`."""

    name: str
    hard: bool
    weight: float | None
    need: _Need
    points: int
    met: int
    share: float
    is_met: bool
    worst: list[Point] = []
    gap: Gap | None = None


class Robust(_Part):
    """What a robust objective is made of, see `warpav.optimisation.camera_loss.RobustValue`."""

    camera_loss: Literal["mean", "worst"] | None = None
    weight: float | None = None
    mount_error_m: float | None = None
    mount_error_deg: float | None = None
    start: dict[str, float] | None
    optimised: dict[str, float] | None


class Evaluation(_Part):
    """``evaluation.json``."""

    version: Literal[1] = Field(1, alias="schema")
    scenes: Annotated[dict[Literal["test"], int], Field(min_length=1)]
    arms: dict[str, Arm] = Field(min_length=1)
    paired: dict[str, dict[str, Difference]] = {}
    training_objective: _StartAndEnd | None = None
    seconds: dict[str, float] = {}
    descent: _SearchEnd | None = None
    constraints: dict[str, list[Margin]] | None = None
    outcomes: list[_ReportedObject] | None = None
    ground: _GroundTable | None = None
    camera_outage: dict[str, _Outage | None] = {}
    mount_tolerance: _Tolerance | None = None
    requirements: dict[str, list[Requirement]] = {}
    robust: Robust | None = None
    soiling: dict[str, Any] | None = None
    load_states: dict[str, Any] | None = None

    @model_validator(mode="after")
    def _knows_its_arms(self) -> Evaluation:
        of_parts = {name for seen in self.outcomes or () for name in self.arms if name not in seen.outcome}
        of_parts |= set(self.arms) - set(self.ground.blind if self.ground else self.arms)
        of_parts |= {self.first} - set(self.arms if self.constraints is None else self.constraints)
        if of_parts:
            raise ValueError(
                f"outcomes and ground must be of all arms, constraints of the first, {min(of_parts)} is missing"
            )
        if len({tuple(each.name for each in outcomes) for outcomes in self.requirements.values()}) > 1:
            raise ValueError("requirements must be the same for all arms")
        groups = [
            {by: set(table) for by, table in arm.recall_by.items()} for arm in self.arms.values() if arm.recall_by
        ]
        if any(each != groups[0] for each in groups):
            raise ValueError("recall_by must have the same groups for all arms")
        return self

    @property
    def first(self) -> str:
        """The arm that the others are compared with."""
        return next(iter(self.arms))

    @property
    def best(self) -> Arm:
        """Its metrics."""
        return self.arms[self.first]


class View(_Part):
    """What a camera sees of a scene, with boxes [px]; see `warpav.view.figures.images.DetectionPanel`."""

    scene: str
    scene_number: int = 0
    rig: str
    camera: str
    image: Annotated[str, Field(pattern=r"^[^/\\]+$")]
    size_px: tuple[int, int]
    truth_box_px: list[_BoxPx | None]
    detection_box_px: list[_BoxPx]
    detection_of_truth: list[int]

    @field_validator("size_px")
    @classmethod
    def _is_a_size(cls, size_px: tuple[int, int]) -> tuple[int, int]:
        if min(size_px) < 1:
            raise ValueError("an image has at least one pixel")
        return size_px


@dataclass(frozen=True)
class _GroundMap:
    """Cells of the ground, see `warpav.evaluation.blind_ground.BlindGround`.

    Attributes:
        blind_share: Share of the scenes in which no camera sees somebody on a cell, of those in which he can stand
            there, by arm, float64 [height, row, column]; NaN where he never can.
        ego_bounds_m: Lowest and highest corner of the vehicle in its frame [m], [2, 3].
    """

    blind_share: dict[str, np.ndarray]
    heights_m: list[float]
    cell_m: float
    ego_bounds_m: np.ndarray


@dataclass(frozen=True)
class RunContent:
    """Everything of a run that is shown; what a run that was stopped does not have is None or empty."""

    name: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    config: Config | None = None
    config_mistake: str = ""
    environment: dict[str, Any] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)
    evaluation: Evaluation | None = None
    start: Rig | None = None
    result: Rig | None = None
    views: list[View] = field(default_factory=list)
    ground: _GroundMap | None = None
    certificate: Certificate | None = None
    further: FurtherCameras | None = None
    zones: tuple[Zone, ...] = ()


def read_run(folder: RunFolder) -> RunContent:
    """Everything in a run folder that is shown.

    Raises:
        InputError: A file is not what a run writes; or there is nothing to show.
    """
    options = read_yaml(folder.path / "config.yaml")[0]
    if not isinstance(options, dict):
        raise InputError(f"{folder.path / 'config.yaml'}: expected sections of options, got {options!r:.40}")
    try:
        config, config_mistake = folder.config(), ""
    except InputError as error:  # another version's options, or a file that is gone
        config, config_mistake = None, str(error).splitlines()[0].removeprefix(f"{folder.path}/")
    events = _checked(list[Event], folder.events(), folder, "events.jsonl")
    content = folder.evaluation()
    if not events and content is None:
        raise InputError(f"{folder.path}: run folder: expected at least one iteration to report on, got none")
    evaluation = None if content is None else _checked(Evaluation, content, folder, "evaluation.json")
    scenes = None if config is None else config.scenes.search_scene_count
    return RunContent(
        name=folder.path.resolve().name,
        options=options,
        config=config,
        config_mistake=config_mistake,
        environment=_checked(dict[str, Any], folder.environment(), folder, "env.json"),
        events=events,
        evaluation=evaluation,
        start=folder.rig("initial") if (folder.path / "rig_initial.yaml").is_file() else None,
        result=_result(folder, config),
        views=_checked(list[View], folder.views() or [], folder, "figures/views.json"),
        ground=_ground(folder, evaluation),
        certificate=Certificate.of([event.model_dump() for event in events], scenes=scenes),
        further=folder.further_cameras(),
        zones=() if config is None or config.mount.zones is None else read_zones(config.mount.zones),
    )


def _checked(form: type[Content], data: object, folder: RunFolder, name: str) -> Content:
    try:
        return TypeAdapter(form).validate_python(data)
    except ValidationError as error:
        mistake = error.errors()[0]
        place = ".".join(str(part) for part in mistake["loc"])
        place = f"{place}: " if place else ""
        text = mistake["msg"].removeprefix("Value error, ")
        raise InputError(
            f"{folder.path / name}: {place}expected what warpav optimise writes, got {mistake['input']!r:.40} "
            f"({text[0].lower() + text[1:]}); was the file changed?"
        ) from None


def _result(folder: RunFolder, config: Config | None) -> Rig | None:
    roles: Sequence[Literal["best", "final"]] = ("best", "final")
    if config is not None and config.optimiser.keep != "best":
        roles = ("final", "best")
    for role in roles:
        if (folder.path / f"rig_{role}.yaml").is_file():
            return folder.rig(role)
    return None


def _ground(folder: RunFolder, evaluation: Evaluation | None) -> _GroundMap | None:
    arrays = folder.ground()
    if arrays is None or evaluation is None:
        return None
    file = folder.path / "figures" / "ground.npz"
    wanted: Mapping[str, int] = {
        "open_count": 3,
        "heights_m": 1,
        "cell_m": 0,
        "ego_bounds_m": 2,
        **{f"blind_count_{arm}": 3 for arm in ("start", evaluation.first)},
    }
    for name, dimensions in wanted.items():
        if name not in arrays or arrays[name].ndim != dimensions or arrays[name].dtype.kind not in "iuf":
            raise InputError(
                f"{file}: expected numbers {name} with {dimensions} dimensions, got none; was the file changed?"
            )
    opened = arrays["open_count"].astype(np.float64)
    shares = {}
    for arm in ("start", evaluation.first):
        blind = arrays[f"blind_count_{arm}"].astype(np.float64)
        if blind.shape != opened.shape or len(blind) != len(arrays["heights_m"]):
            raise InputError(f"{file}: expected counts of one shape, got {blind.shape} and {opened.shape}")
        shares[arm] = np.divide(blind, opened, out=np.full(opened.shape, np.nan), where=opened > 0)
    return _GroundMap(shares, arrays["heights_m"].tolist(), float(arrays["cell_m"]), arrays["ego_bounds_m"])
