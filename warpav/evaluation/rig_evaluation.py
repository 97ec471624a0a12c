"""Rigs side by side on the same scenes: their metrics, what becomes of every object, and how sure differences are."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from warpav.core.data_frame import data_frame
from warpav.core.errors import ArgumentError
from warpav.core.table import Table
from warpav.evaluation.metrics import (
    EQUAL_FALSE_ALARMS_PER_FRAME,
    OPTIONAL_METRICS,
    PAIRED_METRICS,
    REDUNDANT_CAMERAS,
    REDUNDANT_WITHIN_M,
    ArmMetrics,
    ObjectOutcome,
)
from warpav.evaluation.perturbations import CameraOutages
from warpav.evaluation.statistics import Difference, paired_difference, paired_differences
from warpav.rig.rig import Rig

if TYPE_CHECKING:
    import pandas  # pyright: ignore[reportMissingImports]

    from warpav.sight.check import RequirementResult

TABLE_ROWS = {
    "tp_detection_rate": "recall of the rig",
    "weighted_recall": "weighted recall",
    "misses_per_100": "misses per 100",
    "weighted_misses_per_100": "weighted misses per 100",
    "attainable_rate": "attainable by any camera",
    "attainable_recall": "recall of the attainable",
    "attainable_misses_per_100": "attainable misses per 100",
    "recall_at_equal_false_alarms": f"recall at {EQUAL_FALSE_ALARMS_PER_FRAME:g} false alarms",
    "visible_rate": "visible to the rig",
    "rig_recall_visible": "recall of the visible",
    "redundant_rate": f"seen by {REDUNDANT_CAMERAS} cameras within {REDUNDANT_WITHIN_M:g} m",
    "map50_average": "AP50, mean of the cameras",
    "map50_min_camera": "AP50, worst camera",
    "map50_max_camera": "AP50, best camera",
    "ap50_pooled": "AP50, all images",
    "ap50_small": "AP50, up to 32 x 32 px",
    "ap50_medium": "AP50, to 96 x 96 px",
    "ap50_large": "AP50, larger",
    "ap50_95_pooled": "AP50:95, all images",
    "false_alarms_per_frame": "false alarms a frame",
    "tp_in_frame_rate": "in frame",
    "detection_confidence": "confidence",
    "objective": "objective",
    "constraint_violation": "violation [m]",
    "min_camera_distance_m": "closest cameras [m]",
    "body_share_max": "own body, largest share",
}
"""Metrics that every table shows, and their headings; those of `OPTIONAL_METRICS` where they are known."""

_CAPTION = "Recalls pool the objects of all scenes; difference() is a mean over scenes, each counting alike."


@dataclass(frozen=True)
class _SeenObject:
    """An object of a scene before several rigs."""

    scene: str
    category: str
    distance_m: float
    bearing_deg: float
    outcome: dict[str, ObjectOutcome]
    seen_by: dict[str, tuple[str, ...]]
    detected_by: dict[str, tuple[str, ...]]


@dataclass(frozen=True, eq=False)
class RigEvaluation:
    """What rigs achieve on the same scenes.

    Attributes:
        rigs: The rigs by name.
        metrics: Their metrics by name.
        scenes: Names of the scenes.
        objects: Every object of the scenes, and what becomes of it.
        camera_outage: What each rig is expected to miss without any one of its cameras, by name; None for rigs whose
            detection probabilities are not known, see `outage_table`.
        requirements: What each rig meets of what has to be seen near the vehicle, by name; empty: nothing is required.
    """

    rigs: dict[str, Rig]
    metrics: dict[str, ArmMetrics]
    scenes: tuple[str, ...]
    objects: tuple[_SeenObject, ...]
    camera_outage: dict[str, CameraOutages | None] = field(default_factory=dict)
    requirements: dict[str, RequirementResult] = field(default_factory=dict)

    @property
    def recall(self) -> dict[str, float | None]:
        """Share of all objects that some camera detects, by rig; None where there is no object."""
        return {name: metrics.rig_recall for name, metrics in self.metrics.items()}

    def difference(self, one: str, other: str, metric: str = "rig_recall") -> Difference:
        """How a rig differs from another on the same scenes, one - other, with a 95 % interval.

        It is the mean over scenes of the difference within each scene, and every scene counts alike. The recalls of
        `table` pool the objects of all scenes, so a scene with many counts more there, and the difference of two
        recalls is another number than this. The scenes are resampled, together for both rigs, so the interval speaks
        of other scenes like these.

        Args:
            one: Name of a rig.
            other: Name of another.
            metric: One of `warpav.evaluation.metrics.PAIRED_METRICS`, or of `OPTIONAL_METRICS` where they are known.

        Raises:
            InputError: There is no rig or metric of a name.
        """
        for argument, name in (("one", one), ("other", other)):
            if name not in self.metrics:
                raise ArgumentError(argument, f"expected one of {', '.join(self.metrics)}, got {name!r}")
        metrics = [*PAIRED_METRICS, *(name for name in OPTIONAL_METRICS if name in self.metrics[one].per_scene)]
        if metric not in metrics:
            raise ArgumentError("metric", f"expected one of {', '.join(metrics)}, got {metric!r}")
        return paired_difference(self.metrics[one].per_scene[metric], self.metrics[other].per_scene[metric])

    def table(self) -> Table:
        """Metrics by rig: text when printed, HTML in a notebook.

        The recalls pool the objects of all scenes; `difference` is a mean over scenes.
        """
        rows = [
            (heading, *(_cell(getattr(metrics, field)) for metrics in self.metrics.values()))
            for field, heading in TABLE_ROWS.items()
            if field not in OPTIONAL_METRICS or any(getattr(each, field) is not None for each in self.metrics.values())
        ]
        rows += requirement_rows(self.to_json()["requirements"])
        return Table((f"{len(self.scenes)} scenes, {len(self.objects)} objects", *self.metrics), tuple(rows), _CAPTION)

    def outage_table(self, name: str | None = None) -> Table:
        """What a rig is expected to miss without each of its cameras: text when printed, HTML in a notebook.

        Args:
            name: Of the rig; None: the first.

        Raises:
            InputError: There is no such rig, or the detection probabilities of its cameras are not known: they are of
                cameras of the placement's model, where its objective needs them.
        """
        name = next(iter(self.rigs)) if name is None else name
        if name not in self.rigs:
            raise ArgumentError("name", f"expected one of {', '.join(self.rigs)}, got {name!r}")
        found = self.camera_outage.get(name)
        if found is None:
            raise ArgumentError(
                "name", f"expected a rig whose detection probabilities are known, in scenes with objects, got {name!r}"
            )
        columns, rows = outage_rows(found.to_json())
        return Table((f"{name} without", *columns), tuple((first, *cells) for first, *cells in rows))

    def to_pandas(self) -> pandas.DataFrame:
        """The metrics as a table of pandas: one row a rig, one column a metric.

        Raises:
            ImportError: pandas is not installed.
        """
        skipped = ("body_share", "recall_by", "per_scene")
        rows = {
            name: {field: value for field, value in metrics.to_json().items() if field not in skipped}
            for name, metrics in self.metrics.items()
        }
        return data_frame(rows)

    def to_json(self) -> dict[str, Any]:
        """Metrics and paired differences as ``evaluation.json`` has them; the first rig is compared with the others."""
        first, *others = self.metrics
        return {
            "scenes": {"test": len(self.scenes)},
            "arms": {name: metrics.to_json() for name, metrics in self.metrics.items()},
            "paired": {name: paired_differences(self.metrics[first], self.metrics[name]) for name in others},
            "camera_outage": {
                name: None if found is None else found.to_json() for name, found in self.camera_outage.items()
            },
            "requirements": {
                name: [each.to_json() for each in found.outcomes] for name, found in self.requirements.items()
            },
        }

    def outcomes(self) -> list[dict[str, Any]]:
        """The objects as ``evaluation.json`` has them."""
        return [
            {
                "scene": seen.scene,
                "category": seen.category,
                "distance_m": round(seen.distance_m, 3),
                "bearing_deg": round(seen.bearing_deg, 2),
                "outcome": dict(seen.outcome),
            }
            for seen in self.objects
        ]

    def __repr__(self) -> str:
        found = ", ".join(f"{name} {_cell(recall)}" for name, recall in self.recall.items())
        return f"RigEvaluation({len(self.scenes)} scenes, {len(self.objects)} objects; recall: {found})"

    def _repr_html_(self) -> str:
        return self.table()._repr_html_()


def requirement_rows(requirements: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Rows of text from ``requirements`` of ``evaluation.json``: a requirement, and what each rig meets of it."""
    outcomes = list(requirements.values())
    return [
        (
            f"points met: {each['name']}",
            *(f"{of_rig[k]['share']:.1%}" + ("" if of_rig[k]["is_met"] else " (not met)") for of_rig in outcomes),
        )
        for k, each in enumerate(outcomes[0] if outcomes else ())
    ]


def outage_rows(outage: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Headings, and a row of text for each camera that is gone, of ``camera_outage`` of a rig in ``evaluation.json``.

    The first row is the whole rig; the first cell of a row is the camera's name, without a heading.
    """
    names = ["expected_misses_per_100", "difference_per_100"]
    columns = ["expected misses per 100", "difference"]
    if "weighted_expected_misses_per_100" in outage:
        names += [f"weighted_{name}" for name in names]
        columns += [f"weighted {column}" for column in columns]
    whole = ["no camera", *(f"{outage[name]:.2f}" if name in outage else "" for name in names)]
    rows = [
        [
            each["camera"] + (" (worst)" if each["camera"] == outage["worst"] else ""),
            *(f"{each[name]:{'+' if 'difference' in name else ''}z.2f}" for name in names),
        ]
        for each in outage["cameras"]
    ]
    return columns, [whole, *rows]


def _cell(value: float | None) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.4f}"


def seen_objects(
    observations: Mapping[str, Any], scenes: Sequence[Any], rigs: Mapping[str, Rig]
) -> tuple[_SeenObject, ...]:
    """Every object of scenes before several rigs."""
    objects = []
    for number, scene in enumerate(scenes):
        cameras = {name: each.observations[number].cameras for name, each in observations.items()}
        outcomes = {name: each.observations[number].outcomes for name, each in observations.items()}
        for k in range(scene.vehicle_count):
            forward_m, left_m = scene.from_ego_m[k]
            objects.append(
                _SeenObject(
                    scene.name,
                    scene.category[k],
                    math.hypot(forward_m, left_m),
                    math.degrees(math.atan2(left_m, forward_m)),
                    {name: each[k] for name, each in outcomes.items()},
                    {
                        name: _names(rigs[name], [math.isfinite(each.truth_box_px[k, 0]) for each in cameras[name]])
                        for name in rigs
                    },
                    {name: _names(rigs[name], [each.match[k] >= 0 for each in cameras[name]]) for name in rigs},
                )
            )
    return tuple(objects)


def _names(rig: Rig, flags: Sequence[bool]) -> tuple[str, ...]:
    return tuple(camera.name for camera, flag in zip(rig.cameras, flags, strict=True) if flag)
