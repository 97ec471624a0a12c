"""Files that appear whole or not at all, and folders that one process at a time writes to."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import json
import math
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from warpav.core.errors import ArgumentError, WriteError

DRAFT = ".draft-"
"""How the names of files begin that are not whole yet."""
_TAKEN = (errno.EAGAIN, errno.EACCES)


def sync(path: Path) -> None:
    """Wait until a file, or the list of files of a folder, is on the disk; a file that does not exist is none."""
    with contextlib.suppress(FileNotFoundError):
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextlib.contextmanager
def atomic_write(file: Path, *, is_durable: bool = False) -> Iterator[Path]:
    """A path to write to; the file takes its place in one step when the block ends well, else it is removed.

    A device or a pipe stays what it is and is given the content. A durable file is on the disk when this returns.
    """
    name = f"{DRAFT}{secrets.token_hex(4)}-{file.name}"
    if file.exists() and not (file.is_file() or file.is_dir()):
        with tempfile.TemporaryDirectory() as folder:
            yield Path(folder) / name
            with (Path(folder) / name).open("rb") as draft_stream, file.open("wb") as stream:
                shutil.copyfileobj(draft_stream, stream)
        return
    draft = file.with_name(name)
    try:
        yield draft
        if is_durable:
            sync(draft)
        os.replace(draft, file)
        if is_durable:
            sync(file.parent)
    finally:
        with contextlib.suppress(OSError):  # what went wrong before matters more
            draft.unlink()


@contextlib.contextmanager
def writing(place: Path) -> Iterator[None]:
    """What keeps a file from being written is a `WriteError`, one line that names it."""
    try:
        yield
    except OSError as error:
        raise WriteError(f"{place}: expected a place to write to, got: {error.strerror}") from None


def check_parent(file: Path | None, option: str) -> None:
    """Refuse a file to write, the value of an option, whose folder does not exist."""
    if file is not None and not file.absolute().parent.is_dir():
        raise ArgumentError(option, f"expected an existing folder to write to, got {str(file.parent)!r}", place=file)


def write_text(file: Path, text: str) -> None:
    """Write a text in one step; raises `WriteError`."""
    with writing(file), atomic_write(file) as draft:
        draft.write_text(text, encoding="utf-8")


def write_json(file: Path, data: object) -> None:
    """Write data as JSON in one step; dataclasses and arrays are welcome, NaN becomes null. Raises `WriteError`."""
    write_text(file, json.dumps(json_ready(data), indent=2, allow_nan=False) + "\n")


def append_line(file: Path, line: str) -> None:
    """Add a line to a file, whole or not at all, as far as a process that goes on can see to it."""
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
    """Reject a file where a folder is to be written; the `InputError` names ``option``."""
    if folder.exists() and not folder.is_dir():
        raise ArgumentError(option, "expected a folder to write to, got a file", place=folder)


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
    return str(value) if isinstance(value, Path) else value


@contextlib.contextmanager
def held_folder(folder: Path) -> Iterator[bool]:
    """Hold a folder that exists while the block runs; whether nobody else did (on NFS everybody may)."""
    try:
        import fcntl
    except ImportError:  # no such thing on Windows
        yield True
        return
    handle = os.open(folder, os.O_RDONLY)
    is_free = True
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            is_free = error.errno not in _TAKEN
        yield is_free
    finally:
        os.close(handle)
