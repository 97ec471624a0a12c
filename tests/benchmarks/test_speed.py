"""Speed of what takes the time: a step, a view by lens, the cameras of a pool, requirements, a selection.

Left out of the ordinary run; ``pytest tests/benchmarks/test_speed.py --benchmark-only -n 0 [-k NAME]`` runs it. Extra
figures say what one view or camera takes.
"""

import math

import numpy as np
import pytest
import warp as wp

import warpav as wa
from tests.optimisation.calls import select
from tests.optimisation.objectives import OneScene, thesis_losses
from warpav.experiments.bench._workload import embedded_workload, pack_workload
from warpav.optimisation import AssignedScene, CameraMount, CameraProbability, ZoneAndSpacing
from warpav.optimisation._mount import views_of_rig
from warpav.optimisation._pool import spread_mount_poses
from warpav.optimisation._single_cameras import SingleCameras
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer
from warpav.rig import MountSurface, mount_surface_from_mesh
from warpav.runs._detector_fit import ensure_fit
from warpav.runs.config import Config
from warpav.scene import DeviceScene
from warpav.sight import read_requirements

CAMERA = CameraModel(256, 256, math.radians(90.0))
LENSES = {
    "pinhole 90": CAMERA,
    "brown_conrady 100": CameraModel(
        256, 256, math.radians(100.0), lens="brown_conrady", distortion=(-0.21, 0.06, 0.002, -0.001, -0.008)
    ),
    "fisheye 190": CameraModel(
        256, 256, math.radians(190.0), lens="fisheye", distortion=(-0.013, 0.0021, -0.0042, 0.0007)
    ),
    "panorama": CameraModel(512, 128, 2.0 * math.pi, lens="panorama"),
}


def town_cameras(count, *, seeds=(150,), camera=CAMERA, device="cpu", free=None, thread_count=None):
    """Cameras above a town vehicle by the shipped fit, ``count`` mount poses all over it, and scenes on the device."""
    town = wa.town(seeds)
    surface = mount_surface_from_mesh(town[0].ego)
    mount = CameraMount(surface, camera=camera, height_offset_m=0.25, device=device, free=free)
    cameras = SingleCameras(mount, CameraProbability(ensure_fit(Config(), camera=CAMERA)), thread_count=thread_count)
    pose = spread_mount_poses(mount, ZoneAndSpacing(surface, camera_count=1), count, seed=0)
    return cameras, pose, [DeviceScene.pack(scene, device=device) for scene in town]


@pytest.fixture(scope="module")
def ego():
    (scene,) = wa.town((0,))
    return scene.ego


class Steps:
    """Steps without a detector on the embedded workload, with boxes that cut through what its cameras see."""

    def __init__(self, device, occlusion=Occlusion.EXACT, scenes=1):
        workload = embedded_workload()
        (model,) = set(workload.models(range(len(workload.pose))))
        surface = MountSurface(np.full((64, 64), workload.height_m[0] - 0.25, np.float32), np.array([-3.0, -3.0]), 0.1)
        mount = CameraMount(surface, camera=model, height_offset_m=0.25, device=device)
        cameras = len(workload.pose)
        self.start = np.zeros((cameras, 7), np.float32)
        self.start[:, :3] = workload.pose[:, [1, 0, 2]]  # the workload's z is the ego frame's x
        self.renderer = Renderer([model] * (cameras * mount.rotation_count), occlusion=occlusion, device=device)
        packed = pack_workload(workload, device=device)
        count = packed.object_count
        facts = (("vehicle",) * count, np.zeros(count, np.int32), np.zeros((count, 2)), np.full(count, np.nan))
        assigned = AssignedScene(
            DeviceScene(workload.name, packed, *facts), (np.arange(count) % cameras).astype(np.int32)
        )
        self.scenes = [OneScene(mount, self.renderer, assigned, cameras, thesis_losses()) for _ in range(scenes)]
        self.box_px = np.tile(np.float32([60.0, 60.0, 200.0, 200.0]), (cameras, count, 1))

    def gradient(self, pose):
        results = [one.at(pose, self.box_px) for one in self.scenes]
        assert np.isfinite([loss for loss, _ in results]).all()
        return sum(gradient for _, gradient in results)


@pytest.mark.parametrize("occlusion", list(Occlusion), ids=lambda occlusion: occlusion.value)
def test_step(benchmark, device, occlusion):
    """16 views, 10 vehicles, 112,768 triangles."""
    steps = Steps(device, occlusion)
    benchmark.pedantic(lambda: steps.gradient(steps.start), rounds=15, warmup_rounds=3)
    assert not steps.renderer.grew()


@pytest.mark.parametrize("content", [Content.IMAGES, Content.COVERAGE, Content.ALL], ids=lambda each: each.value)
@pytest.mark.parametrize("lens", LENSES)
def test_view(benchmark, device, lens, content):
    """Views all over the vehicle: 16 on one thread, 1,024 on a GPU."""
    count = 16 if device == "cpu" else 1024
    cameras, pose, (scene,) = town_cameras(count, device=device)
    views = views_of_rig(cameras.mount.rig(pose), rotation_count=1, rotation_step_rad=1.0, device=device)
    renderer = Renderer([LENSES[lens]] * count, thread_count=1, device=device)

    def render():
        renderer.render(scene.raster, views.position_ego_m, views.camera_from_ego, content=content)
        wp.synchronize_device(device)

    benchmark.pedantic(render, rounds=5, warmup_rounds=1)
    benchmark.extra_info["ms_per_view"] = 1e3 * benchmark.stats.stats.min / count


@pytest.mark.parametrize("template", ["r158_like", "near_field"])
@pytest.mark.parametrize("count", [4, 10])
def test_requirements(benchmark, ego, template, count):
    rig, wanted = wa.Rig(wa.preset("edgar").cameras[-count:]), read_requirements(template)
    result = benchmark.pedantic(lambda: wa.check_requirements(rig, ego, wanted).is_point_met, rounds=5, warmup_rounds=1)
    benchmark.extra_info["points"] = len(result)


@pytest.mark.parametrize(
    ("name", "count", "gap"),
    [("pool_2x60", 2, 0.0), ("pool_4x90", 4, 0.0), ("pool_150", 4, 0.0), *(("pool_150", k, 1e-3) for k in range(4, 9))],
)
def test_selection(benchmark, pool_folder, name, count, gap):
    """Until a rig is proven to be within the gap of the best; ``WARPAV_TEST_POOLS`` names the pools."""
    probability = np.load(pool_folder / f"{name}.npz")["P"]
    found = benchmark.pedantic(lambda: select(probability, count, gap=gap, time_limit_s=300.0), rounds=1, iterations=1)
    benchmark.extra_info |= {"objective": found.objective, "bound": found.bound, "nodes": found.nodes}
    assert found.gap <= max(gap, 1e-9)
