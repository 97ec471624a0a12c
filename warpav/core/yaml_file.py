"""Strict reading of YAML: plain data with the line of every value, so that messages can point at it."""

from __future__ import annotations

import re
import typing
from pathlib import Path
from typing import Any

import yaml

from warpav.core.errors import InputError

Location = tuple[str, ...]
"""Where a value stands: the keys and list indices that lead to it, as text."""

_MAX_DEPTH = 12
_PLAIN_TAGS = {f"tag:yaml.org,2002:{name}" for name in ("map", "seq", "null", "bool", "int", "float", "str")}


class _Yaml12Loader(yaml.SafeLoader):
    """Safe loader whose plain scalars follow YAML 1.2."""

    yaml_implicit_resolvers: typing.ClassVar[dict] = {}  # pyright: ignore[reportIncompatibleVariableOverride]

    def construct_decimal(self, node: yaml.ScalarNode) -> int:
        return int(node.value)


for _tag, _pattern, _first in (
    ("tag:yaml.org,2002:null", r"", ""),
    ("tag:yaml.org,2002:null", r"~|null|Null|NULL", "~nN"),
    ("tag:yaml.org,2002:bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("tag:yaml.org,2002:int", r"[-+]?[0-9]+", "-+0123456789"),
    (
        "tag:yaml.org,2002:float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+.0123456789",
    ),
):
    _Yaml12Loader.add_implicit_resolver(_tag, re.compile(f"^(?:{_pattern})$"), list(_first) or [""])
_Yaml12Loader.add_constructor("tag:yaml.org,2002:int", _Yaml12Loader.construct_decimal)


def read_yaml(source: Path | str, place: str | None = None) -> tuple[Any, dict[Location, int]]:
    """The data in a YAML file or a YAML text, and the line (from 1) of every value.

    Numbers follow YAML 1.2 (``1e-3`` is a number, ``no`` and ``1:30`` are text); keys are always text.

    Args:
        source: The file, or a text of one document, which messages quote without lines.
        place: What messages call the source; None: by the file's name.

    Returns:
        None, bool, int, float, str, list and dict; the line of every key and list item.

    Raises:
        InputError: The file cannot be read, the text is not YAML, or a key is there twice.
    """
    line_of: dict[Location, int] = {}
    has_lines = isinstance(source, Path)
    place = str(source) if place is None else place
    try:
        text = source.read_text(encoding="utf-8") if isinstance(source, Path) else source
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise InputError(f"{place}: expected a readable YAML file, got: {reason}") from None

    def at(line: int) -> str:
        return f"{place}:{line}" if has_lines else place

    def plain(loader: _Yaml12Loader, node: yaml.Node, location: Location) -> Any:  # noqa: ANN401
        line = node.start_mark.line + 1
        line_of.setdefault(location, line)
        if len(location) > _MAX_DEPTH:
            raise InputError(f"{at(line)}: expected at most {_MAX_DEPTH} levels, got more")
        if node.tag not in _PLAIN_TAGS:
            raise InputError(f"{at(line)}: {dotted(location)}: expected plain YAML, got the tag {node.tag!r}")
        if isinstance(node, yaml.MappingNode):
            mapping: dict[str, Any] = {}
            for key_node, value_node in node.value:
                inner = (*location, str(key_node.value))
                if inner[-1] in mapping:
                    raise InputError(
                        f"{at(key_node.start_mark.line + 1)}: {dotted(inner)}: expected every key once, "
                        f"got it again (first in line {line_of[inner]})"
                    )
                line_of[inner] = key_node.start_mark.line + 1
                mapping[inner[-1]] = plain(loader, value_node, inner)
            return mapping
        if isinstance(node, yaml.SequenceNode):
            return [plain(loader, item, (*location, str(i))) for i, item in enumerate(node.value)]
        return loader.construct_object(node)

    try:
        loader = _Yaml12Loader(text)
        try:
            node = loader.get_single_node()
            return (None if node is None else plain(loader, node, ())), line_of
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        where = at(error.problem_mark.line + 1) if error.problem_mark else place
        problem = " ".join(str(error.problem or error.context).split())
        raise InputError(f"{where}: expected valid YAML, got a syntax error: {problem}") from None
    except yaml.YAMLError as error:
        raise InputError(f"{place}: expected valid YAML, got: {' '.join(str(error).split())}") from None


def dotted(location: Location) -> str:
    """The location as messages write it: ``cameras[2].yaw_deg``."""
    text = "".join(f"[{part}]" if part.isdigit() else f".{part}" for part in location)
    return text.removeprefix(".")
