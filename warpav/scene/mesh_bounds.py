"""Bounds of mesh files, held before trimesh reads them: it takes what they state at its word."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from warpav.core.bounded_files import (
    ARRAY_BYTES_MAX,
    BYTES_MAX,
    DATA_SET_BYTES_MAX,
    DATA_SET_NODES_MAX,
    parse_json,
    parse_xml,
    read_bytes,
)
from warpav.core.errors import InputError

TRIANGLES_MAX = 5_000_000
"""Triangles of a file, counted at every node that shows them."""
_LINES_MAX, _LINE_BYTES_MAX = 2_000_000, 1_000_000
_TEXT_FORMATS = ("obj", "off", "dae", "gltf")
_COMPONENT_COUNT = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_GLB_HEAD = 20  # bytes before the JSON


def bounded_mesh(file: Path, suffix: str, place: str) -> bytes:
    """The content of a mesh file, once it is known to be within bounds."""
    kind = f"a readable {suffix} file"
    content = read_bytes(file, kind, bytes_max=DATA_SET_BYTES_MAX)
    try:
        if suffix in _TEXT_FORMATS or content.startswith(b"solid") or b"format ascii" in content[:1000]:
            _check_text(content, has_short_lines=suffix in ("obj", "off", "ply"))
        if suffix == "dae":
            parse_xml(content, "", "COLLADA", nodes_max=DATA_SET_NODES_MAX)
        elif suffix == "gltf":
            _check_document(content)
        elif suffix == "glb" and content.startswith(b"glTF"):
            _check_document(content[_GLB_HEAD : _GLB_HEAD + int.from_bytes(content[12:16], "little")])
    except InputError as error:
        raise InputError(f"{place}: expected {kind}, got: {error}; export it again") from None
    return content


def _check_text(content: bytes, *, has_short_lines: bool) -> None:
    if len(content) > BYTES_MAX:
        raise InputError(f"more than {BYTES_MAX // 1_000_000} MB of text")
    lines = content.split(b"\n")
    if len(lines) > _LINES_MAX:
        raise InputError(f"more than {_LINES_MAX:,} lines")
    if has_short_lines and max(map(len, lines)) > _LINE_BYTES_MAX:
        raise InputError(f"a line of more than {_LINE_BYTES_MAX:,} characters")


def _check_document(content: bytes) -> None:
    """Check the JSON of a glTF file: trimesh takes memory for what it states."""
    document = parse_json(content.rstrip(b"\0"), "", "a glTF document", nodes_max=DATA_SET_NODES_MAX)
    if _stated_bytes(document) > ARRAY_BYTES_MAX:
        raise InputError(f"arrays of more than {ARRAY_BYTES_MAX // 1_000_000} MB")


def _stated_bytes(document: Any) -> float:  # noqa: ANN401 (JSON)
    """What the arrays of a glTF document take, each counted where it is named; infinite where that cannot be told."""
    total = 0.0
    try:
        for view in document.get("bufferViews", ()):
            total += _size(view["byteLength"])
        for accessor in document.get("accessors", ()):
            total += 8.0 * _COMPONENT_COUNT[accessor["type"]] * _size(accessor["count"])
    except (AttributeError, KeyError, TypeError):
        return 0.0  # it is no glTF, which trimesh says better
    return total


def _size(count: object) -> float:
    return float(count) if isinstance(count, int) and count >= 0 else math.inf
