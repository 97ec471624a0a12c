"""Zones anywhere on a body, their chart and their file."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import warpav as wa
from tests.raster.bodies import ball, cuboid
from warpav.core.errors import InputError
from warpav.rig import NORMALS, Zone, chart_of, parts_of, propose_zones, read_zones, write_zones
from warpav.rig._zone import mirrored
from warpav.scene import read_vehicle

SIZE_M, PLACE_M = (4.0, 1.8, 1.4), (1.3, 0.0, 0.9)
LOW_M, HIGH_M = np.array(PLACE_M) - np.array(SIZE_M) / 2.0, np.array(PLACE_M) + np.array(SIZE_M) / 2.0
BOX = cuboid(SIZE_M, PLACE_M)


def zones_of(**options):
    return tuple(Zone(name, normal, **options) for name, normal in NORMALS.items())


def cells(chart, number):
    """Places of the cells of a zone that can carry a camera, and their points in the ego frame."""
    inside = (chart.zone_of_cell == number) & chart.is_mountable
    place_m = chart.origin_m + chart.cell_m * np.argwhere(inside)
    return place_m, chart.point_m(place_m, chart.height_m[inside])


def test_the_zones_of_a_box_are_its_sides():
    zones = zones_of()
    chart = chart_of(zones, BOX, cell_m=0.05)
    for number, zone in enumerate(zones):
        place_m, point_m = cells(chart, number)
        normal = np.array(zone.normal)
        axis, outwards = int(np.abs(normal).argmax()), normal.sum() > 0
        face_m = (HIGH_M if outwards else LOW_M)[axis]
        np.testing.assert_allclose(point_m[:, axis], face_m, atol=2e-6)
        others = [k for k in range(3) if k != axis]
        assert np.all(point_m[:, others] > LOW_M[others] - 1e-6)
        assert np.all(point_m[:, others] < HIGH_M[others] + 1e-6)
        # nearly all of the side belongs to it
        side_m2 = math.prod(SIZE_M[k] for k in others)
        assert len(place_m) * chart.cell_m**2 == pytest.approx(side_m2, rel=0.02)
        # outwards is along the normal
        raised_m = chart.point_m(place_m, chart.height_at_m(place_m) + 0.1)
        np.testing.assert_allclose(raised_m - point_m, np.broadcast_to(0.1 * normal, point_m.shape), atol=2e-6)
        assert np.linalg.det(zone.axes) == pytest.approx(1.0)
        np.testing.assert_array_equal(chart.zone_at(place_m), number)


def test_the_height_field_of_a_ball_is_its_own():
    """A slanting zone: every point of it is on the ball, and its box limits it."""
    normal = np.array([1.0, 1.0, 1.0]) / math.sqrt(3.0)
    middle_m = np.array([0.5, 0.2, 1.0])
    zone = Zone("corner", tuple(normal), box_m=np.array([[0.5, 0.2, 1.0], [9.0, 9.0, 9.0]]))
    chart = chart_of([zone], ball(0.8, middle_m), cell_m=0.02)
    _, point_m = cells(chart, 0)
    np.testing.assert_allclose(np.linalg.norm(point_m - middle_m, axis=1), 0.8, atol=0.012)
    assert (point_m > middle_m - 0.02).all()
    assert len(point_m) > 300


@given(st.integers(0, 4), st.floats(0.05, 0.95), st.floats(0.05, 0.95), st.floats(0.0, 0.03))
def test_the_place_of_a_point_is_where_it_came_from(number, along, across, rise_m):
    chart = chart_of(zones_of(), BOX, cell_m=0.1)
    place_m, _ = cells(chart, number)
    low_m, high_m = place_m.min(axis=0), place_m.max(axis=0)
    wanted_m = low_m + np.array([along, across]) * (high_m - low_m)
    point_m = chart.point_m(wanted_m, chart.height_at_m(wanted_m) + rise_m)
    found_m, found_rise_m = chart.place_of(point_m)
    np.testing.assert_allclose(found_m, wanted_m, atol=1e-5)
    assert float(found_rise_m) == pytest.approx(rise_m, abs=1e-5)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_point_of_two_zones_belongs_to_that_in_which_it_lies_deeper(order):
    boxes_m = np.array([[[0.0, -9.0, 0.0], [2.0, 9.0, 9.0]], [[1.0, -9.0, 0.0], [3.0, 9.0, 9.0]]])
    zones = [Zone(name, NORMALS["up"], box_m=box_m) for name, box_m in zip("ab", boxes_m, strict=True)]
    chart = chart_of([zones[k] for k in order], BOX, cell_m=0.05)
    place_m, _ = chart.place_of(np.array([[1.1, 0.0, HIGH_M[2]], [1.9, 0.0, HIGH_M[2]]]))
    assert [order[number] for number in chart.zone_at(place_m)] == [0, 1]
    assert chart.zone_distance_m(place_m).min() > 0.8


def test_a_file_of_zones_comes_back(tmp_path):
    zones = (
        Zone("roof", NORMALS["up"], pitch_rad=(-0.1, 0.3)),
        Zone(
            "left pillar",
            NORMALS["left"],
            box_m=np.array([[0.0, 0.5, 0.8], [1.0, 1.0, 1.2]]),
            keep_out_m=(np.array([[0.2, 0.5, 0.8], [0.3, 1.0, 1.2]]),),
            stand_off_m=(0.01, 0.05),
            yaw_rad=(0.5, 2.0),
            roll_rad=(-0.05, 0.05),
        ),
        Zone("no: [x]\n\x1b[31m", NORMALS["right"]),
        Zone("slant", (0.6, 0.0, 0.8), origin_m=(1.0, 0.0, 0.5)),
        Zone(
            "windscreen",
            (0.6, 0.0, 0.8),
            outline_m=np.array([[2.0, -0.5, 1.0], [2.0, 0.5, 1.0], [1.5, 0.4, 1.5], [1.5, -0.4, 1.5]]),
            stand_off_m=(0.04, 0.1),
            is_behind_glass=True,
        ),
    )
    write_zones(zones, tmp_path / "zones.yaml")
    again = read_zones(tmp_path / "zones.yaml")
    for one, other in zip(zones, again, strict=True):
        for name in ("name", "stand_off_m", "rise_m", "is_behind_glass"):
            assert getattr(one, name) == getattr(other, name)
        for name in ("axes", "origin_m", "outline_m", "box_m", "yaw_rad", "pitch_rad", "roll_rad"):
            before, after = getattr(one, name), getattr(other, name)
            assert (before is None) == (after is None)
            if before is not None:
                np.testing.assert_allclose(before, after, atol=1e-3)
        np.testing.assert_allclose(one.keep_out_m, other.keep_out_m, atol=1e-3)


def test_an_outline_limits_a_zone():
    corner_m = np.array([[0.0, 0.9, 0.4], [2.0, 0.9, 0.4], [1.0, 0.9, 1.2]])
    chart = chart_of([Zone("left", NORMALS["left"], outline_m=corner_m)], BOX, cell_m=0.02)
    _, point_m = cells(chart, 0)
    assert len(point_m) * 0.02**2 == pytest.approx(0.5 * 2.0 * 0.8, rel=0.06)
    assert ((point_m[:, 2] - 0.4) <= 0.8 - np.abs(point_m[:, 0] - 1.0) * 0.8 + 0.03).all()
    other = mirrored(mirrored(Zone("left", NORMALS["left"], outline_m=corner_m)))
    np.testing.assert_allclose(other.outline_m, corner_m)


def test_borders_belong_to_a_zone_and_to_what_it_keeps_out():
    """Of a zone on the ground plane, whose own coordinates are the ego frame's; all numbers are exact."""
    square_m = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [4.0, 2.0, 0.0], [0.0, 2.0, 0.0]])
    box_m, out_m = np.array([[-1.0, 0.5, 0.0], [3.0, 9.0, 1.0]]), np.array([[[1.0, 1.0, 0.0], [2.0, 1.5, 1.0]]])
    inside = {(0.0, 0.5, 0.0), (3.0, 2.0, 1.0), (0.0, 2.0, 0.5), (2.25, 1.25, 0.5)}
    outside = {(-0.25, 1.0, 0.0), (3.25, 1.0, 0.0), (3.0, 0.25, 0.0), (3.0, 2.25, 1.0), (0.0, 0.5, 1.25)}
    kept_out = {(1.0, 1.0, 0.0), (2.0, 1.5, 1.0), (1.5, 1.0, 0.5)}
    for outline_m in (square_m, square_m[::-1]):
        zone = Zone("roof", NORMALS["up"], outline_m=outline_m, box_m=box_m, keep_out_m=out_m)
        for points_m, belongs in ((inside, True), (outside, False), (kept_out, False)):
            place_m = (np.array(sorted(points_m)) - zone.origin_m) @ zone.axes.T
            assert (zone.holds(place_m) == belongs).all()


def test_a_zone_behind_glass_has_a_pane_as_large_as_its_outline():
    """Without an outline it is the hull of its cells, a margin of 2 cm wider."""
    normal = (0.6, 0.0, 0.8)
    sphere = ball(0.8, np.array([0.5, 0.2, 1.0]))
    zone = Zone("dome", normal, stand_off_m=(0.03, 0.15), is_behind_glass=True)
    chart = chart_of([Zone("roof", NORMALS["up"]), zone], sphere, cell_m=0.02, min_zone_normal=0.9)
    assert chart.panes[0] is None
    pane = chart.panes[1]
    radius_m = 0.8 * math.sqrt(1.0 - 0.9**2) + 0.02
    # the hull of whole cells is up to half their diagonal wider
    assert math.pi * radius_m**2 < pane.area_m2 < math.pi * (radius_m + 0.03) ** 2
    assert pane.clear_area_m2(sphere) == pytest.approx(pane.area_m2, rel=0.06)
    place_m, _ = cells(chart, 1)
    assert chart.panes_at(place_m) == [pane] * len(place_m)
    inside_m = chart.point_m(place_m, chart.height_at_m(place_m) + zone.rise_m[0])
    away_m = 0.8 - np.linalg.norm(inside_m - [0.5, 0.2, 1.0], axis=1)
    assert (away_m > 0.12).all()
    assert (away_m < 0.16).all()


@pytest.mark.parametrize("name", ["bus", "minibus", "moving_truck", "truck"])
def test_the_panes_of_the_shipped_vehicles_are_found_by_their_colour(name):
    mesh = read_vehicle(name)
    panes = parts_of(mesh).panes
    assert [zone.name for zone in panes] == ["windscreen", "rear_window"]
    corner_m = mesh.vertex_m[mesh.triangle]
    is_dark = mesh.vertex_rgb[mesh.triangle].mean(axis=(1, 2)) < 40.0
    for zone in panes:
        chart = chart_of([zone], mesh, cell_m=0.03)
        clear = chart.panes[0].is_clear(corner_m)
        area_m2 = 0.5 * np.linalg.norm(
            np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0]), axis=1
        )
        assert area_m2[clear & is_dark].sum() > 0.85 * area_m2[clear].sum()
        assert area_m2[clear].sum() > 1.0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("zones: {a: {normal: upp}}", ["zones.a.normal", "did you mean up"]),
        ("zones: {a: {normal: [0, 0, 0]}}", ["a direction", "length 0"]),
        ("zones: {a: {normal: up, boxm: 1}}", ["'boxm'", "did you mean box_m"]),
        ("zones: {a: {normal: up, box_m: [[0, 0, 0], [1, -1, 1]]}}", ["zones.a.box_m", "lowest corner"]),
        ("zones: {a: {normal: up, stand_off_m: [0.3, 0.1]}}", ["zones.a.stand_off_m", "lower end first"]),
        ("zones: {a: {normal: up, yaw_deg: [0, 500]}}", ["zones.a", "whole turn"]),
        ("zones: {a: {box_m: [[0, 0, 0], [1, 1, 1]]}}", ["zones.a.normal", "got nothing"]),
        ("zones: {a: {normal: up, mirror: maybe}}", ["zones.a.mirror", "true or false"]),
        ("zones: {a: {normal: front, behind_glass: 3}}", ["zones.a.behind_glass", "true or false"]),
        ("zones: {a: {normal: front, behind_glass: true, stand_off_m: 0}}", ["zones.a", "more than 0, inwards"]),
        ("zones: {a: {normal: up, outline_m: [[0, 0, 0], [1, 0, 0]]}}", ["zones.a", "outline_m", "convex"]),
        (
            "zones: {a: {normal: up, outline_m: [[0, 0, 0], [2, 0, 0], [0.5, 0.5, 0], [0, 2, 0]]}}",
            ["zones.a", "outline_m", "convex"],
        ),
        ("zones: []", ["zones", "a mapping"]),
        ("zones: {}", ["at least one zone"]),
        ("zone: {}", ["'zone'"]),
    ],
)
def test_a_file_that_is_wrong_is_one_line(tmp_path, text, words):
    file = tmp_path / "zones.yaml"
    file.write_text(text)
    with pytest.raises(InputError) as error:
        read_zones(file)
    assert "\n" not in str(error.value)
    assert str(file) in str(error.value)
    for word in words:
        assert word in str(error.value)


def test_a_zone_that_selects_nothing_is_named():
    nowhere = Zone("nowhere", NORMALS["left"], box_m=np.array([[50.0, 0.0, 0.0], [51.0, 1.0, 1.0]]))
    expected = (
        r"zone 'nowhere': expected a part of the body that faces to the left inside box_m.* reaches from .* to .* m$"
    )
    with pytest.raises(InputError, match=expected):
        chart_of([nowhere], BOX)
    with pytest.raises(InputError, match="expected one on the left or in the middle for a symmetric rig, got none"):
        chart_of([Zone("right", NORMALS["right"])], BOX, pair_spacing_m=0.3)
    with pytest.raises(InputError, match="names that differ"):
        chart_of([Zone("a", NORMALS["up"]), Zone("a", NORMALS["up"])], BOX)


def test_what_is_proposed_for_the_town_s_car_lies_on_it():
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    ego = wa.town([0])[0].ego
    zones = propose_zones(ego)
    assert {zone.name for zone in zones} == {*NORMALS, "roof", "bonnet", "windscreen", "rear_window"} - {"up"}
    chart = chart_of(zones, ego, cell_m=0.04)
    body = EmbreeScene()
    TriangleMesh(body, ego.vertex_m[ego.triangle])
    for number, zone in enumerate(zones):
        _, point_m = cells(chart, number)
        assert len(point_m) * chart.cell_m**2 > 0.3, zone.name
        normal = np.array(zone.normal, np.float32)
        start_m = (point_m + 0.05 * normal).astype(np.float32)
        away_m = body.run(start_m, np.tile(-normal, (len(start_m), 1)), query="DISTANCE") - 0.05
        assert np.quantile(np.abs(away_m), 0.95) < 0.03, zone.name
        assert np.median(np.abs(away_m)) < 0.01, zone.name
