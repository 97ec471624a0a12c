"""Time to check a rig against an R158-like area, and a pool of cameras against the near field.

Left out of the ordinary run; ``pytest tests/benchmarks/test_requirements.py --benchmark-only`` runs it.
"""

import math

import numpy as np
import pytest

import warpav as wa
from warpav.optimisation.constraints import ZoneAndSpacing
from warpav.optimisation.mount import CameraMount
from warpav.optimisation.pool import spread_mount_poses
from warpav.raster.camera import CameraModel
from warpav.requirements.read import read_requirements
from warpav.requirements.requirement import Ghosts
from warpav.requirements.visibility import ghost_jacobians, ghost_visibility, poses_of
from warpav.rig.mount_surface import mount_surface_from_mesh
from warpav.scene.files import town

POOL = 256


@pytest.fixture(scope="module")
def ego():
    (scene,) = town((0,))
    return scene.ego


@pytest.mark.parametrize("template", ["r158_like", "near_field"])
@pytest.mark.parametrize("count", [4, 10])
def test_rig(benchmark, ego, template, count):
    rig = wa.Rig(wa.preset("edgar").cameras[-count:])
    wanted = read_requirements(template)
    result = benchmark.pedantic(lambda: wa.check_requirements(rig, ego, wanted).is_point_met, rounds=5, warmup_rounds=1)
    benchmark.extra_info["points"] = len(result)


def test_jacobians(benchmark, ego):
    ghosts = Ghosts.of(read_requirements("r158_like"), ego)
    pose, models = poses_of(wa.Rig(wa.preset("edgar").cameras[-4:]))
    benchmark.pedantic(lambda: ghost_jacobians(pose, models, ghosts, ego), rounds=3, warmup_rounds=1)


def test_pool(benchmark, ego):
    model = CameraModel(640, 480, math.radians(90.0))
    surface = mount_surface_from_mesh(ego)
    mount = CameraMount(surface, camera=model, height_offset_m=0.25)
    mount_pose = spread_mount_poses(mount, ZoneAndSpacing(surface, camera_count=1), POOL, seed=0)
    pose = np.stack([each.ego_from_camera for each in mount.rig(mount_pose).cameras])
    ghosts = Ghosts.of(read_requirements("near_field"), ego)
    benchmark.pedantic(lambda: ghost_visibility(pose, [model] * POOL, ghosts, ego), rounds=3, warmup_rounds=1)
    benchmark.extra_info["ms_per_camera"] = 1e3 * benchmark.stats.stats.min / POOL
