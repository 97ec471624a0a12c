"""What pools of cameras have drawn, kept in a folder camera by camera, and files that say what they were drawn with.

A chunk is a file with the probabilities of some cameras in one scene. Its name begins with a hash of all that these
depend on, so a folder can hold those of any number of scenes, vehicles and detectors, and none is found by another.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import time
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.cache import digest, remove_oldest
from warpav.core.errors import InputError
from warpav.core.files import atomic_write
from warpav.optimisation._mount import MOUNT_POSE_SIZE

_CAPACITY_BYTES = 2**30
"""What a folder holds at most; beyond that the chunks that were not used for the longest time go."""
SCENES = "scenes-"  # how the names of folders begin in which scenes travel to tasks
UNREADABLE = (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile)
"""What `read_arrays` raises where there is no such file."""
_FORMAT = 1
_ABANDONED_S = 7 * 86400.0  # no draw takes so long
_MEANING = {
    "vehicle": "of this vehicle, got one of another",
    "camera": "of this camera model, supersampling, occlusion and errors of mounting, got one of others",
    "detector": "of this model of detection probability, got one of another",
    "scenes": "of these scenes, got one of others",
    "version": "of this version of warpav and this kind of device, got one of others",
}

_Identity = Mapping[str, Any]
"""Hashes of what a file was drawn with, by `_MEANING`'s names; those of the scenes in a list."""


class PoolCache:
    """A folder of chunks, as pools of one vehicle, camera and detector see it.

    Where the folder cannot be written to, nothing is kept.
    """

    def __init__(self, folder: Path, identity: _Identity) -> None:
        self.folder = folder
        self._identity = dict(identity)
        self._pose: dict[Path, np.ndarray] = {}  # of the chunks that were opened, float32 [camera, 7]
        self._files: dict[str, list[Path]] | None = None  # the chunks by how their names begin

    def find(self, scene: str, object_count: int, mount_pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which cameras are there, bool [camera], and what these detect, float32 [camera that is there, object].

        Chunks that cannot be read are passed over.
        """
        is_there = np.zeros(len(mount_pose), bool)
        found = np.zeros((len(mount_pose), object_count), np.float32)
        for file in self._chunks(scene):
            if is_there.all():
                break
            try:
                row = self._rows(file, scene, mount_pose)
                is_new = (row >= 0) & ~is_there
                if is_new.any():
                    found[is_new] = read_arrays(file)[0]["detection_probability"][row[is_new]]
                    is_there |= is_new
                    file.touch()
            except InputError:
                raise
            except UNREADABLE:
                continue  # drawn again
        return is_there, found[is_there]

    def keep(self, scene: str, mount_pose: np.ndarray, detection_probability: np.ndarray) -> None:
        """Keep what some cameras detect in a scene, as a file that appears whole or not at all."""
        file = self.folder / f"{self._name(scene)}_{digest(mount_pose.tobytes())}.npz"
        with contextlib.suppress(OSError):
            self.folder.mkdir(parents=True, exist_ok=True)
            write_arrays(
                file,
                {**self._identity, "scenes": [scene]},
                mount_pose=mount_pose,
                detection_probability=detection_probability,
            )
            self._pose[file] = mount_pose
            if self._files is not None:
                self._files.setdefault(self._name(scene), []).append(file)

    def shrink(self) -> None:
        """Remove the oldest chunks, until the others fit into the capacity, and scenes of draws that were killed."""
        remove_oldest(self.folder, "pool_*.npz", capacity_bytes=_CAPACITY_BYTES)
        with contextlib.suppress(OSError):  # another process removes as well
            for scenes in self.folder.glob(f"{SCENES}*"):
                if time.time() - scenes.stat().st_mtime > _ABANDONED_S:
                    shutil.rmtree(scenes)
        self._files = None

    def _chunks(self, scene: str) -> list[Path]:
        """The files of a scene; the folder is listed once for all scenes, and again after `shrink`."""
        if self._files is None:
            self._files = {}
            for file in sorted(self.folder.glob("pool_*.npz")):
                self._files.setdefault(file.name.rpartition("_")[0], []).append(file)
        return self._files.get(self._name(scene), [])

    def _name(self, scene: str) -> str:
        """How the names of a scene's chunks begin."""
        return f"pool_{digest(_FORMAT, sorted(self._identity.items()), scene)}"

    def _rows(self, file: Path, scene: str, mount_pose: np.ndarray) -> np.ndarray:
        """Where the cameras stand in a chunk, -1 where they do not, int [camera]."""
        if file not in self._pose:
            arrays, identity = read_arrays(file)
            expected = {**self._identity, "scenes": [scene]}
            for name, text in _MEANING.items():
                if identity.get(name) != expected[name]:
                    raise InputError(f"{file}: {name}: expected a pool {text}; remove it, and draw it again")
            self._pose[file] = arrays["mount_pose"]
        return rows_of(mount_pose, self._pose[file])


def rows_of(wanted: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Where each of the wanted poses [camera, 7] stands among others, -1 where its bytes do not; int [camera]."""
    row = np.full(len(wanted), -1)
    if len(there):
        keys, first = np.unique(pose_keys(there), return_index=True)
        wanted_keys = pose_keys(wanted)
        place = np.minimum(np.searchsorted(keys, wanted_keys), len(keys) - 1)
        is_there = keys[place] == wanted_keys
        row[is_there] = first[place[is_there]]
    return row


def pose_keys(mount_pose: np.ndarray) -> np.ndarray:
    """The bytes of every pose, which can be sorted and compared, [camera]; no zero is negative."""
    pose = np.ascontiguousarray(mount_pose, np.float32) + np.float32(0.0)
    return pose.view(f"S{4 * MOUNT_POSE_SIZE}").reshape(-1)


def write_arrays(file: Path, identity: _Identity, **arrays: np.ndarray) -> None:
    """Write arrays and what they were drawn with."""
    words = json.dumps({"format": _FORMAT, "identity": dict(identity)}).encode()
    with atomic_write(file) as draft, draft.open("wb") as stream:
        np.savez(stream, words=np.frombuffer(words, np.uint8), **arrays)  # pyright: ignore[reportArgumentType]


def read_arrays(file: Path) -> tuple[dict[str, np.ndarray], _Identity]:
    """What `write_arrays` wrote; any of `UNREADABLE` where it did not, or the file is damaged."""
    with np.load(file, allow_pickle=False) as kept:
        arrays = {name: kept[name] for name in kept.files}
    words = json.loads(arrays.pop("words").tobytes())
    if words["format"] != _FORMAT or not isinstance(words["identity"], dict):
        raise ValueError(f"format {words['format']}")
    return arrays, words["identity"]
