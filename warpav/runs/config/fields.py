"""Types of options: what a file may say for a seed, a path, a range or a count, and how it is written back."""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, PlainSerializer, WithJsonSchema
from pydantic_core import PydanticCustomError

from warpav.core.errors import InputError
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
from warpav.rig.presets import preset_names
from warpav.scene.scene import ROAD_USERS
from warpav.scene.vehicles import SHIPPED, vehicle_file, vehicle_names
from warpav.sight.templates import template_names

NAMED_STARTS = ("random", "highest")
"""What rig.start may be besides a rig."""

START_TEXT = "random, highest, a preset, a run folder or the path of a rig YAML"

AUTO = "auto"
"""Requirements that are the near field, as a term of the objective alone, where the search knows requirements."""

MAX_SEED = 2**31 - 1
_MAX_SEED_COUNT = 100_000
MOST_CAMERAS = 16


def _hint(value: object, words: Sequence[str], otherwise: str = "", cutoff: float = 0.6) -> str:
    near = difflib.get_close_matches(str(value), words, 1, cutoff)
    return f"; did you mean {near[0]}?" if near else otherwise


# seeds

_SEEDS_TEXT = "seeds as a range such as 1000..1009 or a list such as [1, 2, 3]"


def _range_of(value: object) -> tuple[int, int] | None:
    """The ends of a text such as ``2..8``; None for everything else."""
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
    twice = [seed for seed, count in Counter(seeds).items() if count > 1]
    if twice:
        mistake(f"expected every seed once, got {min(twice)} twice")
    return tuple(seeds)


def read_seeds(text: str, place: str) -> tuple[int, ...]:
    """Seeds from a range such as ``1000..1009`` or a list such as ``[1, 2, 3]``; messages call it ``place``."""
    try:
        return _read_seeds(read_yaml(text, place)[0])
    except PydanticCustomError as error:
        raise InputError(f"{place}: {error.message()}") from None


def _shown_seeds(seeds: tuple[int, ...]) -> str | list[int]:
    # as long as the seeds: sealed ones lie a billion apart
    if len(seeds) > 1 and seeds == tuple(range(seeds[0], seeds[0] + len(seeds))):
        return f"{seeds[0]}..{seeds[-1]}"
    return list(seeds)


Seeds = Annotated[
    tuple[int, ...],
    BeforeValidator(_read_seeds),
    PlainSerializer(_shown_seeds),
    Expectation(_SEEDS_TEXT),
    WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "integer"}, {"type": "array"}]}),
]

# files and folders


def _read_path(value: object) -> object:
    if isinstance(value, str):
        if not value.strip():
            mistake(f"expected a path, got {value!r}")
        return Path(value).expanduser()
    return value


def _check_file(value: str, expected: str, words: Sequence[str] = ()) -> None:
    """Reject a path at which there is no file; ``words`` may have been meant instead."""
    if not Path(value).expanduser().is_file():
        mistake(f"expected {expected}, got {value!r}{_hint(value, words, '; no such file')}")


def _file(what: str, or_what: str) -> tuple[object, ...]:
    """What makes a field the path of a file that exists."""

    def read(value: object) -> object:
        if isinstance(value, str):
            _check_file(value, f"{what}, {or_what}")
        return _read_path(value)

    return BeforeValidator(read), PlainSerializer(str), Expectation(what)


_MESH_FILE = "the path of a mesh file"


def _read_mesh_file(value: object) -> object:
    if isinstance(value, str) and vehicle_file(value) is None:
        names = [] if Path(value).suffix else vehicle_names()  # a file rather than a name
        text = f"{_MESH_FILE}, or null"
        _check_file(value, f"one of {', '.join(names)}, {text}" if names else text, names)
    return _read_path(value)


Folder = Annotated[Path, BeforeValidator(_read_path), PlainSerializer(str), Expectation("a folder")]
MeshFile = Annotated[Path, BeforeValidator(_read_mesh_file), PlainSerializer(str), Expectation(_MESH_FILE)]
ZonesFile = Annotated[Path, *_file("the path of a YAML file of zones", "or null")]
CatalogueFile = Annotated[Path, *_file("the path of a catalogue of modules", "or null")]


def _several(expected: str, read_one: Callable[[object], object], hint: Callable[[str], str]) -> tuple[object, ...]:
    """What makes a field one path or several, all of which exist but for words that ``hint`` knows no remedy for."""

    def read(value: object) -> object:
        paths = [value] if isinstance(value, str) else value
        if not isinstance(paths, (list, tuple)):
            return value
        if not paths:
            mistake(f"expected {expected}, got none")
        for path in paths:
            if isinstance(path, str) and (remedy := hint(path)) and not Path(path).expanduser().exists():
                mistake(f"expected {expected}, got {path!r}; {remedy}")
        return tuple(read_one(path) for path in paths)

    return (
        BeforeValidator(read),
        PlainSerializer(lambda value: [str(path) for path in value]),
        Expectation(expected),
        WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}}]}),
    )


def _not_there(path: str) -> str:
    del path
    return "no such file or folder"


Recordings = Annotated[
    tuple[Path, ...],
    *_several("paths of recorded traffic, such as [log.xml, recordings]", _read_path, _not_there),
]
RigFiles = Annotated[
    tuple[Path, ...],
    *_several("rig files or run folders, such as [present.yaml, first_rig]", _read_path, _not_there),
]


def _once(paths: object) -> object:
    twice = [path for path, count in Counter(paths if isinstance(paths, tuple) else ()).items() if count > 1]
    if twice:
        mistake(f"expected every path once, got {shown(str(twice[0]))} twice")
    return paths


def _no_vehicles(path: str) -> str:
    near = difflib.get_close_matches(path, [SHIPPED], 1, 0.6)
    return "" if path == SHIPPED else f"did you mean {near[0]}?" if near else _not_there(path)


Vehicles = Annotated[
    tuple[Literal["shipped"] | Path, ...],
    BeforeValidator(_once),
    *_several(
        f"{SHIPPED}, or paths of mesh files or of folders of these, such as [{SHIPPED}, my_vehicles]",
        lambda path: path if path == SHIPPED else _read_path(path),
        _no_vehicles,
    ),
]

# words out of lists


def _words(expected: str, known: Callable[[], Sequence[str]], cutoff: float = 0.6) -> Callable[[object], None]:
    def check(value: object) -> None:
        if value not in known():
            mistake(f"expected {expected}, got {shown(value)}{_hint(value, known(), cutoff=cutoff)}")

    return check


_TARGETS_TEXT = f"a list out of {', '.join(ROAD_USERS)}"


def _read_targets(value: object) -> tuple[str, ...]:
    targets = list(value) if isinstance(value, (list, tuple)) else [value]
    check = _words(_TARGETS_TEXT, lambda: ROAD_USERS)
    for target in targets:
        check(target)
    if not targets:
        mistake(f"expected {_TARGETS_TEXT}, got none; targets must not be empty")
    return tuple(each for each in ROAD_USERS if each in targets)


Targets = Annotated[
    tuple[str, ...],
    BeforeValidator(_read_targets),
    PlainSerializer(list),
    Expectation(_TARGETS_TEXT),
    WithJsonSchema({"type": "array", "items": {"enum": list(ROAD_USERS)}, "minItems": 1}),
]


def _read_presets(value: object) -> object:
    if not isinstance(value, (list, tuple)):
        return value
    check = _words(f"presets out of {', '.join(preset_names())}", preset_names, 0.5)
    for name in value:
        check(name)
    return tuple(value)


PresetNames = Annotated[
    tuple[str, ...], BeforeValidator(_read_presets), Expectation("a list of presets, such as [nuscenes, argoverse2]")
]
PresetImages = Annotated[
    Literal["same_pixels", "same_width", "sensor"], Expectation("same_pixels, same_width or sensor")
]


def _read_requirements(value: object) -> object:
    named = [AUTO, *template_names()]
    if isinstance(value, str) and value not in named:
        _check_file(value, f"one of {', '.join(named)}, or a YAML file", named)
    return value


Requirements = Annotated[
    str,
    BeforeValidator(_read_requirements),
    Expectation("auto, the name of a template, such as near_field, or the path of a YAML file"),
]


def _read_device(value: object) -> object:
    if not isinstance(value, str) or not re.fullmatch(r"cpu|cuda:[0-9]{1,2}", value):
        hint = "; write cuda:0 for the first GPU" if value in ("cuda", "gpu", "cuda0") else ""
        mistake(f"expected cpu or a GPU such as cuda:0, got {shown(value)}{hint}")
    return value


Device = Annotated[str, BeforeValidator(_read_device), Expectation("cpu or a GPU such as cuda:0")]


def _read_model(value: object) -> object:
    if isinstance(value, str) and value != "builtin":
        _check_file(value, "builtin or the path of an ONNX file", ["builtin"])
    return value


DetectorModel = Annotated[str, BeforeValidator(_read_model), Expectation("builtin or the path of an ONNX file")]

# lists


def _as_list(expected: str) -> tuple[object, ...]:
    """What makes a tuple of a list, and a list of a tuple where it is written."""
    return (
        BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value),
        PlainSerializer(list),
        Expectation(expected),
    )


Heights = Annotated[tuple[float, ...], *_as_list("a list of heights in metres, such as [14, 28, 45]")]
Distortion = Annotated[tuple[float, ...], *_as_list("a list of numbers, such as [-0.31, 0.11, 0.0, 0.0]")]
Labels = Annotated[tuple[str, ...], *_as_list("a list of labels of the detector, such as [car, bus]")]

_LABELS_TEXT = "a list of labels, such as [car, bus], or the path of a file with one a line"


def _read_labels(value: object) -> object:
    if isinstance(value, str):
        _check_file(value, _LABELS_TEXT)
        return value
    return tuple(value) if isinstance(value, list) else value


LabelsOrFile = Annotated[
    tuple[str, ...] | str | None,
    BeforeValidator(_read_labels),
    PlainSerializer(lambda value: list(value) if isinstance(value, tuple) else value),
    Expectation(_LABELS_TEXT),
]

_NAMES_TEXT = "a list of names of cameras of rig.start, such as [front, rear]"


def _read_names(value: object) -> tuple[Any, ...]:
    names = tuple(value) if isinstance(value, (list, tuple)) else (value,)
    for name in names:
        if not isinstance(name, str) or not name:
            mistake(f"expected {_NAMES_TEXT}, got {shown(value)}")
        if names.count(name) > 1:
            mistake(f"expected every name once, got {name!r} {names.count(name)} times")
    return names


CameraNames = Annotated[
    tuple[str, ...],
    BeforeValidator(_read_names),
    PlainSerializer(list),
    Expectation(_NAMES_TEXT),
    WithJsonSchema({"anyOf": [{"type": "array", "items": {"type": "string"}}, {"type": "string"}]}),
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


ModuleCounts = Annotated[
    Mapping[str, tuple[int, int]],
    BeforeValidator(_read_counts),
    PlainSerializer(_shown_counts),
    Expectation(COUNTS_TEXT),
    WithJsonSchema({"type": "object", "additionalProperties": {"type": ["integer", "string"]}}),
]
