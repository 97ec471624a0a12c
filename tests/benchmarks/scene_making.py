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
from collections.abc import Sequence
from pathlib import Path

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


def main(argv: Sequence[str] | None = None) -> None:
    """Print the times."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sources", nargs="*", default=["traffic", *LEVELS], metavar="SOURCE")
    parser.add_argument("--scenes", type=int, default=1500)
    given = parser.parse_args(argv)
    before_s = 0.0
    for name in given.sources:
        began_s = time.perf_counter()
        every = sources(name, given.scenes)
        every[0].scene()  # reads the recording, and what is kept of vehicles
        say(f"{Path(name).name}: {time.perf_counter() - began_s:.1f} s until the first scene is there")
        spent = []
        for source in every[1 : 1 + ALONE]:
            began_s, began_core_s = time.perf_counter(), time.process_time()
            scene = source.scene()
            made_s, made_core_s = time.perf_counter() - began_s, time.process_time() - began_core_s
            DeviceScene.pack(scene)
            spent.append((made_s, made_core_s, time.process_time() - began_core_s - made_core_s))
        mean = [sum(each[k] for each in spent) / len(spent) for k in range(3)]
        say(
            f"  one core: {mean[0]:.2f} s a scene ({mean[1]:.2f} s of the processor, the slowest "
            f"{max(each[1] for each in spent):.2f} s), {mean[2]:.2f} s to pack it"
        )
        with tempfile.TemporaryDirectory() as folder:
            recipes = [SceneRecipe(source) for source in every]
            began_s = time.perf_counter()
            for _ in stored_scenes(recipes, folder=Path(folder)):
                pass
            made_s = time.perf_counter() - began_s
            worker_s = resource.getrusage(resource.RUSAGE_CHILDREN)
            size = sum(file.stat().st_size for file in Path(folder).iterdir())
            began_s = time.perf_counter()
            for _ in stored_scenes(recipes, folder=Path(folder)):
                pass
            opened_s = time.perf_counter() - began_s
        own, worker = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, worker_s.ru_maxrss  # KiB
        cores, core_s = available_cores(), worker_s.ru_utime + worker_s.ru_stime  # of all sources so far
        say(
            f"  {len(every)} scenes on {cores} cores: {made_s:.0f} s to make, pack and keep them "
            f"({core_s - before_s:.0f} s of the processor), {size / 1e9:.1f} GB; {opened_s:.0f} s to open them; "
            f"at most {(own + cores * worker) / 2**20:.2f} GiB of memory"
        )
        before_s = core_s


def say(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
