"""Stored scenes are packed scenes, bit for bit, whatever state their folder is in, and take no memory without end."""

import os
import signal
import subprocess
import sys
import time
import weakref

import numpy as np
import pytest

from tests.driving_scene import street
from warpav.core import cache as core_cache
from warpav.core.errors import InputError
from warpav.scene import DeviceScene, SceneRecipe, TownSource, read_scene, stored_scenes, town_scene, write_scene
from warpav.scene import _stored_scene as module
from warpav.scene.town._vehicle_shapes import ego_mesh

SEEDS = (0, 7, 500)

# writes half of the file of a scene and is killed
KILLED = """
import os, signal, sys
from pathlib import Path
import numpy as np
from warpav.scene._stored_scene import SceneRecipe, stored_scenes

def half(stream, record, **_):
    stream.write(record.tobytes()[:100_000])
    stream.flush()
    os.kill(os.getpid(), signal.SIGKILL)

np.save = half
list(stored_scenes([SceneRecipe(Path(sys.argv[1]))], folder=Path(sys.argv[2])))
"""


@pytest.fixture(scope="module")
def glb_files(tmp_path_factory):
    """Small scenes: of 5 vehicles, of none, and of 3."""
    folder = tmp_path_factory.mktemp("glb")
    files = []
    for seed, count in enumerate((5, 0, 3)):
        write_scene(street(count, seed, 1), folder / f"scene_{seed}.glb")
        files.append(folder / f"scene_{seed}.glb")
    return files


@pytest.fixture
def recipes(glb_files):
    return [SceneRecipe(file) for file in glb_files]


@pytest.fixture
def made(monkeypatch):
    """Sources of scenes that were made in this process."""
    sources, real = [], SceneRecipe.scene

    def scene(self):
        sources.append(self.source)
        return real(self)

    monkeypatch.setattr(SceneRecipe, "scene", scene)
    return sources


def assert_identical(stored, packed):
    one, other = stored.arrays(), packed.arrays()
    assert one.keys() == other.keys()
    for name, array in other.items():
        found = one[name]
        assert (found.dtype, found.shape, found.tobytes()) == (array.dtype, array.shape, array.tobytes()), name
    assert (stored.name, stored.category) == (packed.name, packed.category)
    assert stored.vehicle_count == packed.vehicle_count
    assert stored.fingerprint == packed.fingerprint
    assert type(stored).__mro__[1] is DeviceScene


def test_stored_scenes_are_those_that_are_made_and_packed(tmp_path, made):
    recipes = [SceneRecipe(TownSource(seed)) for seed in SEEDS]
    for _ in range(2):
        for seed, scene in zip(SEEDS, stored_scenes(recipes, folder=tmp_path), strict=True):
            assert_identical(scene, DeviceScene.pack(town_scene(seed)))
            np.testing.assert_array_equal(scene.ego_bounds_m, ego_mesh().bounds_m())
    assert made == [TownSource(seed) for seed in SEEDS]


def test_vehicle_targets_and_mirror_images_are_part_of_a_scene(tmp_path, monkeypatch):
    monkeypatch.setattr(core_cache, "_PARALLEL_MIN", 5)
    ego = ego_mesh().transformed(1.2 * np.eye(3), np.array([7.0, 0.0, 0.0]))
    targets = ("vehicle", "pedestrian")
    recipes = [
        SceneRecipe(TownSource(7), ego, targets),
        SceneRecipe(TownSource(7), None, targets),
        SceneRecipe(TownSource(7), ego),
        SceneRecipe(TownSource(7), ego, targets, is_mirrored=True),
    ]
    assert len({recipe.file_name for recipe in recipes}) == 4
    whole = town_scene(7)
    around = whole.around(ego)
    expected = [
        around.targeting(targets),
        whole.targeting(targets),
        around.targeting(["vehicle"]),
        around.targeting(targets).mirrored(),
    ]
    for _ in range(2):
        for scene, each in zip(stored_scenes(recipes, folder=tmp_path), expected, strict=True):
            assert_identical(scene, DeviceScene.pack(each))
    assert [scene.left_out for scene in stored_scenes(recipes, folder=tmp_path)] == [
        count := len(whole.road_users) - len(around.road_users),
        0,
        count,
        count,
    ]


def test_processes_make_the_same_files_and_say_what_cannot_be_made(tmp_path, glb_files, recipes, monkeypatch, made):
    monkeypatch.setattr(core_cache, "_PARALLEL_MIN", 2)
    (tmp_path / "scene_9.glb").write_bytes(b"no scene")
    wrong = [*recipes, SceneRecipe(tmp_path / "scene_9.glb")]
    with pytest.raises(InputError, match=r"scene_9\.glb"):
        list(stored_scenes(wrong, folder=tmp_path / "two", worker_count=2))
    scenes = list(stored_scenes([*recipes, recipes[0]], folder=tmp_path / "two", worker_count=2))
    assert made == [tmp_path / "scene_9.glb"]  # the others not here
    for file, scene in zip([*glb_files, glb_files[0]], scenes, strict=True):
        assert_identical(scene, DeviceScene.pack(read_scene(file).targeting(["vehicle"])))
    list(stored_scenes(recipes, folder=tmp_path / "one", worker_count=1))
    two, one = ({file.name: file.read_bytes() for file in (tmp_path / name).iterdir()} for name in ("two", "one"))
    assert two == one


@pytest.mark.parametrize(
    "damage",
    [lambda whole: b"", lambda whole: whole[:5000], lambda whole: whole[:-1], lambda whole: whole[:9000] + b"\xff" * 9],
    ids=["empty", "cut", "a byte short", "short and overwritten"],
)
def test_a_damaged_file_is_made_again(tmp_path, recipes, made, damage):
    list(stored_scenes(recipes, folder=tmp_path))
    file = tmp_path / recipes[0].file_name
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    made.clear()
    list(stored_scenes(recipes, folder=tmp_path))
    assert made == [recipes[0].source]
    assert file.read_bytes() == whole


def test_meshes_are_held_up_to_a_size_and_then_let_go(tmp_path, recipes, monkeypatch):
    list(stored_scenes(recipes, folder=tmp_path))
    monkeypatch.setattr(module, "_held", module._Held())
    monkeypatch.setattr(module, "_recent", module.deque(maxlen=2))
    size = (tmp_path / recipes[0].file_name).stat().st_size
    monkeypatch.setattr(module, "HELD_BYTES", 2 * size)  # for two, as the others are no larger
    scenes = [next(stored_scenes(recipes[:1], folder=tmp_path)) for _ in range(6)]
    rasters = [weakref.ref(scene.raster) for scene in scenes]
    assert [raster() is not None for raster in rasters] == [True, True, False, False, True, True]
    assert scenes[0].raster is rasters[0]()
    assert scenes[5].raster is rasters[5]()  # it was used last
    del scenes[0]
    third = weakref.ref(scenes[1].raster)  # there is room for it now
    for scene in (scenes[2], scenes[3], scenes[4]):
        assert scene.raster.triangle_count
    assert third() is scenes[1].raster


def test_a_process_that_is_killed_leaves_nothing_that_is_taken_for_a_scene(tmp_path, glb_files, recipes, made):
    folder = tmp_path / "kept"
    done = subprocess.run([sys.executable, "-c", KILLED, glb_files[0], folder], check=False)
    assert done.returncode == -signal.SIGKILL
    (draft,) = folder.iterdir()
    assert draft.name.startswith(".draft-")
    list(stored_scenes(recipes, folder=folder))
    assert made == [recipe.source for recipe in recipes]
    assert draft.is_file()  # somebody may be writing it
    old = time.time() - 2 * 3600.0
    os.utime(draft, (old, old))
    list(stored_scenes(recipes, folder=folder))
    assert sorted(file.name for file in folder.iterdir()) == sorted(recipe.file_name for recipe in recipes)


def test_the_scenes_unused_for_longest_go_first_but_none_that_is_asked_for(tmp_path, recipes, monkeypatch):
    list(stored_scenes(recipes, folder=tmp_path))
    for age, recipe in enumerate(recipes):
        os.utime(tmp_path / recipe.file_name, (1e9 - age, 1e9 - age))
    size = max((tmp_path / recipe.file_name).stat().st_size for recipe in recipes)
    monkeypatch.setattr(module, "CAPACITY_BYTES", 2 * size)
    list(stored_scenes(recipes[2:], folder=tmp_path))
    assert {file.name for file in tmp_path.iterdir()} == {recipes[0].file_name, recipes[2].file_name}
    monkeypatch.setattr(module, "CAPACITY_BYTES", 1)
    list(stored_scenes(recipes, folder=tmp_path))
    assert len(list(tmp_path.iterdir())) == 3
