"""Scenes from the cache are those of the town, bit for bit, whatever state the cache is in."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest

from warpav.scene import TownSource, level_scene, town_scene
from warpav.scene import _cache as module
from warpav.scene._cache import built_scenes, scene_file

SEEDS = (3, 1000, 12)

# as a user writes it: without asking for __name__ == "__main__"
SCRIPT = """
import sys
from pathlib import Path
from warpav.scene._cache import built_scenes
from warpav.scene.town._levels import TownSource
sources = [TownSource(seed) for seed in range(4)]
print(*(scene.name for scene in built_scenes(sources, folder=Path(sys.argv[1]), worker_count=2)))
"""


def town_scenes(seeds, **options):
    return built_scenes([TownSource(seed) for seed in seeds], **options)


@pytest.fixture(scope="module")
def built():
    return {seed: town_scene(seed) for seed in SEEDS}


@pytest.fixture(scope="module")
def filled_folder(tmp_path_factory, built):
    folder = tmp_path_factory.mktemp("cache")
    for seed, scene in built.items():
        module._write(scene, scene_file(TownSource(seed), folder))
    return folder


@pytest.fixture
def unbuilt(monkeypatch):
    """Seeds that were built in this process, which are none where all is read."""
    seeds = []

    def build(seed, level, fleet, street):
        seeds.append(seed)
        return level_scene(seed, level, fleet, street)

    monkeypatch.setattr("warpav.scene.town._levels.level_scene", build)
    return seeds


def assert_identical(one, other, place="scene"):
    """All fields are of the same types and the same values; arrays of the same type, shape and bits."""
    assert type(one) is type(other), place
    if dataclasses.is_dataclass(one):
        for field in dataclasses.fields(one):
            assert_identical(getattr(one, field.name), getattr(other, field.name), f"{place}.{field.name}")
    elif isinstance(one, tuple):
        assert len(one) == len(other), place
        for k, pair in enumerate(zip(one, other, strict=True)):
            assert_identical(*pair, f"{place}[{k}]")
    elif isinstance(one, np.ndarray):
        assert (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes()), place
    else:
        assert one == other, place


def test_scenes_that_were_read_are_those_that_were_built(filled_folder, built, unbuilt):
    for seed, scene in zip(SEEDS, town_scenes(SEEDS, folder=filled_folder), strict=True):
        assert_identical(scene, built[seed])
    assert unbuilt == []


def test_processes_build_the_same_scenes_from_a_script_of_any_kind(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    folder = tmp_path / "cache"
    done = subprocess.run([sys.executable, script, folder], check=True, capture_output=True, text=True)
    assert (done.stdout.split(), done.stderr) == ([f"town_{seed:04d}" for seed in range(4)], "")
    assert {file.name for file in folder.iterdir()} == {scene_file(TownSource(seed), folder).name for seed in range(4)}
    assert_identical(module.read_kept(scene_file(TownSource(2), folder)), town_scene(2))


@pytest.mark.parametrize(
    "damage",
    [
        lambda whole: b"",
        lambda whole: b"no zip",
        lambda whole: whole[: len(whole) // 2],
        lambda whole: whole[:90_000] + bytes(1000) + whole[91_000:],
    ],
    ids=["empty", "words", "cut", "overwritten"],
)
def test_a_damaged_file_is_built_again(tmp_path, filled_folder, built, unbuilt, damage):
    file = scene_file(TownSource(3), tmp_path)
    whole = scene_file(TownSource(3), filled_folder).read_bytes()
    file.write_bytes(damage(whole))
    [scene] = town_scenes([3], folder=tmp_path)
    assert unbuilt == [3]
    assert_identical(scene, built[3])
    assert file.read_bytes() == whole


def test_where_nothing_can_be_kept_scenes_are_built(tmp_path, built):
    (tmp_path / "file").write_text("in the place of the folder")
    [scene] = town_scenes([3], folder=tmp_path / "file")
    assert_identical(scene, built[3])
