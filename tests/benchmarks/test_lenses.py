"""Time of a view of a town scene by lens, 256 x 256 pixels or as many, on one thread of the CPU.

Left out of the ordinary run; ``pytest tests/benchmarks/test_lenses.py --benchmark-only`` runs it. A round is 16 views
all over the vehicle; ``ms_per_view`` among the extra figures is what that takes for one.
"""

import math

import pytest

import warpav as wa
from warpav.optimisation.constraints import ZoneAndSpacing
from warpav.optimisation.mount import CameraMount, views_of_rig
from warpav.optimisation.pool import spread_mount_poses
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.renderer import Renderer
from warpav.rig.mount_surface import mount_surface_from_mesh
from warpav.scene.device_scene import DeviceScene

VIEWS = 16
BARREL = (-0.21, 0.06, 0.002, -0.001, -0.008)
KB4 = (-0.013, 0.0021, -0.0042, 0.0007)
LENSES = {
    "pinhole 90": CameraModel(256, 256, math.radians(90.0)),
    "brown_conrady 100": CameraModel(256, 256, math.radians(100.0), lens="brown_conrady", distortion=BARREL),
    "fisheye 190": CameraModel(256, 256, math.radians(190.0), lens="fisheye", distortion=KB4),
    "panorama": CameraModel(512, 128, 2.0 * math.pi, lens="panorama"),
}


@pytest.fixture(scope="module")
def town():
    """A scene, and poses of views in it."""
    (scene,) = wa.town((150,))
    surface = mount_surface_from_mesh(scene.ego)
    mount = CameraMount(surface, camera=LENSES["pinhole 90"], height_offset_m=0.25)
    pose = spread_mount_poses(mount, ZoneAndSpacing(surface, camera_count=1), VIEWS, seed=0)
    views = views_of_rig(mount.rig(pose), rotation_count=1, rotation_step_rad=1.0)
    return DeviceScene.pack(scene, device="cpu").raster, views.position_ego_m, views.camera_from_ego


@pytest.mark.parametrize("content", [Content.IMAGES, Content.COVERAGE, Content.ALL], ids=lambda each: each.value)
@pytest.mark.parametrize("lens", LENSES)
def test_view(benchmark, town, lens, content):
    scene, position, rotation = town
    renderer = Renderer([LENSES[lens]] * VIEWS, thread_count=1)
    benchmark.pedantic(lambda: renderer.render(scene, position, rotation, content=content), rounds=5, warmup_rounds=1)
    benchmark.extra_info["ms_per_view"] = 1e3 * benchmark.stats.stats.min / VIEWS
