"""The scenes of a run: opened from their files, and nothing found of them before somebody asks."""

import numpy as np
import pytest

from tests.driving_scene import street
from tests.experiments.small_experiment import OPTIONS
from warpav.core.errors import InputError
from warpav.core.progress import NullProgress
from warpav.runs import Placement, SceneSet, load_scene_set, load_scenes
from warpav.runs._scene_set import pack_scenes
from warpav.runs.config import load_config
from warpav.scene import write_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    for seed in range(6):
        write_scene(street(3 + seed % 3, seed, 1), folder / f"scene_{seed}.glb")
    return folder


def config_of(folder, *more):
    return load_config("thesis", [*OPTIONS, f"scenes.folder={folder}", *more])


@pytest.mark.parametrize("mirror", [False, True])
def test_a_scene_set_is_that_of_the_scenes_themselves(folder, mirror):
    config = config_of(
        folder,
        "scenes.train_seeds=[4, 0]",
        "scenes.validation_seeds=[1]",
        "scenes.test_seeds=[2, 3]",
        f"scenes.mirror={mirror}",
    )
    found = load_scene_set(config, NullProgress())
    expected = pack_scenes(load_scenes(config, (4, 0, 1, 2, 3)), (2, 1), config, NullProgress())
    for part in ("train", "validation", "test"):
        one, other = ([scene.fingerprint for scene in getattr(each, part)] for each in (found, expected))
        assert one == other, part
    assert len(found.train) == (4 if mirror else 2)
    np.testing.assert_array_equal(found.ego.vertex_m, expected.ego.vertex_m)
    assert found.shown.name == expected.shown.name
    for one, other in zip(found.areas(found.scenes, 8), expected.areas(expected.scenes, 8), strict=True):
        np.testing.assert_array_equal(one, other)


def test_scenes_around_different_vehicles_are_refused(folder, tmp_path):
    for seed in range(2):
        (tmp_path / f"scene_{seed}.glb").write_bytes((folder / f"scene_{seed}.glb").read_bytes())
    odd = street(3, 2, 1)
    odd = type(odd)("odd", odd.environment, odd.ego.transformed(1.5 * np.eye(3), np.zeros(3)), odd.vehicles)
    write_scene(odd, tmp_path / "scene_2.glb")
    config = config_of(tmp_path, "scenes.train_seeds=[0, 1]", "scenes.test_seeds=[2]")
    with pytest.raises(InputError, match="ego: expected the same vehicle as in the first scene, got another"):
        load_scene_set(config, NullProgress())


def test_nothing_is_rendered_before_somebody_asks(folder, monkeypatch):
    rendered = []
    real = SceneSet.areas_of

    def areas_of(self, scenes, rotation_count):
        rendered.extend(scene.name for scene in scenes)
        return real(self, scenes, rotation_count)

    monkeypatch.setattr(SceneSet, "areas_of", areas_of)
    config = config_of(folder, "scenes.train_seeds=[0, 1, 4]", "scenes.test_seeds=[2, 3]")
    placement = Placement.from_config(config).prepare()
    assert rendered == []
    assert len(placement.segregation.yaw_rad) == 2
    train = [each.scene.name for each in placement.train]
    assert rendered == train
    assert placement.test[1].assigned_camera.dtype == np.int32
    assert rendered == [*train, placement.test[1].scene.name]
    assert placement.test[1].assigned_camera is placement.test[1].assigned_camera
    assert placement.train[0].assigned_camera.shape == (placement.train[0].scene.vehicle_count,)
    assert len(rendered) == 4


def test_zones_without_room_for_a_module_are_said(tmp_path):
    """Once, whichever way the scenes come; a zone named ``roof`` is fine for the module but for its stand-off."""
    zone = "    stand_off_m: [0.0, 0.005]\n    recess_m: 0.0\n"
    (tmp_path / "zones.yaml").write_text(
        f"zones:\n  roof:\n    normal: up\n{zone}  top:\n    normal: up\n    kind: roof\n    stand_off_m: [0.0, 0.3]\n"
    )
    options = [
        f"mount.zones={tmp_path / 'zones.yaml'}",
        "rig.modules={front_8mp_30: 2}",
        "scenes.train_seeds=[0]",
        "scenes.validation_seeds=null",
        "scenes.test_seeds=[1]",
    ]
    config = load_config("quick", options)

    class Listening(NullProgress):
        def __init__(self):
            self.said = []

        def say(self, text):
            self.said.append(text)

    opened, packed = Listening(), Listening()
    load_scene_set(config, opened)
    pack_scenes(load_scenes(config, (0, 1)), (1, 0), config, packed)
    for said in (opened.said, packed.said):
        [line] = said
        assert line.startswith("module 'front_8mp_30': left out of zones without room for its housing: roof needs ")
        assert "and allows 5; raise the zone's stand_off_m" in line
