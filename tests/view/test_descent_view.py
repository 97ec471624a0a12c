"""Arrows of the descent against their closed forms, and the animation of a run."""

import itertools
import math

import numpy as np
import pytest

from tests.driving_scene import flat_surface
from tests.view.stand_ins import needs_opengl, rig, scene, vehicle
from warpav.rig.mount_surface import MountSurface
from warpav.view.descent_view import LONGEST_M, WIDEST_RAD, Steepest, add_descent, arrows_m
from warpav.view.palette import camera_rgb
from warpav.view.recording import run_animation, shown_iterations
from warpav.view.rig_view import rig_plotter

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
    np.testing.assert_allclose(arrows_m(rig(2), descent, FLAT), [[0, LONGEST_M, 0], [-LONGEST_M / 2, 0, 0]], atol=1e-6)
    # on a slope of 30 degrees the second one, which goes down it, keeps its length
    rise = math.tan(math.radians(30.0))
    down = arrows_m(rig(2), descent, slope(rise))[1]
    np.testing.assert_allclose(down, -LONGEST_M / 2 * np.array([math.cos(math.pi / 6), 0, 0.5]), atol=1e-4)


def test_a_run_that_recorded_no_gradient_has_no_arrows():
    assert Steepest.of_event({"iteration": 0}) is None
    assert Steepest.of_event({"iteration": 0, "gradient": {}}) is None
    still = Steepest(np.zeros((2, 2)), np.zeros(2))
    assert not arrows_m(rig(2), still, FLAT).any()


@needs_opengl
def test_bent_arrows_turn_the_way_of_the_descent():
    plotter = rig_plotter(rig(2), scene=scene(), off_screen=True, window_size=(160, 100), labels=False)
    try:
        add_descent(plotter, rig(2), Steepest.of_event(EVENT), FLAT)
        names = {f"descent/cam_{k}/{kind}" for k in (0, 1) for kind in ("move", "turn")}
        assert names <= set(plotter.actors)
        # camera 0 looks ahead and turns to the left by the widest angle: the tip lies there
        first = plotter.actors["descent/cam_0/turn"].mapper.dataset.points - rig(2).cameras[0].position_m
        bearing = np.arctan2(first[:, 1], first[:, 0])
        assert bearing.min() > -0.1
        assert WIDEST_RAD < bearing.max() < WIDEST_RAD + 0.6
        # camera 1 looks back and turns to the right by half of it
        second = plotter.actors["descent/cam_1/turn"].mapper.dataset.points - rig(2).cameras[1].position_m
        turned = np.angle(np.exp(1j * (np.arctan2(second[:, 1], second[:, 0]) - math.pi)))
        assert turned.max() < 0.1
        assert -WIDEST_RAD / 2 - 0.6 < turned.min() < -WIDEST_RAD / 2
        add_descent(plotter, rig(2), None, FLAT)
        assert not names & set(plotter.actors)
        with pytest.raises(ValueError, match="each of 3 cameras, got 2"):
            add_descent(plotter, rig(3), Steepest.of_event(EVENT), FLAT)
    finally:
        plotter.close()


def test_long_runs_are_thinned():
    assert shown_iterations(3) == [0, 1, 2]
    shown = shown_iterations(1000)
    assert (len(shown), shown[0], shown[-1]) == (60, 0, 999)
    assert set(np.diff(shown)) <= {16, 17, 18}


@needs_opengl
def test_an_animation_moves(tmp_path):
    events = [dict(EVENT, iteration=k, best_training_objective=1.0 / (k + 1)) for k in range(3)]
    animation = run_animation(
        [rig(2, fov_deg=60.0 + 10.0 * k) for k in range(3)],
        events,
        end=rig(2),
        scene=scene(vehicle(1, 9.0, 3.0)),
        surface=FLAT,
        window_size=(320, 200),
        supersampling=1,
    )
    images = list(animation.image_rgb)
    assert len(images) == animation.count == 4
    assert all(image.shape == (200, 320, 3) for image in images)
    for image in images:  # the names of the cameras in their colours, lower left
        names = image[150:, :80].astype(int).reshape(-1, 3)
        for index in range(2):
            assert (np.abs(names - camera_rgb(index)).max(axis=1) < 60).sum() > 20
    for one, other in itertools.pairwise(images):
        assert np.abs(one.astype(int) - other).max() > 60
