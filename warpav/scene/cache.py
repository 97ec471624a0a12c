"""Scenes that are built, kept in the user's cache folder: built once, several at a time, then read.

A file is named after what it was made of: the source, the code that makes scenes, and the versions of NumPy and Embree.
So it never has to be checked for its age; a file that cannot be read is built again. The folder holds at most
`CAPACITY_BYTES`; beyond that the scenes that were not used for the longest time go.
"""

from __future__ import annotations

import contextlib
import json
import zipfile
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
import platformdirs

from warpav.core.atomic_write import atomic_write
from warpav.core.cache_folder import remove_oldest
from warpav.core.executor import available_cores, run_tasks
from warpav.core.fingerprint import digest
from warpav.raster.mesh import Mesh
from warpav.scene.scene import Box, Scene, Sky, Vehicle
from warpav.scene.town.levels import Level, TownSource
from warpav.scene.traffic.traffic_scene import TrafficSource

CAPACITY_BYTES = 512 * 2**20
"""What the cache holds at most: about 300 scenes of 1.8 MB."""
_PARALLEL_MIN = 4  # fewer scenes are built sooner than processes start
_FORMAT = 2
_UNREADABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)


def scene_cache_folder() -> Path:
    """Where scenes are kept; it may not exist yet."""
    return Path(platformdirs.user_cache_dir("warpav", appauthor=False)) / "scenes"


BuiltSource = TownSource | TrafficSource
"""What a scene can be built of: a seed and a level of the town, or a moment of a recording."""


def town_scenes(
    seeds: Sequence[int], level: Level = "easy", *, folder: Path | None = None, worker_count: int | None = None
) -> Iterator[Scene]:
    """The embedded scenes of ``seeds`` and a level; see `built_scenes`.

    Raises:
        ValueError: A seed is negative.
    """
    return built_scenes([TownSource(seed, level) for seed in seeds], folder=folder, worker_count=worker_count)


def built_scenes(
    sources: Sequence[BuiltSource], *, folder: Path | None = None, worker_count: int | None = None
) -> Iterator[Scene]:
    """The scenes of ``sources``, in this order: read where they were built before, built where not.

    Args:
        sources: What they are built of.
        folder: Where to keep them; None: `scene_cache_folder`. Nothing is kept where it cannot be written to.
        worker_count: Processes that build scenes; None: one for each core.

    Yields:
        Scenes, array for array and bit for bit those of ``source.scene()``.

    Raises:
        ValueError: A seed is negative.
        InputError: A recording cannot be read.
    """
    folder = folder or scene_cache_folder()
    missing = [source for source in dict.fromkeys(sources) if not scene_file(source, folder).is_file()]
    worker_count = min(worker_count or available_cores(), len(missing))
    built: dict[BuiltSource, Scene] = {}
    outcomes = iter(())
    if worker_count > 1 and len(missing) >= _PARALLEL_MIN:
        tasks = [(source, folder) for source in missing]
        outcomes = run_tasks(_build, tasks, executor="process", worker_count=worker_count, gpu_count=0)
    else:
        missing = []
    for source in sources:
        while source in missing and source not in built:
            outcome = next(outcomes)
            finished, _ = outcome.task
            # one that failed fails again here, with its own error
            built[finished] = _build(outcome.task) if outcome.result is None else outcome.result
        yield built[source] if source in built else _read_or_build(source, folder)
    for _ in outcomes:
        pass
    remove_oldest(folder, "*.npz", capacity_bytes=CAPACITY_BYTES)


def scene_once(source: BuiltSource) -> Scene:
    """The scene of a source, read where it was built before, else built and not kept.

    Raises:
        ValueError: The seed is negative.
        InputError: A recording cannot be read.
    """
    try:
        return _read(scene_file(source, scene_cache_folder()))
    except _UNREADABLE:
        return source.scene()


def scene_file(source: BuiltSource, folder: Path) -> Path:
    """The file that keeps a scene."""
    made_of = digest(_FORMAT, source.fingerprint, version("numpy"), version("embreex"))
    name = f"town_{source.seed}" if isinstance(source, TownSource) else "traffic"
    return folder / f"{name}_{made_of}.npz"


def _read_or_build(source: BuiltSource, folder: Path) -> Scene:
    file = scene_file(source, folder)
    try:
        scene = _read(file)
        file.touch()
    except _UNREADABLE:
        scene = _build((source, folder))
    return scene


def _build(task: tuple[BuiltSource, Path]) -> Scene:
    """Build a scene, and keep it if the folder lets itself be written to."""
    source, folder = task
    scene = source.scene()
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        _write(scene, scene_file(source, folder))
    return scene


def _write(scene: Scene, file: Path) -> None:
    """Keep a scene, all meshes end to end and uncompressed: that reads fastest."""
    meshes = [scene.environment, scene.ego, *(user.mesh for user in (*scene.vehicles, *scene.others))]
    users = [*scene.vehicles, *scene.others]
    words = {
        "name": scene.name,
        "source": scene.source,
        "vehicles": len(scene.vehicles),
        "users": [
            [
                user.instance_id,
                user.category,
                user.box.yaw_rad,
                None if user.velocity_ego_m_s is None else user.velocity_ego_m_s.tolist(),
            ]
            for user in users
        ],
    }
    with atomic_write(file) as draft, draft.open("wb") as stream:
        np.savez(
            stream,
            words=np.frombuffer(json.dumps(words).encode(), np.uint8),
            vertex_m=np.concatenate([mesh.vertex_m for mesh in meshes]),
            triangle=np.concatenate([mesh.triangle for mesh in meshes]),
            vertex_rgb=np.concatenate([mesh.vertex_rgb for mesh in meshes]),
            count=np.array([[len(mesh.vertex_m), len(mesh.triangle)] for mesh in meshes]),
            box_m=np.array([[user.box.center_m, user.box.size_m] for user in users]).reshape(-1, 2, 3),
            sky_rgb=np.array([scene.sky.horizon_rgb, scene.sky.zenith_rgb]),
        )


def _read(file: Path) -> Scene:
    """The scene of a file; zip's checksums tell one that is damaged."""
    with np.load(file, allow_pickle=False) as kept:
        arrays = {name: kept[name] for name in kept.files}
    words = json.loads(arrays["words"].tobytes())
    vertex_end, triangle_end = np.cumsum(arrays["count"], axis=0)[:-1].T
    meshes = [
        Mesh(*parts)
        for parts in zip(
            np.split(arrays["vertex_m"], vertex_end),
            np.split(arrays["triangle"], triangle_end),
            np.split(arrays["vertex_rgb"], vertex_end),
            strict=True,
        )
    ]
    users = tuple(
        Vehicle(
            instance_id,
            category,
            mesh,
            Box(box_m[0], box_m[1], yaw_rad),
            None if velocity is None else np.array(velocity),
        )
        for (instance_id, category, yaw_rad, velocity), mesh, box_m in zip(
            words["users"], meshes[2:], arrays["box_m"], strict=True
        )
    )
    count = words["vehicles"]
    sky = Sky(*arrays["sky_rgb"])
    return Scene(words["name"], meshes[0], meshes[1], users[:count], sky, words["source"], users[count:])
