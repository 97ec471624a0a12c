"""Scenes as a device takes them, in files that are mapped into memory: made once, by several processes, then opened.

A file is named after all that it was made of: the source, the vehicle, the targets, the code that makes and packs
scenes, and the versions of NumPy and Embree. So it never has to be checked for its age; one that is damaged is made
again. On the CPU a `StoredScene` reads its meshes where the file lies in memory. Where a process holds on to
`HELD_BYTES` already, it lets go of them after use: thousands of scenes take no more memory than a hundred.
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
import platformdirs
import warp as wp

from warpav.core.atomic_write import atomic_write
from warpav.core.cache_folder import remove_oldest
from warpav.core.executor import available_cores, run_tasks
from warpav.core.fingerprint import digest, fingerprint
from warpav.raster.mesh import Mesh
from warpav.raster.scene import Scene as RasterScene
from warpav.scene.cache import BuiltSource, scene_once
from warpav.scene.device_scene import DeviceScene, boxes_of_arrays
from warpav.scene.glb import read_scene
from warpav.scene.scene import Scene
from warpav.scene.town.levels import TownSource
from warpav.scene.traffic.traffic_scene import TrafficSource

CAPACITY_BYTES = 4 * 2**30
"""What the cache holds at most: about 750 scenes of 5.5 MB. What a run uses stays until another run needs the room."""
HELD_BYTES = 2**29
"""Meshes that a process holds on to, of all its stored scenes together."""
RECENT_COUNT = 8
"""Further scenes, those that were used last, whose meshes it has not let go of yet."""
_PARALLEL_MIN = 4  # fewer scenes are made sooner than processes start
_FORMAT = 1
_CHECKED_FROM = 8  # the checksum itself comes first


def packed_scene_folder() -> Path:
    """Where packed scenes are kept; it may not exist yet."""
    return Path(platformdirs.user_cache_dir("warpav", appauthor=False)) / "packed_scenes"


@dataclass(frozen=True, eq=False)
class SceneRecipe:
    """Which scene, and what is done to it before it is packed.

    Attributes:
        source: What it is built of, or a GLB file.
        ego: The vehicle that takes the place of the scene's own; None: that stays.
        targets: Kinds of road users that are objects; the others are part of the environment.
        is_mirrored: Whether left and right are exchanged.
    """

    source: BuiltSource | Path
    ego: Mesh | None = None
    targets: tuple[str, ...] = ("vehicle",)
    is_mirrored: bool = False

    def scene(self) -> tuple[Scene, int]:
        """The scene, and how many road users were left out because the vehicle stands in their places.

        Raises:
            InputError: The file cannot be read.
        """
        if isinstance(self.source, TrafficSource):
            scene, left_out = self.source.scene_and_left_out(self.ego)
            targeted = scene.targeting(self.targets)
            return targeted.mirrored() if self.is_mirrored else targeted, left_out
        scene = scene_once(self.source) if isinstance(self.source, TownSource) else read_scene(self.source)
        around = scene if self.ego is None else scene.around(self.ego)
        targeted = around.targeting(self.targets)
        left_out = len(scene.road_users) - len(around.road_users)
        return targeted.mirrored() if self.is_mirrored else targeted, left_out

    @cached_property
    def file_name(self) -> str:
        """The file that keeps it, by all that it is made of.

        Raises:
            OSError: The file of the source cannot be read.
        """
        if isinstance(self.source, Path):
            source, code = (digest(self.source.read_bytes()), version("numpy")), ("warpav.scene.glb",)
        else:
            source, code = (self.source.fingerprint, version("numpy"), version("embreex")), ()
        ego = self.ego and [array.tobytes() for array in (self.ego.vertex_m, self.ego.triangle, self.ego.vertex_rgb)]
        made_of = (_FORMAT, *source, self.targets, self.is_mirrored, *(ego or ()))
        return f"scene_{fingerprint(*made_of, code=(*code, 'warpav.scene.device_scene'))}.npy"


class StoredScene(DeviceScene):
    """A scene on a device whose meshes lie in a file.

    Attributes:
        left_out: Road users that were left out, because the vehicle stands in their places.
    """

    left_out: int

    def __init__(self, recipe: SceneRecipe, folder: Path, device: str) -> None:
        """Open the file, or make it where there is none that can be read.

        Args:
            recipe: Which scene.
            folder: Where scenes are kept. Where it cannot be written to, the scene is held in memory.
            device: Warp device.

        Raises:
            InputError: The scene cannot be made.
        """
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
    recipes: Sequence[SceneRecipe],
    *,
    device: str = "cpu",
    folder: Path | None = None,
    worker_count: int | None = None,
) -> Iterator[StoredScene]:
    """Scenes on a device, in this order: opened where they were made before, made where not.

    Args:
        recipes: Which scenes.
        device: Warp device.
        folder: Where to keep them; None: `packed_scene_folder`.
        worker_count: Processes that make scenes; None: one for each core.

    Yields:
        Scenes with the arrays of `DeviceScene.pack`, bit for bit.

    Raises:
        InputError: A scene cannot be made.
    """
    folder = folder or packed_scene_folder()
    missing = {recipe.file_name: recipe for recipe in recipes if not (folder / recipe.file_name).is_file()}
    worker_count = min(worker_count or available_cores(), len(missing))
    outcomes = iter(())
    if worker_count > 1 and len(missing) >= _PARALLEL_MIN:
        tasks = [(recipe, folder) for recipe in missing.values()]
        outcomes = run_tasks(_make, tasks, executor="process", worker_count=worker_count, gpu_count=0)
    else:
        missing = {}
    for recipe in recipes:
        while recipe.file_name in missing:
            # one that failed fails again below, with its own error
            missing.pop(next(outcomes).task[0].file_name)
        yield StoredScene(recipe, folder, device)
    for _ in outcomes:
        pass
    _shrink(folder, recipes)


def _shrink(folder: Path, recipes: Sequence[SceneRecipe]) -> None:
    """Remove the scenes that were not used for the longest time, but none of these."""
    used = {recipe.file_name for recipe in recipes}
    size = sum(file.stat().st_size for name in used if (file := folder / name).is_file())
    remove_oldest(folder, "scene_*.npy", capacity_bytes=max(CAPACITY_BYTES, size))


def _make(task: tuple[SceneRecipe, Path]) -> None:
    """Make the file of a scene."""
    recipe, folder = task
    _write(_packed(recipe), folder / recipe.file_name)


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
    record = np.load(file, mmap_mode="r", allow_pickle=False)
    if not is_checked and int(record["checksum"]) != _checksum(record):
        raise ValueError(f"{file}: damaged")
    return record


def _packed(recipe: SceneRecipe) -> np.ndarray:
    """A scene, packed, as one structured element."""
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
    """Keep a scene, as a file that appears whole or not at all.

    Raises:
        OSError: It cannot be written.
    """
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
        with self._lock:
            if self._size + size > HELD_BYTES:
                return False
            self._size += size
        weakref.finalize(scene, self._give_back, size).atexit = False
        return True

    def _give_back(self, size: int) -> None:
        with self._lock:
            self._size -= size


_held = _Held()
_recent: deque[RasterScene] = deque(maxlen=RECENT_COUNT)
