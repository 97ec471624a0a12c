"""Areas on the ground, against brute force."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.path import Path

from tests.raster.bodies import cuboid
from warpav.core.errors import InputError
from warpav.sight import Body, Ghosts, Requirement
from warpav.sight._requirement import SIZES_M, Band, Polygon, Strip, TestObject, grid_m

POST = TestObject("post", SIZES_M["post"])


def box(size_m=(4.0, 2.0, 1.5), centre_m=(1.0, 0.0, 0.75)):
    return cuboid(size_m, centre_m)


@given(st.floats(-6.0, 8.0), st.floats(-6.0, 6.0))
def test_the_distance_from_a_box_is_known(x, y):
    expected = math.hypot(max(abs(x - 1.0) - 2.0, 0.0), max(abs(y) - 1.0, 0.0))
    assert Body.of(box()).distance_m(np.array([x, y])) == pytest.approx(expected, abs=1e-9)


def test_the_distance_from_a_round_body_is_that_of_its_nearest_point(rng):
    turn = np.linspace(0.0, 2.0 * math.pi, 40, endpoint=False)
    body = Body(np.stack([2.0 * np.cos(turn), np.sin(turn)], axis=1))
    share = np.linspace(0.0, 1.0, 400)[:, None, None]
    border = (body.outline_m + share * (np.roll(body.outline_m, -1, axis=0) - body.outline_m)).reshape(-1, 2)
    for point in rng.uniform(-4.0, 4.0, (200, 2)):
        inside = Path(body.outline_m).contains_point(point)
        expected = 0.0 if inside else np.linalg.norm(border - point, axis=1).min()
        assert body.distance_m(point) == pytest.approx(expected, abs=1e-3)  # worst seen 7e-5


def test_a_polygon_holds_what_matplotlib_says(rng):
    star = tuple((float(r * math.cos(k)), float(r * math.sin(k))) for k, r in enumerate([3.0, 1.0, 2.5, 0.7, 3.0, 1.2]))
    point = rng.uniform(-3.0, 3.0, (2000, 2))
    found = Polygon(star).holds(point, Body.of(box()))
    assert found.sum() > 100
    np.testing.assert_array_equal(found, Path(star).contains_points(point))


@pytest.mark.parametrize("spacing_m", [0.1, 0.25])
def test_a_band_has_as_many_points_as_its_area(spacing_m):
    body = Body.of(box())
    point = grid_m(Band((1.0, 3.0)), body, spacing_m)
    distance = body.distance_m(point)
    assert 1.0 - 1e-5 <= distance.min() < distance.max() <= 3.0 + 1e-5
    area = 2.0 * (4.0 + 2.0) * 2.0 + math.pi * (9.0 - 1.0)
    assert len(point) * spacing_m**2 == pytest.approx(area, rel=0.08)
    np.testing.assert_allclose(point.mean(axis=0), body.centre_m, atol=1e-9)
    outer, inner = Band((1.0, 3.0)).outlines_m(body)
    np.testing.assert_allclose(body.distance_m(outer), 3.0, rtol=1e-3)
    np.testing.assert_allclose(body.distance_m(inner), 1.0, rtol=1e-3)


def test_no_test_object_reaches_under_the_body():
    wanted = [
        Requirement("posts", Band((0.0, 1.0)), 0.05, POST),
        Requirement("people", Band((0.0, 1.0)), 0.05, TestObject("lying", SIZES_M["lying"])),
    ]
    ghosts = Ghosts.of(wanted, box())
    for k, lengths in enumerate([(0.15, 0.15), (0.875, 0.25)]):
        offset = np.abs(ghosts.position_m[ghosts.requirement == k] - [1.0, 0.0]) - [2.0, 1.0]
        gap = (offset - lengths).max(axis=1)
        assert gap.min() > -0.05  # a corner of the body may point at the middle of a side of the post
        assert 0.0 < gap.min() + 0.05 < 0.15


def test_an_area_without_points_or_with_too_many_is_rejected(monkeypatch):
    with pytest.raises(InputError, match="requirement under: expected at least one point of the area outside"):
        Ghosts.of([Requirement("under", Strip("rear", (-1.0, -0.5)), 0.25, POST)], box())
    monkeypatch.setattr("warpav.sight._requirement.MAX_GHOSTS", 1000)
    with pytest.raises(InputError, match=r"at most 1000 points together, got 2032; choose wider grids"):
        Ghosts.of([Requirement("all", Band((0.0, 3.0)), 0.25, POST)] * 2, box())
