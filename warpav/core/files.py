"""Files that are written whole: a reader sees the old content or the new, never a part."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from warpav.core.atomic_write import atomic_write
from warpav.core.errors import ArgumentError, WriteError


def write_text(file: Path, text: str) -> None:
    """Write a text in one step.

    Raises:
        WriteError: The file cannot be written.
    """
    with writing(file), atomic_write(file) as draft:
        draft.write_text(text, encoding="utf-8")


def write_json(file: Path, data: object) -> None:
    """Write data as JSON in one step; dataclasses and arrays are welcome, NaN becomes null.

    Raises:
        WriteError: The file cannot be written.
    """
    write_text(file, json.dumps(json_ready(data), indent=2, allow_nan=False) + "\n")


def append_line(file: Path, line: str) -> None:
    """Add a line to a file, whole or not at all, as far as a process that goes on can see to it.

    Raises:
        WriteError: The file cannot be written.
    """
    with writing(file), file.open("ab", buffering=0) as stream:
        before, left = stream.tell(), line.encode()
        try:
            while left:
                left = left[stream.write(left) :]  # a disk that is nearly full takes a part
        except OSError:
            with contextlib.suppress(OSError):
                stream.truncate(before)
            raise


def check_folder(folder: Path, option: str) -> None:
    """Reject a file where a folder is to be written; the error names ``option``.

    Raises:
        InputError: It is a file.
    """
    if folder.exists() and not folder.is_dir():
        raise ArgumentError(option, "expected a folder to write to, got a file", place=folder)


@contextlib.contextmanager
def writing(place: Path) -> Iterator[None]:
    """What keeps a file from being written is one line that names it."""
    try:
        yield
    except OSError as error:
        raise WriteError(f"{place}: expected a place to write to, got: {error.strerror}") from None


def json_ready(value: object) -> Any:  # noqa: ANN401
    """The value in JSON's own types: arrays become lists, numbers that are not finite become None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: json_ready(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): json_ready(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(inner) for inner in value]
    if hasattr(value, "tolist"):  # NumPy arrays and scalars
        return json_ready(value.tolist())  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value
