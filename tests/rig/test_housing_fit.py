"""Room for housings: closed forms on boxes and balls, and no corner in the body wherever a camera may stand."""

import math

import numpy as np
import pytest

from tests.raster.bodies import ball, cuboid
from warpav.core.errors import InputError
from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll
from warpav.rig import NORMALS, Housing, Module, Price, Zone, chart_of

BOX = cuboid((4.0, 1.8, 1.4), (1.3, 0.0, 0.9))


def module(size_m=(0.04, 0.03, 0.06), offset_m=(0.0, 0.0, -0.02)):
    return Module(
        name="cube",
        sensor_px=(640, 480),
        fov_rad=1.5,
        housing=Housing(size_m, offset_m),
        price=Price(1.0),
        source="test",
    )


def roof(**options):
    return Zone(
        "roof", NORMALS["up"], **{"stand_off_m": (0.0, 0.1), "pitch_rad": (0.0, 0.0), "recess_m": 0.0, **options}
    )


def test_a_level_camera_on_a_flat_roof_stands_half_its_height_above_it():
    chart = chart_of([roof()], BOX, cell_m=0.05, modules=[module()])
    assert chart.zones[0].stand_off_m == (pytest.approx(0.015), 0.1)
    plain = chart_of([roof(recess_m=None)], BOX, cell_m=0.05, modules=[module()])
    assert plain.zones[0].stand_off_m == (0.0, 0.1)
    np.testing.assert_array_equal(plain.is_mountable, chart.is_mountable)
    let_in = chart_of([roof(recess_m=0.01)], BOX, cell_m=0.05, modules=[module()])
    assert let_in.zones[0].stand_off_m == (pytest.approx(0.005), 0.1)
    assert chart_of([roof(recess_m=0.05)], BOX, cell_m=0.05, modules=[module()]).zones[0].stand_off_m == (0.0, 0.1)


def test_no_corner_of_a_housing_is_in_a_ball():
    """Where the ball falls away to one side it bulges on the other: cells there are kept out or stand off."""
    middle_m, radius_m = np.array([0.5, 0.2, 1.0]), 0.8
    zone = roof(pitch_rad=(-0.2, 0.4), stand_off_m=(0.0, 0.08))
    case = module((0.03, 0.03, 0.04), (0.0, 0.0, -0.01))
    chart = chart_of([zone], ball(radius_m, middle_m), cell_m=0.02, modules=[case])
    free = chart_of([roof(recess_m=None)], ball(radius_m, middle_m), cell_m=0.02, modules=[case])
    assert 0.3 * free.is_mountable.sum() < chart.is_mountable.sum() < free.is_mountable.sum()
    place_m = chart.origin_m + chart.cell_m * np.argwhere(chart.is_mountable)
    half_m = 0.5 * np.asarray(case.housing.size_m)
    corner_m = half_m * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T + case.housing.offset_m

    def deepest_m(rise_m):
        """How deep a corner is in the ball, of cameras anywhere and any way within the zone."""
        centre_m = chart.point_m(place_m, chart.height_at_m(place_m) + rise_m)
        rng = np.random.default_rng(0)
        found = -np.inf
        for _ in range(200):
            turn = rotation_from_yaw_pitch_roll(rng.uniform(-math.pi, math.pi), rng.uniform(-0.2, 0.4), 0.0)
            at_m = centre_m[:, None] + corner_m @ (turn @ FLU_FROM_RDF).T
            found = max(found, radius_m - np.linalg.norm(at_m - middle_m, axis=-1).min())
        return found

    assert deepest_m(chart.zones[0].rise_m[0]) < 1e-3
    assert deepest_m(0.0) > 0.01


def test_behind_glass_no_housing_reaches_the_pane():
    mesh = ball(0.8, np.array([0.5, 0.2, 1.0]))
    zone = Zone(
        "screen",
        NORMALS["front"],
        stand_off_m=(0.01, 0.15),
        is_behind_glass=True,
        yaw_rad=(0.0, 0.0),
        pitch_rad=(0.0, 0.0),
        box_m=np.array([[0.0, 0.1, 0.9], [2.0, 0.3, 1.1]]),
    )
    chart = chart_of([zone], mesh, cell_m=0.02, modules=[module(offset_m=(0.0, 0.0, 0.02))])
    least_m, most_m = chart.zones[0].stand_off_m
    assert most_m == 0.15
    # the front is 5 cm ahead of the centre, and within 25 mm to the side the ball falls away by up to 4 mm
    assert 0.05 <= least_m < 0.055
    assert chart.panes[0] is not None


def test_a_housing_that_fits_nowhere_names_module_and_zone():
    zone = roof(stand_off_m=(0.0, 0.01))
    with pytest.raises(InputError, match=r"^module 'cube': housing: expected room .*: roof needs 15 mm and allows 10;"):
        chart_of([zone], BOX, cell_m=0.05, modules=[module()])
    # where another zone has room, the module stands there alone
    side = Zone("left", NORMALS["left"], stand_off_m=(0.0, 0.03))
    chart = chart_of([zone, side], BOX, cell_m=0.05, modules=[module()])
    assert [each.name for each in chart.zones] == ["left"]
    [note] = chart.notes  # and that is said
    assert note.startswith(
        "module 'cube': left out of zones without room for its housing: roof needs 15 mm and allows 10; raise "
    )
    assert chart_of([side], BOX, cell_m=0.05, modules=[module()]).notes == ()
    assert chart_of([zone, side], BOX, cell_m=0.05).notes == ()
