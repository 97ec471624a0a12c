"""Strict reading of YAML: plain data with the line of every value, so that messages can point at it.

Bounds are those of `warpav.core.bounded_files`, held while libyaml parses, event by event.
"""

from __future__ import annotations

import math
import re
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from yaml.composer import Composer
from yaml.constructor import SafeConstructor
from yaml.cyaml import CParser  # pyright: ignore[reportAttributeAccessIssue]  # not in its hints
from yaml.resolver import Resolver

from warpav.core.bounded_files import (
    DIGITS_MAX,
    LEVELS_MAX,
    NODES_MAX,
    read_text,
    refuse_digits,
    refuse_levels,
    refuse_nodes,
)
from warpav.core.errors import InputError

Location = tuple[str, ...]
"""Where a value stands: the keys and list indices that lead to it, as text."""

_END = re.compile(r"\n---\s*\Z")
"""What follows every message of a ROS topic; to YAML another document begins there."""
_PLAIN_TAGS = {f"tag:yaml.org,2002:{name}" for name in ("map", "seq", "null", "bool", "int", "float", "str")}


class _Yaml12Loader(Composer, CParser, SafeConstructor, Resolver):  # pyright: ignore[reportIncompatibleMethodOverride]
    """Safe loader whose plain scalars follow YAML 1.2, and which stops at the bounds of nodes and levels."""

    yaml_implicit_resolvers: typing.ClassVar[dict] = {}  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(self, text: str, at: Callable[[int], str]) -> None:
        CParser.__init__(self, text)
        for part in (Composer, SafeConstructor, Resolver):
            part.__init__(self)
        self._at, self._values, self._levels = at, 0, 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:  # noqa: ANN401
        self._values += index is not None  # else it is a key, or the whole
        self._levels += 1
        if self._values > NODES_MAX:
            refuse_nodes(self._at(self.peek_event().start_mark.line + 1))
        if self._levels > LEVELS_MAX + 1:  # the file itself is one of them
            refuse_levels(self._at(self.peek_event().start_mark.line + 1))
        node = super().compose_node(parent, index)
        self._levels -= 1
        return node

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
    """The data in a YAML 1.2 file or text, keys always text, and the line (from 1) of every value."""
    line_of: dict[Location, int] = {}
    has_lines = isinstance(source, Path)
    if place is None:
        place = str(source) if has_lines else f"{source:.60}"
    text = read_text(source, "a readable YAML file") if isinstance(source, Path) else _whole_text(source, place)
    if text.startswith("%YAML:"):  # as OpenCV writes it; to YAML it is a mistake
        text = f"#{text}"
    text = _END.sub("\n", text)
    node_count = 0

    def at(line: int) -> str:
        return f"{place}:{line}" if has_lines else place

    def plain(loader: _Yaml12Loader, node: yaml.Node, location: Location) -> Any:  # noqa: ANN401
        nonlocal node_count
        line = node.start_mark.line + 1
        line_of.setdefault(location, line)
        node_count += 1  # of an alias again wherever it stands
        if node_count > NODES_MAX:
            refuse_nodes(at(line))
        if len(location) >= LEVELS_MAX and not isinstance(node, yaml.ScalarNode):
            refuse_levels(at(line))
        if node.tag not in _PLAIN_TAGS:
            raise InputError(f"{at(line)}: {dotted(location)}: expected plain YAML, got the tag {node.tag!r}")
        if isinstance(node, yaml.MappingNode):
            mapping: dict[str, Any] = {}
            for key_node, value_node in node.value:
                if not isinstance(key_node, yaml.ScalarNode):
                    raise InputError(f"{at(line)}: expected texts as keys, got a list or a mapping")
                inner = (*location, _whole_text(key_node.value, at(line)))
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
        if node.tag == "tag:yaml.org,2002:int" and len(node.value) > DIGITS_MAX:
            refuse_digits(f"{at(line)}: {dotted(location)}" if location else at(line))
        value = loader.construct_object(node)
        return _whole_text(value, at(line)) if isinstance(value, str) else value

    try:
        loader = _Yaml12Loader(text, at)
        try:
            node = loader.get_single_node()
            return (None if node is None else plain(loader, node, ())), line_of
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        where = at(error.problem_mark.line + 1) if error.problem_mark else place
        if "nesting depth" in str(error.problem):  # of libyaml, which scans ahead
            refuse_levels(where)
        problem = " ".join(str(error.problem or error.context).split())
        raise InputError(f"{where}: expected valid YAML, got a syntax error: {problem}") from None
    except yaml.YAMLError as error:
        raise InputError(f"{place}: expected valid YAML, got: {' '.join(str(error).split())}") from None


def _whole_text(text: str, place: str) -> str:
    if not text.isascii() and any("\ud800" <= each <= "\udfff" for each in text):
        raise InputError(
            f"{place}: expected text, got half of a character, such as \\ud800 alone; if it is of a path that is not "
            "UTF-8, rename that, or set LC_ALL=C.UTF-8"
        )
    return text


def yaml_name(name: str) -> str:
    """A name as YAML, in quotes unless it is plainly text; ``no``, ``1e3``, ``2026-01-01`` and ``a: b`` are not."""
    is_plain = _PLAIN.fullmatch(name) and name.casefold() not in _WORDS and read_yaml(name)[0] == name
    return name if is_plain else yaml.safe_dump(name, default_style='"', width=math.inf).rstrip()


def yaml_lines(value: Mapping[str, Any] | Sequence[Any], indent: str = "") -> Iterator[str]:
    """Lines of nested mappings and lists whose leaves are YAML already, such as ``[1.0, 2.0]``; None is left out."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            if isinstance(inner, (Mapping, list)):
                yield f"{indent}{key}:"
                yield from yaml_lines(inner, f"{indent}  ")
            elif inner is not None:
                yield f"{indent}{key}: {inner}"
        return
    for item in value:
        first, *others = [f"{indent}  {item}"] if isinstance(item, str) else yaml_lines(item, f"{indent}  ")
        yield f"{indent}- {first.lstrip()}"
        yield from others


def yaml_number(value: float, decimals: int | None = None) -> str:
    """A number as every YAML reader wants it, a point before any exponent: in full, or rounded in its shortest form."""
    if decimals is None:
        text = repr(float(value))
        return text if "." in text else text.replace("e", ".0e")
    text = f"{value:.{decimals}f}".rstrip("0")
    text += "0" if text.endswith(".") else ""
    return "0.0" if text == "-0.0" else text


def yaml_row(values: Iterable[float], decimals: int | None = None) -> str:
    """Numbers as a list of YAML on one line."""
    return f"[{', '.join(yaml_number(value, decimals) for value in values)}]"


_PLAIN = re.compile(r"[^\W\d_][\w.-]*( [\w.-]+)*")
_WORDS = {"y", "n", "yes", "no", "on", "off", "true", "false", "null"}


def dotted(location: Location) -> str:
    """The location as messages write it: ``cameras[2].yaw_deg``."""
    text = "".join(f"[{part}]" if part.isdigit() else f".{part}" for part in location)
    return text.removeprefix(".")
