"""Scenes as a device takes them, in files that are mapped into memory: made once, by several processes, then opened.

A file is named after all that it was made of: the source, the vehicle, the targets, the code that makes and packs
scenes, and the versions of NumPy and Embree. On the CPU a `StoredScene` reads its meshes where the file lies. Where a
process holds on to `HELD_BYTES` already, it lets go of them after use: thousands of scenes take no more memory than a
hundred.
"""

from __future__ import annotations

import contextlib
import threading
import weakref
import zlib
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warpav.core.cache import digest, fingerprint, made_files, remove_oldest, user_cache_folder
from warpav.core.files import atomic_write
from warpav.raster.mesh import Mesh
from warpav.raster.scene import Scene as RasterScene
from warpav.scene._cache import UNREADABLE, BuiltSource, built_scenes, read_kept, scene_file
from warpav.scene._device_scene import DeviceScene, boxes_of_arrays
from warpav.scene._glb import read_scene
from warpav.scene._scene import Scene
from warpav.scene.town._levels import TownSource
from warpav.scene.traffic.traffic_scene import TrafficSource

CAPACITY_BYTES = 4 * 2**30
"""What the cache holds at most: about 750 scenes of 5.5 MB. What a run uses stays until another run needs the room."""
HELD_BYTES = 2**29  # meshes that a process holds on to, of all its stored scenes together
_RECENT_COUNT = 8  # further scenes, those that were used last, whose meshes it has not let go of yet
_FORMAT = 1
_CHECKED_FROM = 8  # the checksum itself comes first
_READING = threading.Lock()  # CPython 3.11 fails where two threads parse headers of npy files at once


@dataclass(frozen=True, eq=False)
class SceneRecipe:
    """Which scene, and what is done to it before it is packed."""

    source: BuiltSource | Path  # what it is built of, or a GLB file
    ego: Mesh | None = None  # the vehicle that takes the place of the scene's own; None: that stays
    targets: tuple[str, ...] = ("vehicle",)  # kinds of road users that are objects; others are environment
    is_mirrored: bool = False  # whether left and right are exchanged

    @property
    def is_built(self) -> bool:
        """Whether it is made of a scene that `built_scenes` gives."""
        return isinstance(self.source, TownSource) or (isinstance(self.source, TrafficSource) and self.ego is None)

    def scene(self, built: Scene | None = None) -> tuple[Scene, int]:
        """The scene, and how many road users were left out because the vehicle stands in their places.

        ``built`` is that of `built_scenes`, where the caller has it. Raises `InputError` where a file cannot be read.
        """
        left_out = 0
        if isinstance(self.source, TrafficSource) and self.ego is not None:
            scene, left_out = self.source.scene_and_left_out(self.ego)
        else:
            scene = self._whole_scene() if built is None else built
            if self.ego is not None:
                everybody, scene = len(scene.road_users), scene.around(self.ego)
                left_out = everybody - len(scene.road_users)
        targeted = scene.targeting(self.targets)
        return targeted.mirrored() if self.is_mirrored else targeted, left_out

    def _whole_scene(self) -> Scene:
        if isinstance(self.source, Path):
            return read_scene(self.source)
        try:
            return read_kept(scene_file(self.source, user_cache_folder("scenes")))
        except UNREADABLE:  # and it is not kept: the packed one is
            return self.source.scene()

    @cached_property
    def file_name(self) -> str:
        """The name of the file that keeps it, by all that it is made of; OSError where the source cannot be read."""
        if isinstance(self.source, Path):
            source, code = (digest(self.source.read_bytes()), version("numpy")), ("warpav.scene._glb",)
        else:
            source, code = (self.source.fingerprint, version("numpy"), version("embreex")), ()
        ego = self.ego and [array.tobytes() for array in (self.ego.vertex_m, self.ego.triangle, self.ego.vertex_rgb)]
        made_of = (_FORMAT, *source, self.targets, self.is_mirrored, *(ego or ()))
        return f"scene_{fingerprint(*made_of, code=(*code, 'warpav.scene._device_scene'))}.npy"


def scenes_of(recipes: Sequence[SceneRecipe]) -> Iterator[tuple[Scene, int]]:
    """As `SceneRecipe.scene` of each recipe in turn; several processes build what nobody built before."""
    built = built_scenes(
        [recipe.source for recipe in recipes if recipe.is_built and not isinstance(recipe.source, Path)]
    )
    for recipe in recipes:
        yield recipe.scene(next(built) if recipe.is_built else None)


class StoredScene(DeviceScene):
    """A scene on a device whose meshes lie in a file."""

    left_out: int  # road users that were left out, because the vehicle stands in their places

    def __init__(self, recipe: SceneRecipe, folder: Path, device: str) -> None:
        """Open the file, or make it where there is none that can be read."""
        record = _record(recipe, folder)
        # a frozen dataclass, whose field `raster` is a property here
        self.__dict__.update(
            name=str(record["name"]),
            category=tuple(str(name) for name in record["category"]),
            road_user_index=np.array(record["road_user_index"]),
            from_ego_m=np.array(record["from_ego_m"]),
            time_to_collision_s=np.array(record["time_to_collision_s"]),
            fingerprint=str(record["fingerprint"]),
            ego_bounds_m=np.array(record["ego_bounds_m"]),
            left_out=int(record["left_out"]),
            upright_box=boxes_of_arrays(record, device=device),
            _made_of=(recipe, folder, device),
            _held=None,
            _recent=lambda: None,
        )
        if wp.get_device(device).is_cuda or not isinstance(record, np.memmap):
            self.__dict__["_held"] = RasterScene.of_arrays(record, device=device)

    @property
    def raster(self) -> RasterScene:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The meshes as the rasteriser takes them; whoever keeps a part of them keeps the whole."""
        state = self.__dict__
        raster = state["_held"] or state["_recent"]()
        if raster is None:
            recipe, folder, device = state["_made_of"]
            record = _record(recipe, folder, is_checked=True)
            raster = RasterScene.of_arrays(record, device=device)
            state["_recent"] = weakref.ref(raster)
            if not isinstance(record, np.memmap) or _held.take(self, record.nbytes):
                state["_held"] = raster
        if state["_held"] is None:
            _recent.append(raster)
        return raster

    @property
    def vehicle_count(self) -> int:
        """Number of vehicles, at least 0."""
        return len(self.category)

    def __reduce__(self) -> tuple[Any, ...]:
        """As it travels to another process of this machine: what it is made of, and where it lies."""
        return StoredScene, self.__dict__["_made_of"]


def stored_scenes(
    recipes: Sequence[SceneRecipe], *, device: str = "cpu", folder: Path | None = None, worker_count: int | None = None
) -> Iterator[StoredScene]:
    """Scenes on a Warp device, in this order: opened where they were made before, made where not.

    Their arrays are those of `DeviceScene.pack`, bit for bit. Raises `InputError` where a scene cannot be made.
    """
    folder = folder or user_cache_folder("packed_scenes")
    files = [folder / recipe.file_name for recipe in recipes]
    for recipe, file in made_files(_make, recipes, files, worker_count=worker_count):
        yield StoredScene(recipe, file.parent, device)
    used = sum(file.stat().st_size for file in set(files) if file.is_file())  # none of these goes
    remove_oldest(folder, "scene_*.npy", capacity_bytes=max(CAPACITY_BYTES, used))


def _make(task: tuple[SceneRecipe, Path]) -> None:
    _write(_packed(task[0]), task[1])


def _record(recipe: SceneRecipe, folder: Path, *, is_checked: bool = False) -> np.ndarray:
    """All arrays of a scene as one structured element, mapped from its file, which is made where it must be."""
    file = folder / recipe.file_name
    try:
        record = _mapped(file, is_checked=is_checked)
        if not is_checked:
            file.touch()
    except (OSError, ValueError, EOFError):
        record = _packed(recipe)
        with contextlib.suppress(OSError):  # then it stays in memory
            _write(record, file)
            record = _mapped(file, is_checked=True)
    return record


def _mapped(file: Path, *, is_checked: bool) -> np.ndarray:
    with _READING:
        record = np.load(file, mmap_mode="r", allow_pickle=False)
    if not is_checked and int(record["checksum"]) != _checksum(record):
        raise ValueError(f"{file}: damaged")
    return record


def _packed(recipe: SceneRecipe) -> np.ndarray:
    scene, left_out = recipe.scene()
    packed = DeviceScene.pack(scene)
    arrays = {
        **packed.arrays(),
        "fingerprint": np.array(packed.fingerprint),
        "ego_bounds_m": scene.ego.bounds_m(),
        "left_out": np.array(left_out),
    }
    fields = [(name, array.dtype, array.shape) for name, array in arrays.items()]
    record = np.zeros((), np.dtype([("checksum", np.uint64), *fields], align=True))
    for name, array in arrays.items():
        record[name] = array
    record["checksum"] = _checksum(record)
    return record


def _checksum(record: np.ndarray) -> int:
    return zlib.crc32(record.reshape(1).view(np.uint8).data[_CHECKED_FROM:])


def _write(record: np.ndarray, file: Path) -> None:
    """Keep a scene, as a file that appears whole or not at all."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(file) as draft, draft.open("wb") as stream:
        np.save(stream, record, allow_pickle=False)


class _Held:
    """Counts the bytes of meshes that scenes hold on to."""

    def __init__(self) -> None:
        self._size = 0
        self._lock = threading.Lock()

    def take(self, scene: StoredScene, size: int) -> bool:
        """Whether a scene may hold on to so many bytes; they are free again when the scene goes."""
        is_taken = self._add(size)
        if is_taken:
            weakref.finalize(scene, self._add, -size).atexit = False
        return is_taken

    def _add(self, size: int) -> bool:
        with self._lock:
            fits = self._size + size <= HELD_BYTES
            self._size += size if fits else 0
        return fits


_held = _Held()
_recent: deque[RasterScene] = deque(maxlen=_RECENT_COUNT)
