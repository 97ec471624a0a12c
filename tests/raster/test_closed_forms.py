"""Areas and Jacobians of a sphere, boxes and an edge against formulas; the formulas against the scanline oracle."""

import dataclasses
import math

import numpy as np
import pytest

from tests.driving_scene import camera_pose
from tests.oracle import closed_forms, scanline
from tests.oracle.scanline import ZOOM
from tests.raster.bodies import WEIGHT, ball, cuboid, edges_of, error, measured, poses_towards, scene_of
from warpav.raster.areas import AMODAL_AREA, BOX_AREA, VISIBLE_AREA
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh

MODEL = CameraModel(64, 48, math.radians(75.0), 0.1)
TINY = CameraModel(20, 16, math.radians(75.0), 0.1)
BALL_M, RADIUS_M = np.array([4.0, 0.5, 0.3]), 0.7
BOX = cuboid([1.6, 2.4, 1.1], [5.0, 0.4, 0.2], (0.1, 0.2, 0.3))
NEAR_M = 1.6
SAMPLINGS = [(MODEL, 1), (MODEL, 2), (TINY, 4), (TINY, 8)]
SAMPLING_IDS = ["x1", "x2", "x4", "x8"]


def convex_truth(mesh, poses, model, windows=None):
    """Areas [view] and derivatives [view, 7]."""
    windows = [None] * len(poses) if windows is None else windows
    pairs = [
        closed_forms.convex_area(mesh.vertex_m, edges_of(mesh), pose, model, window)
        for pose, window in zip(poses, windows, strict=True)
    ]
    area, derivative = zip(*pairs, strict=True)
    return np.array(area), np.array(derivative)


def spheres():
    return poses_towards(np.random.default_rng(1), BALL_M, 24, distance_m=(2.2, 4.0), aim_rad=0.1)


def whole_boxes():
    return poses_towards(np.random.default_rng(2), [5.0, 0.4, 0.2], 24, distance_m=(5.0, 7.0), aim_rad=0.1)


def cut_boxes():
    """The image's border goes through the box."""
    return poses_towards(np.random.default_rng(3), [5.0, 0.4, 0.2], 40, distance_m=(3.0, 5.0), aim_rad=0.9)


def near_boxes():
    """A near plane of `NEAR_M` goes through the box, in most of them the image's border too."""
    return poses_towards(np.random.default_rng(4), [5.0, 0.4, 0.2], 24, distance_m=(1.7, 2.7), aim_rad=0.6)


def test_the_scanline_oracle_equals_the_formulas():
    round_body = ball(RADIUS_M, BALL_M, subdivisions=1)
    cases = [
        (BOX, MODEL, whole_boxes()[:2]),
        (BOX, MODEL, cut_boxes()[:4]),
        (BOX, dataclasses.replace(MODEL, near_m=NEAR_M), near_boxes()[:4]),
    ]
    for mesh, model, poses in [*cases, (round_body, MODEL, spheres()[:1])]:
        area, derivative = convex_truth(mesh, poses, model)
        for k, pose in enumerate(poses):
            np.testing.assert_allclose(scanline.areas([mesh], pose, model)[:, 0], area[k], atol=1e-8)
            ours = scanline.gradients([mesh], pose, model, shift_m=1e-4, spin_rad=1e-5)[:, 0]
            # worst seen 1e-4 of gradients of hundreds: the steps
            np.testing.assert_allclose(ours, np.tile(derivative[k], (2, 1)), atol=1e-3)


# Largest error of an area [px^2], of any Jacobian, and of all poses' Jacobians together, by supersampling.
LIMITS = {1: (8.0, 0.02, 0.008), 2: (4.0, 0.02, 0.005), 4: (1.0, 0.03, 0.008), 8: (0.5, 0.015, 0.004)}
# Where the near plane cuts: there the outline slides along the surface.
NEAR_LIMITS = {1: (8.0, 0.04, 0.015), 2: (4.0, 0.03, 0.008), 4: (1.0, 0.05, 0.012), 8: (0.5, 0.03, 0.006)}
# Inside a window whose sides run between the samples.
WINDOW_LIMITS = {1: (30.0, 0.1, 0.03), 2: (20.0, 0.06, 0.012), 4: (3.0, 0.12, 0.018), 8: (1.0, 0.05, 0.01)}


def assert_close(value, jacobian, area, derivative, limits, model):
    """Areas [view], and Jacobians [view, 7] each by itself and all together."""
    area_px, each, together = limits
    np.testing.assert_allclose(value, area, atol=area_px)
    assert error(jacobian, derivative, 0.25 * model.width_px).max() < each
    assert np.linalg.norm((jacobian - derivative) * WEIGHT) / np.linalg.norm(derivative * WEIGHT) < together


# worst seen: 5.1 .0036 .0018, 2.3 .0016 .0008, .40 .0023 .0013, .23 .0013 .0009
@pytest.mark.parametrize(("model", "supersampling"), SAMPLINGS, ids=SAMPLING_IDS)
def test_a_sphere_is_an_ellipse(device, model, supersampling):
    scene, poses = scene_of([ball(RADIUS_M, BALL_M)]), spheres()
    value, jacobian = measured(scene, poses, model, device, supersampling=supersampling)
    truth = [closed_forms.sphere_area(BALL_M, RADIUS_M, pose, model) for pose in poses]
    area, derivative = (np.array(numbers) for numbers in zip(*truth, strict=True))
    for kind in (VISIBLE_AREA, AMODAL_AREA):
        assert_close(value[:, 0, kind], jacobian[:, 0, kind], area, derivative, LIMITS[supersampling], model)


# worst seen: 5.2 .011 .0034, 2.2 .0017 .0009, .59 .015 .0041, .20 .0019 .0006; cut by the near plane 3.7 .021 .0075,
# 1.9 .023 .0037, .27 .021 .0082, .10 .015 .0035;
# in the window 18 .058 .018, 13 .033 .0065, 1.6 .069 .0095, .50 .025 .0052
@pytest.mark.parametrize(("model", "supersampling"), SAMPLINGS, ids=SAMPLING_IDS)
@pytest.mark.parametrize("cut", ["nothing", "border", "near plane"])
def test_a_box_is_a_polygon(device, model, supersampling, cut):
    poses = {"nothing": whole_boxes, "border": cut_boxes, "near plane": near_boxes}[cut]()
    if cut == "near plane":
        model = dataclasses.replace(model, near_m=NEAR_M)
    size = np.array([model.width_px, model.height_px])
    # a window round the middle whose sides are no whole pixels
    window = np.random.default_rng(5).uniform([0.1, 0.1, 0.6, 0.6], [0.4, 0.4, 0.9, 0.9], (len(poses), 4))
    window *= np.tile(size, 2)
    value, jacobian = measured(
        scene_of([BOX]), poses, model, device, supersampling=supersampling, box_px=window[:, None]
    )
    whole, part = convex_truth(BOX, poses, model), convex_truth(BOX, poses, model, window)
    limits = NEAR_LIMITS if cut == "near plane" else LIMITS
    rows = ((VISIBLE_AREA, whole, limits), (AMODAL_AREA, whole, limits), (BOX_AREA, part, WINDOW_LIMITS))
    for kind, truth, limits in rows:
        assert_close(value[:, 0, kind], jacobian[:, 0, kind], *truth, limits[supersampling], model)


@pytest.mark.parametrize("supersampling", [1, 2])
def test_an_edge_across_the_image_moves_as_a_line(device, supersampling):
    # a wall that ends at a slanted edge, higher and lower than the image
    rng = np.random.default_rng(6)
    a, b = np.array([3.0, -0.4, -9.0]), np.array([3.6, 0.9, 9.0])
    away = np.array([2.0, 80.0, 0.0])
    wall = Mesh.create([a, b, a + away, b + away], [[0, 2, 3], [0, 3, 1]], [9, 9, 9])
    poses = np.array([camera_pose(rng.normal(0, 0.2, 3), *rng.normal(0, 0.15, 3)) for _ in range(20)])
    value, jacobian = measured(scene_of([wall]), poses, MODEL, device, supersampling=supersampling)
    truth = [closed_forms.half_plane_area(a, b, pose, MODEL) for pose in poses]
    area, derivative = (np.array(numbers) for numbers in zip(*truth, strict=True))
    # worst seen: 13 .00003 .00001; the area counts samples, the Jacobian solves where the line runs between them
    assert_close(value[:, 0, AMODAL_AREA], jacobian[:, 0, AMODAL_AREA], area, derivative, (20.0, 1e-4, 1e-4), MODEL)


def test_the_focal_length_moves_areas_as_other_lenses_show(device):
    # jac_log_focal by itself, against cameras of another field of view; the truth's own grain is a sample
    factor = 1.1
    lenses = [
        dataclasses.replace(MODEL, fov_rad=2.0 * math.atan(math.tan(0.5 * MODEL.fov_rad) * f))
        for f in (1 / factor, factor)
    ]
    scene, poses = scene_of([ball(RADIUS_M, BALL_M), BOX]), spheres()[:8]
    _, jacobian = measured(scene, poses, MODEL, device)
    (long_value, _), (short_value, _) = (measured(scene, poses, lens, device, supersampling=4) for lens in lenses)
    difference = (long_value - short_value)[..., AMODAL_AREA] / (2.0 * math.log(factor))
    ours = jacobian[:, :, AMODAL_AREA, ZOOM]
    np.testing.assert_allclose(ours, difference, rtol=0.04)  # worst seen .021
