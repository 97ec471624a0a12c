"""Configurations from files and overrides, and back.

A file and the overrides are joined first and validated once, so that both have the same rules and the same messages.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from pydantic import BaseModel, ValidationError

from warpav.core.errors import InputError, OptionError
from warpav.core.section import move_option, renamed_options, shown, warn_renamed
from warpav.core.yaml_file import Location, read_yaml
from warpav.rig.find import is_preset
from warpav.runs.config.explain import COMMAND_LINE, explain, option_locations, option_values, place_of, placed
from warpav.runs.config.rig_options import NAMED_STARTS
from warpav.runs.config.schema import (
    CATALOGUE_FILE,
    EXTENDS,
    REQUIREMENTS_FILE,
    START_FILE,
    ZONES_FILE,
    ConfigTree,
    merged,
)
from warpav.runs.config.shipped import find_config
from warpav.scene.vehicles import SHIPPED, vehicle_file

if TYPE_CHECKING:
    from warpav import Placement

_PATH_MAX = 255
_MISTAKES_MAX = 50  # which messages list; a file may have a hundred thousand


class Config(ConfigTree):
    """Every option of warpav; what is left out is as in ``quick``, or with ``method: thesis`` as in ``thesis``."""

    @classmethod
    def load(cls, path: str | Path | None = None, *overrides: str) -> Config:
        """The configuration of a YAML file or a shipped name, such as ``quick``, with ``key=value`` overrides.

        Args:
            path: The file or the name; None: the defaults, which are those of ``quick``.
            overrides: Such as ``"rig.cameras=6"``; the value is read as YAML.

        Raises:
            InputError: Anything is wrong; one line a mistake.
        """
        return load_config(path, overrides, origin="override")

    def placement(self) -> Placement:
        """The placement that it describes; scenes and detector are loaded when they are first needed.

        Raises:
            InputError: The rig of ``rig.start`` cannot be used.
        """
        import warpav  # the face of the package, since what makes placements stands above

        return warpav.Placement.from_config(self)


def load_config(
    source: str | Path | Config | None = None, overrides: Sequence[str] = (), *, origin: str | None = COMMAND_LINE
) -> Config:
    """The configuration of a YAML file and ``key=value`` overrides.

    Args:
        source: A YAML file, the name of a shipped configuration (``quick``, ``thesis``), None for the defaults, or a
            configuration.
        overrides: Texts such as ``rig.cameras=6`` or ``scenes.test_seeds=[1, 2]``; the value is read as YAML.
        origin: What messages call the source of the overrides; None: they do not name it.

    Returns:
        The validated, immutable tree.

    Raises:
        InputError: Anything is wrong; one line per mistake, each with its place, its field, what was expected and
            what came.
    """
    file = None if source is None or isinstance(source, Config) else find_config(source)
    data, written_at = _read_file(file) if file else ({}, {})
    if isinstance(source, Config):
        data = source.model_dump(mode="json")
    kept = (("rig", "start", START_FILE), ("mount", "zones", ZONES_FILE), ("rig", "catalogue", CATALOGUE_FILE))
    for section, option, name in kept:
        values = data.get(section)
        if file and isinstance(values, dict) and values.get(option) == name and (file.parent / name).is_file():
            values[option] = str((file.parent / name).absolute())
    if file and data.get("requirements") == REQUIREMENTS_FILE and (file.parent / REQUIREMENTS_FILE).is_file():
        data["requirements"] = str((file.parent / REQUIREMENTS_FILE).absolute())
    override_of: dict[Location, str] = {}
    new_name = dict(renamed_options(Config))
    for override in overrides:
        place = _override_place(override, origin)
        location, value = _read_override(override, place)
        if location in new_name:
            warn_renamed(place, ".".join(location), ".".join(new_name[location]))
            location = new_name[location]
        override_of[location] = place
        _put(data, location, value, place)
    counts = {("rig", "cameras"), ("rig", "modules")} & {location[:2] for location in override_of}
    if counts == {("rig", "modules")} and data["rig"]["modules"]:  # they say how many there are
        data["rig"] = {name: value for name, value in data["rig"].items() if name not in ("cameras", "fewest_cameras")}
    elif ("rig", "cameras") in override_of and ("rig", "fewest_cameras") not in override_of:
        data["rig"].pop("fewest_cameras", None)
    try:
        return Config.model_validate(data)
    except ValidationError as error:
        found = error.errors(include_url=False)
        below = _to_indent([_location(each["loc"]) for each in found])
        said_above = set(itertools.chain(*below.values()))
        found = [each for each in found if _location(each["loc"]) not in said_above]
        lines = []
        for each in found[:_MISTAKES_MAX]:
            names = [location[-1] for location in below.get(_location(each["loc"]), ())]
            hint = f"; indent {' and '.join(names)} below it" if names else ""
            lines.append(explain(each, file, written_at, override_of) + hint)
        lines = list(dict.fromkeys(lines))
        if len(found) > _MISTAKES_MAX:
            lines.append(f"and {len(found) - _MISTAKES_MAX} more mistakes")
        raise InputError(*lines) from None


def _location(found: Sequence[int | str]) -> Location:
    return tuple(map(str, found))


def _to_indent(mistaken: Sequence[Location]) -> dict[Location, list[Location]]:
    """Sections that are mistakes, each with the mistakes beside it that are options of it, not indented."""
    options = set(option_locations(Config))
    sections = {option[:-1] for option in options if option[:-1]} & set(mistaken)
    beside = {
        section: [each for each in mistaken if each[:-1] == section[:-1] and (*section, *each[-1:]) in options]
        for section in sections
    }
    return {section: found for section, found in beside.items() if found}


def changed_config(config: Config, overrides: Sequence[str], *, origin: str | None = COMMAND_LINE) -> Config:
    """The configuration with other values for some options.

    Args:
        config: The configuration.
        overrides: As of :func:`load_config`.
        origin: What messages call the source of the overrides; None: they do not name it.

    Raises:
        InputError: An override is wrong, or does not fit the rest.
    """
    return load_config(config, overrides, origin=origin)


def with_absolute_paths(config: Config) -> Config:
    """The same configuration, whose files are found from every working directory; ``run.out`` stays as it is."""
    overrides = []
    for option, value in (
        ("scenes.folder", config.scenes.folder),
        ("scenes.ego", None if vehicle_file(config.scenes.ego or "") else config.scenes.ego),
        ("detector.model", None if config.detector.model == "builtin" else config.detector.model),
        ("detector.labels", config.detector.labels if isinstance(config.detector.labels, str) else None),
        ("rig.start", config.rig.start if _is_path(config.rig.start) else None),
        ("mount.zones", config.mount.zones),
        ("rig.catalogue", config.rig.catalogue),
        ("requirements", config.requirements_file),
    ):
        if value is not None:
            overrides.append(f"{option}={flow_text(str(Path(value).expanduser().absolute()))}")
    for option, paths in (
        ("scenes.recordings", config.scenes.recordings),
        ("scenes.test_recordings", config.scenes.test_recordings),
        ("baselines.rigs", config.baselines.rigs),
    ):
        if paths is not None:
            overrides.append(f"{option}={flow_text([str(path.expanduser().absolute()) for path in paths])}")
    vehicles = config.scenes.vehicles
    if vehicles is not None and any(path != SHIPPED for path in vehicles):
        found = [path if path == SHIPPED else str(Path(path).expanduser().absolute()) for path in vehicles]
        overrides.append(f"scenes.vehicles={flow_text(found)}")
    return changed_config(config, overrides) if overrides else config


def _is_path(start: str) -> bool:
    path = Path(start).expanduser()
    return start not in NAMED_STARTS and (path.is_file() or (path / "config.yaml").is_file())


def overridden_option(override: str) -> str:
    """The option's name in an override such as ``rig.cameras=6``.

    Raises:
        InputError: It is none.
    """
    return ".".join(_read_override(override, _override_place(override, COMMAND_LINE))[0])


@contextlib.contextmanager
def placed_config(path: str | Path, overrides: Sequence[str] = ()) -> Iterator[Config]:
    """The configuration as of :func:`load_config`, to be used inside a ``with`` block.

    An error about an option that only its use reveals names the file and line, or the override, like all others.

    Raises:
        InputError: As :func:`load_config`; and for every :class:`OptionError` of the block.
    """
    config = load_config(path, overrides)
    try:
        yield config
    except OptionError as error:
        file = find_config(path)
        override_of = {_read_override(each)[0]: _override_place(each, COMMAND_LINE) for each in overrides}
        place = place_of(tuple(error.option.split(".")), file, _read_file(file)[1], override_of)
        raise InputError(f"{place}: {error}") from None


def dump_config(config: Config) -> str:
    """The whole tree as YAML that :func:`load_config` reads back to an equal tree."""
    return yaml.dump(config.model_dump(mode="json"), Dumper=_FlowListDumper, sort_keys=False, allow_unicode=True)


_ABSENT = object()


def unset_options(config: Config) -> dict[str, object]:
    """The options and sections that `dump_config` leaves out because they are not set, with what holds without them."""

    def left_out(section: object, dumped: object, above: str) -> Iterator[tuple[str, object]]:
        if isinstance(section, BaseModel):
            names = list(type(section).model_fields)
        elif dataclasses.is_dataclass(section):
            names = [field.name for field in dataclasses.fields(section)]
        else:
            if dumped is _ABSENT:
                yield above, section
            return
        for name in names:
            there = dumped.get(name, _ABSENT) if isinstance(dumped, dict) else dumped
            yield from left_out(getattr(section, name), there, f"{above}.{name}".lstrip("."))

    return dict(left_out(config, config.model_dump(mode="json"), ""))


def overrides_from(base: Config, config: Config) -> list[str]:
    """The overrides that make one configuration of another, as :func:`load_config` takes them.

    Args:
        base: The configuration that is overridden.
        config: What it becomes.
    """
    before = option_values(base)
    changed = {name: value for name, value in option_values(config).items() if value != before[name]}
    return [f"{name}={flow_text(value)}" for name, value in changed.items()]


def flow_text(value: object) -> str:
    """A value as YAML on one line."""
    return yaml.safe_dump(value, default_flow_style=True, width=math.inf, allow_unicode=True).partition("\n")[0]


def _read_file(file: Path, above: tuple[Path, ...] = ()) -> tuple[dict[str, Any], dict[Location, str]]:
    """What a file says, on top of what the file says that its ``extends`` names, and where each option stands."""
    data, line_of = read_yaml(file)
    if data is not None and not isinstance(data, dict):
        raise InputError(f"{file}:1: expected sections such as 'rig: {{cameras: 4}}', got {shown(data)}")
    if data is not None and {"frame", "cameras"} <= data.keys():
        raise InputError(f"{file}: expected a configuration, got a rig file; rig.start={file} begins with it")
    data = data or {}
    written_at = {location: f"{file}:{line}" for location, line in line_of.items()}
    for old, new in renamed_options(Config):
        if move_option(data, old, new):
            written_at[new] = written_at.get(old, f"{file}:1")
            warn_renamed(written_at[new], ".".join(old), ".".join(new))
    base = data.pop(EXTENDS, None)
    if base is None:
        return data, written_at
    place = written_at[(EXTENDS,)]
    if not isinstance(base, str):
        raise InputError(f"{place}: {EXTENDS}: expected a YAML file or a shipped name such as quick, got {shown(base)}")
    if len(base) > _PATH_MAX or "\0" in base:
        raise InputError(f"{place}: {EXTENDS}: expected a YAML file or a shipped name, got a name that no file has")
    beside = file.parent / Path(base).expanduser()
    found = beside if beside.is_file() else _extended(base, place)
    if found.resolve() in (*above, file.resolve()):
        raise InputError(f"{place}: {EXTENDS}: expected a file that does not extend this one, got {base}")
    below, below_at = _read_file(found, (*above, file.resolve()))
    return merged(below, data), {**below_at, **written_at}


def _extended(name: str, place: str) -> Path:
    try:
        return find_config(name)
    except InputError as error:
        raise InputError(f"{place}: {EXTENDS}: {error}") from None


class _FlowListDumper(yaml.SafeDumper):
    """Dumper that writes lists on one line."""


_FlowListDumper.add_representer(
    list, lambda dumper, value: dumper.represent_sequence("tag:yaml.org,2002:seq", value, flow_style=True)
)


def _override_place(override: str, origin: str | None) -> str:
    """Where an override stands, for messages; empty where that needs no saying."""
    return "" if origin is None else f"{origin} ({override})"


def _read_override(override: str, place: str = COMMAND_LINE) -> tuple[Location, object]:
    key, equals, text = override.partition("=")
    location = tuple(part.strip() for part in key.split("."))
    if not equals or not all(location):
        near = difflib.get_close_matches(key, [".".join(name) for name in option_locations(Config)], 1, 0.6)
        hint = f"did you mean {near[0]}=...?" if near else "for example rig.cameras=6"
        if is_preset(key) or Path(key).suffix in (".yaml", ".yml"):
            hint = "a command takes one rig; plot compares it with those of --beside"
        raise InputError(placed(place, f"expected key=value, got {override!r}; {hint}"))
    return location, read_yaml(text, place or key)[0]


def _put(data: dict[str, Any], location: Location, value: object, place: str) -> None:
    for depth, part in enumerate(location[:-1], start=1):
        if data.get(part) is None:
            data[part] = {}
        data = data[part]
        if not isinstance(data, dict):
            outer = ".".join(location[:depth])
            raise InputError(placed(place, f"{outer}: expected a section, got {shown(data)} in the file"))
    data[location[-1]] = value
