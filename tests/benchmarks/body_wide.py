"""Flush cameras anywhere on the body against flush cameras on the roof, and against known rigs on the same vehicle.

A program, not a test: ``python tests/benchmarks/body_wide.py --device cuda:0 --workers 8 --out body_wide.json``. For
each vehicle it searches among the zones that the body suggests (none behind glass) and among its roof alone, with equal
numbers of equal cameras; for each known rig with as many cameras, of its most frequent field of view and proportions.
Both begin with the rig of one search on the roof; then one looks among all zones and the other once more on the roof,
with pools as large. All rigs are judged by what they are expected to miss in scenes that no search saw, differences
with 95 % intervals over these scenes.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import trimesh
import warp as wp

import warpav as wa
from warpav.evaluation.statistics import paired_difference
from warpav.raster.buffers import Content
from warpav.raster.mesh import Mesh
from warpav.raster.renderer import Renderer
from warpav.rig.presets import preset_names
from warpav.rig.zone import read_zones, write_zones
from warpav.runs.config import Config, load_config
from warpav.runs.detector_fit import ensure_fit
from warpav.runs.mounts import preset_for
from warpav.runs.vehicle_zones import propose
from warpav.scene.device_scene import DeviceScene
from warpav.scene.town.levels import LEVELS

VEHICLES = {"car": None, "van": "minibus", "bus": "bus"}
PIXELS = 65_536
"""Of every image, about."""
UNSEEN_FROM = 30_000
AT_ONCE = 50
"""Unseen scenes on the device."""


@dataclass(frozen=True)
class Task:
    """The searches of a vehicle with cameras of a kind.

    Attributes:
        vehicle: A key of `VEHICLES`.
        like: The known rig whose cameras it has; None: four of 90 degrees.
        seed: Of the search.
        settings: What the command line says.
    """

    vehicle: str
    like: str | None
    seed: int
    settings: argparse.Namespace


def main() -> None:
    """Search, judge, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--workers", type=int, default=1, help="searches at a time")
    parser.add_argument("--vehicles", default=",".join(VEHICLES))
    parser.add_argument("--like", default=",".join(preset_names()), help="known rigs")
    parser.add_argument("--seeds", type=int, default=1, help="searches with four cameras of 90 degrees, by vehicle")
    parser.add_argument("--train", type=int, default=200, help="scenes of a search")
    parser.add_argument("--unseen", type=int, default=200, help="scenes that judge")
    parser.add_argument("--pool", type=int, default=1024, help="cameras of the first pool of a search")
    parser.add_argument("--level", default="easy", choices=LEVELS, help="of the town")
    parser.add_argument("--targets", default="vehicle,pedestrian,cyclist")
    parser.add_argument("--out", type=Path, default=Path("body_wide.json"))
    settings = parser.parse_args()
    known = [name for name in settings.like.split(",") if name]
    tasks = [
        Task(vehicle, like, seed, settings)
        for vehicle in settings.vehicles.split(",")
        for like, seed in [*((None, seed) for seed in range(settings.seeds)), *((name, 0) for name in known)]
    ]
    began = time.perf_counter()
    seeds = [*range(settings.train), *range(UNSEEN_FROM, UNSEEN_FROM + settings.unseen)]
    wa.town(seeds, settings.level)  # the processes read them
    kept = {key: str(value) for key, value in vars(settings).items() if key != "out"}
    result: dict[str, object] = {"settings": kept, "rows": []}
    with ProcessPoolExecutor(settings.workers, mp_context=get_context("spawn")) as processes:
        searches = [processes.submit(searched, task) for task in tasks]
        presets = {
            (vehicle, name): processes.submit(judged_preset, vehicle, name, settings)
            for vehicle in settings.vehicles.split(",")
            for name in known
        }
        for search in searches:
            row = row_of(search.result(), presets)
            print(json.dumps(row), flush=True)  # noqa: T201
            result["rows"].append(row)
            result["seconds"] = time.perf_counter() - began
            settings.out.write_text(json.dumps(result, indent=1), encoding="utf-8")


def row_of(found: dict, presets: dict[tuple[str, str], Future]) -> dict[str, object]:
    """What a rig of the body misses, and how much more others miss."""
    arms = found.pop("missed")
    if found["like"] is not None:
        arms["preset"] = presets[found["vehicle"], found["like"]].result()
    row = found | {f"{name}_per_100": 100.0 * float(np.nanmean(each)) for name, each in arms.items()}
    for name in list(arms)[1:]:
        difference = paired_difference(100.0 * arms[name], 100.0 * arms["body"])
        row[f"{name}_less_body"] = {"mean": difference.mean, "low": difference.low, "high": difference.high}
    return row


def searched(task: Task) -> dict[str, object]:
    """The rigs of the body and of the roof, and what they miss in each unseen scene."""
    began = time.perf_counter()
    row: dict[str, object] = {"vehicle": task.vehicle, "like": task.like, "seed": task.seed}
    missed = {}
    first, _, _ = search(task, "roof", start=None)
    for where in ("body", "roof"):
        rig, objective, row[f"{where}_zones"] = search(task, where, start=first)
        row[f"{where}_train_per_100"] = 100.0 * objective
        missed[where] = misses(rig, task.vehicle, task.settings)
    return row | {"missed": missed, "search_seconds": time.perf_counter() - began}


def search(task: Task, where: str, *, start: wa.Rig | None) -> tuple[wa.Rig, float, dict[str, int]]:
    """A search on the body or the roof: rig, objective, cameras a zone; a second one, from a start, draws others."""
    with tempfile.TemporaryDirectory() as folder:
        placement = wa.Placement(
            wa.town(range(task.settings.train), task.settings.level),
            ego=VEHICLES[task.vehicle],
            zones=zones_of(task.vehicle, Path(folder) / "zones.yaml", where),
            start=start,
            requirements=(),
            config=config_of(task, seed=2 * task.seed + (start is not None)),
        )
        result = wa.optimise(placement)
        surface = placement.mount.surface
        place_m = placement.mount_pose_of(result.rig)[:, :2].astype(np.float64)
        return result.rig, result.objective, dict(Counter(surface.zones[k].name for k in surface.zone_at(place_m)))


def config_of(task: Task, *, seed: int = 0) -> Config:
    """What the cameras are, and how long is searched."""
    settings = task.settings
    options = [
        f"run.seed={seed}",
        f"device={settings.device}",
        f"scenes.targets=[{settings.targets}]",
        f"optimiser.pool_cameras={settings.pool}",
        "rig.free.pitch_deg=[-10, 30]",
    ]
    if task.like is not None:
        cameras = wa.preset(task.like).cameras
        (fov, _), *_ = Counter(round(np.degrees(each.model.fov_rad), 1) for each in cameras).most_common(1)
        model = next(each.model for each in cameras if round(np.degrees(each.model.fov_rad), 1) == fov)
        model = model.with_pixels(PIXELS)
        options += [f"rig.cameras={len(cameras)}", f"camera.fov_deg={fov}"]
        options += [f"camera.width_px={model.width_px}", f"camera.height_px={model.height_px}"]
    return load_config(Config(), options, origin=None)


def zones_of(vehicle: str, file: Path, where: str) -> Path:
    """The zones that a body suggests outside of its glass, or its roof alone, in a file."""
    mesh, source = vehicle_of(vehicle), file.with_suffix(".ply")
    trimesh.Trimesh(mesh.vertex_m, mesh.triangle, vertex_colors=mesh.vertex_rgb, process=False).export(source)
    config = load_config(Config(), ["rig.free.pitch_deg=[-10, 30]"], origin=None)
    for _ in propose(source, config, out=file):
        pass
    zones = [zone for zone in read_zones(file) if not zone.is_behind_glass]
    zones = [zone for zone in zones if where == "body" or zone.name == "roof"]
    write_zones([replace(zone, stand_off_m=(0.0, 0.03)) for zone in zones], file)
    return file


def vehicle_of(name: str) -> Mesh:
    """A vehicle in the ego frame."""
    scene = wa.town([0])
    placement = wa.Placement(list(scene), ego=VEHICLES[name], requirements=())
    return placement.ego


def judged_preset(vehicle: str, name: str, settings: argparse.Namespace) -> np.ndarray:
    """What a known rig on the body of a vehicle misses in each unseen scene."""
    moved = preset_for(name, config_of(Task(vehicle, None, 0, settings)), vehicle_of(vehicle))
    return misses(moved.rig, vehicle, settings)


def misses(rig: wa.Rig, vehicle: str, settings: argparse.Namespace) -> np.ndarray:
    """Share of the objects of each unseen scene that a rig is expected to miss, NaN where there is none, [scene]."""
    config = config_of(Task(vehicle, None, 0, settings))
    sizes = dict.fromkeys((each.model.width_px, each.model.height_px) for each in rig.cameras)
    groups = []
    for size in sizes:
        cameras = [each for each in rig.cameras if (each.model.width_px, each.model.height_px) == size]
        pose = np.stack([each.ego_from_camera for each in cameras])
        position = wp.array(pose[:, :3, 3].astype(np.float32), dtype=wp.vec3, device=settings.device)
        turned = pose[:, :3, :3].transpose(0, 2, 1).astype(np.float32)
        rotation = wp.array(turned, dtype=wp.mat33, device=settings.device)
        renderer = Renderer([each.model for each in cameras], device=settings.device)
        fits = [ensure_fit(config, camera=each.model) for each in cameras]
        groups.append((renderer, position, rotation, fits))
    found = []
    for scene in unseen(vehicle, settings):
        missed = np.ones(scene.vehicle_count)
        for renderer, position, rotation, fits in groups if scene.vehicle_count else ():
            frame = renderer.render(scene.raster, position, rotation, content=Content.COVERAGE)
            for k, fit in enumerate(fits):
                missed *= 1.0 - fit.of_coverage(frame, scene, position).probability.numpy()[k]
        found.append(missed.mean() if len(missed) else np.nan)
    return np.array(found)


def unseen(vehicle: str, settings: argparse.Namespace) -> Iterator[DeviceScene]:
    """The scenes that judge, on the device a few at a time."""
    config = config_of(Task(vehicle, None, 0, settings))
    scenes = wa.town(range(UNSEEN_FROM, UNSEEN_FROM + settings.unseen), settings.level)
    placement = wa.Placement(list(scenes[:1]), ego=VEHICLES[vehicle], requirements=(), config=config)
    for first in range(0, len(scenes), AT_ONCE):
        yield from (each.scene for each in placement.observed(scenes[first : first + AT_ONCE]))


if __name__ == "__main__":
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    main()
