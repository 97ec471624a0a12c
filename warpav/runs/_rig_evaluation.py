"""Rigs side by side on the same scenes: what Python gets, what ``evaluation.json`` holds, what reports are made of."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, PlainSerializer, PrivateAttr, model_validator

from warpav.core.errors import ArgumentError
from warpav.core.table import Table, data_frame
from warpav.optimisation import (
    OPTIONAL_METRICS,
    PAIRED_METRICS,
    REDUNDANT_CAMERAS,
    REDUNDANT_WITHIN_M,
    ArmMetrics,
    CameraOutages,
    Difference,
    LoadStates,
    Margin,
    MountEffect,
    MountTolerance,
    ObjectOutcome,
    SceneObservations,
    Soiling,
    paired_difference,
    paired_differences,
)
from warpav.rig import Rig
from warpav.scene import DeviceScene
from warpav.sight import Gap, RequirementResult, RuleMargin, WorstPoint

if TYPE_CHECKING:
    import pandas  # pyright: ignore[reportMissingImports]

TABLE_ROWS = {
    "misses_at_equal_false_alarms": ("missed per 100, equal false alarms", 1.0, 1),
    "weighted_misses_per_100": ("the same, weighted", 1.0, 1),
    "attainable_misses_per_100": ("the same, of what any camera could see", 1.0, 1),
    "objective": ("objective", 1.0, 4),
    "log_average_miss_rate": ("log-average miss rate [%]", 100.0, 1),
    "ap50_rig": ("AP50 of the rig [%]", 100.0, 1),
    "ap50_pooled": ("AP50, image by image [%]", 100.0, 1),
    "map50_average": ("AP50, mean of the cameras [%]", 100.0, 1),
    "misses_per_100": ("missed per 100, detector's threshold", 1.0, 1),
    "false_alarms_per_frame": ("false alarms an image, detector's threshold", 1.0, 2),
    "visible_rate": ("visible to a camera [%]", 100.0, 1),
    "redundant_rate": (f"of those within {REDUNDANT_WITHIN_M:g} m, to {REDUNDANT_CAMERAS} cameras [%]", 100.0, 1),
    "body_share_max": ("own body, largest share of an image [%]", 100.0, 0),
    "min_camera_distance_m": ("closest cameras [m]", 1.0, 2),
}
"""Metrics that every table shows: heading, factor and decimals; those of `OPTIONAL_METRICS` where they are known."""

LOWER_IS_BETTER = frozenset(
    (
        "misses_at_equal_false_alarms",
        "log_average_miss_rate",
        "misses_per_100",
        "weighted_misses_per_100",
        "attainable_misses_per_100",
        "false_alarms_per_frame",
        "objective",
    )
)
"""Metrics of which less is better."""

_CAPTION = "Each rig at the confidence that leaves as many false alarms an image; difference() has intervals."

_RECALL_GROUPS = {"road_user": "", "distance_m": " m", "sector": "", "category": ""}
"""Groupings of the objects in ``recall_by``, in the order in which they are shown, and the unit of their names."""


class _Part(BaseModel):
    """A part of the file; what nobody shows is left out, and what older versions did not write is None or empty."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


@dataclass(frozen=True)
class _SeenObject:
    """An object of a scene before several rigs; which cameras see and detect it is not written to files."""

    scene: str
    category: str
    distance_m: float
    bearing_deg: float
    outcome: dict[str, ObjectOutcome]
    seen_by: dict[str, tuple[str, ...]] = field(default_factory=dict)
    detected_by: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def found_alone_by(self) -> str | None:
        """The rig that detects it where no other of several does."""
        found = [name for name, outcome in self.outcome.items() if outcome == ObjectOutcome.DETECTED]
        return found[0] if len(found) == 1 < len(self.outcome) else None

    def to_json(self) -> dict[str, Any]:
        """As ``evaluation.json`` has it."""
        place = {"distance_m": round(self.distance_m, 3), "bearing_deg": round(self.bearing_deg, 2)}
        return {"scene": self.scene, "category": self.category, **place, "outcome": dict(self.outcome)}


class StartAndEnd(_Part):
    """A number of the start and of the rig that was found."""

    start: float | None
    optimised: float | None


class Simpler(_Part):
    """The rig that was found with as many numbers as by hand as cost little: its objective, and these by camera."""

    objective: float
    differing: int  # numbers in which the rig that was found differs from the one by hand
    by_hand: dict[str, list[str]]


class SearchEnd(_Part):
    """How a search ended: its steps, why it took no more (None: it took all), and those after which the rig stood."""

    iterations: int
    planned: int
    ended: str | None
    kept: int


class GroundTable(_Part):
    """Cells of the ground by sector and band, see `warpav.sight._ground.BlindGround.table`."""

    scenes: int = Field(ge=1)
    heights_m: list[float]
    cell_m: float
    radius_m: float
    sectors: list[str]
    bands_m: list[str]
    cells: list[list[list[int]]]
    blind: dict[str, list[list[list[int]]]]

    @model_validator(mode="after")
    def _has_its_shape(self) -> GroundTable:
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

    def worst_near(self, arm: str) -> tuple[float, str, str]:
        """Where near the vehicle no camera of an arm sees most of someone of the least height: share, sector, band."""
        share, _, sector, band = max(
            (self.share(arm, 0, sector, band) or 0.0, -band, name, self.bands_m[band])
            for sector, name in enumerate(self.sectors)
            for band in range(min(2, len(self.bands_m)))
        )
        return share, sector, band

    def area_m2(self, arm: str, height: int) -> float:
        """Area that no camera of an arm sees, mean of the scenes [m^2]."""
        return float(np.array(self.blind[arm])[height].sum()) * self.cell_m**2 / self.scenes


class _Draws(_Part):
    count: int = Field(ge=1, le=1_000_000)
    expected_misses_per_100: float
    quantile_95: float


class _WorstEffect(_Part):
    camera: str
    degree: Literal["x", "y", "z", "yaw", "pitch", "roll"]
    change_per_100: float


class ToleranceTable(_Part):
    """What `MountTolerance.to_json` gives."""

    position_m: float = Field(gt=0.0)
    angle_rad: float = Field(gt=0.0)
    expected_misses_per_100: float
    draws: _Draws
    effects: tuple[Annotated[MountEffect, PlainSerializer(MountEffect.to_json)], ...]
    worst: _WorstEffect
    scenes: int

    def tolerance(self) -> MountTolerance:
        """The tolerance itself; of the draws only their mean."""
        samples = np.full(self.draws.count, self.draws.expected_misses_per_100)
        nominal = self.expected_misses_per_100
        return MountTolerance(self.position_m, self.angle_rad, nominal, samples, self.effects, self.scenes)


class _Need(_Part):
    """What a requirement asks for, see `warpav.sight._requirement.Requirement`."""

    object: str
    visible_share: float
    pixels: float
    cameras: int
    share: float | None = 1.0


class _MetRequirement(_Part):
    """What a rig meets of a requirement, see `warpav.sight._check.RequirementOutcome.to_json`."""

    name: str
    hard: bool
    weight: float | None
    need: _Need
    points: int
    met: int
    share: float
    is_met: bool
    gap: Gap | None = None
    worst: list[WorstPoint] = []

    @property
    def text(self) -> str:
        """The share that is met, as tables have it."""
        return f"{self.share:.1%}" + ("" if self.is_met else " (not met)")


class Robust(_Part):
    """What a robust objective is made of, see `warpav.optimisation._camera_loss.RobustValue`."""

    camera_loss: Literal["mean", "worst"] | None = None
    weight: float | None = None
    mount_error_m: float | None = None
    mount_error_deg: float | None = None
    start: dict[str, float] | None
    optimised: dict[str, float] | None


class RigEvaluation(_Part):
    """What rigs achieve on the same scenes; of a run also what ``evaluation.json`` holds besides.

    Attributes:
        arms: Metrics of every rig by its name, see `metrics`.
        paired: Differences of the first rig to every other by metric; computed when they are written.
        camera_outage: What each rig is expected to miss without any one of its cameras, by name; None for rigs whose
            detection probabilities are not known, see `outage_table`.
        objects: Every object of the scenes, and what becomes of it.
    """

    version: Literal[1] = Field(1, alias="schema")
    counts: Annotated[dict[Literal["test"], int], Field(alias="scenes", min_length=1)]
    arms: dict[str, Annotated[ArmMetrics, PlainSerializer(ArmMetrics.to_json)]] = Field(min_length=1)
    paired: dict[str, dict[str, Annotated[Difference, PlainSerializer(Difference.to_json)]]] = {}
    camera_outage: dict[str, Annotated[CameraOutages, PlainSerializer(CameraOutages.to_json)] | None] = {}
    met: dict[str, list[_MetRequirement]] = Field({}, alias="requirements")
    mount_tolerance: ToleranceTable | None = None
    rig_of_run: str | None = None
    training_objective: StartAndEnd | None = None
    descent: SearchEnd | None = None
    simpler: Simpler | None = None
    certificate: dict[str, Any] | None = None
    robust: Robust | None = None
    constraints: dict[str, list[Margin]] | None = None
    rules: dict[str, list[RuleMargin]] | None = None
    outcomes: list[Annotated[_SeenObject, PlainSerializer(_SeenObject.to_json)]] | None = None
    ground: GroundTable | None = None
    seconds: dict[str, float] = {}
    soiling: Annotated[Soiling, PlainSerializer(Soiling.to_json)] | None = None
    load_states: Annotated[LoadStates, PlainSerializer(LoadStates.to_json)] | None = None

    _rigs: dict[str, Rig] = PrivateAttr(default_factory=dict)
    _scenes: tuple[str, ...] = PrivateAttr(default=())
    _requirements: dict[str, RequirementResult] = PrivateAttr(default_factory=dict)

    @classmethod
    def of(
        cls,
        rigs: Mapping[str, Rig],
        metrics: Mapping[str, ArmMetrics],
        scenes: Sequence[str],
        objects: Sequence[_SeenObject] = (),
        *,
        camera_outage: Mapping[str, CameraOutages | None] | None = None,
        requirements: Mapping[str, RequirementResult] | None = None,
    ) -> RigEvaluation:
        """From what was measured of rigs in scenes of these names."""
        found = requirements or {}
        evaluation = cls.model_validate(
            {
                "scenes": {"test": len(scenes)},
                "arms": dict(metrics),
                "camera_outage": dict(camera_outage or {}),
                "requirements": {name: [each.to_json() for each in met.outcomes] for name, met in found.items()},
                "outcomes": list(objects),
            }
        )
        evaluation._rigs, evaluation._scenes, evaluation._requirements = dict(rigs), tuple(scenes), dict(found)
        return evaluation

    @model_validator(mode="after")
    def _knows_its_arms(self) -> RigEvaluation:
        of_parts = {name for seen in self.outcomes or () for name in self.arms if name not in seen.outcome}
        of_parts |= set(self.arms) - set(self.ground.blind if self.ground else self.arms)
        of_parts |= {self.first} - set(self.arms if self.constraints is None else self.constraints)
        if of_parts:
            raise ValueError(
                f"outcomes and ground must be of all arms, constraints of the first, {min(of_parts)} is missing"
            )
        if len({tuple(each.name for each in outcomes) for outcomes in self.met.values()}) > 1:
            raise ValueError("requirements must be the same for all arms")
        groups = [
            {by: set(table) for by, table in arm.recall_by.items()} for arm in self.arms.values() if arm.recall_by
        ]
        if any(each != groups[0] for each in groups):
            raise ValueError("recall_by must have the same groups for all arms")
        return self

    @property
    def first(self) -> str:
        """The rig that the others are compared with."""
        return next(iter(self.arms))

    @property
    def start(self) -> str:
        """The rig that a run began with: the best by hand, or the one that it was given."""
        return "by_hand" if "by_hand" in self.arms else "start"

    @property
    def best(self) -> ArmMetrics:
        """Its metrics."""
        return self.arms[self.first]

    @property
    def scene_count(self) -> int:
        """How many scenes the rigs were compared on."""
        return self.counts["test"]

    @property
    def rigs(self) -> dict[str, Rig]:
        """The rigs by name."""
        return self._rigs

    @property
    def metrics(self) -> dict[str, ArmMetrics]:
        """Their metrics by name."""
        return self.arms

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes."""
        return self._scenes

    @property
    def objects(self) -> tuple[_SeenObject, ...]:
        """Every object of the scenes, and what becomes of it."""
        return tuple(self.outcomes or ())

    @property
    def requirements(self) -> dict[str, RequirementResult]:
        """What each rig meets of what has to be seen near the vehicle, by name; empty: nothing is required."""
        return self._requirements

    @property
    def misses(self) -> dict[str, float | None]:
        """Of 100 objects those that no camera detects, at equal false alarms, by rig; None where there is no object."""
        return {name: metrics.misses_at_equal_false_alarms for name, metrics in self.arms.items()}

    @property
    def recall(self) -> dict[str, float | None]:
        """Share of all objects that some camera detects at the detector's own threshold, by rig; None: no object."""
        return {name: metrics.tp_detection_rate for name, metrics in self.arms.items()}

    def difference(self, one: str, other: str, metric: str = "misses_at_equal_false_alarms") -> Difference:
        """How a rig differs from another on the same scenes, one - other, with a 95 % interval.

        Of misses, recalls and the objective it is the difference of what `table` shows; of average precisions and false
        alarms the mean over scenes. The scenes are resampled, together for both rigs, so the interval speaks of other
        scenes like these.

        Args:
            one: Name of a rig.
            other: Name of another.
            metric: One of `PAIRED_METRICS`, or of `OPTIONAL_METRICS` where they are known.

        Raises:
            InputError: There is no rig or metric of a name.
        """
        for argument, name in (("one", one), ("other", other)):
            if name not in self.arms:
                raise ArgumentError(argument, f"expected one of {', '.join(self.arms)}, got {name!r}")
        metrics = [*PAIRED_METRICS, *(name for name in OPTIONAL_METRICS if name in self.arms[one].per_scene)]
        if metric not in metrics:
            raise ArgumentError("metric", f"expected one of {', '.join(metrics)}, got {metric!r}")
        first, second = self.arms[one], self.arms[other]
        weight = first.scene_weights(metric)
        return paired_difference(first.per_scene[metric], second.per_scene[metric], weight=weight)

    def table(self) -> Table:
        """Metrics by rig: text when printed, HTML in a notebook."""
        outcomes = list(self.met.values())
        rows = [
            (f"points met: {each.name}", *(of_rig[k].text for of_rig in outcomes))
            for k, each in enumerate(outcomes[0] if outcomes else ())
        ]
        columns = (f"{len(self.scenes)} scenes, {len(self.objects)} objects", *self.arms)
        return Table(columns, (*self.metric_table().rows, *rows), _CAPTION)

    @property
    def is_worse_than_start(self) -> bool:
        """Whether the objective of the rig that was found is higher than that of its start, or no number.

        Then the start is the rig of the run, unless it breaks rules that the other keeps.
        """
        training = self.training_objective
        if training is None or training.start is None or self.rules is not None:
            return False
        return training.optimised is None or training.optimised > training.start

    @property
    def rows(self) -> dict[str, tuple[str, float, int]]:
        """Those of `TABLE_ROWS` that are known of some rig; the objective of a search by a pool is expected misses."""
        arms = self.arms.values()
        rows = {name: row for name, row in TABLE_ROWS.items() if any(getattr(arm, name) is not None for arm in arms)}
        if "objective" in rows and any("object_weight" in arm.per_scene for arm in arms):
            weighted = "" if self.best.weighted_misses_per_100 is None else ", weighted"
            rows["objective"] = f"expected misses per 100{weighted}", 100.0, 1
        return rows

    def metric_table(self) -> Table:
        """The metrics that are known of some rig."""
        rows = [
            (heading, *(_cell(getattr(arm, name), factor, digits) for arm in self.arms.values()))
            for name, (heading, factor, digits) in self.rows.items()
        ]
        return Table((f"{self.scene_count} test scenes", *self.arms), tuple(rows))

    def group_table(self) -> Table | None:
        """Misses at equal false alarms by road user, distance, sector and class; None where not known of all rigs.

        Groups without objects, and road users where there is only one kind of them, are left out.
        """
        tables = [arm.recall_by for arm in self.arms.values() if arm.recall_by]
        if len(tables) < len(self.arms):
            return None
        rows: list[tuple[str, ...]] = []
        for by, unit in _RECALL_GROUPS.items():
            block = [
                (f"{name}{unit}", str(group.objects), *(_missed(table[by][name].recall) for table in tables))
                for name, group in tables[0].get(by, {}).items()
                if group.objects
            ]
            rows += block if len(block) > (by == "road_user") else []
        return Table(("missed per 100", "objects", *self.arms), tuple(rows)) if rows else None

    def requirement_table(self) -> Table | None:
        """What every rig meets of what has to be seen near the vehicle; None where nothing has to."""
        found = list(self.met.values())
        rows = [
            (f"{each.name}, {each.points} points" + (" (hard)" if each.hard else ""), *(arm[k].text for arm in found))
            for k, each in enumerate(found[0] if found else ())
        ]
        return Table(("points met near the vehicle", *self.met), tuple(rows)) if rows else None

    def outage_table(self, name: str | None = None) -> Table:
        """What a rig is expected to miss without each of its cameras: text when printed, HTML in a notebook.

        Args:
            name: Of the rig; None: the first.

        Raises:
            InputError: There is no such rig, or the detection probabilities of its cameras are not known: they are of
                cameras of the placement's model, where its objective needs them.
        """
        name = self.first if name is None else name
        if name not in self.arms:
            raise ArgumentError("name", f"expected one of {', '.join(self.arms)}, got {name!r}")
        found = self.camera_outage.get(name)
        if found is None:
            raise ArgumentError(
                "name", f"expected a rig whose detection probabilities are known, in scenes with objects, got {name!r}"
            )
        return found.table(name)

    def to_pandas(self) -> pandas.DataFrame:
        """The metrics as a table of pandas: one row a rig, one column a metric.

        Raises:
            ImportError: pandas is not installed.
        """
        skipped = ("body_share", "recall_by", "per_scene")
        rows = {
            name: {field: value for field, value in metrics.to_json().items() if field not in skipped}
            for name, metrics in self.arms.items()
        }
        return data_frame(rows)

    def compared(self) -> RigEvaluation:
        """The same with the paired differences of the first rig to all others, which take a moment."""
        others = {name: paired_differences(self.best, self.arms[name]) for name in self.arms if name != self.first}
        return self.model_copy(update={"paired": others})

    def to_json(self, *, with_objects: bool = False) -> dict[str, Any]:
        """As ``evaluation.json`` has it, but for the version; of the parts those that were measured."""
        whole = self if "paired" in self.model_fields_set else self.compared()
        exclude = {"version"} if with_objects else {"version", "outcomes"}
        return whole.model_dump(by_alias=True, exclude_unset=True, exclude=exclude)

    def __repr__(self) -> str:
        found = ", ".join(f"{name} {_cell(misses)}" for name, misses in self.misses.items())
        return f"RigEvaluation({len(self.scenes)} scenes, {len(self.objects)} objects; missed per 100: {found})"

    def _repr_html_(self) -> str:
        return self.table()._repr_html_()


def _cell(value: float | None, factor: float = 1.0, digits: int = 1) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{factor * value:z.{digits}f}"


def _missed(recall: float | None) -> str:
    return _cell(1.0 - (recall or 0.0), 100.0, 0)


def seen_objects(
    observations: Mapping[str, SceneObservations], scenes: Sequence[DeviceScene], rigs: Mapping[str, Rig]
) -> list[_SeenObject]:
    """Every object of scenes before several rigs."""
    objects = []
    for number, scene in enumerate(scenes):
        seen = {name: each.observations[number] for name, each in observations.items()}
        cameras = {name: [camera.name for camera in rigs[name].cameras] for name in rigs}
        outcomes = {name: each.outcomes for name, each in seen.items()}
        sees = {name: each.visible_to_camera for name, each in seen.items()}
        detects = {name: each.detected_by_camera for name, each in seen.items()}
        for k in range(scene.vehicle_count):
            forward_m, left_m = scene.from_ego_m[k]
            objects.append(
                _SeenObject(
                    scene.name,
                    scene.category[k],
                    math.hypot(forward_m, left_m),
                    math.degrees(math.atan2(left_m, forward_m)),
                    {name: each[k] for name, each in outcomes.items()},
                    *(
                        {name: tuple(np.array(cameras[name])[flags[name][:, k]].tolist()) for name in rigs}
                        for flags in (sees, detects)
                    ),
                )
            )
    return objects
