"""Most memory that renders of many cameras hold, and their time, by the size of the images.

A program, not a test: ``python tests/benchmarks/memory.py 256x256,1920x1080,3840x2160``. Every line is a process of its
own: what is rendered, the most memory less that before the first render [MB], the time of the second call [s], and a
hash of the numbers.
"""

from __future__ import annotations

import hashlib
import math
import multiprocessing
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import warpav as wa
import warpav.detection
from warpav.detection.probability import DetectionProbability
from warpav.optimisation.constraints import ZoneAndSpacing
from warpav.optimisation.losses.scene_on_tape import CameraProbability
from warpav.optimisation.mount import CameraMount
from warpav.optimisation.mount_errors import MountErrors
from warpav.optimisation.pool import spread_mount_poses
from warpav.optimisation.required_points import RequiredPoints
from warpav.optimisation.single_cameras import MisplacedCameras, SingleCameras
from warpav.raster.camera import CameraModel
from warpav.requirements.read import read_requirements
from warpav.rig.mount_surface import mount_surface_from_mesh
from warpav.scene.device_scene import DeviceScene

CAMERAS, RIG = 48, 6
WORK = ("single cameras", "Jacobians", "Jacobians with errors of mounting", "requirements", "Jacobians of requirements")


def main() -> None:
    """Measure every kind of work with every size."""
    for size in sys.argv[1].split(","):
        for name in WORK:
            process = multiprocessing.get_context("spawn").Process(target=measure, args=(name, size))
            process.start()
            process.join()


def measure(name: str, size: str) -> None:
    """Measure one kind of work with images of one size."""
    width_px, height_px = map(int, size.split("x"))
    scenes = list(wa.town((150, 151)))
    ego, surface = scenes[0].ego, mount_surface_from_mesh(scenes[0].ego)
    mount = CameraMount(surface, camera=CameraModel(width_px, height_px, math.radians(90.0)), height_offset_m=0.25)
    pose = spread_mount_poses(mount, ZoneAndSpacing(surface, camera_count=1), CAMERAS, seed=0)
    folder = Path(warpav.detection.__file__).parent / "models"
    fits = [DetectionProbability.read(file) for file in sorted(folder.glob("*_p_detected_*.json"))]
    fit = next(fit for fit in fits if fit.record["settings"].get("camera", {}).get("fov_deg") == 90.0)
    cameras = SingleCameras(mount, CameraProbability(fit))
    misplaced = MisplacedCameras.of(cameras, MountErrors(0.02, math.radians(1.0)))
    packed = [DeviceScene.pack(scene) for scene in scenes]
    ghosts = RequiredPoints(read_requirements("near_field"), ego)
    work: dict[str, Callable[[], tuple[np.ndarray, ...]]] = {
        WORK[0]: lambda: tuple(cameras.detection_probability(pose, scene) for scene in packed),
        WORK[1]: lambda: cameras.with_jacobian(pose[:RIG], packed),
        WORK[2]: lambda: misplaced.with_jacobian(pose[:RIG], packed),
        WORK[3]: lambda: (cameras.detection_probability(pose, ghosts),),
        WORK[4]: lambda: cameras.with_jacobian(pose[:RIG], [ghosts]),
    }
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    work[name]()
    began = time.perf_counter()
    found = work[name]()
    time_s = time.perf_counter() - began
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    bits = hashlib.sha256(b"".join(each.tobytes() for each in found)).hexdigest()[:12]
    sys.stdout.write(f"{size} {name}: {(most - before) / 1000:.0f} MB, {time_s:.2f} s, {bits}\n")


if __name__ == "__main__":
    main()
