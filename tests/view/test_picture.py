"""The picture of a rig, drawn small and looked at pixel by pixel."""

import numpy as np
import pytest

from tests.view.conftest import WINDOW_PX
from tests.view.stand_ins import ego, needs_opengl, rig, scene, vehicle
from warpav.core.errors import InputError
from warpav.rig import MountSurface
from warpav.view import _picture as picture
from warpav.view import load_pyvista, render_rgb
from warpav.view._outlines import frustum_points
from warpav.view._palette import camera_rgb

pytestmark = needs_opengl


def distance_to(image_rgb, rgb):
    return np.linalg.norm(image_rgb.astype(float) - np.asarray(rgb, float), axis=-1)


def test_every_camera_is_drawn_where_it_is_in_its_colour(draw):
    plotter = draw(rig=rig(), ego=ego())
    image = render_rgb(plotter)
    assert image.shape == (300, 480, 3)
    for index, camera in enumerate(rig().cameras):
        x, y = picture.project_px(plotter, camera.position_m[None])[0].astype(int)
        assert distance_to(image[y - 6 : y + 7, x - 6 : x + 7], camera_rgb(index)).min() < 60.0, camera.name


def test_frustum_edges_lie_where_the_closed_form_puts_them(draw):
    plotter = draw(ego=ego())
    picture.add_rig(plotter, rig(1), depth_m=1.7, sectors=False)
    image = render_rgb(plotter, supersampling=4)
    corner = frustum_points(rig().cameras[0], depth_m=1.7)[1:]
    for first, second in zip(corner, np.roll(corner, -1, axis=0), strict=True):
        column, row = picture.project_px(plotter, (0.5 * (first + second))[None])[0].astype(int)
        assert distance_to(image[row - 2 : row + 3, column - 2 : column + 3], camera_rgb(0)).min() < 80.0


def test_projection_is_that_of_vtk(draw):
    plotter = draw(rig=rig(1), ego=ego())
    plotter.show(auto_close=False)
    point = np.array([[1.0, 0.5, 1.6], [3.0, -2.0, 0.0]])
    for expected, (column, row) in zip(point, picture.project_px(plotter, point), strict=True):
        plotter.renderer.SetWorldPoint(*expected, 1.0)
        plotter.renderer.WorldToDisplay()
        x, y, _ = plotter.renderer.GetDisplayPoint()
        assert (column, row) == pytest.approx((x, WINDOW_PX[1] - y), abs=0.02)


def test_sector_tints_the_ground_on_its_side_only(draw):
    plotter, plain = (draw(rig=rig(1), ego=ego(), sectors=shown) for shown in (True, False))
    changed = distance_to(render_rgb(plotter), 0) - distance_to(render_rgb(plain), 0)
    ahead, behind = picture.project_px(plotter, np.array([[5.5, 0.0, 0.0], [-3.0, 0.0, 0.0]])).astype(int)
    assert abs(changed[ahead[1], ahead[0]]) > 10.0
    assert abs(changed[behind[1], behind[0]]) < 1.0


def test_near_traffic_and_road_are_drawn_and_walls_are_not(draw):
    image = render_rgb(draw(rig=rig(1), scene=scene(vehicle(1, -5.0, 3.4, rgb=(20, 150, 30)))))
    green = (image[..., 1] > image[..., 0] + 60) & (image[..., 1] > image[..., 2] + 60)
    assert green.sum() > 150
    assert (distance_to(image, (160, 90, 70)) < 25.0).sum() == 0
    # the road of grey 110, moved towards white by the softness
    assert (distance_to(image, np.full(3, 110 + 0.42 * 145)) < 6.0).sum() > 300
    assert set(draw(scene=scene(vehicle(1, 8.0, 3.4))).actors) == {"ego", "ground", "scene/ground", "scene/vehicles"}
    assert "scene/vehicles" not in draw(scene=scene(vehicle(1, 80.0, 3.4))).actors


def test_viewer_stands_where_no_vehicle_hides_the_ego():
    for users, side in (((), 1), ((vehicle(1, 6.0, 3.4),), -1), ((vehicle(1, 6.0, -3.4),), 1)):
        assert picture._clear_azimuth_rad(scene(*users)) == side * picture.VIEW_AZIMUTH_RAD


def test_drawing_again_replaces_the_actors(draw):
    plotter = draw(rig=rig(), ego=ego(), labels=True)
    names = set(plotter.actors)
    picture.add_rig(plotter, rig())
    assert set(plotter.actors) == names
    assert {"ego", "rig/cam_0/frustum", "rig/cam_3/sector", "rig/cam_1/label-labels"} <= names


@pytest.mark.parametrize("count", [1, 4, 9, 12])
def test_labels_that_want_one_place_do_not_overlap(draw, count):
    plotter = draw(rig=rig(1), ego=ego())
    wanted, size = np.tile([1.3, 0.0, 3.0], (count, 1)), np.tile([70.0, 20.0], (count, 1))
    lower_left = picture.project_px(plotter, picture._label_anchors_m(plotter, wanted, size))
    apart = np.abs(lower_left[:, None] - lower_left[None])
    assert not ((apart < size - 1.5).all(axis=-1) & ~np.eye(count, dtype=bool)).any()
    assert (lower_left > -1.0).all()
    assert (lower_left + np.array([70.0, 0.0]) < np.array(WINDOW_PX) + 1.0).all()
    middle = picture.project_px(plotter, wanted)[0]  # one of them is centred on it
    assert np.abs(lower_left - middle - np.array([-35.0, 10.0])).max(axis=1).min() < 0.8


def test_trajectory_is_drawn_from_start_to_end(draw):
    step = np.linspace(0.0, 1.0, 20)[:, None]
    path = np.concatenate([1.0 + 1.5 * step, 0.5 - step, np.full_like(step, 1.55)], axis=1)[:, None]
    still = np.ones((20, 1, 3))
    actors = draw(rig=rig(1), ego=ego(), trajectory_m=np.concatenate([path, still], axis=1)).actors
    assert actors["trajectory/0/path"].mapper.dataset.bounds[:2] == pytest.approx((1.0, 2.5), abs=0.03)
    assert "trajectory/1/start" in actors
    assert "trajectory/1/path" not in actors


@pytest.mark.parametrize(
    "bad", [np.zeros((5, 3)), np.zeros((0, 2, 3)), np.zeros((4, 2, 2)), np.full((2, 2, 3), np.nan)]
)
def test_bad_trajectory_is_refused(bad):
    with pytest.raises(InputError, match="trajectory_m"):
        picture.add_trajectory(load_pyvista().Plotter(off_screen=True), bad)


def test_mount_surface_is_draped_at_its_height(draw):
    height_m = np.array([[1.5, 1.5], [1.6, 1.6], [1.7, 1.7]], np.float32)
    surface = MountSurface(height_m, origin_m=np.array([0.0, -0.5]), cell_m=1.0)
    plotter = draw(rig=rig(1), ego=ego(), mount_surface=surface)
    render_rgb(plotter)
    squares = plotter.actors["mount_surface"].mapper.dataset
    assert squares.bounds[:4] == pytest.approx((-0.5, 2.5, -1.0, 1.0))
    middle_m = squares.points.reshape(-1, 4, 3).mean(axis=1)
    np.testing.assert_allclose(squares.cell_data["height_m"], 1.5 + 0.1 * middle_m[:, 0], atol=1e-6)
    assert not list(plotter.scalar_bars.keys())
