"""The section ``rig``: which cameras, how many, where they start, and what of them is free."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, PlainSerializer, WithJsonSchema, model_validator

from warpav.core.section import Expectation, Section, mistake, shown
from warpav.core.units import DEGREES_PER_UNIT, METRES_PER_UNIT, NUMBER_OR_TEXT, Metres, range_reader
from warpav.runs.config.file_options import existing_file, read_path

NAMED_STARTS = ("random", "highest")
"""What rig.start may be besides a rig."""

START_TEXT = "random, highest, a preset, a run folder or the path of a rig YAML"


_NAMES_TEXT = "a list of names of cameras of rig.start, such as [front, rear]"


def _read_names(value: object) -> tuple[Any, ...]:
    names = tuple(value) if isinstance(value, (list, tuple)) else (value,)
    for name in names:
        if not isinstance(name, str) or not name:
            mistake(f"expected {_NAMES_TEXT}, got {shown(value)}")
        if names.count(name) > 1:
            mistake(f"expected every name once, got {name!r} {names.count(name)} times")
    return names


_PITCHES_TEXT = "two angles from -60 deg to 60 deg, the lower one first, such as [-20, 20]"
_HEIGHTS_TEXT = "two heights from 0 m to 2 m, the lower one first, such as [0.05, 0.4]"
_FOVS_TEXT = "two angles from 10 deg to 360 deg, the lower one first, such as [60, 110]"
_RANGE_AS_LIST = PlainSerializer(lambda value: None if value is None else list(value))
_RANGE_SCHEMA = WithJsonSchema(
    {"anyOf": [{"type": "array", "items": NUMBER_OR_TEXT, "minItems": 2, "maxItems": 2}, {"type": "null"}]}
)

Range = tuple[float, float] | None
PitchRange = Annotated[
    Range,
    range_reader(DEGREES_PER_UNIT, _PITCHES_TEXT, low=-60.0, high=60.0),
    _RANGE_AS_LIST,
    Expectation(_PITCHES_TEXT),
    _RANGE_SCHEMA,
]
HeightRange = Annotated[
    Range,
    range_reader(METRES_PER_UNIT, _HEIGHTS_TEXT, low=0.0, high=2.0),
    _RANGE_AS_LIST,
    Expectation(_HEIGHTS_TEXT),
    _RANGE_SCHEMA,
]
FovRange = Annotated[
    Range,
    range_reader(DEGREES_PER_UNIT, _FOVS_TEXT, low=10.0, high=360.0),
    _RANGE_AS_LIST,
    Expectation(_FOVS_TEXT),
    _RANGE_SCHEMA,
]


class FreeConfig(Section):
    """What the optimiser moves besides x, y and yaw, each within two bounds; null leaves it as configured."""

    pitch_deg: PitchRange = Field(
        default=(-10.0, 20.0), description="bounds of each camera's pitch, nose-down positive; null: level cameras"
    )
    height_m: HeightRange = Field(
        default=None, description="bounds of each camera's height above the mount surface, around rig.height_offset_m"
    )
    fov_deg: FovRange = Field(
        default=None, description="bounds of each camera's horizontal field of view, around camera.fov_deg"
    )


LATER_RIG_OPTIONS = ("fewest_cameras", "modules", "catalogue", "max_cost", "symmetric")
"""Options of the section that files leave out where they are not set."""

LATER_BASELINE_OPTIONS = ("presets", "rigs", "preset_images")
"""The same of the section ``baselines``."""

_COUNTS_TEXT = "a mapping from modules to how many, such as {front_8mp_30: 1, fisheye_3mp_190: 0..4}"
_MOST_CAMERAS = 16


def _read_count(value: object, expected: str, *fields: str) -> tuple[int, int]:
    """A number such as 4, or a range such as ``2..8``; ``fields`` as of `mistake`."""
    match = re.fullmatch(r"\s*([0-9]+)\s*\.\.\s*([0-9]+)\s*", value) if isinstance(value, str) else None
    if match:
        pair = int(match[1]), int(match[2])
    elif isinstance(value, int) and not isinstance(value, bool):
        pair = value, value
    elif isinstance(value, (list, tuple)) and len(value) == 2 and all(isinstance(each, int) for each in value):
        pair = value[0], value[1]
    else:
        mistake(f"expected {expected}, got {shown(value)}", *fields)
    if not 0 <= pair[0] <= pair[1] <= _MOST_CAMERAS:
        text = f"expected numbers from 0 to {_MOST_CAMERAS}, the lower one first"
        mistake(f"{text}, got {shown(value)}", *fields)
    return pair


def _read_counts(value: object) -> object:
    if not isinstance(value, Mapping):
        return value
    if not value:
        mistake(f"expected {_COUNTS_TEXT}, got none")
    return {str(name): _read_count(count, _COUNTS_TEXT) for name, count in value.items()}


def _shown_count(pair: tuple[int, int]) -> int | str:
    return pair[0] if pair[0] == pair[1] else f"{pair[0]}..{pair[1]}"


def _read_catalogue(value: object) -> object:
    if isinstance(value, str):
        existing_file(value, "the path of a catalogue of modules, or null", [value], [])
    return read_path(value)


class RigConfig(Section):
    """How many cameras there are, where they start, how close they may come, and what else of them is free."""

    cameras: int = Field(
        default=4,
        ge=1,
        le=_MOST_CAMERAS,
        description="cameras on the vehicle; of modules also the range in which their number may be, such as 2..8",
    )
    start: Annotated[str, Expectation(START_TEXT)] = Field(
        default="random", description=f"rig that the optimiser starts from: {START_TEXT}"
    )
    freeze: Annotated[
        tuple[str, ...],
        BeforeValidator(_read_names),
        PlainSerializer(list),
        Expectation(_NAMES_TEXT),
        WithJsonSchema({"anyOf": [{"type": "array", "items": {"type": "string"}}, {"type": "string"}]}),
    ] = Field(
        default=(),
        description="cameras of rig.start that stay as they are, by name: their places, directions and lenses; the "
        "others are optimised around them, and cameras that rig.start lacks for rig.cameras are added",
    )
    height_offset_m: Metres = Field(
        default=0.25, ge=0.0, le=2.0, description="height of the cameras above the mount surface"
    )
    min_spacing_m: Metres = Field(default=0.2, gt=0.0, le=5.0, description="minimum distance between two cameras")
    free: FreeConfig = Field(default=FreeConfig(), description="what is optimised besides x, y and yaw")
    fewest_cameras: int | None = Field(
        default=None,
        ge=1,
        le=_MOST_CAMERAS,
        description="cameras at least, where rig.cameras is the most; null: as many",
    )
    modules: (
        Annotated[
            Mapping[str, tuple[int, int]],
            BeforeValidator(_read_counts),
            PlainSerializer(lambda value: {name: _shown_count(pair) for name, pair in value.items()}),
            Expectation(_COUNTS_TEXT),
            WithJsonSchema({"type": "object", "additionalProperties": {"type": ["integer", "string"]}}),
        ]
        | None
    ) = Field(
        default=None,
        description="camera modules that the rig is made of, each with its number or a range of it; they stand in the "
        "zones that they fit; null: equal cameras as the section camera says",
    )
    catalogue: (
        Annotated[
            Path,
            BeforeValidator(_read_catalogue),
            PlainSerializer(str),
            Expectation("the path of a catalogue of modules"),
        ]
        | None
    ) = Field(default=None, description="catalogue of the modules; null: the one that ships with warpav")
    max_cost: float | None = Field(
        default=None, gt=0.0, description="what all cameras may cost together, in the unit of the catalogue"
    )
    symmetric: bool | None = Field(
        default=None,
        description="whether modules stand in mirrored pairs, or in the middle where a zone is centred; null: no",
    )

    @model_validator(mode="before")
    @classmethod
    def _counted(cls, data: object) -> object:
        """The ends of a range of cameras apart; without a number as many as the modules allow."""
        if not isinstance(data, dict):
            return data
        result, cameras, modules = dict(data), data.get("cameras"), data.get("modules")
        if isinstance(cameras, str) and ".." in cameras:
            least, most = _read_count(cameras, "a number of cameras from 1 to 16, or a range such as 2..8", "cameras")
            if data.get("fewest_cameras") not in (None, least):
                mistake(f"expected null where rig.cameras is {least}..{most}", "fewest_cameras", "cameras")
            result |= {"cameras": most, "fewest_cameras": least if least < most else None}
        elif cameras is None and isinstance(modules, Mapping) and modules:
            counts = [_read_count(count, _COUNTS_TEXT, "modules") for count in modules.values()]
            least, most = (sum(pair[end] for pair in counts) for end in range(2))
            if most > _MOST_CAMERAS:
                text = f"expected at most {_MOST_CAMERAS} cameras, or rig.cameras, got modules that allow {most}"
                mistake(text, "modules", "cameras")
            result |= {"cameras": max(most, 1), "fewest_cameras": max(least, 1) if least < most else None}
        return result

    @property
    def camera_range(self) -> tuple[int, int]:
        """The least and the greatest number of cameras."""
        return self.cameras if self.fewest_cameras is None else self.fewest_cameras, self.cameras
