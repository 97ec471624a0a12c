"""The picture of a rig, drawn small and looked at pixel by pixel."""

import numpy as np
import pytest

from tests.view.stand_ins import ego, needs_opengl, rig, scene, vehicle
from warpav.core.errors import InputError
from warpav.rig.mount_surface import MountSurface
from warpav.view import rig_view
from warpav.view.frustum import frustum_points
from warpav.view.opengl import load_pyvista
from warpav.view.output import render_rgb
from warpav.view.palette import camera_rgb

pytestmark = needs_opengl

WINDOW_PX = (480, 300)


def distance_to(image_rgb, rgb):
    return np.linalg.norm(image_rgb.astype(float) - np.asarray(rgb, float), axis=-1)


@pytest.fixture
def draw():
    opened = []

    def make(*args, **options):
        plotter = rig_view.rig_plotter(*args, off_screen=True, window_size=WINDOW_PX, **options)
        opened.append(plotter)
        return plotter

    yield make
    for plotter in opened:
        plotter.close()


def test_every_camera_is_drawn_where_it_is_in_its_colour(draw):
    plotter = draw(rig(), ego=ego(), labels=False)
    image = render_rgb(plotter)
    assert image.shape == (300, 480, 3)
    for index, camera in enumerate(rig().cameras):
        column, row = rig_view.project_px(plotter, frustum_points(camera, depth_m=0.0)[:1])[0]
        x, y = int(column), int(row)
        near = image[y - 6 : y + 7, x - 6 : x + 7]
        assert distance_to(near, camera_rgb(index)).min() < 60.0, camera.name


def test_frustum_edges_lie_where_the_closed_form_puts_them(draw):
    camera = rig().cameras[0]
    plotter = draw(rig(1), ego=ego(), labels=False, sectors=False, frustum_depth_m=1.7)
    image = render_rgb(plotter, supersampling=4)
    corner = frustum_points(camera, depth_m=1.7)[1:]
    for first, second in zip(corner, np.roll(corner, -1, axis=0), strict=True):
        column, row = rig_view.project_px(plotter, (0.5 * (first + second))[None])[0].astype(int)
        patch = image[row - 2 : row + 3, column - 2 : column + 3]
        assert distance_to(patch, camera_rgb(0)).min() < 80.0


def test_projection_is_that_of_vtk(draw):
    plotter = draw(rig(1), ego=ego())
    plotter.show(auto_close=False)
    point = np.array([[1.0, 0.5, 1.6], [3.0, -2.0, 0.0]])
    for expected, (column, row) in zip(point, rig_view.project_px(plotter, point), strict=True):
        plotter.renderer.SetWorldPoint(*expected, 1.0)
        plotter.renderer.WorldToDisplay()
        x, y, _ = plotter.renderer.GetDisplayPoint()
        assert (column, row) == pytest.approx((x, WINDOW_PX[1] - y), abs=0.02)


def test_sector_tints_the_ground_on_its_side_only(draw):
    plotter = draw(rig(1), ego=ego(), labels=False)
    plain = draw(rig(1), ego=ego(), labels=False, sectors=False)
    changed = distance_to(render_rgb(plotter), 0) - distance_to(render_rgb(plain), 0)
    ahead, behind = rig_view.project_px(plotter, np.array([[5.5, 0.0, 0.0], [-3.0, 0.0, 0.0]])).astype(int)
    assert abs(changed[ahead[1], ahead[0]]) > 10.0
    assert abs(changed[behind[1], behind[0]]) < 1.0


def test_traffic_and_road_are_drawn_and_walls_are_not(draw):
    image = render_rgb(draw(rig(1), ego=ego(), scene=scene(vehicle(1, -5.0, 3.4, rgb=(20, 150, 30))), labels=False))
    green = (image[..., 1] > image[..., 0] + 60) & (image[..., 1] > image[..., 2] + 60)
    assert green.sum() > 150
    assert (distance_to(image, (160, 90, 70)) < 25.0).sum() == 0
    # The road of grey 110, moved towards white by the softness.
    assert (distance_to(image, np.full(3, 110 + 0.42 * 145)) < 6.0).sum() > 300


def test_far_traffic_is_left_out(draw):
    plotter = draw(rig(1), ego=ego(), scene=scene(vehicle(1, 80.0, 3.4)))
    assert "scene/vehicles" not in plotter.actors


def test_viewer_stands_where_no_vehicle_hides_the_ego():
    assert rig_view.clear_azimuth_rad(scene()) == rig_view.VIEW_AZIMUTH_RAD
    assert rig_view.clear_azimuth_rad(scene(vehicle(1, 6.0, 3.4))) == -rig_view.VIEW_AZIMUTH_RAD
    assert rig_view.clear_azimuth_rad(scene(vehicle(1, 6.0, -3.4))) == rig_view.VIEW_AZIMUTH_RAD


def test_ego_keeps_its_colours():
    surface = rig_view.mesh_to_pyvista(ego())
    assert surface.n_cells == 12
    np.testing.assert_array_equal(surface.point_data["RGB"], ego().vertex_rgb)
    np.testing.assert_array_equal(surface.points, ego().vertex_m)


def test_drawing_again_replaces_the_actors(draw):
    plotter = draw(rig(), ego=ego())
    names = set(plotter.actors)
    rig_view.add_rig(plotter, rig())
    assert set(plotter.actors) == names
    assert {"ego", "rig/cam_0/frustum", "rig/cam_3/sector", "rig/cam_1/label"} <= {
        name.removesuffix("-labels") for name in names
    }


@pytest.mark.parametrize("count", [4, 9, 12])
def test_labels_that_want_one_place_do_not_overlap(draw, count):
    plotter = draw(rig(1), ego=ego(), labels=False)
    wanted = np.tile([1.3, 0.0, 3.0], (count, 1))
    size = np.tile([70.0, 20.0], (count, 1))
    lower_left = rig_view.project_px(plotter, rig_view.label_anchors_m(plotter, wanted, size))
    apart = np.abs(lower_left[:, None] - lower_left[None])
    overlap = (apart < size - 1.5).all(axis=-1) & ~np.eye(count, dtype=bool)
    assert not overlap.any()
    assert (lower_left > -1.0).all()
    assert (lower_left + np.array([70.0, 0.0]) < np.array(WINDOW_PX) + 1.0).all()


def test_lone_label_is_centred_on_its_wish(draw):
    plotter = draw(rig(1), ego=ego(), labels=False)
    wanted = np.array([[1.3, 0.0, 3.0]])
    corner = rig_view.label_anchors_m(plotter, wanted, np.array([[60.0, 20.0]]))
    middle = rig_view.project_px(plotter, wanted)[0]
    assert rig_view.project_px(plotter, corner)[0] == pytest.approx(middle + np.array([-30.0, 10.0]), abs=0.8)


def test_trajectory_is_drawn_from_start_to_end(draw):
    step = np.linspace(0.0, 1.0, 20)[:, None]
    path = np.concatenate([1.0 + 1.5 * step, 0.5 - step, np.full_like(step, 1.55)], axis=1)[:, None]
    plotter = draw(rig(1), ego=ego(), trajectory_m=path, labels=False)
    tube = plotter.actors["trajectory/0/path"].mapper.dataset
    assert tube.bounds[0] == pytest.approx(1.0, abs=0.03)
    assert tube.bounds[1] == pytest.approx(2.5, abs=0.03)


def test_camera_that_never_moves_has_no_path(draw):
    plotter = draw(rig(1), ego=ego(), trajectory_m=np.ones((5, 1, 3)))
    assert "trajectory/0/start" in plotter.actors
    assert "trajectory/0/path" not in plotter.actors


@pytest.mark.parametrize(
    "bad", [np.zeros((5, 3)), np.zeros((0, 2, 3)), np.zeros((4, 2, 2)), np.full((2, 2, 3), np.nan)]
)
def test_bad_trajectory_is_refused(bad):
    with pytest.raises(InputError, match="trajectory_m"):
        rig_view.add_trajectory(load_pyvista().Plotter(off_screen=True), bad)


def test_mount_surface_is_draped_at_its_height(draw):
    height_m = np.array([[1.5, 1.5], [1.6, 1.6], [1.7, 1.7]], np.float32)
    surface = MountSurface(height_m, origin_m=np.array([0.0, -0.5]), cell_m=1.0)
    plotter = draw(rig(1), ego=ego(), mount_surface=surface)
    render_rgb(plotter)
    grid = plotter.actors["mount_surface"].mapper.dataset
    assert grid.bounds[:4] == pytest.approx((0.0, 2.0, -0.5, 0.5))
    for point, height in zip(grid.points, grid.point_data["height_m"], strict=True):
        assert height == pytest.approx(1.5 + 0.1 * point[0])


def test_scene_without_cameras_is_drawn(draw):
    plotter = draw(None, ego=ego(), scene=scene(vehicle(1, 8.0, 3.4)))
    assert set(plotter.actors) == {"ego", "ground", "scene/ground", "scene/vehicles"}
