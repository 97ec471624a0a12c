"""Scenes in the user's cache: built once, several at a time, then read; see `warpav.core.cache`."""

from __future__ import annotations

import contextlib
import json
import zipfile
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np

from warpav.core.cache import digest, made_files, remove_oldest, user_cache_folder
from warpav.core.files import atomic_write
from warpav.raster.mesh import Mesh
from warpav.scene._scene import Box, Scene, Sky, Vehicle
from warpav.scene.town._levels import TownSource
from warpav.scene.traffic.traffic_scene import TrafficSource

_CAPACITY_BYTES = 512 * 2**20  # what the cache holds at most: about 300 scenes of 1.8 MB
_FORMAT = 2
UNREADABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)
BuiltSource = TownSource | TrafficSource
"""What a scene can be built of: a seed and a level of the town, or a moment of a recording."""


def built_scenes(
    sources: Sequence[BuiltSource], *, folder: Path | None = None, worker_count: int | None = None
) -> Iterator[Scene]:
    """The scenes of ``sources``, in this order: read where they were built before, built where not.

    They are array for array and bit for bit those of ``source.scene()``. Nothing is kept where the folder cannot be
    written to. Raises `InputError` where a recording cannot be read.
    """
    folder = folder or user_cache_folder("scenes")
    files = [scene_file(source, folder) for source in sources]
    for source, file in made_files(_keep_scene, sources, files, worker_count=worker_count):
        try:
            scene = read_kept(file)
            file.touch()
        except UNREADABLE:
            scene = source.scene()
            with contextlib.suppress(OSError):
                file.parent.mkdir(parents=True, exist_ok=True)
                _write(scene, file)
        yield scene
    remove_oldest(folder, "*.npz", capacity_bytes=_CAPACITY_BYTES)


def scene_file(source: BuiltSource, folder: Path) -> Path:
    made_of = digest(_FORMAT, source.fingerprint, version("numpy"), version("embreex"))
    name = f"town_{source.seed}" if isinstance(source, TownSource) else "traffic"
    return folder / f"{name}_{made_of}.npz"


def _keep_scene(task: tuple[BuiltSource, Path]) -> None:
    source, file = task
    file.parent.mkdir(parents=True, exist_ok=True)
    _write(source.scene(), file)


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


def read_kept(file: Path) -> Scene:
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
