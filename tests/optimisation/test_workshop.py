"""Rigs as a workshop takes them: names by direction, rounded numbers, roles, pairs of symmetric vehicles."""

import math
from dataclasses import replace

import numpy as np
import pytest

import warpav as wa
from tests.optimisation.test_hand_rigs import flat
from warpav.core.errors import InputError
from warpav.optimisation import CameraMount, ZoneAndSpacing, mount_pose_by_hand, workshop_rig
from warpav.optimisation._mount import named_by_direction
from warpav.optimisation._pool_run import roundings
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh
from warpav.rig import NORMALS, Housing, Module, Price, RigCamera, Role, Zone, chart_of, with_middles
from warpav.runs._mounts import made_symmetric
from warpav.runs.config import load_config

CAR = wa.town([0])[0].ego


@pytest.mark.parametrize(
    ("looks", "names"),
    [
        ([(0, 90), (50, 90), (-50, 90), (180, 90)], ["front", "front_left", "front_right", "rear"]),
        ([(3, 30), (-3, 120), (-180, 90)], ["front_30", "front_120", "rear"]),
        ([(90, 90), (95, 90), (-135, 90)], ["left_2", "left_1", "rear_right"]),
    ],
)
def test_cameras_are_named_by_where_they_look(looks, names):
    cameras = [
        RigCamera(
            "x", np.array([float(k), 0, 1]), yaw_rad=math.radians(yaw), model=CameraModel(9, 9, math.radians(fov))
        )
        for k, (yaw, fov) in enumerate(looks)
    ]
    assert [each.name for each in named_by_direction(cameras)] == names


def test_numbers_are_rounded_and_the_nearest_comes_first():
    pose = np.array([0.1234, 0.2222, 0.613, 0.1009, 0, 0, 0], np.float32)
    found = list(roundings(pose, flat(), lambda _: True))
    np.testing.assert_allclose(found[0][[0, 1, 2, 3]], [0.125, 0.22, math.radians(35), math.radians(6)], atol=1e-6)
    first = workshop_rig(flat().rig(found[0][None])).cameras[0]
    assert first.position_m[0] == pytest.approx(0.125, abs=1e-12)
    assert math.degrees(first.yaw_rad) == pytest.approx(35.0, abs=1e-12)
    assert len(found) == 32  # x, y, z, yaw and pitch to either side
    for each in found:
        steps = np.degrees(each[[2, 3]]) / 0.5
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-4)


def module(role):
    housing, price = Housing((0.03, 0.03, 0.03)), Price(1.0)
    return Module(
        name="one", sensor_px=(64, 64), fov_rad=1.0, housing=housing, price=price, source="made up", role=role
    )


@pytest.mark.parametrize(
    ("role", "middle_deg", "reach_deg"), [("front", [0], 20), ("rear", [180], 20), ("side", [90, -90], 60)]
)
def test_a_role_bounds_where_a_module_stands_and_looks(role, middle_deg, reach_deg):
    roof = Zone("roof", NORMALS["up"], pitch_rad=(-0.5, 0.5))
    chart = chart_of([roof], CAR, modules=[module(role)], cell_m=0.05)
    assert len(chart.zones) == len(middle_deg)
    for zone, middle in zip(chart.zones, middle_deg, strict=True):
        assert np.degrees(zone.yaw_rad) == pytest.approx([middle - reach_deg, middle + reach_deg])
        assert np.abs(zone.pitch_rad).max() <= (0.5 if role == "side" else math.radians(10.0)) + 1e-9
    place_m = chart.place_m[chart.inside]
    point_m = chart.point_m(place_m, chart.height_at_m(place_m))
    middle_m = CAR.bounds_m()[:, 0].mean()
    sign = {"front": 1.0, "rear": -1.0}.get(role)
    if sign:
        assert (sign * (point_m[:, 0] - middle_m) >= -0.06).all()
    with pytest.raises(InputError, match=r"module 'one': role: expected a zone that lets it stand and look as a front"):
        chart_of([Zone("back", NORMALS["rear"])], CAR, modules=[module("front")], cell_m=0.05)


def test_rigs_are_symmetric_where_the_vehicle_is():
    assert made_symmetric(load_config("quick"), CAR).rig.is_symmetric
    bent = CAR.vertex_m + np.where(CAR.vertex_m[:, 1:2] < -0.1, [[0.0, 0.0, 0.1]], 0.0)
    crooked = Mesh(bent.astype(np.float32), CAR.triangle, CAR.vertex_rgb)
    assert not made_symmetric(load_config("quick"), crooked).rig.is_symmetric
    with pytest.raises(
        InputError, match=r"rig\.symmetric: expected a vehicle that is its own mirror image, got .* off"
    ):
        wa.Placement([wa.town([0])[0].around(crooked)], rig={"symmetric": True}).prepare()
    assert not made_symmetric(load_config("quick", ["rig.cameras=1"]), CAR).rig.is_symmetric
    assert with_middles([Zone("back", NORMALS["rear"])])[1].is_centred


@pytest.mark.parametrize(
    ("role", "is_pair", "count", "expected_deg"),
    [
        ("front", None, 1, [0]),
        ("front", None, 2, [-7.5, 7.5]),
        ("front", True, 2, [-11.25, -3.75, 3.75, 11.25]),
        ("front", False, 2, [0, 0]),
        ("rear", None, 3, [-170, 170, 180]),
        ("rear", False, 1, [180]),
        ("side", None, 2, [-90, 90]),
        ("side", None, 5, [-135, -45, 30, 90, 150]),
        ("side", True, 2, [-136, -44, 44, 136]),
        ("surround", None, 4, [-136, -44, 44, 136]),
        ("surround", True, 3, [-120, 0, 120]),
        ("surround", False, 2, [0, 180]),
    ],
)
def test_modules_stand_and_look_by_hand_where_their_role_has_them(role, is_pair, count, expected_deg):
    """On the roof of a car, asymmetric or in pairs or in the middle: each at the edge or corner to which it looks."""
    roof = Zone("roof", NORMALS["up"], pitch_rad=(-0.5, 0.5))
    turns = {} if is_pair is None else {"ahead": 0.0, "back": math.pi}
    middles = [replace(roof, name=name, is_centred=True, yaw_rad=(yaw, yaw)) for name, yaw in turns.items()]
    options = {"modules": [module(role)], "cell_m": 0.05}
    surface = chart_of([roof, *middles], CAR, pair_spacing_m=None if is_pair is None else 0.2, **options)
    cameras = [CameraModel(64, 64, 1.0)] * len(surface.modules)
    mount = CameraMount(surface, camera=cameras, height_offset_m=0.0, roles=[Role(role)] * len(cameras))
    kinds = np.full(count, 0 if is_pair is None else surface.pairs.index(is_pair))
    constraints = ZoneAndSpacing(surface, camera_count=count, min_spacing_m=0.05, margin_m=0.0, module=kinds)
    pose = mount_pose_by_hand("corners", mount, constraints, count)
    rig = mount.rig(pose)
    yaw_deg = [round(math.degrees(each.yaw_rad) % 360.0, 3) % 360.0 for each in rig.cameras]
    assert sorted(yaw_deg) == pytest.approx(sorted(each % 360 for each in expected_deg), abs=2e-3)
    assert constraints.violation_m(rig) == 0.0
    place_m = surface.place_m[surface.inside]
    point_m = surface.point_m(place_m, surface.height_at_m(place_m))
    if role == "surround":  # those that may look anywhere stand on the top
        point_m = point_m[point_m[:, 2] >= point_m[:, 2].max() - 0.25]
    low_m, high_m = point_m.min(axis=0), point_m.max(axis=0)
    for each in rig.cameras:
        x, y = math.cos(each.yaw_rad), math.sin(each.yaw_rad)
        edge_m = high_m[0] - 0.3 if x > 0.0 else low_m[0]  # the front row is set back
        if abs(x) > 0.35:
            assert each.position_m[0] == pytest.approx(edge_m, abs=0.3), each
        if abs(y) > 0.35:
            assert each.position_m[1] * math.copysign(1.0, y) == pytest.approx(high_m[1], abs=0.3), each
