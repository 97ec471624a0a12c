"""Formats of recorded traffic: a module and a row of `FORMATS` each.

A reader gives a `Recording` by `recording_of`, which checks all numbers: it names road users that it cannot describe as
faults, passes over the words of what is no road user, and raises `InputError` where the file itself is no such file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from warpav.scene.traffic.formats import _argoverse2, _commonroad, _json
from warpav.scene.traffic.recording import Recording


def _nothing(folder: Path) -> list[Path]:
    del folder
    return []


@dataclass(frozen=True)
class TrafficFormat:
    """A format of recorded traffic."""

    what: str  # what a recording of it is, for messages and help
    is_recording: Callable[[Path], bool]  # whether a path is one: a file, a folder, or a name in a folder of tables
    read: Callable[[Path], Recording]
    files_of: Callable[[Path], list[Path]] = lambda path: [path]  # all files that a recording is made of
    recordings_of: Callable[[Path], list[Path]] = _nothing  # of a folder that holds several in files together


def _is_file(*suffixes: str) -> Callable[[Path], bool]:
    return lambda path: path.name.endswith(suffixes) and path.is_file()


FORMATS = (
    TrafficFormat("folders of Argoverse 2 logs", _argoverse2.is_log, _argoverse2.read, _argoverse2.files_of),
    TrafficFormat("CommonRoad XML", _is_file(".xml", ".xml.gz"), _commonroad.read),
    TrafficFormat("JSON", _is_file(".json", ".json.gz"), _json.read),
)
"""Every format; the first one that takes a path reads it."""
