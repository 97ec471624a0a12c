"""A pool on one GPU against the same pool on several, one process each: the ratio of the times, and the same bytes.

A program, not a test: ``python tests/benchmarks/pool_gpus.py --gpus 2``. Both ways start new processes, so that each
pays for its own start. ``--seconds`` says about how long one GPU is to be busy.
"""

from __future__ import annotations

import argparse
import time

import warpav as wa
from tests.benchmarks.test_pool import shipped_fit
from tests.optimisation.calls import draw
from warpav.core.executor import Executor
from warpav.optimisation.constraints import ZoneAndSpacing
from warpav.optimisation.losses.scene_on_tape import CameraProbability
from warpav.optimisation.mount import CameraMount
from warpav.optimisation.pool import CHUNK_CAMERAS, CameraPool, spread_mount_poses
from warpav.optimisation.single_cameras import SingleCameras
from warpav.raster.camera import CameraModel
from warpav.rig.mount_surface import mount_surface_from_mesh
from warpav.scene.device_scene import DeviceScene


def main() -> None:
    """Draw the pool both ways and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gpus", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=90.0)
    parser.add_argument("--side-px", type=int, default=640)
    parser.add_argument("--device", default="cuda:0")
    settings = parser.parse_args()
    town = wa.town(range(200, 208))
    scenes = [DeviceScene.pack(scene, device=settings.device) for scene in town]
    surface = mount_surface_from_mesh(town[0].ego)
    camera = CameraModel(settings.side_px, settings.side_px)
    mount = CameraMount(surface, camera=camera, height_offset_m=0.25, device=settings.device)
    cameras = SingleCameras(mount, CameraProbability(shipped_fit()))
    placed = ZoneAndSpacing(surface, camera_count=1)

    def drawn(count: int, executor: Executor | None) -> tuple[CameraPool, float]:
        pose = spread_mount_poses(mount, placed, count, seed=0)
        began = time.perf_counter()
        pool = draw(pose, scenes=scenes, cameras=cameras, executor=executor)
        return pool, time.perf_counter() - began

    drawn(CHUNK_CAMERAS, None)  # compiles
    _, seconds = drawn(CHUNK_CAMERAS, None)
    count = CHUNK_CAMERAS * max(2, round(settings.seconds / seconds))
    each_ms = 1e3 * seconds / CHUNK_CAMERAS / len(scenes)
    print(f"{count * len(scenes)} renders of {settings.side_px} px; {each_ms:.3f} ms each in this process")  # noqa: T201
    one, one_s = drawn(count, Executor("process", 1))
    several, several_s = drawn(count, Executor("process", settings.gpus, gpu_count=settings.gpus))
    same = one.detection_probability.tobytes() == several.detection_probability.tobytes()
    print(f"one GPU {one_s:.1f} s, {settings.gpus} GPUs {several_s:.1f} s: {several_s / one_s:.3f}; same bytes: {same}")  # noqa: T201


if __name__ == "__main__":
    main()
