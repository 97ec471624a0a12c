"""Types of options: what a file may say for a seed, a path, a range or a count, and how it is written back."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, PlainSerializer, WithJsonSchema
from pydantic_core import PydanticCustomError

from warpav.core.errors import InputError
from warpav.core.records import nearest
from warpav.core.section import (
    DEGREES_PER_UNIT,
    METRES_PER_UNIT,
    NUMBER_OR_TEXT,
    Expectation,
    mistake,
    range_reader,
    shown,
)
from warpav.core.yaml_file import read_yaml
from warpav.rig import HAND_RIGS, preset_names
from warpav.scene import LEVELS, ROAD_USERS, SHIPPED, Level, vehicle_file, vehicle_names
from warpav.sight import template_names

BY_HAND = "by_hand"
"""The start that is the best of some rigs by hand."""

NAMED_STARTS = (BY_HAND, "random", *HAND_RIGS)
"""What rig.start may be besides a rig."""

START_TEXT = f"{', '.join(NAMED_STARTS)}, a preset, a run folder or the path of a rig YAML"

AUTO = "auto"
"""Requirements that are the near field, as a term of the objective alone, where the search knows requirements."""

MAX_SEED = 2**31 - 1
_MAX_SEED_COUNT = 100_000
MOST_CAMERAS = 16

_TEXT_OR_TEXTS = {"anyOf": [{"type": "array", "items": {"type": "string"}}, {"type": "string"}]}


def _option(
    expected: str,
    read: Callable[[Any], object],
    write: Callable[[Any], object] | None = None,
    schema: Mapping[str, Any] | None = None,
) -> tuple[object, ...]:
    """What makes a type an option: how it is read and written, and what messages and editors know of it."""
    parts: list[object] = [BeforeValidator(read), Expectation(expected)]
    parts += [] if write is None else [PlainSerializer(write)]
    return (*parts, *([] if schema is None else [WithJsonSchema(dict(schema))]))


def _check_words(values: Sequence[object], known: Sequence[str], expected: str) -> None:
    for value in values:
        if value not in known:
            mistake(f"expected {expected}, got {shown(value)}{nearest(value, known)}")


# seeds

_SEEDS_TEXT = "seeds as a range such as 1000..1009 or a list such as [1, 2, 3]"


def _range_of(value: object) -> tuple[int, int] | None:
    match = re.fullmatch(r"\s*([0-9]+)\s*\.\.\s*([0-9]+)\s*", value) if isinstance(value, str) else None
    return (int(match[1]), int(match[2])) if match else None


def _read_seeds(value: object) -> tuple[int, ...]:
    seeds: list[int] = []
    for item in value if isinstance(value, (list, tuple)) else [value]:
        if ends := _range_of(item):
            first, last = ends
            if last < first:
                mistake(f"expected a range whose end is not below its start, got {item!r}; write {last}..{first}")
            if last > MAX_SEED or len(seeds) + last - first >= _MAX_SEED_COUNT:
                mistake(f"expected at most {_MAX_SEED_COUNT} seeds up to {MAX_SEED}, got {item!r}")
            seeds.extend(range(first, last + 1))
        elif isinstance(item, int) and not isinstance(item, bool):
            if not 0 <= item <= MAX_SEED:
                mistake(f"expected seeds from 0 to {MAX_SEED}, got {item}")
            seeds.append(item)
        else:
            mistake(f"expected {_SEEDS_TEXT}, got {shown(value)}")
    if not seeds:
        mistake(f"expected {_SEEDS_TEXT}, got none; at least one scene is needed")
    _check_once(seeds, "seed")
    return tuple(seeds)


def _check_once(values: Sequence[Any], noun: str) -> None:
    twice = [value for value, count in Counter(values).items() if count > 1]
    if twice:
        text = shown(str(twice[0])) if isinstance(twice[0], (str, Path)) else min(twice)
        mistake(f"expected every {noun} once, got {text} twice")


def read_seeds(text: str, place: str) -> tuple[int, ...]:
    """Seeds from a range such as ``1000..1009`` or a list such as ``[1, 2, 3]``; messages call it ``place``."""
    try:
        return _read_seeds(read_yaml(text, place)[0])
    except PydanticCustomError as error:
        raise InputError(f"{place}: {error.message()}") from None


def _shown_seeds(seeds: tuple[int, ...]) -> str | list[int]:
    if len(seeds) > 1 and seeds == tuple(range(seeds[0], seeds[0] + len(seeds))):
        return f"{seeds[0]}..{seeds[-1]}"
    return list(seeds)


_SEEDS_SCHEMA = {"anyOf": [{"type": "string"}, {"type": "integer"}, {"type": "array"}]}
Seeds = Annotated[tuple[int, ...], *_option(_SEEDS_TEXT, _read_seeds, _shown_seeds, _SEEDS_SCHEMA)]

# files and folders


def _read_path(value: object) -> object:
    if isinstance(value, str):
        if not value.strip():
            mistake(f"expected a path, got {value!r}")
        return Path(value).expanduser()
    return value


def _check_file(value: str, expected: str, words: Sequence[str] = ()) -> None:
    if not Path(value).expanduser().is_file():
        mistake(f"expected {expected}, got {value!r}{nearest(value, words) or '; no such file'}")


def _file(what: str, words: Callable[[], Sequence[str]] | None = None) -> tuple[object, ...]:
    """What makes a field the path of a file that exists, or a text that is one of some words or such a path."""

    def read(value: object) -> object:
        known = () if words is None else words()
        if isinstance(value, str) and value not in known:
            _check_file(value, f"{what}, or null" if words is None else what, known)
        return _read_path(value) if words is None else value

    return _option(what, read, str if words is None else None)


_MESH_FILE = "the path of a mesh file"


def _read_mesh_file(value: object) -> object:
    if isinstance(value, str) and vehicle_file(value) is None:
        names = [] if Path(value).suffix else vehicle_names()  # a file rather than a name
        text = f"{_MESH_FILE}, or null"
        _check_file(value, f"one of {', '.join(names)}, {text}" if names else text, names)
    return _read_path(value)


Folder = Annotated[Path, *_option("a folder", _read_path, str)]
MeshFile = Annotated[Path, *_option(_MESH_FILE, _read_mesh_file, str)]
ZonesFile = Annotated[Path, *_file("the path of a YAML file of zones")]
CatalogueFile = Annotated[Path, *_file("the path of a catalogue of modules")]
DetectorModel = Annotated[str, *_file("builtin or the path of an ONNX file", lambda: ["builtin"])]
Requirements = Annotated[
    str,
    *_file(
        "auto, the name of a template, such as near_field, or the path of a YAML file",
        lambda: [AUTO, *template_names()],
    ),
]


def _paths(expected: str, word: str | None = None) -> tuple[object, ...]:
    """What makes a field one path or several, all of which exist but for a word."""

    def read(value: object) -> object:
        paths = [value] if isinstance(value, str) else value
        if not isinstance(paths, (list, tuple)):
            return value
        if not paths:
            mistake(f"expected {expected}, got none")
        for path in paths:
            if isinstance(path, str) and path != word and not Path(path).expanduser().exists():
                hint = nearest(path, [word or ""]) or "; no such file or folder"
                mistake(f"expected {expected}, got {path!r}{hint}")
        found = [path if path == word else _read_path(path) for path in paths]
        if word is not None:
            _check_once([path for path in found if isinstance(path, (str, Path))], "path")
        return tuple(found)

    return _option(expected, read, lambda value: [str(path) for path in value], _TEXT_OR_TEXTS)


Recordings = Annotated[tuple[Path, ...], *_paths("paths of recorded traffic, such as [log.xml, recordings]")]


def _read_places(value: object) -> object:
    from warpav.scene import KNOWN_PLACES, recordings_of

    given = list(value) if isinstance(value, (list, tuple)) else [value]
    places = [place for place in given if isinstance(place, str)]
    if not places or len(places) < len(given):
        mistake(f"expected a list of places, such as [sind, town:dense], got {shown(value)}")
    for place in places:
        try:
            recordings_of(place)
        except InputError as error:
            mistake(str(error))
    _check_once(places, "place")
    return tuple(place if place in KNOWN_PLACES else str(_read_path(place)) for place in places)


Places = Annotated[tuple[str, ...], *_option("a list of places, such as [sind, town:dense]", _read_places)]
RigFiles = Annotated[tuple[Path, ...], *_paths("rig files or run folders, such as [present.yaml, first_rig]")]
Vehicles = Annotated[
    tuple[Literal["shipped"] | Path, ...],
    *_paths(f"{SHIPPED}, or paths of mesh files or of folders of these, such as [{SHIPPED}, my_vehicles]", SHIPPED),
]

# words

_TARGETS_TEXT = f"a list out of {', '.join(ROAD_USERS)}"


def _read_targets(value: object) -> tuple[str, ...]:
    targets = list(value) if isinstance(value, (list, tuple)) else [value]
    _check_words(targets, ROAD_USERS, _TARGETS_TEXT)
    if not targets:
        mistake(f"expected {_TARGETS_TEXT}, got none; targets must not be empty")
    return tuple(each for each in ROAD_USERS if each in targets)


_TARGETS_SCHEMA = {"type": "array", "items": {"enum": list(ROAD_USERS)}, "minItems": 1}
Targets = Annotated[tuple[str, ...], *_option(_TARGETS_TEXT, _read_targets, list, _TARGETS_SCHEMA)]


_LEVELS_TEXT = f"one of {', '.join(LEVELS)}, or a list of these"


def _read_levels(value: object) -> tuple[Any, ...]:
    levels = tuple(value) if isinstance(value, (list, tuple)) else (value,)
    _check_words(levels or (value,), LEVELS, _LEVELS_TEXT)
    return levels


def _shown_levels(levels: tuple[str, ...]) -> str | list[str]:
    return levels[0] if len(levels) == 1 else list(levels)


_LEVEL_SCHEMA = {"enum": list(LEVELS)}
_LEVELS_SCHEMA = {"anyOf": [_LEVEL_SCHEMA, {"type": "array", "items": _LEVEL_SCHEMA, "minItems": 1}]}
Levels = Annotated[tuple[Level, ...], *_option(_LEVELS_TEXT, _read_levels, _shown_levels, _LEVELS_SCHEMA)]


def _read_presets(value: object) -> object:
    if not isinstance(value, (list, tuple)):
        return value
    _check_words(value, preset_names(), f"presets out of {', '.join(preset_names())}")
    return tuple(value)


PresetNames = Annotated[tuple[str, ...], *_option("a list of presets, such as [nuscenes, argoverse2]", _read_presets)]


def _read_device(value: object) -> object:
    if not isinstance(value, str) or not re.fullmatch(r"cpu|cuda:[0-9]{1,2}", value):
        hint = "; write cuda:0 for the first GPU" if value in ("cuda", "gpu", "cuda0") else ""
        mistake(f"expected cpu or a GPU such as cuda:0, got {shown(value)}{hint}")
    return value


Device = Annotated[str, *_option("cpu or a GPU such as cuda:0", _read_device)]

_NAMES_TEXT = "a list of names of cameras of rig.start, such as [front, rear]"


def _read_names(value: object) -> tuple[Any, ...]:
    names = tuple(value) if isinstance(value, (list, tuple)) else (value,)
    for name in names:
        if not isinstance(name, str) or not name:
            mistake(f"expected {_NAMES_TEXT}, got {shown(value)}")
    _check_once(names, "name")
    return names


CameraNames = Annotated[tuple[str, ...], *_option(_NAMES_TEXT, _read_names, list, _TEXT_OR_TEXTS)]

# lists


def _as_tuple(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


def _list_of(expected: str) -> tuple[object, ...]:
    return _option(expected, _as_tuple, list)


Heights = Annotated[tuple[float, ...], *_list_of("a list of heights in metres, such as [14, 28, 45]")]
Distortion = Annotated[tuple[float, ...], *_list_of("a list of numbers, such as [-0.31, 0.11, 0.0, 0.0]")]
Labels = Annotated[tuple[str, ...], *_list_of("a list of labels of the detector, such as [car, bus]")]

_LABELS_TEXT = "a list of labels, such as [car, bus], or the path of a file with one a line"


def _read_labels(value: object) -> object:
    if isinstance(value, str):
        _check_file(value, _LABELS_TEXT)
    return _as_tuple(value)


LabelsOrFile = Annotated[
    tuple[str, ...] | str | None,
    *_option(_LABELS_TEXT, _read_labels, lambda value: list(value) if isinstance(value, tuple) else value),
]

# ranges and counts


def _range(unit_factor: Mapping[str, float], expected: str, low: float, high: float) -> tuple[object, ...]:
    pair = {"type": "array", "items": NUMBER_OR_TEXT, "minItems": 2, "maxItems": 2}
    return (
        range_reader(unit_factor, expected, low=low, high=high),
        PlainSerializer(lambda value: None if value is None else list(value)),
        Expectation(expected),
        WithJsonSchema({"anyOf": [pair, {"type": "null"}]}),
    )


Range = tuple[float, float] | None
_ORDER = "the lower one first, such as"
PitchRange = Annotated[
    Range, *_range(DEGREES_PER_UNIT, f"two angles from -60 deg to 60 deg, {_ORDER} [-20, 20]", -60.0, 60.0)
]
HeightRange = Annotated[Range, *_range(METRES_PER_UNIT, f"two heights from 0 m to 2 m, {_ORDER} [0.05, 0.4]", 0.0, 2.0)]
FovRange = Annotated[
    Range, *_range(DEGREES_PER_UNIT, f"two angles from 10 deg to 360 deg, {_ORDER} [60, 110]", 10.0, 360.0)
]

COUNTS_TEXT = "a mapping from modules to how many, such as {front_8mp_30: 1, fisheye_3mp_190: 0..4}"


def read_count(value: object, expected: str, *fields: str) -> tuple[int, int]:
    """A number such as 4, or a range such as ``2..8``; ``fields`` as of `mistake`."""
    pair = _range_of(value)
    if pair is None and isinstance(value, int) and not isinstance(value, bool):
        pair = value, value
    elif pair is None and isinstance(value, (list, tuple)) and len(value) == 2:
        pair = (value[0], value[1]) if all(isinstance(each, int) for each in value) else None
    if pair is None:
        mistake(f"expected {expected}, got {shown(value)}", *fields)
    if not 0 <= pair[0] <= pair[1] <= MOST_CAMERAS:
        text = f"expected numbers from 0 to {MOST_CAMERAS}, the lower one first"
        mistake(f"{text}, got {shown(value)}", *fields)
    return pair


def _read_counts(value: object) -> object:
    if not isinstance(value, Mapping):
        return value
    if not value:
        mistake(f"expected {COUNTS_TEXT}, got none")
    return {str(name): read_count(count, COUNTS_TEXT) for name, count in value.items()}


def _shown_counts(counts: Mapping[str, tuple[int, int]]) -> dict[str, int | str]:
    return {name: low if low == high else f"{low}..{high}" for name, (low, high) in counts.items()}


_COUNTS_SCHEMA = {"type": "object", "additionalProperties": {"type": ["integer", "string"]}}
ModuleCounts = Annotated[
    Mapping[str, tuple[int, int]], *_option(COUNTS_TEXT, _read_counts, _shown_counts, _COUNTS_SCHEMA)
]
