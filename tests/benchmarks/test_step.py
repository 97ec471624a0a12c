"""Time of an optimisation step without a detector, on the embedded workload: 16 views, 10 vehicles, 112,768 triangles.

Left out of the ordinary run; ``pytest tests/benchmarks --benchmark-only`` runs it.
"""

import numpy as np
import pytest
import warp as wp

from tests.optimisation.objectives import OneScene, thesis_losses
from warpav.experiments.bench.workload import embedded_workload, pack_workload
from warpav.optimisation.losses.scene_on_tape import AssignedScene
from warpav.optimisation.mount import CameraMount
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer
from warpav.rig.mount_surface import MountSurface
from warpav.scene.device_scene import DeviceScene
from warpav.thesis.descent import AdamW

SCENES, ITERATIONS = 4, 100


class Steps:
    """Steps of one rig on some scenes, with boxes that cut through what its cameras see."""

    def __init__(self, device, occlusion=Occlusion.EXACT):
        workload = embedded_workload()
        (model,) = set(workload.models(range(len(workload.pose))))
        surface = MountSurface(np.full((64, 64), workload.height_m[0] - 0.25, np.float32), np.array([-3.0, -3.0]), 0.1)
        mount = CameraMount(surface, camera=model, height_offset_m=0.25, device=device)
        cameras = len(workload.pose)
        self.start = np.zeros((cameras, 7), np.float32)
        self.start[:, :3] = workload.pose[:, [1, 0, 2]]  # the workload's z is the ego frame's x
        self.device = device
        self.renderer = Renderer([model] * (cameras * mount.rotation_count), occlusion=occlusion, device=device)
        packed = pack_workload(workload, device=device)
        vehicles = packed.object_count
        scene = DeviceScene(
            workload.name,
            packed,
            ("vehicle",) * vehicles,
            np.zeros(vehicles, np.int32),
            np.zeros((vehicles, 2)),
            np.full(vehicles, np.nan),
        )
        self.scenes = [
            OneScene(
                mount,
                self.renderer,
                AssignedScene(scene, (np.arange(vehicles) % cameras).astype(np.int32)),
                cameras,
                thesis_losses(),
            )
            for _ in range(SCENES)
        ]
        self.box_px = np.tile(np.float32([60.0, 60.0, 200.0, 200.0]), (cameras, vehicles, 1))

    def run(self, pose, scenes=SCENES):
        """One step at a rig: the gradient over some scenes."""
        results = [one.at(pose, self.box_px) for one in self.scenes[:scenes]]
        assert np.isfinite([loss for loss, _ in results]).all()
        return sum(gradient for _, gradient in results)

    def descend(self):
        """A hundred iterations on four scenes."""
        rate = np.zeros_like(self.start)
        rate[:, :3] = 1e-3
        adam = AdamW(self.start, weight_decay=1e-3)
        for _ in range(ITERATIONS):
            adam.step(self.run(adam.value), rate)


@pytest.mark.parametrize("occlusion", list(Occlusion), ids=lambda occlusion: occlusion.value)
def test_step(benchmark, device, occlusion):
    steps = Steps(device, occlusion)

    def call():
        steps.run(steps.start, 1)

    benchmark.pedantic(call, rounds=15, warmup_rounds=3)
    assert not steps.renderer.grew()


@pytest.mark.gpu
@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device")
def test_four_scenes_a_hundred_times(benchmark):
    steps = Steps("cuda:0")
    benchmark.pedantic(steps.descend, rounds=3, warmup_rounds=1)
    assert not steps.renderer.grew()
