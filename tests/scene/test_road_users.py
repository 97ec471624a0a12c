"""Who a rig is made for: kinds of road users, scenes that target some of them, files and sources that know them."""

import numpy as np
import pytest

from tests.driving_scene import ego_mesh
from tests.scene.test_glb import _tetrahedron
from warpav.runs.config import load_config
from warpav.runs.scene_set import load_scenes
from warpav.scene.glb import write_scene
from warpav.scene.scene import ROAD_USERS, Box, Scene, Vehicle
from warpav.scene.town.town import town_scene


def user(instance_id, category, x_m=5.0, y_m=0.0):
    """A tetrahedron that passes for a road user."""
    box = Box(np.array([x_m, y_m, 0.7]), np.ones(3), 0.0)
    return Vehicle(instance_id, category, _tetrahedron([x_m, y_m, 0.0], [9, 9, 9]), box)


@pytest.fixture
def scene():
    """Cars 1 and 4, a cyclist 2, a pedestrian 3, whoever stands where."""
    environment = _tetrahedron([0, 0, -9], [90, 90, 90])
    vehicles = (user(1, "saloon"), user(4, "lorry", -3.0))
    return Scene(
        "mixed", environment, ego_mesh(np.random.default_rng(0)), vehicles,
        others=(user(2, "cyclist", 2.0, 3.0), user(3, "pedestrian", 4.0)),
    )  # fmt: skip


def ids(users):
    return [each.instance_id for each in users]


@pytest.mark.parametrize(
    ("targets", "vehicles", "others"),
    [
        (["vehicle"], [1, 4], [2, 3]),
        (["pedestrian"], [3], [1, 2, 4]),
        (["cyclist", "vehicle"], [1, 2, 4], [3]),
        (ROAD_USERS, [1, 2, 3, 4], []),
        ([], [], [1, 2, 3, 4]),
    ],
)
def test_targets_become_the_vehicles_and_keep_their_ids(scene, targets, vehicles, others):
    aimed = scene.targeting(targets)
    assert (ids(aimed.vehicles), ids(aimed.others)) == (vehicles, others)
    assert len(aimed.surroundings().triangle) == len(scene.environment.triangle) + 4 * len(others)
    # whoever was targeted before
    again = aimed.targeting(["vehicle"])
    assert (ids(again.vehicles), ids(again.others)) == ([1, 4], [2, 3])


def test_configured_targets_reach_every_source(scene, tmp_path):
    write_scene(scene, tmp_path / "scene_7.glb")
    overrides = ["scenes.source=folder", f"scenes.folder={tmp_path}", "scenes.train_seeds=[7]", "run.batch_size=1"]
    config = load_config("quick", [*overrides, "scenes.targets=[pedestrian, cyclist]"])
    (read,) = load_scenes(config, [7])
    assert (ids(read.vehicles), ids(read.others)) == ([2, 3], [1, 4])
    (read,) = load_scenes(load_config("quick", overrides), [7])
    assert ids(read.vehicles) == [1, 4]

    whole = town_scene(1000)
    (built,) = load_scenes(load_config("quick", ["scenes.targets=[vehicle, pedestrian, cyclist]"]), [1000])
    assert ids(built.vehicles) == ids(whole.vehicles) + ids(whole.others)
    assert len(whole.others) > 0
    (default,) = load_scenes(load_config("quick"), [1000])
    assert (ids(default.vehicles), ids(default.others)) == (ids(whole.vehicles), ids(whole.others))
