"""Configurations from files and overrides, and back.

A file and the overrides are joined first and validated once, so that both have the same rules and the same messages.
"""

from __future__ import annotations

import contextlib
import difflib
import functools
import itertools
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from pydantic import BaseModel, ValidationError

from warpav.core.errors import InputError, OptionError
from warpav.core.records import schema_of
from warpav.core.section import move_option, renamed_options, shown, warn_renamed
from warpav.core.yaml_file import Location, read_yaml
from warpav.rig import ModulesForm, RigForm, ZonesForm, is_preset
from warpav.runs.config._explain import COMMAND_LINE, explain, option_locations, option_values, place_of, placed
from warpav.runs.config._fields import NAMED_STARTS
from warpav.runs.config._schema import EXTENDS, KEPT_FILES, ConfigTree, find_config, merged
from warpav.scene import vehicle_file
from warpav.sight import RequirementsForm

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

    def replace(self, values: Mapping[str, object]) -> Config:
        """The same configuration with other values for some options, checked once.

        Args:
            values: By the option's dotted name, such as ``{"rig.cameras": 6}``, as files have them.

        Raises:
            InputError: A value is wrong, or does not fit the rest; one line a mistake.
        """
        if not values:
            return self
        data = self.model_dump(mode="json")
        locations = {tuple(name.split(".")): "" for name in values}
        for location, value in zip(locations, values.values(), strict=True):
            _put(data, location, value, "")
        return _validated(data, None, {}, locations)

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
    """The configuration of a YAML file and ``key=value`` overrides, joined first and validated once.

    ``source`` is a file, a shipped name, a configuration, or None for the defaults; messages call where the overrides
    come from ``origin``, or do not.
    """
    file = None if source is None or isinstance(source, Config) else find_config(source)
    data, written_at = _read_file(file) if file else ({}, {})
    if isinstance(source, Config):
        data = source.model_dump(mode="json")
    beside = KEPT_FILES if file else {}
    for option, name in beside.items():
        *sections, last = option.split(".")
        values: Any = data
        for section in sections:
            values = values.get(section)
        if isinstance(values, dict) and values.get(last) == name and (kept := Path(file or "").parent / name).is_file():
            values[last] = str(kept.absolute())
    override_of: dict[Location, str] = {}
    new_name = dict(renamed_options(Config))
    for override in overrides:
        place = _override_place(override, origin)
        location, value = _read_override(override, place)
        for old, new in new_name.items():
            if location[: len(old)] == old:
                warn_renamed(place, ".".join(old), ".".join(new))
                location = (*new, *location[len(old) :])
        override_of[location] = place
        _put(data, location, value, place)
    return _validated(data, file, written_at, override_of)


def _validated(
    data: dict[str, Any], file: Path | None, written_at: Mapping[Location, str], override_of: Mapping[Location, str]
) -> Config:
    counts = {("rig", "cameras"), ("rig", "modules")} & {location[:2] for location in override_of}
    if counts == {("rig", "modules")} and data["rig"]["modules"]:  # they say how many there are
        data["rig"] = {name: value for name, value in data["rig"].items() if name not in ("cameras", "fewest_cameras")}
    elif ("rig", "cameras") in override_of and ("rig", "fewest_cameras") not in override_of:
        data["rig"].pop("fewest_cameras", None)
    try:
        return Config.model_validate(data)
    except ValidationError as error:
        found = error.errors(include_url=False)
    located = [(tuple(map(str, each["loc"])), each) for each in found]
    below = _to_indent([location for location, _ in located])
    said_above = set(itertools.chain(*below.values()))
    found = [each for each in located if each[0] not in said_above]
    lines = []
    for at, each in found[:_MISTAKES_MAX]:
        names = [location[-1] for location in below.get(at, ())]
        hint = f"; indent {' and '.join(names)} below it" if names else ""
        lines.append(explain(each, file, written_at, override_of) + hint)
    lines = list(dict.fromkeys(lines))
    if len(found) > _MISTAKES_MAX:
        lines.append(f"and {len(found) - _MISTAKES_MAX} more mistakes")
    raise InputError(*lines)


def _to_indent(mistaken: Sequence[Location]) -> dict[Location, list[Location]]:
    """Sections that are mistakes, each with the mistakes beside it that are options of it, not indented."""
    options = set(option_locations(Config))
    sections = {option[:-1] for option in options if option[:-1]} & set(mistaken)
    beside = {
        section: [each for each in mistaken if each[:-1] == section[:-1] and (*section, *each[-1:]) in options]
        for section in sections
    }
    return {section: found for section, found in beside.items() if found}


def with_absolute_paths(config: Config) -> Config:
    """The same configuration, whose files are found from every working directory; ``run.out`` stays as it is."""

    def whole(value: object) -> object:
        if isinstance(value, tuple):
            return [whole(each) for each in value]
        return str(value.expanduser().absolute()) if isinstance(value, Path) else value

    def has_path(value: object) -> bool:
        return any(isinstance(each, Path) for each in (value if isinstance(value, tuple) else (value,)))

    values = {".".join(at): functools.reduce(getattr, at, config) for at in option_locations(Config)}
    start = Path(config.rig.start).expanduser()
    texts = {  # options that may be a path, or else a word
        "detector.model": config.detector.model != "builtin",
        "detector.labels": isinstance(config.detector.labels, str),
        "rig.start": config.rig.start not in NAMED_STARTS and (start.is_file() or (start / "config.yaml").is_file()),
        "requirements": config.requirements_file is not None,
    }
    values |= {name: Path(str(values[name])) for name, is_path in texts.items() if is_path}
    del values["run.out"]
    if vehicle_file(config.scenes.ego or ""):
        del values["scenes.ego"]
    return config.replace({name: whole(value) for name, value in values.items() if has_path(value)})


def overridden_option(override: str) -> str:
    """The option's name in an override such as ``rig.cameras=6``."""
    return ".".join(_read_override(override, _override_place(override, COMMAND_LINE))[0])


@contextlib.contextmanager
def placed_config(path: str | Path, overrides: Sequence[str] = ()) -> Iterator[Config]:
    """The configuration as of :func:`load_config`, to be used inside a ``with`` block."""
    config = load_config(path, overrides)
    try:
        yield config
    except OptionError as error:
        file = find_config(path)
        override_of = {_read_override(each)[0]: _override_place(each, COMMAND_LINE) for each in overrides}
        place = place_of(tuple(error.option.split(".")), file, _read_file(file)[1], override_of)
        raise InputError(f"{place}: {error}") from None


def dump_config(
    config: Config, *, kept: Mapping[str, object] | None = None, only: Collection[str] | None = None
) -> str:
    """The whole tree as YAML that `load_config` reads back to an equal tree, or some options of it.

    ``kept`` replaces options, and ``only`` names those that are written.
    """
    data = config.model_dump(mode="json") if only is None else {}
    chosen = {name: value for name, value in option_values(config).items() if only is not None and name in only}
    for option, value in {**chosen, **(kept or {})}.items():
        _put(data, tuple(option.split(".")), value, "")
    return yaml.dump(data, Dumper=_FlowListDumper, sort_keys=False, allow_unicode=True)


def overrides_from(base: Config, config: Config) -> list[str]:
    """The overrides that make one configuration of another, as :func:`load_config` takes them."""
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
            written_at |= {(*new, *at[len(old) :]): line for at, line in written_at.items() if at[: len(old)] == old}
            written_at.setdefault(new, f"{file}:1")
            warn_renamed(written_at[new], ".".join(old), ".".join(new))
    base = data.pop(EXTENDS, None)
    if base is None:
        return data, written_at
    place = written_at[(EXTENDS,)]
    if not isinstance(base, str):
        raise InputError(f"{place}: {EXTENDS}: expected a YAML file or a shipped name such as quick, got {shown(base)}")
    if len(base) > _PATH_MAX or "\0" in base:
        raise InputError(f"{place}: {EXTENDS}: expected a YAML file or a shipped name, got a name that no file has")
    found = file.parent / Path(base).expanduser()
    if not found.is_file():
        try:
            found = find_config(base)
        except InputError as error:
            raise InputError(f"{place}: {EXTENDS}: {error}") from None
    if found.resolve() in (*above, file.resolve()):
        raise InputError(f"{place}: {EXTENDS}: expected a file that does not extend this one, got {base}")
    below, below_at = _read_file(found, (*above, file.resolve()))
    return merged(below, data), {**below_at, **written_at}


class _FlowListDumper(yaml.SafeDumper):
    """Dumper that writes lists on one line."""


_FlowListDumper.add_representer(
    list, lambda dumper, value: dumper.represent_sequence("tag:yaml.org,2002:seq", value, flow_style=True)
)


def _override_place(override: str, origin: str | None) -> str:
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


def file_schema(of: str) -> dict[str, Any]:
    """The JSON Schema of a kind of file that people write, by which editors complete and check it, draft 2020-12."""
    schemas: dict[str, tuple[type[BaseModel], str]] = {
        "config": (Config, "configuration of a run"),
        "rig": (RigForm, "rig of cameras"),
        "modules": (ModulesForm, "catalogue of camera modules"),
        "zones": (ZonesForm, "zones of a vehicle's body that may carry cameras"),
        "requirements": (RequirementsForm, "requirements on the ground around a vehicle"),
    }
    form, title = schemas[of]
    return schema_of(form, of, title)
