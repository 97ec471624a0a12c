"""Warp says nothing of itself where warpav is used from Python, and compiles kernels while something else is done."""

import subprocess
import sys

PACK = """
from warpav.scene.device_scene import DeviceScene
from warpav.scene.town.town import town_scene
DeviceScene.pack(town_scene(3))
"""


def test_a_scene_is_packed_without_a_word():
    done = subprocess.run([sys.executable, "-c", PACK], check=True, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("", "")


COMPILE = """
import sys, warp
warp.config.kernel_cache_dir = sys.argv[1]
from warpav_kernels.placement import constraint_losses, lagrangian
from warpav_kernels.raster import linearise
from warpav.core.warp_setup import compiling
with compiling("cpu", but=["placement.constraint"]):
    print("meanwhile")
modules = [warp.get_module(module.__name__) for module in (lagrangian, linearise)]
before = [dict(module.execs) for module in modules]
warp.force_load("cpu", modules)  # nothing is left to do
print(all(one and one == module.execs for one, module in zip(before, modules)))
"""


def test_kernels_are_compiled_when_the_block_ends(tmp_path):
    done = subprocess.run([sys.executable, "-c", COMPILE, tmp_path], check=True, capture_output=True, text=True)
    assert (done.stdout.split(), done.stderr) == (["meanwhile", "True"], "")
    compiled = {file.name.rsplit("_", 1)[0].removeprefix("wp_warpav_kernels.") for file in tmp_path.glob("*/wp_*")}
    assert {"placement.lagrangian", "raster.linearise"} <= compiled
    assert "placement.constraint_losses" not in compiled
