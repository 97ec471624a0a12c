"""Projection to the constraints, and how violations are measured."""

import functools
import itertools
import math

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.driving_scene import flat_surface, roof
from warpav.core.errors import InputError
from warpav.optimisation import CameraMount, FrozenCameras, ZoneAndSpacing
from warpav.optimisation._constraints import min_camera_distance_m
from warpav.raster.camera import CameraModel
from warpav.rig import MountSurface, Rig, RigCamera, mount_surface_from_mesh
from warpav.scene import ego_vehicle
from warpav.thesis import BoundsAndSpacing

SURFACE = flat_surface([-1.0, -0.6], [1.4, 0.6])
coordinate = st.floats(-3.0, 3.0, allow_nan=False)
places = st.lists(st.tuples(coordinate, coordinate), min_size=1, max_size=8).map(lambda p: np.array(p, float))


def on_surface(place, surface, offset_m=0.25):
    return np.c_[place, surface.height_at_m(place) + offset_m]


def rig_at(place, surface):
    model = CameraModel(64, 64)
    points = on_surface(np.asarray(place, float), surface)
    return Rig([RigCamera(f"camera_{i}", p, 0.0, 0.0, 0.0, model) for i, p in enumerate(points)])


@pytest.mark.parametrize("surface", [SURFACE, roof()], ids=["flat", "curved"])
@settings(max_examples=40, derandomize=True)
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


def test_spacing_counts_in_space_not_in_the_plane():
    # 0.2 m apart in the plane, one 1 m above the other
    cliff = flat_surface([0.0, 0.0], [0.2, 0.2])
    cliff.height_m[2] += 1.0
    place = np.array([[1e-5, 0.1], [0.2 - 1e-5, 0.1]])
    constraints = BoundsAndSpacing(cliff, min_spacing_m=0.5)
    np.testing.assert_array_equal(constraints.project(place), place)
    np.testing.assert_array_equal(constraints.project(place, np.array([0.2, 0.4])), place)


@pytest.mark.parametrize("camera_count", [2, 9])
def test_projection_refuses_what_does_not_fit(camera_count):
    with pytest.raises(InputError, match=rf"rig\.cameras: expected .* fits .* 2\.40 m x 1\.20 m .* got {camera_count}"):
        BoundsAndSpacing(SURFACE, min_spacing_m=3.0).project(np.zeros((camera_count, 2)))


def test_violation_adds_excess_and_missing_spacing():
    assert BoundsAndSpacing(SURFACE, min_spacing_m=0.3).violation_m(rig_at([[0, 0], [1, 0]], SURFACE)) == 0.0
    # 0.1 m beyond x, 0.2 m beyond -y, and a pair 0.2 m apart instead of 0.3 m
    rig = rig_at([[1.5, 0.0], [0.0, -0.8], [-0.5, 0.3], [-0.5, 0.5]], SURFACE)
    assert BoundsAndSpacing(SURFACE, min_spacing_m=0.3).violation_m(rig) == pytest.approx(0.1 + 0.2 + 0.1)


@pytest.mark.parametrize("held", [None, [True, False, False]])
def test_the_slope_of_the_slack_is_that_of_its_differences(held):
    slope = flat_surface([0.0, 0.0], [2.0, 2.0])
    slope.height_m[:] += 0.3 * np.linspace(0.0, 2.0, len(slope.height_m))[:, None]
    place, rise = np.array([[0.503, 0.611], [1.207, 0.909], [0.311, 1.513]]), np.array([0.0, 0.1, -0.05])
    frozen = None
    if held is not None:
        cameras = rig_at(place, slope).cameras
        frozen = FrozenCameras(tuple(cameras), np.array(held), np.c_[place, np.zeros((3, 5))].astype(np.float32))
    constraints = ZoneAndSpacing(slope, camera_count=3, min_spacing_m=0.3, frozen=frozen)
    found = constraints.slack_slope(place, rise)
    expected = np.full(found.shape, np.nan)
    for camera, number in np.ndindex(3, 3):
        ends = []
        for step in (1e-5, -1e-5):
            moved = np.c_[place, rise]
            moved[camera, number] += step
            ends.append(constraints.slack_m(moved[:, :2], moved[:, 2]))
        expected[:, camera, number] = (ends[0] - ends[1]) / 2e-5
    np.testing.assert_allclose(found, expected, atol=1e-5)


# --- the mountable zone ----------------------------------------------------------------------------------------------


def zone_surface():
    """Bonnet and roof of a car, 10 cm apart and of different heights, and a bump on the roof that is no zone."""
    base = flat_surface([-1.5, -0.8], [1.5, 0.8], cell_m=0.05)
    is_mountable = np.zeros(base.height_m.shape, bool)
    is_mountable[:34, 4:-4] = True
    is_mountable[:6, :8] = False
    is_mountable[10:14, 12:16] = False
    is_mountable[36:58, 1:-1] = True
    height_m = base.height_m - np.linspace(0.0, 0.4, len(base.height_m), dtype=np.float32)[:, None]
    return MountSurface(height_m, base.origin_m, base.cell_m, is_mountable)


@functools.cache
def town_surface():
    return mount_surface_from_mesh(ego_vehicle(), min_upward_normal=0.8)


def zone(surface, camera_count=4, margin_m=0.02):
    return ZoneAndSpacing(surface, camera_count=camera_count, min_spacing_m=0.3, margin_m=margin_m)


ZONES = {"rectangle": lambda: SURFACE, "two parts": zone_surface, "town": town_surface}


@pytest.mark.parametrize("surface_of", ZONES.values(), ids=ZONES)
@settings(max_examples=25, derandomize=True)
@given(place=places)
def test_projection_to_the_zone_ends_feasible_and_stays(surface_of, place):
    surface = surface_of()
    constraints = zone(surface, len(place))
    projected = constraints.project(place)
    assert constraints.contains(projected).all()
    assert min_camera_distance_m(on_surface(projected, surface)) >= 0.3
    assert constraints.violation_m(rig_at(projected, surface)) == 0.0
    rounded = projected.astype(np.float32).astype(float)
    assert constraints.contains(rounded).all()
    assert constraints.violation_m(rig_at(rounded, surface)) == 0.0
    np.testing.assert_array_equal(constraints.project(projected), projected)
    # whatever the default method allows, the thesis allows
    assert BoundsAndSpacing(surface, min_spacing_m=0.3).violation_m(rig_at(rounded, surface)) == 0.0


@pytest.mark.parametrize("surface_of", ZONES.values(), ids=ZONES)
def test_projection_to_the_zone_goes_to_the_nearest_place(rng, surface_of):
    surface = surface_of()
    constraints = zone(surface, 1)
    low, high = surface.bounds_m
    x, y = (np.arange(a, b, 0.005) for a, b in zip(low, high, strict=True))
    allowed = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    allowed = allowed[constraints.contains(allowed)]
    for place in rng.uniform(low - 1.0, high + 1.0, (100, 1, 2)):
        moved = np.linalg.norm(constraints.project(place) - place)
        # worst seen 0.0054 on cells of 10 cm, 0.0028 on cells of 2 cm
        assert moved <= np.linalg.norm(allowed - place, axis=1).min() + 0.008


@pytest.mark.parametrize("surface_of", ZONES.values(), ids=ZONES)
def test_random_places_are_uniform_over_the_zone(rng, surface_of):
    surface = surface_of()
    constraints = zone(surface, 2)
    drawn = np.stack([constraints.random_place(2, rng) for _ in range(400)])
    for place in drawn:
        assert constraints.violation_m(rig_at(place, surface)) == 0.0
    # a single camera: as much of it in each quarter of the rectangle as there is zone
    single = np.concatenate([constraints.random_place(1, rng) for _ in range(2000)])
    low, high = surface.bounds_m
    everywhere = rng.uniform(low, high, (100_000, 2))
    everywhere = everywhere[constraints.contains(everywhere)]
    middle = 0.5 * (low + high)
    for corner in ((True, True), (True, False), (False, True), (False, False)):
        share, expected = (((place > middle) == corner).all(axis=1).mean() for place in (single, everywhere))
        assert share == pytest.approx(expected, abs=0.04)  # four standard deviations


def test_violation_of_the_zone_adds_what_is_missing():
    surface = zone_surface()
    constraints = zone(surface, 2, margin_m=0.0)
    # between the parts, 2.5 cm from the roof; beside the roof; a pair 0.2 m apart
    for place, expected in (
        ([[0.2, 0.0], [1.0, 0.0]], 0.025),
        ([[-0.5, 0.0], [-0.5, 0.75]], 0.125),
        ([[1.0, 0.1], [1.0, -0.1]], 0.1),
        ([[-0.5, 0.0], [1.0, 0.0]], 0.0),
    ):
        assert constraints.violation_m(rig_at(place, surface)) == pytest.approx(expected, abs=1e-3), place
    assert not BoundsAndSpacing(surface).violation_m(rig_at([[0.2, 0.0], [-0.5, 0.75]], surface))


@pytest.mark.parametrize("surface", [zone_surface(), roof()], ids=["two parts", "curved"])
def test_inequalities_match_oracle_and_differences(device, rng, surface):
    count, cell = 4, surface.cell_m
    constraints = zone(surface, count)
    mount = CameraMount(surface, camera=CameraModel(64, 64), height_offset_m=0.25, device=device)
    weight = rng.normal(size=len(constraints.names)).astype(np.float32)

    def excess(place):
        points = on_surface(place, surface)
        apart = [0.3 - math.dist(a, b) for a, b in itertools.combinations(points, 2)]
        return np.r_[0.02 - surface.zone_distance_m(place), apart]

    low, high = surface.bounds_m
    for _ in range(10):
        place = rng.uniform(low - 0.3, high + 0.3, (count, 2))
        # off the lines between cells, where slopes jump
        place = (
            surface.origin_m + (np.floor((place - surface.origin_m) / cell) + rng.uniform(0.2, 0.8, (count, 2))) * cell
        )
        array = wp.array(np.c_[place, np.zeros((count, 5))], dtype=float, device=device, requires_grad=True)
        tape = wp.Tape()
        with tape:
            found = constraints.losses_of(mount.place(array), mount.rotation_count)
        tape.backward(grads={found: wp.array(weight, dtype=float, device=device)})
        place = array.numpy()[:, :2].astype(float)
        np.testing.assert_allclose(found.numpy(), excess(place), atol=3e-6)  # worst seen 7e-7
        gradient = np.zeros_like(place)
        for index in np.ndindex(place.shape):
            step = np.zeros_like(place)
            step[index] = 1e-6
            gradient[index] = np.dot(weight, excess(place + step) - excess(place - step)) / 2e-6
        np.testing.assert_allclose(array.grad.numpy()[:, :2], gradient, atol=1e-3)
        # beside the place only the height matters, to the spacing
        assert not array.grad.numpy()[:, [2, 3, 4, 6]].any()


@pytest.mark.parametrize("kind", [BoundsAndSpacing, functools.partial(ZoneAndSpacing, camera_count=3, margin_m=0.05)])
@settings(max_examples=40, derandomize=True)
@given(place=st.lists(st.tuples(coordinate, coordinate), min_size=3, max_size=3))
def test_margins_are_the_single_constraints(kind, place):
    constraints = kind(SURFACE, min_spacing_m=0.3)
    rig = rig_at(place, SURFACE)
    margins = constraints.margins(rig)
    assert [margin.kind for margin in margins] == ["border"] * 3 + ["spacing"] * 3
    assert [margin.cameras for margin in margins[3:]] == list(
        itertools.combinations([camera.name for camera in rig.cameras], 2)
    )
    for margin in margins:
        assert margin.slack_m == pytest.approx(margin.value_m - margin.limit_m)
    assert all(margin.is_kept for margin in margins) == (constraints.violation_m(rig) == 0.0)
    inside = constraints.contains(np.array(place))
    np.testing.assert_array_equal([margin.slack_m >= 0.0 for margin in margins[:3]], inside)
    missing = sum(max(-margin.slack_m, 0.0) for margin in margins[3:])
    assert constraints.violation_m(rig) >= missing - 1e-6
