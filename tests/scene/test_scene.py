"""What scenes say of themselves, whom they target, and their mirror images."""

import math
import re

import numpy as np
import pytest

from tests.driving_scene import ego_mesh
from tests.scene.test_glb import _tetrahedron
from tests.scene.town.closed_surface import signed_volume_m3
from tests.view.stand_ins import scene, vehicle
from warpav.detection import render_images
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh
from warpav.rig import RigCamera
from warpav.runs import load_scenes
from warpav.runs.config import load_config
from warpav.scene import ROAD_USERS, Box, Scene, Vehicle, town_scene, write_scene


def pedestrian(instance_id, x, y):
    mesh = Mesh.create([[x, y, 0], [x + 0.4, y, 0], [x, y, 1.7]], [[0, 1, 2]], (20, 90, 160))
    return Vehicle(instance_id, "pedestrian", mesh, Box(np.array([x, y, 0.85]), np.array([0.5, 0.5, 1.7]), 0.0))


def test_a_scene_is_told_in_a_line():
    street = scene(vehicle(1, 9.0, 3.4), vehicle(2, -20.0, 0.0), pedestrian(3, 4.0, -3.0))
    assert repr(street) == "<Scene test: 3 targets (2 saloon, 1 pedestrian)>"
    assert repr(street.targeting(["vehicle"])) == "<Scene test: 2 targets, 1 not targeted (2 saloon, 1 pedestrian)>"
    assert repr(scene()) == "<Scene test: 0 targets (no road user)>"
    assert repr(street.vehicles[1]) == "<Vehicle 2: saloon at x -20.0, y 0.0 m>"


def cells(page):
    return dict(re.findall(r"<tr><th [^>]*>(.*?)</th><td [^>]*>(.*?)</td></tr>", page))


def test_a_notebook_shows_who_is_in_a_scene():
    street = scene(vehicle(1, 9.0, 3.4), vehicle(2, -20.0, 0.0), pedestrian(3, 4.0, -3.0)).targeting(["vehicle"])
    shown = cells(street._repr_html_())
    assert shown["road users"] == "2 saloon, 1 pedestrian"
    assert shown["not targeted"] == "1"
    assert shown["nearest"] == "pedestrian 3, 5.0 m away at -37°"
    assert shown["farthest"] == "saloon 2, 20.0 m away at +180°"
    # road 2, wall 12, the ego vehicle and two others 12 each, a pedestrian 1
    assert shown["triangles"] == str(2 + 12 + 12 + 2 * 12 + 1)
    assert cells(scene()._repr_html_())["road users"] == "none"
    assert "nearest" not in cells(scene()._repr_html_())


def test_names_are_text_not_markup():
    import dataclasses

    named = dataclasses.replace(scene(), name="<b>", source="a & b")
    assert "<b>" not in named._repr_html_()
    assert cells(named._repr_html_())["source"] == "a &amp; b"


def user_of(instance_id, category, x_m=5.0, y_m=0.0):
    """A tetrahedron that passes for a road user."""
    box = Box(np.array([x_m, y_m, 0.7]), np.ones(3), 0.0)
    return Vehicle(instance_id, category, _tetrahedron([x_m, y_m, 0.0], [9, 9, 9]), box)


@pytest.fixture
def mixed():
    """Cars 1 and 4, a cyclist 2, a pedestrian 3, whoever stands where."""
    environment = _tetrahedron([0, 0, -9], [90, 90, 90])
    vehicles = (user_of(1, "saloon"), user_of(4, "lorry", -3.0))
    return Scene(
        "mixed", environment, ego_mesh(np.random.default_rng(0)), vehicles,
        others=(user_of(2, "cyclist", 2.0, 3.0), user_of(3, "pedestrian", 4.0)),
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
def test_targets_become_the_vehicles_and_keep_their_ids(mixed, targets, vehicles, others):
    aimed = mixed.targeting(targets)
    assert (ids(aimed.vehicles), ids(aimed.others)) == (vehicles, others)
    assert len(aimed.surroundings().triangle) == len(mixed.environment.triangle) + 4 * len(others)
    # whoever was targeted before
    again = aimed.targeting(["vehicle"])
    assert (ids(again.vehicles), ids(again.others)) == ([1, 4], [2, 3])


def test_configured_targets_reach_every_source(mixed, tmp_path):
    write_scene(mixed, tmp_path / "scene_7.glb")
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


LEFT_RIGHT = np.array([1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def town_2():
    return town_scene(2)


def all_users(town_2):
    return (*town_2.vehicles, *town_2.others)


def test_a_mirrored_scene_keeps_who_is_there_and_the_ego_vehicle(town_2):
    mirrored = town_2.mirrored()
    assert mirrored.name == f"{town_2.name}_mirrored"
    assert mirrored.ego is town_2.ego
    assert mirrored.sky == town_2.sky
    assert [(user.instance_id, user.category) for user in mirrored.vehicles] == [
        (user.instance_id, user.category) for user in town_2.vehicles
    ]
    assert len(mirrored.others) == len(town_2.others) > 0
    for user, original in zip(all_users(mirrored), all_users(town_2), strict=True):
        np.testing.assert_allclose(user.box.center_m, original.box.center_m * LEFT_RIGHT)
        # its mesh is where its box is, and turned outwards as before
        assert user.box.contains(user.mesh.vertex_m.astype(float), margin_m=1e-3).all()
        assert signed_volume_m3(user.mesh) == pytest.approx(signed_volume_m3(original.mesh), rel=1e-4)
        assert signed_volume_m3(user.mesh) > 0.0


@pytest.mark.parametrize("yaw_rad", [0.0, math.pi, 0.9])
def test_cameras_see_the_mirror_image(town_2, yaw_rad):
    # above the roof, so that the ego vehicle, which stays as it is, is not in the picture
    model, position_m = CameraModel(96, 64, math.radians(80.0)), np.array([1.5, 0.0, 3.0])
    (image,) = render_images(town_2, [RigCamera("one", position_m, yaw_rad, 0.0, 0.0, model)])
    (mirrored,) = render_images(town_2.mirrored(), [RigCamera("one", position_m, -yaw_rad, 0.0, 0.0, model)])
    assert image.rgb.std() > 10.0
    same = np.abs(mirrored.rgb[:, ::-1].astype(int) - image.rgb).max(axis=2) <= 1
    assert same.mean() > 0.999  # worst seen 1
    same = mirrored.object_index[:, ::-1] == image.object_index
    assert same.mean() > 0.999  # worst seen 1
