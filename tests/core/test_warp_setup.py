"""Warp says nothing of itself where warpav is used from Python."""

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
