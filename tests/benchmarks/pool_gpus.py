"""A pool on one GPU against the same pool on several, one process each: the ratio of the times, and the same bytes.

A program, not a test: ``python tests/benchmarks/pool_gpus.py --gpus 2``. Both ways start new processes, so that each
pays for its own start. ``--seconds`` says about how long one GPU is to be busy.
"""

from __future__ import annotations

import argparse
import time

from tests.benchmarks.test_speed import town_cameras
from tests.optimisation.calls import draw
from warpav.core.executor import Executor
from warpav.optimisation.constraints import ZoneAndSpacing
from warpav.optimisation.pool import CHUNK_CAMERAS, CameraPool, spread_mount_poses
from warpav.raster.camera import CameraModel


def main() -> None:
    """Draw the pool both ways and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gpus", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=90.0)
    parser.add_argument("--side-px", type=int, default=640)
    parser.add_argument("--device", default="cuda:0")
    given = parser.parse_args()
    camera = CameraModel(given.side_px, given.side_px)
    cameras, _, scenes = town_cameras(1, seeds=range(200, 208), camera=camera, device=given.device)
    placed = ZoneAndSpacing(cameras.mount.surface, camera_count=1)

    def drawn(count: int, executor: Executor | None) -> tuple[CameraPool, float]:
        pose = spread_mount_poses(cameras.mount, placed, count, seed=0)
        began = time.perf_counter()
        return draw(pose, scenes=scenes, cameras=cameras, executor=executor), time.perf_counter() - began

    drawn(CHUNK_CAMERAS, None)  # compiles
    _, seconds = drawn(CHUNK_CAMERAS, None)
    count = CHUNK_CAMERAS * max(2, round(given.seconds / seconds))
    each_ms = 1e3 * seconds / CHUNK_CAMERAS / len(scenes)
    print(f"{count * len(scenes)} renders of {given.side_px} px; {each_ms:.3f} ms each in this process")  # noqa: T201
    one, one_s = drawn(count, Executor("process", 1))
    several, several_s = drawn(count, Executor("process", given.gpus, gpu_count=given.gpus))
    same = one.detection_probability.tobytes() == several.detection_probability.tobytes()
    print(f"one GPU {one_s:.1f} s, {given.gpus} GPUs {several_s:.1f} s: {several_s / one_s:.3f}; same bytes: {same}")  # noqa: T201


if __name__ == "__main__":
    main()
