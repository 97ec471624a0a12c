"""What is painted on the body: every zone in its colour, and what one more camera would bring within 0.2 m."""

import dataclasses

import numpy as np
import pytest

from tests.driving_scene import flat_surface
from tests.view.stand_ins import block, ego, needs_opengl, rig
from warpav.optimisation.further_camera import PLACE_M, FurtherCameras
from warpav.rig.catalogue import builtin_modules
from warpav.rig.chart import chart_of
from warpav.rig.mount_surface import mount_surface_from_mesh
from warpav.rig.zone import NORMALS, Zone
from warpav.view import plot
from warpav.view.body_view import (
    GAIN_TITLE,
    WHOLE,
    add_gain,
    add_zones,
    gain_to_pyvista,
    mountable_zone_to_pyvista,
    zone_names,
)
from warpav.view.opengl import load_pyvista
from warpav.view.palette import zone_rgb
from warpav.view.rig_view import project_px

BOX = block((-1.0, -0.8, 0.2), (3.0, 0.8, 1.4), (90, 95, 100))
ROOF, LEFT, RIGHT = (Zone(name, NORMALS[side]) for name, side in (("roof", "up"), ("left", "left"), ("right", "right")))
WIDE = dataclasses.replace(builtin_modules()["fisheye_1_3mp_190"], zones=())
ROOF_ONLY = dataclasses.replace(builtin_modules()["front_3mp_60"], zones=("roof",))


def middles(painted):
    return painted.points.reshape(-1, 4, 3).mean(axis=1)


def further(position_m, gain):
    count = len(gain)
    return FurtherCameras(np.array(position_m), np.zeros(count), np.zeros(count), np.ones(count), np.array(gain))


def test_squares_of_a_zone_lie_on_its_side_of_the_box():
    chart = chart_of([ROOF, LEFT, RIGHT], BOX, cell_m=0.05)
    painted = mountable_zone_to_pyvista(chart)
    zone = painted.cell_data["zone"]
    assert zone_names(chart) == ["roof", "left", "right"]
    for number, (axis, place_m) in enumerate(((2, 1.4), (1, 0.8), (1, -0.8))):
        corners = painted.points.reshape(-1, 4, 3)[zone == number]
        assert len(corners) > 100
        np.testing.assert_allclose(corners[..., axis], place_m, atol=1e-5)
    # all of the roof but its border cells is painted
    assert (zone == 0).sum() * 0.05**2 == pytest.approx(4.0 * 1.6, rel=0.05)


def test_a_zone_of_two_modules_is_painted_once():
    alone = mountable_zone_to_pyvista(chart_of([ROOF, LEFT], BOX, cell_m=0.05))
    both = mountable_zone_to_pyvista(chart_of([ROOF, LEFT], BOX, cell_m=0.05, modules=[WIDE, ROOF_ONLY]))
    assert both.n_cells == alone.n_cells
    order = [np.lexsort(middles(each).round(4).T) for each in (alone, both)]
    np.testing.assert_allclose(middles(both)[order[1]], middles(alone)[order[0]], atol=1e-4)


def test_of_a_symmetric_rig_both_halves_are_painted():
    chart = chart_of([ROOF, LEFT], BOX, cell_m=0.05, modules=[WIDE], pair_spacing_m=0.2)
    painted = mountable_zone_to_pyvista(chart)
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
    painted = mountable_zone_to_pyvista(chart)
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
    add_zones(plotter, chart)
    add_zones(plotter, chart)  # replaces
    names = [name for name in plotter.actors if name.startswith("zones")]
    assert sorted(names) == ["zones", "zones/legend/0", "zones/legend/1"]
    assert [plotter.actors[f"zones/legend/{k}"].input.strip() for k in (1, 0)] == ["roof", "left"]
    plotter.camera_position = [(1.0, 8.0, 6.0), (1.0, 0.4, 1.1), (0.0, 0.0, 1.0)]
    plotter.show(auto_close=False, interactive=False)
    image = plotter.screenshot(return_img=True)
    for point_m, number in (([1.0, 0.0, 1.43], 0), ([1.0, 0.83, 0.8], 1)):
        column, row = project_px(plotter, np.array([point_m]))[0].astype(int)
        assert np.abs(image[row, column].astype(int) - zone_rgb(number)).max() <= 2
    add_zones(plotter, None)
    assert not [name for name in plotter.actors if name.startswith("zones")]
    assert zone_names(flat_surface([0.0, 0.0], [1.0, 1.0])) == [WHOLE]


@needs_opengl
def test_what_nobody_asked_for_is_not_painted(plotter):
    chart = chart_of([ROOF, LEFT], BOX, cell_m=0.05)
    add_gain(plotter, chart, further([[1.0, 0.0, 1.4]], [0.03]))
    drawn = plotter.actors["gain"].mapper.dataset
    assert drawn.n_cells == pytest.approx(np.pi * PLACE_M**2 / 0.05**2, rel=0.1)
    np.testing.assert_allclose(drawn.cell_data["gain_of_100"], 3.0)
    assert list(plotter.scalar_bars.keys()) == [GAIN_TITLE]
    add_gain(plotter, chart, None)
    assert "gain" not in plotter.actors
    assert not list(plotter.scalar_bars.keys())


@needs_opengl
def test_plot_paints_the_body_of_a_rig(tmp_path):
    chart = chart_of([ROOF, LEFT], ego(), cell_m=0.05)
    options = {"ego": ego(), "mount_surface": chart, "window_size": (320, 200)}
    zones = plot(rig(2), **options, out=tmp_path / "zones.png")
    gain = plot(rig(2), **options, further=further([[1.0, 0.0, 1.5]], [0.03]), out=tmp_path / "gain.png")
    assert zones.read_bytes() != gain.read_bytes()
