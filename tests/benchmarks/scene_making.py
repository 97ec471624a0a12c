"""How long scenes take to make, and how much memory: ``python tests/benchmarks/scene_making.py [SOURCE ...]``.

A program, not a test. Sources are levels of the town, ``traffic`` (the recordings that ship) and files and folders of
recordings. Two lines a source: scenes made and packed by one process on one core (wall and processor time a scene, the
slowest scene), and by one process a core into an empty folder, then opened from it; the memory is the most of the main
process and that of every worker, summed up, as if all were at their most at once.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from warpav.core.cores import available_cores
from warpav.scene.device_scene import DeviceScene
from warpav.scene.stored_scene import SceneRecipe, stored_scenes
from warpav.scene.town.levels import TownSource
from warpav.scene.town.town import ego_vehicle
from warpav.scene.traffic.files import recordings_in, shipped_recordings
from warpav.scene.traffic.moments import moment_of, moments_of
from warpav.scene.traffic.traffic_scene import TrafficSource

LEVELS = ("easy", "urban", "dense", "motorway")
FIRST_SEED = 20_000
ALONE = 20


def sources(name: str, count: int) -> list[TownSource | TrafficSource]:
    """What scenes are built of."""
    seeds = range(FIRST_SEED, FIRST_SEED + count)
    if name in LEVELS:
        return [TownSource(seed, name) for seed in seeds]
    files = shipped_recordings() if name == "traffic" else recordings_in([Path(name)])
    moments = moments_of(files, ego_vehicle().bounds_m())
    return [TrafficSource(moment_of(moments, seed), seed) for seed in seeds]


def main() -> None:
    """Print the times."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sources", nargs="*", default=["traffic", *LEVELS], metavar="SOURCE")
    parser.add_argument("--scenes", type=int, default=1500)
    given = parser.parse_args()
    for name in given.sources:
        began_s = time.perf_counter()
        every = sources(name, given.scenes)
        every[0].scene()  # reads the recording, and what is kept of vehicles
        say(f"{Path(name).name}: {time.perf_counter() - began_s:.1f} s until the first scene is there")
        spent = np.array([on_one_core(source) for source in every[1 : 1 + ALONE]])
        wall_s, made_s, packed_s = spent.mean(axis=0)
        say(
            f"  one core: {wall_s:.2f} s a scene ({made_s:.2f} s of the processor, the slowest "
            f"{spent[:, 1].max():.2f} s), {packed_s:.2f} s to pack it"
        )
        with tempfile.TemporaryDirectory() as folder:
            recipes = [SceneRecipe(source) for source in every]
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            made_s, opened_s = (through(recipes, Path(folder)) for _ in range(2))
            worker = resource.getrusage(resource.RUSAGE_CHILDREN)
            size = sum(file.stat().st_size for file in Path(folder).iterdir())
        core_s = worker.ru_utime + worker.ru_stime - before.ru_utime - before.ru_stime
        cores, own = available_cores(), resource.getrusage(resource.RUSAGE_SELF)
        most_gib = (own.ru_maxrss + cores * worker.ru_maxrss) / 2**20
        say(
            f"  {len(every)} scenes on {cores} cores: {made_s:.0f} s to make, pack and keep them ({core_s:.0f} s of "
            f"the processor), {size / 1e9:.1f} GB; {opened_s:.0f} s to open them; at most {most_gib:.2f} GiB of memory"
        )


def on_one_core(source: TownSource | TrafficSource) -> tuple[float, float, float]:
    """Wall and processor time of a scene, and processor time until it is packed [s]."""
    began_s, began_core_s = time.perf_counter(), time.process_time()
    scene = source.scene()
    made_s, made_core_s = time.perf_counter() - began_s, time.process_time() - began_core_s
    DeviceScene.pack(scene)
    return made_s, made_core_s, time.process_time() - began_core_s - made_core_s


def through(recipes: list[SceneRecipe], folder: Path) -> float:
    """Time until all scenes have come out of a folder [s]."""
    began_s = time.perf_counter()
    for _ in stored_scenes(recipes, folder=folder):
        pass
    return time.perf_counter() - began_s


def say(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
