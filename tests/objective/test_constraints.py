"""Projection to the constraints, and how violations are measured."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.driving_scene import flat_surface, roof
from warpav.errors import InputError
from warpav.objective.constraints import BoundsAndSpacing, min_camera_distance_m
from warpav.rig.camera import CameraModel
from warpav.rig.rig import Rig, RigCamera

SURFACE = flat_surface([-1.0, -0.6], [1.4, 0.6])
coordinate = st.floats(-3.0, 3.0, allow_nan=False)
places = st.lists(st.tuples(coordinate, coordinate), min_size=1, max_size=8).map(lambda p: np.array(p, float))


def on_surface(place, surface, offset_m=0.25):
    return np.c_[place, surface.height_at_m(place) + offset_m]


def rig_at(place, surface):
    model = CameraModel(64, 64)
    points = on_surface(np.asarray(place, float), surface)
    return Rig.create([RigCamera(f"camera_{i}", p, 0.0, 0.0, 0.0, model) for i, p in enumerate(points)])


@pytest.mark.parametrize("surface", [SURFACE, roof()], ids=["flat", "curved"])
@settings(max_examples=40, deadline=None, derandomize=True)
@given(place=places)
def test_projection_ends_feasible(surface, place):
    projected = BoundsAndSpacing(surface, min_spacing_m=0.3).project(place)
    low, high = surface.bounds_m
    assert (projected >= low).all()
    assert (projected <= high).all()
    assert min_camera_distance_m(on_surface(projected, surface)) >= 0.3
    assert BoundsAndSpacing(surface, min_spacing_m=0.3).violation_m(rig_at(projected, surface)) == 0.0
    # the numbers are stored as float32: still feasible
    rounded = projected.astype(np.float32).astype(float)
    assert BoundsAndSpacing(surface, min_spacing_m=0.3).violation_m(rig_at(rounded, surface)) == 0.0


@settings(max_examples=40, deadline=None, derandomize=True)
@given(place=places)
def test_projection_leaves_feasible_places_alone(place):
    low, high = SURFACE.bounds_m
    inside = np.clip(place, low + 1e-5, high - 1e-5)
    if min_camera_distance_m(on_surface(inside, SURFACE)) >= 0.3 + 1e-5:
        np.testing.assert_array_equal(BoundsAndSpacing(SURFACE, min_spacing_m=0.3).project(inside), inside)


def test_projection_does_not_touch_its_input():
    place = np.array([[5.0, 5.0], [5.0, 5.0]])
    BoundsAndSpacing(SURFACE, min_spacing_m=0.3).project(place)
    assert (place == 5.0).all()


def test_projection_moves_no_further_than_needed():
    projected = BoundsAndSpacing(SURFACE, min_spacing_m=0.3).project(np.array([[0.0, 0.0], [0.2, 0.0]]))
    np.testing.assert_allclose(projected, [[-0.05, 0.0], [0.25, 0.0]], atol=1e-4)
    outside = BoundsAndSpacing(SURFACE, min_spacing_m=0.3).project(np.array([[9.0, 0.1], [0.0, -9.0]]))
    np.testing.assert_allclose(outside, [[1.4, 0.1], [0.0, -0.6]], atol=1e-5)


def test_projection_parts_cameras_in_a_corner_and_on_one_point():
    for point in ([1.4, 0.6], [-1.0, -0.6], [0.2, 0.0], [30.0, -30.0]):
        projected = BoundsAndSpacing(SURFACE, min_spacing_m=0.3).project(np.tile(point, (4, 1)))
        assert min_camera_distance_m(on_surface(projected, SURFACE)) >= 0.3


def test_spacing_counts_in_space_not_in_the_plane():
    # 0.2 m apart in the plane, one 1 m above the other
    cliff = flat_surface([0.0, 0.0], [0.2, 0.2])
    cliff.height_m[2] += 1.0
    place = np.array([[1e-5, 0.1], [0.2 - 1e-5, 0.1]])
    np.testing.assert_array_equal(BoundsAndSpacing(cliff, min_spacing_m=0.5).project(place), place)


@pytest.mark.parametrize("camera_count", [2, 9])
def test_projection_refuses_what_does_not_fit(camera_count):
    with pytest.raises(InputError, match=rf"rig\.cameras: expected .* fits .* 2\.40 m x 1\.20 m .* got {camera_count}"):
        BoundsAndSpacing(SURFACE, min_spacing_m=3.0).project(np.zeros((camera_count, 2)))


def test_cameras_beyond_one_edge_leave_it_when_it_is_too_short():
    # clipped they stand on one line of 1.2 m, which holds five of them at most
    place = np.c_[np.full(7, 9.0), np.linspace(-0.6, 0.6, 7)]
    projected = BoundsAndSpacing(SURFACE, min_spacing_m=0.3).project(place)
    assert min_camera_distance_m(on_surface(projected, SURFACE)) >= 0.3


def test_many_cameras_that_fit_are_placed(rng):
    # a grid of 12 fits with room to spare
    for _ in range(5):
        place = rng.uniform(-1.0, 1.0, (12, 2))
        projected = BoundsAndSpacing(SURFACE, min_spacing_m=0.3).project(place)
        assert min_camera_distance_m(on_surface(projected, SURFACE)) >= 0.3


def test_violation_adds_excess_and_missing_spacing():
    assert BoundsAndSpacing(SURFACE, min_spacing_m=0.3).violation_m(rig_at([[0, 0], [1, 0]], SURFACE)) == 0.0
    # 0.1 m beyond x, 0.2 m beyond -y, and a pair 0.2 m apart instead of 0.3 m
    rig = rig_at([[1.5, 0.0], [0.0, -0.8], [-0.5, 0.3], [-0.5, 0.5]], SURFACE)
    assert BoundsAndSpacing(SURFACE, min_spacing_m=0.3).violation_m(rig) == pytest.approx(0.1 + 0.2 + 0.1)


def test_smallest_distance_of_cameras():
    points = np.array([[0, 0, 0], [3, 4, 0], [3, 4, 2.0]])
    assert min_camera_distance_m(points) == pytest.approx(2.0)
    assert min_camera_distance_m(points[:1]) == math.inf
