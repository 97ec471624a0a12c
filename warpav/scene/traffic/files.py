"""Files of recorded traffic: which are recordings, what is in them, and the recordings that ship with warpav."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from warpav.core.cache import digest
from warpav.core.errors import InputError
from warpav.scene.traffic.formats import FORMATS, TrafficFormat
from warpav.scene.traffic.formats._rows import stamp_of
from warpav.scene.traffic.recording import Recording

SHIPPED = {"sind": Path(__file__).parent / "sind"}
"""Places whose recordings ship with warpav, by name; the README in a place's folder says more."""
_KINDS = ", ".join(each.what for each in FORMATS)


def _format_of(path: Path) -> TrafficFormat | None:
    """The format of a recording; None where a path is none."""
    return next((each for each in FORMATS if each.is_recording(path)), None)


def is_recording(path: Path) -> bool:
    """Whether a path looks like a recording: a file of these suffixes, or the folder of a log."""
    return _format_of(path) is not None


def recordings_in(paths: Iterable[Path]) -> list[Path]:
    """The recordings that paths mean, each once, in the order of their names, in which 2 stands before 10.

    A path is a recording, a folder with some, or the name of a place that ships with warpav.
    """
    found: dict[Path, None] = {}
    for given in paths:
        path = SHIPPED.get(str(given), given) if not given.exists() else given
        if is_recording(path):
            found[path.absolute()] = None
            continue
        inside = _inside(path) if path.is_dir() else []
        if not inside:
            text = "another file" if path.is_file() else "a folder without any" if path.is_dir() else "no such file"
            raise InputError(f"{path}: expected recorded traffic ({_KINDS}), got {text}")
        found.update(dict.fromkeys(each.absolute() for each in inside))
    return sorted(found, key=natural_order)


def _inside(folder: Path) -> list[Path]:
    """The recordings in a folder, at any depth; the files of a recording that is a folder are its own."""
    for each in FORMATS:
        if inside := each.recordings_of(folder):
            return inside
    return [
        path
        for each in sorted(folder.iterdir())
        if not each.name.startswith(".")
        for path in ([each] if is_recording(each) else _inside(each) if each.is_dir() else [])
    ]


def shipped_recordings() -> list[Path]:
    """The recordings that ship with warpav, in the order of time."""
    return recordings_in([SHIPPED["sind"]])


def content_digest(path: Path) -> str:
    """Hash of what a recording is made of."""
    return _digest_of(path.name, tuple((file, stamp_of(file)) for file in _files_of(path)))


def _files_of(path: Path) -> list[Path]:
    found = _format_of(path)
    return [path] if found is None else found.files_of(path)


@lru_cache(maxsize=1024)
def _digest_of(name: str, files: tuple[tuple[Path, tuple[int, int]], ...]) -> str:
    if len(files) == 1:
        return digest(files[0][0].read_bytes())
    return digest(name, *(_hash_of(*each) for each in files))


@lru_cache(maxsize=1024)
def _hash_of(file: Path, stamp: tuple[int, int]) -> str:
    """Hash of a file that several recordings may be made of, and which may be long."""
    del stamp
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_recording(path: Path) -> Recording:
    """The recording of a file or a log's folder, checked; kept while its files stay as they are."""
    return _read(path, tuple(stamp_of(file) for file in _files_of(path)))


@lru_cache(maxsize=256)
def _read(path: Path, stamps: tuple[tuple[int, int], ...]) -> Recording:
    del stamps
    found = _format_of(path)
    if found is None:
        raise InputError(f"{path}: expected recorded traffic ({_KINDS}), got another file")
    try:
        return found.read(path)
    except InputError as error:
        known = str(path), f"{path.parent}{os.sep}"
        raise InputError(*(line if line.startswith(known) else f"{path}: {line}" for line in error.args)) from None


def natural_order(path: Path) -> list[tuple[str, int]]:
    """Sort key of a path in which numbers count by their value."""
    return [(text, int(digits or -1)) for text, digits in re.findall(r"(\D*)(\d*)", str(path))]
