"""Rigs as a workshop takes them: names by direction, rounded numbers, roles, pairs of symmetric vehicles."""

import math

import numpy as np
import pytest

import warpav as wa
from tests.optimisation.test_hand_rigs import flat
from warpav.core.errors import InputError
from warpav.optimisation.mount import named_by_direction
from warpav.optimisation.rig_limits import RigLimits
from warpav.optimisation.rounding import roundings, workshop_rig
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh
from warpav.rig.chart import chart_of, with_middles
from warpav.rig.module import Housing, Module, Price
from warpav.rig.rig import RigCamera
from warpav.rig.zone import NORMALS, Zone
from warpav.runs.config import load_config
from warpav.runs.mounts import made_symmetric

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
    assert len(found) == 16
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


def test_limits_fill_up_with_the_cheapest():
    limits = RigLimits.of({"a": (1, 3), "b": (0, 2)}, count=(3, 4), price={"a": 2.0, "b": 1.0})
    np.testing.assert_array_equal(limits.first_kinds(), [0, 1, 1])
    assert limits.cost_range() == (4.0, 7.0)
    assert limits.within(count=(4, 4)).cost_range()[0] == 6.0
    assert limits.within(cost_max=5.0).cost_max == 5.0
    assert [row.name for row in limits.rows(np.array([0, 1]))] == ["rig.modules.a = 1..3", "rig.modules.b = 0..2"]
    pairs = RigLimits.of({"a": (2, 2)}, kinds=[("a", 2), ("a", 1)])
    assert pairs.rows(np.array([0, 1]))[0].name == "rig.cameras = 2"
