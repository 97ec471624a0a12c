"""Time of a camera render: detection probabilities of all objects of a town scene in one camera of 256 x 256 pixels.

Left out of the ordinary run; ``pytest tests/benchmarks/test_pool.py --benchmark-only`` runs it. A round is 256 cameras
in one scene; ``ms_per_camera_render`` among the extra figures is what that takes for one.
"""

from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warpav as wa
import warpav.detection
from warpav.detection.probability import Appearance, DetectionProbability
from warpav.optimisation.constraints import ZoneAndSpacing
from warpav.optimisation.losses.scene_on_tape import CameraProbability
from warpav.optimisation.mount import CameraMount
from warpav.optimisation.pool import spread_mount_poses
from warpav.optimisation.single_cameras import SingleCameras
from warpav.raster.camera import CameraModel
from warpav.raster.renderer import Renderer
from warpav.rig.mount_surface import mount_surface_from_mesh
from warpav.scene.device_scene import DeviceScene

CAMERAS, RIG = 256, 4
SEEDS = (150, 151, 152)


def shipped_fit():
    """The built-in detector's model for cameras of 90 degrees."""
    folder = Path(warpav.detection.__file__).parent / "models"
    fits = [DetectionProbability.read(file) for file in sorted(folder.glob("*_p_detected_*.json"))]
    return next(fit for fit in fits if fit.record["settings"].get("camera", {}).get("fov_deg") == 90.0)


@pytest.fixture(scope="module")
def town():
    """Scenes, and the vehicle that they share."""
    scenes = wa.town(SEEDS)
    return scenes, mount_surface_from_mesh(scenes[0].ego)


class Work:
    """Cameras all over the vehicle, and the scenes on a device."""

    def __init__(self, town, device, thread_count=None):
        scenes, surface = town
        self.scenes = [DeviceScene.pack(scene, device=device) for scene in scenes]
        mount = CameraMount(surface, camera=CameraModel(256, 256), height_offset_m=0.25, device=device)
        self.pose = spread_mount_poses(mount, ZoneAndSpacing(surface, camera_count=1), CAMERAS, seed=0)
        self.cameras = SingleCameras(mount, CameraProbability(shipped_fit()), thread_count=thread_count)


def measure(benchmark, call, renders):
    benchmark.pedantic(call, rounds=5, warmup_rounds=1)
    benchmark.extra_info["ms_per_camera_render"] = 1e3 * benchmark.stats.stats.min / renders


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("thread_count", [1, None], ids=["one_thread", "all_cores"])
def test_single_cameras(benchmark, device, town, seed, thread_count):
    work = Work(town, device, thread_count)
    scene = work.scenes[SEEDS.index(seed)]
    measure(benchmark, lambda: work.cameras.detection_probability(work.pose, scene), CAMERAS)


@pytest.mark.parametrize("seed", SEEDS)
def test_as_rigs_are_measured(benchmark, device, town, seed):
    """The same numbers on the way that a loss takes: outlines, Jacobians and images, four cameras at a time."""
    work = Work(town, device)
    scene, mount = work.scenes[SEEDS.index(seed)], work.cameras.mount
    renderer = Renderer([mount.camera] * RIG, device=device)
    found = np.zeros((CAMERAS, scene.vehicle_count), np.float32)

    def call():
        for first in range(0, CAMERAS, RIG):
            views = mount.place(wp.array(work.pose[first : first + RIG], dtype=float, device=device), 1)
            pose = (views.position_ego_m, views.camera_from_ego, views.log_zoom)
            frame = renderer.render(scene.raster, *pose[:2], log_focal=pose[2])
            frame.colours()
            seen = work.cameras.probability.model.on_tape(Appearance.of(frame, scene), *pose)
            found[first : first + RIG] = seen.probability.numpy()

    measure(benchmark, call, CAMERAS)
    np.testing.assert_allclose(found, work.cameras.detection_probability(work.pose, scene), atol=1e-5)
