"""What a rig sees, drawn: points in closed form, colours looked at pixel by pixel."""

import math

import numpy as np
import pytest

from tests.view.stand_ins import ego, needs_opengl, rig, scene, vehicle
from warpav.evaluation.metrics import ObjectOutcome
from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens
from warpav.rig.rig import Rig, RigCamera
from warpav.scene.device_scene import DeviceScene
from warpav.sight.ground import Ground
from warpav.view import visibility_view
from warpav.view.output import render_rgb
from warpav.view.palette import COVERAGE_RGB, OUTCOME_RGB
from warpav.view.rig_view import project_px, rig_plotter

pytestmark = needs_opengl

WINDOW_PX = (480, 300)
STREET = scene(vehicle(1, 9.0, 2.5), vehicle(2, -8.0, -2.5))


@pytest.fixture(scope="module")
def packed():
    return DeviceScene.pack(STREET)


@pytest.fixture
def draw():
    opened = []

    def make(*args, **options):
        plotter = rig_plotter(*args, off_screen=True, window_size=WINDOW_PX, labels=False, sectors=False, **options)
        opened.append(plotter)
        return plotter

    yield make
    for plotter in opened:
        plotter.close()


def camera_at(position_m, model=None, pitch_rad=0.0, yaw_rad=0.0):
    return RigCamera("one", np.array(position_m), yaw_rad, pitch_rad, 0.0, model or CameraModel())


def test_sight_ends_at_the_ground_and_after_its_length(packed):
    camera = camera_at([5.0, -5.0, 2.0], pitch_rad=0.3, yaw_rad=-0.1)
    surface = visibility_view.visibility_to_pyvista(camera, packed, farthest_m=12.0, rays=33)
    part, point_m = surface.cell_data["part"], np.asarray(surface.points)
    assert set(part) == {"seen", "free", "side"}
    corner = np.asarray(surface.regular_faces)
    seen_m = point_m[corner[part == "seen"]]
    np.testing.assert_allclose(seen_m[..., 2], 0.0, atol=visibility_view._LIFT_M)
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
    surface = visibility_view.visibility_to_pyvista(camera, packed, rays=129)
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
    surface = visibility_view.visibility_to_pyvista(camera_at([1.3, 0.0, 2.0], model), packed, rays=21)
    assert np.isfinite(surface.points).all()
    assert surface.n_cells > 100


def test_vehicles_have_the_colour_of_what_becomes_of_them(draw):
    outcomes = [ObjectOutcome.MISSED, ObjectOutcome.DETECTED]
    plotter = draw(None, ego=ego(), scene=STREET, outcomes=outcomes)
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
        visibility_view.add_outcomes(plotter, STREET, outcomes[:1])


def test_the_ground_has_the_colour_of_how_many_cameras_see_it(draw, packed):
    cells = Ground.around(packed, radius_m=6.0)
    coverage = cells.coverage([camera_at([1.3, 0.0, 3.0], CameraModel(256, 256, math.radians(100.0)))])
    surface = visibility_view.coverage_to_pyvista(coverage)
    assert surface.n_cells == coverage.is_open.any(axis=0).sum()
    count = np.asarray(surface.cell_data["cameras_1.1m"])
    np.testing.assert_array_equal(surface.cell_data["blind_1.1m"], count == 0)
    assert (count == 1).sum() == coverage.is_seen[0, 0].sum() > 10
    plotter = draw(None, ego=ego())
    visibility_view.add_coverage(plotter, coverage, height_m=1.7, legend=False)
    plain = render_rgb(draw(None, ego=ego())).astype(float)
    image = render_rgb(plotter).astype(float)
    for x_m, cameras in ((5.5, 1), (-3.0, 0)):
        column, row = project_px(plotter, np.array([[x_m, 0.0, 0.04]]))[0].astype(int)
        expected = 0.6 * np.array(COVERAGE_RGB[cameras]) + 0.4 * plain[row, column]
        assert np.abs(image[row, column] - expected).max() < 6.0, x_m
    with pytest.raises(ValueError, match=r"height_m must be one of \(1.1, 1.7\), got 2"):
        visibility_view.add_coverage(plotter, coverage, height_m=2.0)


def test_drawing_again_replaces(draw, packed):
    plotter = draw(rig(2), ego=ego(), scene=STREET)
    coverage = Ground.around(packed, radius_m=6.0).coverage(rig(2).cameras)
    for _ in range(2):
        visibility_view.add_visibility(plotter, rig(2), packed)
        visibility_view.add_coverage(plotter, coverage)
        names = sorted(plotter.actors)
    assert sorted(plotter.actors) == names
    assert sum(name.startswith("legend/") for name in names) == len(COVERAGE_RGB)
    assert {"coverage", "visibility/cam_0", "visibility/cam_1"} <= set(names)
    # whoever looks into the air sees nothing below the pictures' top
    up = Rig([RigCamera("cam_0", np.array([1.3, 0.0, 3.0]), 0.0, -1.5, 0.0, CameraModel())])
    visibility_view.add_visibility(plotter, up, packed)
    assert "visibility/cam_0" not in plotter.actors
