"""Hashes change with every part and with the code, and with nothing else; caches do not grow without end."""

import functools
import importlib.util
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from warpav.core import cache as module
from warpav.core.cache import fingerprint as fingerprint_of
from warpav.scene import PlanSettings, ReconstructionSettings

TOWN = "warpav.scene.town._town"
fingerprint = functools.partial(fingerprint_of, code=(TOWN,))
PLAN, MESHES = PlanSettings(), ReconstructionSettings()


def no_code(_, names):
    return [name for name in names if name == "__pycache__" or Path(name).suffix not in ("", ".py", ".md")]


@pytest.fixture
def copied_code(tmp_path, monkeypatch):
    """A copy of the code, which a test may change; forgets the hashes before and after."""
    package = Path(module.__file__).parents[1]
    kernels = Path(importlib.util.find_spec("warpav_kernels").origin).parent
    for folder in (package, kernels):
        shutil.copytree(folder, tmp_path / folder.name, ignore=no_code)
    original = module._source_file

    def copied_file(name):
        file = original(name)
        for folder in (package, kernels):
            if file is not None and file.is_relative_to(folder):
                return tmp_path / folder.name / file.relative_to(folder)
        return None

    monkeypatch.setattr(module, "_source_file", copied_file)
    module._code_hash.cache_clear()
    yield tmp_path
    module._code_hash.cache_clear()


def test_a_fingerprint_is_16_hexadecimal_digits_and_stays():
    assert len(fingerprint("town", 3)) == 16
    assert int(fingerprint("town", 3), 16) >= 0
    assert fingerprint("town", 3, PLAN) == fingerprint("town", 3, replace(PLAN))
    code = f"from warpav.core.cache import fingerprint; print(fingerprint('town', 3, code=['{TOWN}']))"
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert other.stdout.strip() == fingerprint("town", 3)  # in another process, where strings hash otherwise


def test_parts_do_not_run_into_one_another():
    assert fingerprint(b"ab", b"c") != fingerprint(b"a", b"bc")


@pytest.mark.parametrize(
    ("code", "file"),
    [
        (TOWN, "warpav/scene/town/_town.py"),
        (TOWN, "warpav/scene/town/_houses.py"),
        (TOWN, "warpav/raster/mesh.py"),
        ("warpav.scene.capture._town_simulator", "warpav/scene/capture/_town_simulator.py"),
        ("warpav.scene.capture._town_simulator", "warpav/scene/town/_town.py"),
        ("warpav.scene.reconstruction._reconstruct", "warpav/scene/reconstruction/_surface.py"),
        ("warpav.scene.reconstruction._reconstruct", "warpav_kernels/reconstruction/poisson.py"),
    ],
)
def test_changed_code_gives_another_fingerprint(copied_code, code, file):
    before = fingerprint_of("town", 3, code=(code,))
    module._code_hash.cache_clear()
    assert fingerprint_of("town", 3, code=(code,)) == before
    with open(copied_code / file, "a") as source:
        source.write("# changed\n")
    module._code_hash.cache_clear()
    assert fingerprint_of("town", 3, code=(code,)) != before


@pytest.mark.parametrize(
    "file",
    [
        "warpav/scene/design.md",
        "warpav/scene/capture/_folder.py",
        "warpav/rig/_rig.py",
        "warpav/view/_picture.py",
        "warpav_kernels/raster/measure.py",
    ],
)
def test_what_a_town_is_not_made_with_does_not_matter(copied_code, file):
    before = fingerprint("town", 3)
    with open(copied_code / file, "a") as source:
        source.write("# changed\n")
    module._code_hash.cache_clear()
    assert fingerprint("town", 3) == before


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Three files of 100 bytes on a disk with room: one used long ago, one ten minutes ago, one now."""
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(total=1000, used=0, free=1000))
    for name, age_s in (("old", 2.0 * module._IN_USE_S), ("used", 600.0), ("new", 0.0)):
        (tmp_path / name).write_bytes(bytes(100))
        os.utime(tmp_path / name, (time.time() - age_s,) * 2)
    return tmp_path


def left_in(folder, capacity_bytes):
    module.remove_oldest(folder, "*", capacity_bytes=capacity_bytes)
    return {file.name for file in folder.iterdir()}


def test_what_another_run_may_be_using_stays(folder):
    assert left_in(folder, 300) == {"old", "used", "new"}
    assert left_in(folder, 100) == {"used", "new"}


def test_on_a_full_disk_the_capacity_counts(folder, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(total=1000, used=950, free=50))
    assert left_in(folder, 100) == {"new"}


def test_a_folder_that_is_not_there_is_empty(tmp_path):
    module.remove_oldest(tmp_path / "none", "*", capacity_bytes=0)
