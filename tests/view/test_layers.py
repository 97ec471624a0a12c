"""What is laid over pictures: points in closed form, colours looked at pixel by pixel."""

import dataclasses
import math

import numpy as np
import pytest

from tests.driving_scene import flat_surface
from tests.view.stand_ins import block, ego, needs_opengl, rig, scene, vehicle
from warpav.optimisation import PLACE_M, FurtherCameras, ObjectOutcome
from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens
from warpav.rig import NORMALS, MountSurface, Rig, RigCamera, Zone, builtin_modules, chart_of, mount_surface_from_mesh
from warpav.scene import DeviceScene
from warpav.sight import Ground, Requirement, check_requirements
from warpav.sight._requirement import SIZES_M, Band, TestObject
from warpav.view import Steepest, load_pyvista, plot, render_rgb
from warpav.view import _layers as layers
from warpav.view._layers import (
    _GAIN_TITLE,
    _LONGEST_M,
    _WIDEST_RAD,
    WHOLE,
    _zone_names,
    gain_to_pyvista,
    zones_to_pyvista,
)
from warpav.view._palette import COVERAGE_RGB, OUTCOME_RGB, zone_rgb
from warpav.view._picture import project_px

STREET = scene(vehicle(1, 9.0, 2.5), vehicle(2, -8.0, -2.5))
BOX = block((-1.0, -0.8, 0.2), (3.0, 0.8, 1.4), (90, 95, 100))
ROOF, LEFT, RIGHT = (Zone(name, NORMALS[side]) for name, side in (("roof", "up"), ("left", "left"), ("right", "right")))
WIDE = dataclasses.replace(builtin_modules()["fisheye_1_3mp_190"], zones=())
ROOF_ONLY = dataclasses.replace(builtin_modules()["front_3mp_60"], zones=("roof",))


@pytest.fixture(scope="module")
def packed():
    return DeviceScene.pack(STREET)


def camera_at(position_m, model=None, pitch_rad=0.0, yaw_rad=0.0):
    return RigCamera("one", np.array(position_m), yaw_rad, pitch_rad, 0.0, model or CameraModel())


def test_sight_ends_at_the_ground_and_after_its_length(packed):
    camera = camera_at([5.0, -5.0, 2.0], pitch_rad=0.3, yaw_rad=-0.1)
    surface = layers.visibility_to_pyvista(camera, packed, farthest_m=12.0, rays=33)
    part, point_m = surface.cell_data["part"], np.asarray(surface.points)
    assert set(part) == {"seen", "free", "side"}
    corner = np.asarray(surface.regular_faces)
    seen_m = point_m[corner[part == "seen"]]
    np.testing.assert_allclose(seen_m[..., 2], 0.0, atol=layers._LIFT_M)
    assert (seen_m[..., 2] > 0.0).all()
    reach_m = np.linalg.norm(point_m - camera.position_m, axis=1)
    assert reach_m.max() == pytest.approx(12.0, abs=1e-4)
    # rays above the horizon are free
    rising = point_m[:, 2] > camera.position_m[2] + 1e-3
    np.testing.assert_allclose(reach_m[rising], 12.0, atol=1e-4)
    # every side holds the camera's centre
    centre = len(point_m) - 1
    assert (corner[part == "side"] == centre).any(axis=1).all()


def test_nothing_is_painted_between_a_vehicle_and_the_ground_that_it_hides(packed):
    camera = camera_at([1.0, 2.0, 2.2], pitch_rad=0.15)
    surface = layers.visibility_to_pyvista(camera, packed, rays=129)
    seen_m = np.asarray(surface.points)[np.asarray(surface.regular_faces)[surface.cell_data["part"] == "seen"]]
    is_on_vehicle = np.stack([STREET.vehicles[0].box.contains(corner_m, margin_m=0.1) for corner_m in seen_m])
    is_on_both = is_on_vehicle.any(axis=1) & ~is_on_vehicle.all(axis=1)
    assert is_on_vehicle.all(axis=1).sum() > 50
    edge_m = np.linalg.norm(seen_m[is_on_both] - np.roll(seen_m[is_on_both], 1, axis=1), axis=-1)
    assert edge_m.max() < 0.4  # where it stands on the ground, no more
    # the ground is painted far out, flat though rays meet it
    assert seen_m[~is_on_vehicle.any(axis=1)][..., 0].max() > 13.0


def test_a_lens_that_sees_a_circle_has_no_corners(packed):
    model = CameraModel(120, 120, 3.0, lens=Lens.FISHEYE, distortion=(0.1, 0.0, 0.0, 0.0))
    surface = layers.visibility_to_pyvista(camera_at([1.3, 0.0, 2.0], model), packed, rays=21)
    assert np.isfinite(surface.points).all()
    assert surface.n_cells > 100


@needs_opengl
def test_vehicles_have_the_colour_of_what_becomes_of_them(draw):
    outcomes = [ObjectOutcome.MISSED, ObjectOutcome.DETECTED]
    plotter = draw(scene=STREET, outcomes=outcomes)
    plotter.camera.zoom(0.5)
    image = render_rgb(plotter).astype(float)
    for car, outcome in zip(STREET.vehicles, outcomes, strict=True):
        x_m, y_m, z_m = car.box.center_m
        top_m = np.array([[x_m, y_m, z_m + 0.5 * car.box.size_m[2]]])
        column, row = project_px(plotter, top_m)[0].astype(int)
        expected = 0.45 * np.array([150, 20, 20]) + 0.55 * np.array(OUTCOME_RGB[outcome])
        assert np.abs(image[row, column] - expected).max() < 12.0, outcome
    assert {"scene/outcomes/1/body", "scene/outcomes/2/box", "legend/0", "legend/1"} <= set(plotter.actors)
    assert "scene/vehicles" not in plotter.actors
    with pytest.raises(ValueError, match="an outcome of each of 2 vehicles, got 1"):
        layers.add_outcomes(plotter, STREET, outcomes[:1])


@needs_opengl
def test_the_ground_has_the_colour_of_how_many_cameras_see_it(draw, packed):
    cells = Ground.around(packed, radius_m=6.0)
    coverage = cells.coverage([camera_at([1.3, 0.0, 3.0], CameraModel(256, 256, math.radians(100.0)))])
    surface = layers.coverage_to_pyvista(coverage)
    assert surface.n_cells == coverage.is_open.any(axis=0).sum()
    count = np.asarray(surface.cell_data["cameras_1.1m"])
    np.testing.assert_array_equal(surface.cell_data["blind_1.1m"], count == 0)
    assert (count == 1).sum() == coverage.is_seen[0, 0].sum() > 10
    plotter = draw(ego=ego())
    layers.add_coverage(plotter, coverage, height_m=1.7, legend=False)
    plain = render_rgb(draw(ego=ego())).astype(float)
    image = render_rgb(plotter).astype(float)
    for x_m, cameras in ((5.5, 1), (-3.0, 0)):
        column, row = project_px(plotter, np.array([[x_m, 0.0, 0.04]]))[0].astype(int)
        expected = 0.6 * np.array(COVERAGE_RGB[cameras]) + 0.4 * plain[row, column]
        assert np.abs(image[row, column] - expected).max() < 6.0, x_m
    with pytest.raises(ValueError, match=r"height_m must be one of \(1.1, 1.7\), got 2"):
        layers.add_coverage(plotter, coverage, height_m=2.0)


@needs_opengl
def test_drawing_again_replaces(draw, packed):
    plotter = draw(rig=rig(2), scene=STREET)
    coverage = Ground.around(packed, radius_m=6.0).coverage(rig(2).cameras)
    for _ in range(2):
        for k, camera in enumerate(rig(2).cameras):
            layers.add_visibility(plotter, camera, k, packed)
        layers.add_coverage(plotter, coverage)
        names = sorted(plotter.actors)
    assert sorted(plotter.actors) == names
    assert sum(name.startswith("legend/") for name in names) == len(COVERAGE_RGB)
    assert {"coverage", "visibility/cam_0", "visibility/cam_1"} <= set(names)
    # whoever looks into the air sees nothing below the pictures' top
    up = Rig([RigCamera("cam_0", np.array([1.3, 0.0, 3.0]), 0.0, -1.5, 0.0, CameraModel())])
    layers.add_visibility(plotter, up.cameras[0], 0, packed)
    assert "visibility/cam_0" not in plotter.actors


# ---- on the ground and on the body

NEAR = Requirement("near", Band((0.0, 6.0)), 0.8, TestObject("child", SIZES_M["child"]), visible_share=0.3)


@needs_opengl
def test_points_that_are_met_are_discs_and_the_others_crosses():
    result = check_requirements(rig(), ego(), [NEAR])
    drawn = layers.requirements_to_pyvista(result)
    point = drawn.cell_data["point"]
    colours = np.array(COVERAGE_RGB)[np.minimum(result.camera_count, 3)]
    np.testing.assert_array_equal(drawn.cell_data["RGB"], colours[point])
    assert set(point) == set(range(len(result.is_point_met)))
    corner_m = drawn.points.reshape(-1, 3, 3)
    radius_m = 0.4 * result.ghosts.of_each("grid_m")
    for k, is_met in enumerate(result.is_point_met):
        some = corner_m[point == k]
        away_m = np.linalg.norm(some[..., :2] - result.ghosts.position_m[k], axis=-1)
        assert len(some) == (12 if is_met else 4)
        assert away_m.max() == pytest.approx(radius_m[k] * (1.0 if is_met else np.hypot(1.0, 0.22)), rel=1e-4)
    assert 0 < result.is_point_met.sum() < len(result.is_point_met)


def middles(painted):
    return painted.points.reshape(-1, 4, 3).mean(axis=1)


def further(position_m, gain):
    count = len(gain)
    return FurtherCameras(np.array(position_m), np.zeros(count), np.zeros(count), np.ones(count), np.array(gain))


def test_squares_of_a_zone_lie_on_its_side_of_the_box():
    chart = chart_of([ROOF, LEFT, RIGHT], BOX, cell_m=0.05)
    painted = zones_to_pyvista(chart)
    zone = painted.cell_data["zone"]
    assert _zone_names(chart) == ["roof", "left", "right"]
    for number, (axis, place_m) in enumerate(((2, 1.4), (1, 0.8), (1, -0.8))):
        corners = painted.points.reshape(-1, 4, 3)[zone == number]
        assert len(corners) > 100
        np.testing.assert_allclose(corners[..., axis], place_m, atol=1e-5)
    # all of the roof but its border cells is painted
    assert (zone == 0).sum() * 0.05**2 == pytest.approx(4.0 * 1.6, rel=0.05)


def test_a_zone_of_two_modules_is_painted_once():
    alone = zones_to_pyvista(chart_of([ROOF, LEFT], BOX, cell_m=0.05))
    both = zones_to_pyvista(chart_of([ROOF, LEFT], BOX, cell_m=0.05, modules=[WIDE, ROOF_ONLY]))
    assert both.n_cells == alone.n_cells
    order = [np.lexsort(middles(each).round(4).T) for each in (alone, both)]
    np.testing.assert_allclose(middles(both)[order[1]], middles(alone)[order[0]], atol=1e-4)


def test_of_a_symmetric_rig_both_halves_are_painted():
    chart = chart_of([ROOF, LEFT], BOX, cell_m=0.05, modules=[WIDE], pair_spacing_m=0.2)
    painted = zones_to_pyvista(chart)
    middle_m, zone = middles(painted), painted.cell_data["zone"]
    for number in range(2):
        y_m = middle_m[zone == number, 1]
        np.testing.assert_allclose(np.sort(y_m[y_m > 0.0]), np.sort(-y_m[y_m < 0.0]), atol=1e-6)
    assert np.abs(middle_m[zone == 0, 1]).min() >= 0.1 - 1e-6


@pytest.mark.parametrize(
    "chart",
    [
        chart_of([ROOF, LEFT, RIGHT], BOX, cell_m=0.05),
        chart_of([ROOF, LEFT], BOX, cell_m=0.05, modules=[WIDE, ROOF_ONLY]),
        flat_surface([-1.0, -0.8], [3.0, 0.8], height_m=1.4, cell_m=0.05),
    ],
    ids=["zones", "modules", "no zones"],
)
def test_a_square_has_the_gain_of_the_best_camera_near_in_its_zone(chart, rng):
    painted = zones_to_pyvista(chart)
    chosen = rng.choice(painted.n_cells, 40, replace=False)
    position_m, zone = middles(painted)[chosen], painted.cell_data["zone"][chosen]
    gain = rng.uniform(0.0, 0.05, len(chosen))
    asked = gain_to_pyvista(chart, further(position_m, gain))
    distance_m = np.linalg.norm(middles(asked)[:, None] - position_m, axis=2)
    is_near = (distance_m <= PLACE_M) & (asked.cell_data["zone"][:, None] == zone)
    expected = np.where(is_near.any(axis=1), 100.0 * np.where(is_near, gain, -1.0).max(axis=1), np.nan)
    is_edge = (np.abs(distance_m - PLACE_M) < 1e-5).any(axis=1)  # of a disc: rounding decides
    assert is_edge.mean() < 0.2
    np.testing.assert_allclose(asked.cell_data["gain_of_100"][~is_edge], expected[~is_edge], atol=1e-12)
    assert np.isnan(expected).any()
    assert np.isfinite(expected).any()


def test_cameras_high_above_the_surface_bring_their_gain_to_what_is_below_them():
    surface = mount_surface_from_mesh(BOX, cell_m=0.05)
    asked = gain_to_pyvista(surface, further([[1.0, 0.1, 1.4 + 0.25]], [0.03]))
    is_known = np.isfinite(asked.cell_data["gain_of_100"])
    assert is_known.sum() == pytest.approx(np.pi * (PLACE_M / 0.05) ** 2, rel=0.1)
    assert np.linalg.norm(middles(asked)[is_known, :2] - [1.0, 0.1], axis=1).max() <= PLACE_M


def test_round_a_corner_is_another_zone():
    chart = chart_of([ROOF, LEFT], BOX, cell_m=0.05)
    asked = gain_to_pyvista(chart, further([[1.0, 0.78, 1.42]], [0.03]))
    zone, gain_of_100 = asked.cell_data["zone"], asked.cell_data["gain_of_100"]
    assert np.isfinite(gain_of_100[zone == 0]).any()
    assert np.isnan(gain_of_100[zone == 1]).all()
    distance_m = np.linalg.norm(middles(asked) - [1.0, 0.78, 1.42], axis=1)
    assert (distance_m[zone == 1] < PLACE_M).any()  # they are near, but on the side
    assert np.isnan(gain_to_pyvista(chart, further(np.zeros((0, 3)), [])).cell_data["gain_of_100"]).all()


def test_a_pair_brings_its_gain_on_both_sides():
    chart = chart_of([ROOF, LEFT], BOX, cell_m=0.05, modules=[WIDE], pair_spacing_m=0.2)
    asked = gain_to_pyvista(chart, further([[1.0, -0.5, 1.4]], [0.04]))
    is_known = np.isfinite(asked.cell_data["gain_of_100"])
    y_m = middles(asked)[is_known, 1]
    assert (y_m > 0.0).sum() == (y_m < 0.0).sum() > 10
    np.testing.assert_allclose(asked.cell_data["gain_of_100"][is_known], 4.0)


@pytest.fixture
def plotter():
    made = load_pyvista().Plotter(off_screen=True, window_size=[320, 200])
    yield made
    made.close()


@needs_opengl
def test_a_zone_has_its_colour_and_its_name(plotter):
    chart = chart_of([ROOF, LEFT], BOX, cell_m=0.05)
    layers.add_zones(plotter, chart)
    layers.add_zones(plotter, chart)  # replaces
    names = [name for name in plotter.actors if name.startswith("zones")]
    assert sorted(names) == ["zones", "zones/legend/0", "zones/legend/1"]
    assert [plotter.actors[f"zones/legend/{k}"].input.strip() for k in (1, 0)] == ["roof", "left"]
    plotter.camera_position = [(1.0, 8.0, 6.0), (1.0, 0.4, 1.1), (0.0, 0.0, 1.0)]
    plotter.show(auto_close=False, interactive=False)
    image = plotter.screenshot(return_img=True)
    for point_m, number in (([1.0, 0.0, 1.43], 0), ([1.0, 0.83, 0.8], 1)):
        column, row = project_px(plotter, np.array([point_m]))[0].astype(int)
        assert np.abs(image[row, column].astype(int) - zone_rgb(number)).max() <= 2
    layers.add_zones(plotter, None)
    assert not [name for name in plotter.actors if name.startswith("zones")]
    assert _zone_names(flat_surface([0.0, 0.0], [1.0, 1.0])) == [WHOLE]


@needs_opengl
def test_what_nobody_asked_for_is_not_painted(plotter):
    chart = chart_of([ROOF, LEFT], BOX, cell_m=0.05)
    layers.add_gain(plotter, chart, further([[1.0, 0.0, 1.4]], [0.03]))
    drawn = plotter.actors["gain"].mapper.dataset
    assert drawn.n_cells == pytest.approx(np.pi * PLACE_M**2 / 0.05**2, rel=0.1)
    np.testing.assert_allclose(drawn.cell_data["gain_of_100"], 3.0)
    assert list(plotter.scalar_bars.keys()) == [_GAIN_TITLE]
    layers.add_gain(plotter, chart, None)
    assert "gain" not in plotter.actors
    assert not list(plotter.scalar_bars.keys())


@needs_opengl
def test_plot_paints_the_body_of_a_rig(tmp_path):
    chart = chart_of([ROOF, LEFT], ego(), cell_m=0.05)
    options = {"ego": ego(), "mount_surface": chart, "window_size": (320, 200)}
    zones = plot(rig(2), **options, out=tmp_path / "zones.png")
    gain = plot(rig(2), **options, further=further([[1.0, 0.0, 1.5]], [0.03]), out=tmp_path / "gain.png")
    assert zones.read_bytes() != gain.read_bytes()


# ---- of a search

FLAT = flat_surface([-1.0, -1.0], [3.0, 1.0], height_m=1.5)
EVENT = {
    "iteration": 0,
    "loss": 0.5,
    "positions_m": [[2.1, 0.0, 1.58], [0.5, 0.0, 1.58]],
    "yaw_deg": [0.0, 180.0],
    "gradient": {"position_per_m": [[0.0, -4.0], [2.0, 0.0]], "yaw_per_rad": [-0.1, 0.05]},
}


def slope(rise):
    """A surface that rises along x."""
    x_m = np.arange(81) * 0.05
    return MountSurface(
        np.repeat((1.0 + rise * x_m)[:, None], 41, axis=1).astype(np.float32), np.array([-1.0, -1.0]), 0.05
    )


def test_arrows_point_down_the_gradient_along_the_surface():
    descent = Steepest.of_event(EVENT)
    np.testing.assert_allclose(
        layers._arrows_m(rig(2), descent, FLAT), [[0, _LONGEST_M, 0], [-_LONGEST_M / 2, 0, 0]], atol=1e-6
    )
    # on a slope of 30 degrees the second one, which goes down it, keeps its length
    rise = math.tan(math.radians(30.0))
    down = layers._arrows_m(rig(2), descent, slope(rise))[1]
    np.testing.assert_allclose(down, -_LONGEST_M / 2 * np.array([math.cos(math.pi / 6), 0, 0.5]), atol=1e-4)


def test_a_run_that_recorded_no_gradient_has_no_arrows():
    assert Steepest.of_event({"iteration": 0}) is None
    assert Steepest.of_event({"iteration": 0, "gradient": {}}) is None
    still = Steepest(np.zeros((2, 2)), np.zeros(2))
    assert not layers._arrows_m(rig(2), still, FLAT).any()


@needs_opengl
def test_bent_arrows_turn_the_way_of_the_descent(draw):
    plotter = draw(rig=rig(2), scene=scene())
    layers.add_descent(plotter, rig(2), Steepest.of_event(EVENT), FLAT)
    names = {f"descent/cam_{k}/{kind}" for k in (0, 1) for kind in ("move", "turn")}
    assert names <= set(plotter.actors)
    # camera 0 looks ahead and turns to the left by the widest angle: the tip lies there
    first = plotter.actors["descent/cam_0/turn"].mapper.dataset.points - rig(2).cameras[0].position_m
    bearing = np.arctan2(first[:, 1], first[:, 0])
    assert bearing.min() > -0.1
    assert _WIDEST_RAD < bearing.max() < _WIDEST_RAD + 0.6
    # camera 1 looks back and turns to the right by half of it
    second = plotter.actors["descent/cam_1/turn"].mapper.dataset.points - rig(2).cameras[1].position_m
    turned = np.angle(np.exp(1j * (np.arctan2(second[:, 1], second[:, 0]) - math.pi)))
    assert turned.max() < 0.1
    assert -_WIDEST_RAD / 2 - 0.6 < turned.min() < -_WIDEST_RAD / 2
    layers.add_descent(plotter, rig(2), None, FLAT)
    assert not names & set(plotter.actors)
    with pytest.raises(ValueError, match="each of 3 cameras, got 2"):
        layers.add_descent(plotter, rig(3), Steepest.of_event(EVENT), FLAT)
