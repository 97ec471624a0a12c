"""Hashes of what something is made with: they change with every part and with the code, and with nothing else."""

import shutil
import subprocess
import sys
from dataclasses import replace

import pytest

from warpav.core import fingerprint as module
from warpav.core.fingerprint import fingerprint
from warpav.scene.capture.plan import PlanSettings
from warpav.scene.reconstruction.settings import MeshSettings, ReconstructionSettings

PLAN, MESHES = PlanSettings(), ReconstructionSettings()


@pytest.fixture
def copied_code(tmp_path, monkeypatch):
    """A copy of the code that the hash covers, which a test may change; forgets the hash before and after."""
    folders = [shutil.copytree(folder, tmp_path / folder.name) for folder in module._code_folders()]
    monkeypatch.setattr(module, "_code_folders", lambda: folders)
    module._code_hash.cache_clear()
    yield tmp_path
    module._code_hash.cache_clear()


def test_a_fingerprint_is_16_hexadecimal_digits_and_stays():
    assert len(fingerprint("town", 3)) == 16
    assert int(fingerprint("town", 3), 16) >= 0
    assert fingerprint("town", 3, PLAN) == fingerprint("town", 3, replace(PLAN))
    code = "from warpav.core.fingerprint import fingerprint; print(fingerprint('town', 3))"
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert other.stdout.strip() == fingerprint("town", 3)  # in another process, where strings hash otherwise


@pytest.mark.parametrize(
    "parts",
    [
        ("town", 4, PLAN, MESHES),
        ("carla", 3, PLAN, MESHES),
        ("town", 3, replace(PLAN, width_px=641), MESHES),
        ("town", 3, replace(PLAN, scene_heights_m=(14.0, 28.0)), MESHES),
        ("town", 3, PLAN, replace(MESHES, method="signed_distance")),
        ("town", 3, PLAN, replace(MESHES, cloud=replace(MESHES.cloud, radius_m=41.0))),
        ("town", 3, PLAN, replace(MESHES, vehicle=MeshSettings(200_000, 0.03, 0.06, 4501))),
        ("town", 3, PLAN),
        ("town", 3, MESHES, PLAN),
        ("town3", PLAN, MESHES),
        (b"town", 3, PLAN, MESHES),
    ],
)
def test_another_setting_gives_another_fingerprint(parts):
    assert fingerprint(*parts) != fingerprint("town", 3, PLAN, MESHES)


def test_parts_do_not_run_into_one_another():
    assert fingerprint(b"ab", b"c") != fingerprint(b"a", b"bc")


@pytest.mark.parametrize(
    "file",
    [
        "scene/town/town.py",
        "scene/capture/town_simulator.py",
        "scene/reconstruction/surface.py",
        "warpav_kernels/reconstruction/poisson.py",
    ],
)
def test_changed_code_gives_another_fingerprint(copied_code, file):
    before = fingerprint("town", 3)
    module._code_hash.cache_clear()
    assert fingerprint("town", 3) == before
    with open(copied_code / file, "a") as code:
        code.write("# changed\n")
    module._code_hash.cache_clear()
    assert fingerprint("town", 3) != before


def test_files_that_are_no_code_do_not_matter(copied_code):
    before = fingerprint("town", 3)
    (copied_code / "scene" / "design.md").write_text("a new thought\n")
    (copied_code / "scene" / "capture" / "notes.pyc").write_bytes(b"\0")
    module._code_hash.cache_clear()
    assert fingerprint("town", 3) == before
