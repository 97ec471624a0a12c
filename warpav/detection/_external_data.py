"""Where an ONNX file says that its weights lie, when they are not in it: beside it, or it is not loaded.

The file is protobuf. Its fields are walked without unpacking weights, and without the package onnx, which warpav itself
does not need.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from pathlib import Path

from warpav.core.bounded_files import LEVELS_MAX, is_inner_path, read_parts, refuse_levels
from warpav.core.errors import InputError

# fields that lead from a model to its tensors, by message: field number -> message
_BELOW = {
    "model": {7: "graph", 25: "function"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "function": {7: "node", 11: "attribute"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "tensor": {13: "entry"},
}
_KEY, _VALUE = 1, 2  # of an entry
_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5  # kinds of fields


def check_external_data(path: Path) -> None:
    """Make sure that weights outside of an ONNX file lie in its folder or below."""
    next(read_parts(path, "an ONNX file", part_bytes=1000), None)  # refuses what is none
    try:
        with path.open("rb") as file:
            content = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
        names = [bytes(location).decode() for location in _locations(content, "model", 0)]
    except OSError as error:
        raise InputError(f"{path}: expected an ONNX file, got: {error.strerror}") from None
    except InputError:
        raise
    except (ValueError, IndexError):
        raise InputError(f"{path}: not an ONNX file that onnxruntime can load: it is empty or damaged") from None
    outside = next((name for name in names if not is_inner_path(name)), None)
    if outside is not None:
        raise InputError(
            f"{path}: expected weights in the file itself or beside it, got the file {outside!r}; save the network "
            "again with all weights in one file"
        )


def _locations(content: memoryview, message: str, level: int) -> Iterator[memoryview]:
    """The values of all entries ``location`` below a message."""
    if level > 2 * LEVELS_MAX:
        refuse_levels("graph")
    if message == "entry":
        fields = dict(_fields(content))
        if fields.get(_KEY) == b"location":
            yield fields.get(_VALUE, memoryview(b""))
        return
    below = _BELOW[message]
    for number, value in _fields(content):
        if number in below:
            yield from _locations(value, below[number], level + 1)


def _fields(content: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Number and bytes of the fields that have any."""
    at = 0
    while at < len(content):
        tag, at = _varint(content, at)
        kind = tag & 7
        if kind == _VARINT:
            _, at = _varint(content, at)
        elif kind in (_EIGHT, _FOUR):
            at += 8 if kind == _EIGHT else 4
        elif kind == _BYTES:
            length, at = _varint(content, at)
            yield tag >> 3, content[at : at + length]
            at += length
        else:
            raise ValueError(f"a field of kind {kind}")
    if at > len(content):
        raise ValueError("cut off")


def _varint(content: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        byte = content[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
    raise ValueError("a number of more than 64 bits")
