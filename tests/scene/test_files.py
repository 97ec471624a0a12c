"""Collections on disk: what is there stays, what is missing is made, what cannot be used is named and left out."""

import dataclasses
import json
import shutil

import cv2
import numpy as np
import pytest

from warpav.core.errors import InputError
from warpav.core.executor import Executor
from warpav.scene import (
    CaptureTask,
    PlanSettings,
    ReconstructionSettings,
    SceneTask,
    TownSimulator,
    TownSource,
    capture_path,
    capture_scenes,
    captures_in,
    check_captures,
    make_scenes,
    read_capture,
    read_scene,
    scene_path,
    split_seeds,
)
from warpav.scene.capture._folder import DESCRIPTION, UNFINISHED
from warpav.scene.reconstruction._settings import MeshSettings

SEED = 4
PLAN = PlanSettings(vehicle_count=1, width_px=96, height_px=72, scene_heights_m=(20.0,), rotation_count=3)
MESHES = ReconstructionSettings(
    vehicle=MeshSettings(2000, 0.1, 0.2, 400),
    ego=MeshSettings(2000, 0.1, 0.2, 400),
    environment=MeshSettings(4000, 1.0, 2.5, 800),
)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A folder with the capture of one situation."""
    folder = tmp_path_factory.mktemp("recorded") / "captures"
    assert [outcome.error for outcome in capture_scenes([capture_task(folder)])] == [None]
    return folder


@pytest.fixture
def captures(recorded, tmp_path):
    """A copy that a test may spoil."""
    return shutil.copytree(recorded, tmp_path / "captures")


def capture_task(folder, seed=SEED, settings=PLAN):
    return CaptureTask(seed, capture_path(folder, seed), settings)


def scene_tasks(captures, out, settings=MESHES):
    return [
        SceneTask(seed, scene_path(out, seed), capture=capture, settings=settings)
        for seed, capture in captures_in(captures).items()
    ]


def content(folder):
    """Every file of a folder with its bytes and the time at which it was written."""
    return {
        file.relative_to(folder).as_posix(): (file.read_bytes(), file.stat().st_mtime_ns)
        for file in folder.rglob("*")
        if file.is_file()
    }


def bytes_of(folder):
    return {name: data for name, (data, _) in content(folder).items()}


def edit(**changes):
    """Spoil the description of a capture; ``vehicles__0__box_size_m`` is the path of a field."""

    def spoil(folder):
        description = json.loads((folder / DESCRIPTION).read_text())
        for path, value in changes.items():
            *parents, last = (int(part) if part.isdigit() else part for part in path.split("__"))
            place = description
            for name in parents:
                place = place[name]
            place[last] = value
        (folder / DESCRIPTION).write_text(json.dumps(description))

    return spoil


def shorten(name, share):
    def spoil(folder):
        file = folder / "images" / name
        file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])

    return spoil


def remove(name):
    return lambda folder: (folder / "images" / name).unlink()


def replace_image(name, image):
    return lambda folder: cv2.imwrite(str(folder / "images" / name), image)


# ------------------------------------------------------------------------------------------------ capturing


def test_a_capture_that_is_there_is_left_alone(captures):
    before = content(captures)
    (outcome,) = capture_scenes([capture_task(captures)])
    assert (outcome.result, outcome.error) == (False, None)
    assert content(captures) == before


@pytest.mark.parametrize("is_finished", [True, False])
def test_missing_and_truncated_images_are_taken_again(captures, recorded, is_finished):
    folder = capture_path(captures, SEED)
    if not is_finished:
        (folder / DESCRIPTION).rename(folder / UNFINISHED)
    for spoil in (remove("rotation_2_rgb.png"), shorten("rotation_1_depth.png", 0.7), shorten("ego_top_rgb.png", 0.0)):
        spoil(folder)
    kept = "images/rotation_0_rgb.png"
    before = content(folder)
    (outcome,) = capture_scenes([capture_task(captures)])
    assert (outcome.result, outcome.error) == (True, None)
    assert content(folder)[kept] == before[kept]
    assert bytes_of(captures) == bytes_of(recorded)


def test_an_interruption_between_two_images_costs_nothing(tmp_path, recorded, monkeypatch):
    capture = TownSimulator.capture

    def interrupted(self, view):
        if view.name == "rotation_1":
            raise KeyboardInterrupt
        return capture(self, view)

    with monkeypatch.context() as patch:
        patch.setattr(TownSimulator, "capture", interrupted)
        with pytest.raises(KeyboardInterrupt):
            list(capture_scenes([capture_task(tmp_path)]))
    before = content(tmp_path)
    assert not (capture_path(tmp_path, SEED) / DESCRIPTION).exists()
    (outcome,) = capture_scenes([capture_task(tmp_path)])
    assert outcome.error is None
    after = content(tmp_path)
    assert all(after[name] == value for name, value in before.items() if name.endswith(".png"))
    assert bytes_of(tmp_path) == bytes_of(recorded)


def test_other_settings_replace_a_capture_but_never_one_from_elsewhere(captures):
    other = dataclasses.replace(PLAN, rotation_count=2)
    (outcome,) = capture_scenes([capture_task(captures, settings=other)])
    assert (outcome.result, outcome.error) == (True, None)
    assert len(read_capture(capture_path(captures, SEED)).images) == 10
    edit(recipe="")(capture_path(captures, SEED))
    before = content(captures)
    (outcome,) = capture_scenes([capture_task(captures)])
    assert outcome.error.startswith(f"{capture_path(captures, SEED) / DESCRIPTION}: expected a capture that may be")
    assert content(captures) == before


# ------------------------------------------------------------------------------------------------ finding captures


def test_captures_are_found_by_their_numbers(tmp_path, captures):
    shutil.copytree(capture_path(captures, SEED), captures / "drive_0012")
    (captures / "notes").mkdir()
    found = captures_in(captures)
    assert found == {12: captures / "drive_0012", SEED: capture_path(captures, SEED)}
    assert captures_in(captures / "drive_0012") == {12: captures / "drive_0012"}
    with pytest.raises(InputError, match="expected every number once, got drive_0012 as well; rename one"):
        captures_in(shutil.copytree(captures / "drive_0012", captures / "drive_12").parent)
    with pytest.raises(InputError, match=r"notes: expected a capture \(a folder with capture.json\) or a folder of"):
        captures_in(captures / "notes")


def test_unfinished_captures_are_found_and_refused(captures, tmp_path):
    unfinished = shutil.copytree(capture_path(captures, SEED), capture_path(captures, 5))
    (unfinished / DESCRIPTION).rename(unfinished / UNFINISHED)
    lines = []
    assert check_captures(list(captures_in(captures).values()), lines.append) == 1
    assert lines == [
        f"{unfinished / DESCRIPTION}: expected the description of a capture, got an unfinished capture; "
        "run warpav scenes capture again"
    ]
    outcomes = {outcome.task.seed: outcome for outcome in make_scenes(scene_tasks(captures, tmp_path / "scenes"))}
    assert outcomes[SEED].error is None
    assert outcomes[5].error == lines[0]


# ------------------------------------------------------------------------------------------------ reconstructing


@pytest.fixture(scope="module")
def reconstructed(recorded, tmp_path_factory):
    """A folder with the scene of the capture."""
    out = tmp_path_factory.mktemp("reconstructed") / "scenes"
    (outcome,) = make_scenes(scene_tasks(recorded, out))
    assert (outcome.result, outcome.error) == (True, None)
    return out


def test_a_scene_of_other_settings_or_another_capture_is_made_again(captures, recorded, reconstructed, tmp_path):
    out = shutil.copytree(reconstructed, tmp_path / "scenes")
    other = dataclasses.replace(MESHES, vehicle=MeshSettings(2000, 0.1, 0.2, 200))
    (outcome,) = make_scenes(scene_tasks(recorded, out, other))
    assert outcome.result is True
    assert len(read_scene(scene_path(out, SEED)).vehicles[0].mesh.triangle) <= 200
    first, second = (scene_tasks(folder, out)[0].fingerprint for folder in (recorded, captures))
    assert first == second  # what a capture holds counts, not where it lies
    file = capture_path(captures, SEED) / "images" / "ego_top_rgb.png"
    cv2.imwrite(str(file), 255 - cv2.imread(str(file)))
    assert scene_tasks(captures, out)[0].fingerprint != first


HOLLOW = [[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 2.0], [0.0, 0.0, 0.0, 1.0]]
REFUSED = [
    (remove("rotation_0_rgb.png"), "images/rotation_0_rgb.png: expected an image, got no such file"),
    (shorten("rotation_0_depth.png", 0.6), "images/rotation_0_depth.png: expected a PNG image, got a file that is"),
    (shorten("ego_top_rgb.png", 0.0), "images/ego_top_rgb.png: expected a PNG image, got a file that is truncated"),
    (
        replace_image("ego_top_depth.png", np.ones((36, 48), np.uint16)),
        "images/ego_top_depth.png: expected 96 x 72 px as capture.json says, got 48 x 36",
    ),
    (
        edit(images__0__ego_from_camera=HOLLOW),
        "capture.json: images[0].ego_from_camera: expected a rotation in the upper left 3 x 3, got one that is off by",
    ),
    (
        replace_image("rotation_0_instance.png", np.full((72, 96), 777, np.uint16)),
        "images/rotation_0_instance.png: expected 0, 65535 and the instance ids of capture.json, got 777, which has",
    ),
    (
        edit(vehicles__0__box_center_m=[0.0, 0.0, 300.0]),
        ": town_0004: vehicle 1: expected at least 200 points in its 3D box, got 0; record it from nearer or remove it",
    ),
]


@pytest.mark.parametrize(("spoil", "message"), REFUSED)
def test_a_capture_that_cannot_be_used_is_named_and_writes_nothing(captures, tmp_path, spoil, message):
    folder = capture_path(captures, SEED)
    spoil(folder)
    before, out = content(captures), tmp_path / "scenes"
    (outcome,) = make_scenes(scene_tasks(captures, out))
    assert outcome.error.startswith(f"{folder}{'' if message.startswith(':') else '/'}{message}")
    assert len(outcome.error.splitlines()) == 1
    assert list(out.iterdir()) == []
    assert content(captures) == before


# ------------------------------------------------------------------------------------------------ building, spreading


def test_processes_make_the_same_files(tmp_path):
    folders = {name: tmp_path / name for name in ("serial", "process")}
    for name, out in folders.items():
        tasks = [SceneTask(seed, scene_path(out, seed), TownSource(seed)) for seed in (1, 2)]
        outcomes = list(make_scenes(tasks, Executor(name, 1)))
        assert sorted(outcome.task.seed for outcome in outcomes) == [1, 2]
        assert [(outcome.result, outcome.error) for outcome in outcomes] == [(True, None)] * 2
    assert bytes_of(folders["serial"]) == bytes_of(folders["process"])


@pytest.mark.parametrize("count", [1, 2, 3, 5, 7, 40, 200])
def test_a_split_is_disjoint_exhaustive_and_stable(count, rng):
    seeds = (100 + 3 * np.arange(count)).tolist()
    split = split_seeds(seeds)
    assert list(split) == ["train", "validation", "test"]
    assert [seed for part in split.values() for seed in part] == seeds  # in order: nothing twice, nothing left out
    assert split_seeds(rng.permutation(seeds).tolist()) == split
    shares = [len(part) / count for part in split.values()]
    np.testing.assert_allclose(shares, [0.6, 0.2, 0.2], atol=1.0 / count)
