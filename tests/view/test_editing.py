"""Editing a rig without a picture: where cameras come to stand, what can be undone, what is said of the rig."""

import dataclasses
import math

import numpy as np
import pytest

from tests.driving_scene import flat_surface
from tests.view.stand_ins import rig
from warpav.core.errors import InputError
from warpav.optimisation import ZoneAndSpacing
from warpav.rig import NORMALS, Rig, Zone, builtin_modules, chart_of, first_hit, ray_caster, read_rig
from warpav.scene import town_scene
from warpav.thesis import BoundsAndSpacing
from warpav.view import Finding
from warpav.view._editing import EditedRig

SURFACE = flat_surface([0.0, -0.6], [2.6, 0.6], height_m=1.5)
HEIGHT_M = 0.08
MODULES = tuple(builtin_modules().values())[:3]
UP, LEFT = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])


@pytest.fixture
def edits():
    constraints = BoundsAndSpacing(SURFACE, min_spacing_m=0.2)
    judge = lambda rig: [Finding("cameras", str(len(rig.cameras)), "at most 4", len(rig.cameras) <= 4)]  # noqa: E731
    return EditedRig(rig(), constraints=constraints, height_offset_m=HEIGHT_M, modules=MODULES, judge=judge)


def places(edits):
    return np.array([camera.position_m for camera in edits.rig.cameras])


def test_a_moved_camera_stays_on_the_surface(edits):
    before = places(edits)
    moved = edits.move(0, np.array([9.0, 0.1, 7.0])).rig.cameras[0]
    np.testing.assert_allclose(moved.position_m, [2.6, 0.1, 1.58], atol=1e-5)
    np.testing.assert_array_equal(places(edits)[1:], before[1:])
    near, count = edits.edit.findings[-2:]
    assert (near.about, near.is_kept, count.is_kept) == ("Closest pair of cameras", True, True)
    edits.move(1, moved.position_m)
    assert edits.edit.findings[-2] == Finding(
        "Closest pair of cameras", "0.00 m (cam_0, cam_1)", "at least 0.20 m", False
    )
    edits.replace(Rig([dataclasses.replace(moved, position_m=np.array([3.5, 0.0, 0.6]))]))
    elsewhere = edits.move(0, np.array([2.0, 0.0])).rig.cameras[0]
    np.testing.assert_allclose(elsewhere.position_m, [2.0, 0.0, 1.5 + HEIGHT_M], atol=1e-5)


def test_a_click_on_the_skin_puts_a_camera_that_looks_away(edits):
    """On the mount surface at its height, elsewhere just off the skin, which the border says."""
    on_roof = edits.put(np.array([2.0, 0.4, 1.5]), UP, module=MODULES[1].name)
    assert (on_roof.camera, len(on_roof.rig.cameras)) == (4, 5)
    camera = on_roof.rig.cameras[4]
    np.testing.assert_allclose(camera.position_m, [2.0, 0.4, 1.5 + HEIGHT_M], atol=1e-5)
    assert (camera.name, camera.module, camera.housing) == ("front_left", MODULES[1].name, MODULES[1].housing)
    assert math.degrees(camera.yaw_rad) == pytest.approx(30.0)  # atan(.4 / .7) is 29.7
    assert edits.edit.findings[-1].is_kept is False
    door = edits.put(np.array([1.0, 0.9, 0.8]), LEFT, like=1).rig.cameras[5]
    np.testing.assert_allclose(door.position_m, [1.0, 0.93, 0.8])
    assert (door.name, door.model, math.degrees(door.yaw_rad)) == ("left", rig().cameras[1].model, pytest.approx(90.0))
    border = edits.edit.findings[0]
    assert (border.found, border.is_kept) == ("-0.33 m (left)", False)


def test_any_zone_carries_a_camera():
    vehicle = town_scene(0).ego
    zones = [Zone("top", NORMALS["up"]), Zone("side", NORMALS["left"], stand_off_m=(0.01, 0.02))]
    edits = EditedRig(rig(), constraints=ZoneAndSpacing(chart_of(zones, vehicle), camera_count=4))
    found = first_hit(ray_caster(vehicle), vehicle, np.array([[1.5, 9.0, 0.7], [0.0, -1.0, 0.0]]))
    assert found is not None
    point_m, outward = found
    assert outward @ LEFT > 0.9
    put = edits.put(point_m, outward)
    assert put.rig.cameras[4].position_m[1] - point_m[1] == pytest.approx(0.01, abs=2e-3)
    np.testing.assert_allclose(edits.foot_m(4), point_m, atol=2e-3)
    assert first_hit(ray_caster(vehicle), vehicle, np.array([[1.5, 9.0, 0.7], [0.0, 1.0, 0.0]])) is None


def test_what_is_typed_is_taken_as_it_is(edits):
    camera = edits.pose(2, x_m=5.0, yaw_deg=200.0, roll_deg=-3.0).rig.cameras[2]
    np.testing.assert_allclose(camera.position_m, [5.0, *rig().cameras[2].position_m[1:]])
    np.testing.assert_allclose(np.degrees([camera.yaw_rad, camera.pitch_rad, camera.roll_rad]), [-160.0, 0.0, -3.0])
    assert edits.edit.findings[0].found == "-2.40 m (cam_2)"
    with pytest.raises(InputError, match="pitch_rad: expected a finite number, got nan"):
        edits.pose(2, pitch_deg=math.nan)
    with pytest.raises(ValueError, match=r"expected some of x_m, .*, got height"):
        edits.pose(2, height=1.0)


def test_modules_change_where_a_camera_stands(edits):
    before = edits.rig.cameras[1]
    found = edits.set_module(1, MODULES[2].name).rig.cameras[1]
    assert (found.module, found.housing) == (MODULES[2].name, MODULES[2].housing)
    assert found.model == dataclasses.replace(MODULES[2].camera_model(), near_m=before.model.near_m)
    np.testing.assert_array_equal(found.ego_from_camera, before.ego_from_camera)
    with pytest.raises(InputError, match=r"module: expected one of .*, got 'none'"):
        edits.set_module(1, "none")


def test_copies_and_mirror_images(edits):
    edits.copy(0)
    apart_m = np.linalg.norm(places(edits)[4] - places(edits)[0])
    assert (edits.rig.cameras[4].name, apart_m) == ("cam_4", pytest.approx(0.202))
    edits.put(np.array([2.0, 0.4, 1.5]), UP)
    image = edits.mirror(5).rig.cameras[6]
    np.testing.assert_allclose(image.position_m, places(edits)[5] * [1.0, -1.0, 1.0])
    assert (image.name, image.yaw_rad) == ("front_right", -edits.rig.cameras[5].yaw_rad)
    edits.pose(5, pitch_deg=7.0)
    again = edits.mirror(5)  # in place of the one that is there
    assert (len(again.rig.cameras), math.degrees(again.rig.cameras[6].pitch_rad)) == (7, pytest.approx(7.0))
    edits.replace(Rig([dataclasses.replace(edits.rig.cameras[1], name="CAM_FRONT_LEFT"), edits.rig.cameras[0]]))
    assert edits.mirror(0).rig.cameras[2].name == "CAM_FRONT_RIGHT"
    edits.undo()
    edits.undo()
    with pytest.raises(InputError, match="camera 'cam_0': expected one aside of the middle"):
        edits.mirror(0)


def test_steps_are_undone_and_taken_again(edits, tmp_path):
    """A drag is one step; what is undone is forgotten once another step is taken."""
    first = edits.edit
    for x_m in (1.0, 1.2, 1.4):
        edits.move(0, np.array([x_m, 0.0]), held=True)
    dragged = edits.move(0, np.array([1.5, 0.0]))
    removed = edits.remove(3)
    assert [each.name for each in removed.rig.cameras] == ["cam_0", "cam_1", "cam_2"]
    assert [edits.undo(), edits.undo(), edits.undo()] == [dragged, first, first]
    assert (edits.past, len(edits.future)) == ((), 2)
    assert [edits.redo(), edits.redo(), edits.redo()] == [dragged, removed, removed]
    edits.undo()
    edits.copy(1)
    assert (len(edits.past), edits.future) == (2, ())
    assert edits.save(tmp_path / "rig.yaml") == tmp_path / "rig.yaml"
    for ours, theirs in zip(read_rig(tmp_path / "rig.yaml").cameras, edits.rig.cameras, strict=True):
        np.testing.assert_allclose(ours.position_m, theirs.position_m, atol=1e-6)
    edits.replace(Rig(rig().cameras[:1]))
    with pytest.raises(InputError, match="expected at least one camera to stay"):
        edits.remove(0)
