"""Formats of recorded traffic: a module and a row of `FORMATS` each.

A reader gives a `Recording` by `recording_of`, which checks all numbers: it names road users that it cannot describe as
faults, passes over the words of what is no road user, and raises `InputError` where the file itself is no such file.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from warpav.scene.traffic.formats import _argoverse2, _commonroad, _drone, _interaction, _json, _nuscenes, _sumo, _waymo
from warpav.scene.traffic.formats import _argoverse2_motion as _motion
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


def _is_file(name: str, *tags: str) -> Callable[[Path], bool]:
    """Whether a path is a file of such a name and, if that is XML, with such a tag first; none is an empty one."""
    named = re.compile(name).fullmatch
    return lambda path: named(path.name) is not None and path.is_file() and (not tags or _sumo.root_tag(path) in tags)


_XML = r".*\.xml(\.gz)?"
FORMATS = (
    TrafficFormat("folders of Argoverse 2 logs", _argoverse2.is_log, _argoverse2.read, _argoverse2.files_of),
    TrafficFormat("folders of Argoverse 2 motion forecasting", _motion.is_scenario, _motion.read, _motion.files_of),
    TrafficFormat("nuScenes tables", _nuscenes.is_scene, _nuscenes.read, _nuscenes.files_of, _nuscenes.recordings_of),
    TrafficFormat("SUMO's FCD output", _is_file(_XML, "fcd-export"), _sumo.read, _sumo.files_of),
    TrafficFormat("CommonRoad XML", _is_file(_XML, "commonRoad", ""), _commonroad.read),
    TrafficFormat("INTERACTION", _is_file(r"vehicle_tracks_\d+\.csv"), _interaction.read, _interaction.files_of),
    TrafficFormat("inD, rounD, exiD, uniD, highD", _is_file(r"\d+_tracks\.csv"), _drone.read, _drone.files_of),
    TrafficFormat("Waymo scenes as JSON of GPUDrive and Nocturne", _waymo.is_scene, _waymo.read),
    TrafficFormat("JSON", _is_file(r".*\.json(\.gz)?"), _json.read),
)
"""Every format; the first one that takes a path reads it."""
