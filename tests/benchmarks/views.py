"""Views a second: detection probabilities and depths of the embedded workload of `warpav bench`, 256 x 256 pixels.

A program, not a test: ``python tests/benchmarks/views.py cuda:0 1024,4096 pinhole,fisheye``. The views stand within
some metres of the workload's; a line says the median of seven runs, and the most memory that was held so far.
"""

from __future__ import annotations

import math
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import warp as wp

import warpav.detection
from warpav.detection.probability import DetectionProbability
from warpav.experiments.bench.items import Bench
from warpav.experiments.bench.workload import embedded_workload, pack_workload
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.renderer import Renderer
from warpav.scene.device_scene import DeviceScene


def main() -> None:
    """Measure every lens with every number of views."""
    device, counts, lenses = sys.argv[1:]
    folder = Path(warpav.detection.__file__).parent / "models"
    fits = [DetectionProbability.read(file) for file in sorted(folder.glob("*_p_detected_*.json"))]
    fit = next(fit for fit in fits if fit.record["settings"].get("camera", {}).get("fov_deg") == 90.0)
    workload = embedded_workload()
    scene = pack_workload(workload, device=device)
    place, turn = (array.numpy() for array in Bench(workload, scene, device=device)._placed())
    count = scene.object_count
    cars = DeviceScene(
        "bench", scene, ("car",) * count, np.full(count, -1), np.zeros((count, 2)), np.full(count, np.nan)
    )
    rng = np.random.default_rng(0)
    for lens in lenses.split(","):
        fov_rad = math.radians(90.0 if lens == "pinhole" else 190.0)
        for view_count in map(int, counts.split(",")):
            which = rng.integers(0, len(place), view_count)
            position_m = place[which] + rng.normal(size=(view_count, 3)) * [1.0, 1.0, 0.05]
            position = wp.array(position_m.astype(np.float32), dtype=wp.vec3, device=device)
            rotation = wp.array(turn[which], dtype=wp.mat33, device=device)
            renderer = Renderer([CameraModel(256, 256, fov_rad, lens=lens)] * view_count, device=device)

            def probabilities(renderer=renderer, position=position, rotation=rotation) -> object:
                frame = renderer.render(scene, position, rotation, content=Content.COVERAGE)
                return fit.of_coverage(frame, cars, position).probability

            def depths(renderer=renderer, position=position, rotation=rotation) -> object:
                return renderer.render(scene, position, rotation, content=Content.IMAGES).depths_and_ids()

            for name, draw in (("probabilities", probabilities), ("depths", depths)):
                sys.stdout.write(f"{lens} {view_count} {name}: {timed(draw, view_count, device)}\n")
                sys.stdout.flush()


def timed(draw: Callable[[], object], view_count: int, device: str) -> str:
    """Time, rate and memory of a call."""
    draw()
    times_s = []
    for _ in range(7):
        wp.synchronize_device(device)
        began = time.perf_counter()
        draw()
        wp.synchronize_device(device)
        times_s.append(time.perf_counter() - began)
    time_s = statistics.median(times_s)
    memory = f", {wp.get_mempool_used_mem_high(device) / 2**20:.0f} MiB" if wp.get_device(device).is_cuda else ""
    return f"{1000.0 * time_s:.2f} ms, {view_count / time_s:,.0f} views/s{memory}"


if __name__ == "__main__":
    main()
