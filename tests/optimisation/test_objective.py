"""The whole objective: value by hand-made parts, gradient against a supersampled objective."""

import functools
import math

import numpy as np
import pytest
import warp as wp

from tests.driving_scene import ConstantDetector, SilentDetector, packed_street, roof
from tests.optimisation.objectives import rig_objective, thesis_losses
from tests.oracle import thesis
from warpav.detection import Observation
from warpav.optimisation import X_M, Y_M, YAW_RAD, AssignedScene, CameraMount
from warpav.optimisation._mount import views_of_rig
from warpav.raster.areas import AMODAL_AREA, BOX_AREA, LEFT, RIGHT, VISIBLE_AREA
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.rig import Rig

MODEL = CameraModel(256, 256, math.pi / 2)
POSE = np.array(
    [
        [1.61, 0.31, 0.15, 0.0, 0.0, 0.0, 0.0],
        [1.09, 0.43, 1.65, 0.0, 0.0, 0.0, 0.0],
        [0.43, -0.27, 3.35, 0.0, 0.0, 0.0, 0.0],
    ],
    np.float32,
)
# gradient to x, y [m] and yaw; 0.1 rad weighs as much as 1 m, as in the tests of the renderer
WEIGHT = np.array([1.0, 1.0, 0.1])


@functools.cache
def assigned_scenes(device):
    scenes = [packed_street(device), packed_street(device, 10, 1)]
    # cars ahead, beside and behind: the camera that looks their way
    camera_of_car = np.array([0, 0, 0, -1, 2, 2, 1, 2, 1, 2], np.int32)  # but car 7 is outside its camera's image
    return [AssignedScene(scene, camera_of_car) for scene in scenes]


def objective_of(detector, device, *, supersampling=1, occlusion=Occlusion.PAIRWISE, **settings):
    mount = CameraMount(roof(), camera=MODEL, height_offset_m=0.25, device=device)
    return rig_objective(
        mount,
        detector,
        camera_count=3,
        settings=thesis_losses(**settings),
        iou_min=0.3,  # a step must not undo a match
        occlusion=occlusion,
        supersampling=supersampling,
    )


def look(objective, scene):
    """What the cameras at POSE see of a scene."""
    return objective.observe_rig(objective.mount.rig(POSE), scene)


class FamiliarDetector:
    """Boxes that cut into the true ones at POSE; knows an image by the one at POSE that it resembles most."""

    names = ("car",)

    def __init__(self, device):
        self.known, self.answers, self.calls = [], [], []
        for scene in assigned_scenes(device):
            observation, *_ = look(objective_of(SilentDetector(), device), scene)
            for image_rgb, truth in zip(observation.image_rgb, observation.truth_box_px, strict=True):
                size = truth[:, 2:] - truth[:, :2]
                large = size.min(axis=1) >= MODEL.width_px / 16  # the others stay undetected
                # well inside on the left and at the bottom, well outside on the right and at the top: no outline may
                # touch an edge of its box, where the gradient has a kink
                size = np.c_[0.18 * size[:, 0], -0.05 * size[:, 1] - 2.0, 0.05 * size[:, 0] + 2.0, -0.15 * size[:, 1]]
                box_px = np.round(truth + size)[large]
                self.known.append(image_rgb.astype(float))
                self.answers += ConstantDetector([box_px], [np.linspace(0.9, 0.5, len(box_px))]).answer

    def detect(self, images_rgb):
        self.calls.append(len(images_rgb))
        distance = [[np.abs(image_rgb - known).mean() for known in self.known] for image_rgb in images_rgb]
        return [self.answers[k] for k in np.argmin(distance, axis=1)]


# seen: cosine .9991, error .045; the truth's steps see the curvature of the objective
@pytest.mark.equation(1, 14, 16)
@pytest.mark.parametrize("occlusion", [Occlusion.PAIRWISE, pytest.param(Occlusion.EXACT, marks=pytest.mark.slow)])
def test_gradient_matches_differences_of_a_supersampled_objective(device, occlusion):
    # the in-frame loss is left out: it holds bearings fixed by design (tests/thesis/test_losses.py)
    settings = {"in_frame_rotation": 0.0, "detected_area": 10.0, "min_detected_area": 1.0, "occlusion": occlusion}
    multiplier = np.array([0.3, 0.2], np.float32)
    scenes = assigned_scenes(device)
    ours = (
        objective_of(FamiliarDetector(device), device, **settings)
        .evaluate(POSE, scenes, multiplier=multiplier, gradient=True)
        .gradient
    )
    fine = objective_of(FamiliarDetector(device), device, supersampling=4, **settings)
    truth = np.zeros((3, 3))
    for camera in range(3):
        for i, column in enumerate((X_M, Y_M, YAW_RAD)):
            step = 0.006 if column == YAW_RAD else 0.06
            values = []
            for sign in (1.0, -1.0):
                pose = POSE.copy()
                pose[camera, column] += sign * step
                values.append(fine.evaluate(pose, scenes, multiplier=multiplier).total)
            truth[camera, i] = (values[0] - values[1]) / (2 * step)
    ours, truth = ours[:, [X_M, Y_M, YAW_RAD]] * WEIGHT, truth * WEIGHT
    cosine = (ours * truth).sum() / np.linalg.norm(ours) / np.linalg.norm(truth)
    assert cosine >= 0.999
    # every camera is moved by its own cars
    assert (np.abs(truth).max(axis=1) > 0.05 * np.abs(truth).max()).all()
    assert np.linalg.norm(ours - truth) <= 0.08 * np.linalg.norm(truth)


# each camera looks over the roof from its far side
FAR_SIDE = np.array(
    [[0.3, 0.1, 0.15, 0, 0, 0, 0], [1.1, -0.6, 1.65, 0, 0, 0, 0], [2.0, 0.2, 3.35, 0, 0, 0, 0]], np.float32
)


# worst seen .061: steps of 3 cm see the curvature; the formulas of test_closed_form_losses.py are the sharper judge
@pytest.mark.equation(17, 18, 19, 24)
@pytest.mark.parametrize(("name", "pose"), [("surface_blockage", FAR_SIDE), ("object_visibility", POSE)])
@pytest.mark.parametrize("occlusion", [Occlusion.PAIRWISE, pytest.param(Occlusion.EXACT, marks=pytest.mark.slow)])
def test_gradient_of_a_cut_loss_matches_differences_of_a_supersampled_one(device, rng, name, pose, occlusion):
    settings = {"in_frame_rotation": 0.0, "detected_area": 0.0, name: 1.0, "occlusion": occlusion}
    settings |= {"min_detected_area": 1.0, "min_unblocked_area": 1.0}
    scenes = assigned_scenes(device)[1:]
    result = objective_of(SilentDetector(), device, **settings).evaluate(pose, scenes, gradient=True)
    assert set(result.terms) == {name, "out_of_bounds", "camera_spacing"}
    assert result.objective == result.terms[name]
    assert 0.05 < result.terms[name] < 0.95
    fine = objective_of(SilentDetector(), device, supersampling=4, **settings)
    ours, truth = [], []
    for direction in rng.normal(size=(4, 3, 3)):
        step = np.zeros(pose.shape, np.float32)
        step[:, [X_M, Y_M, YAW_RAD]] = 0.03 * WEIGHT * direction / np.linalg.norm(direction)
        values = [fine.evaluate(pose + sign * step, scenes).terms[name] for sign in (1.0, -1.0)]
        truth.append(0.5 * (values[0] - values[1]))
        ours.append((result.gradient * step).sum())
    ours, truth = np.array(ours), np.array(truth)
    assert np.linalg.norm(ours - truth) <= 0.08 * np.linalg.norm(truth)


def test_value_is_the_mean_of_the_printed_losses(device):
    detector = FamiliarDetector(device)
    objective = objective_of(detector, device, epsilon=1e-3)
    scenes = assigned_scenes(device)
    result = objective.evaluate(POSE, scenes)
    expected = np.zeros((2, 2))
    for row, item in zip(expected, scenes, strict=True):
        observation, measures, alone, _ = look(objective, item)
        value = measures.value.numpy()
        cars, bearings = np.flatnonzero(item.assigned_camera >= 0), []
        for k in cars:
            views = value[4 * item.assigned_camera[k] : 4 * item.assigned_camera[k] + 4, k]
            around = views[:, VISIBLE_AREA].sum()
            matched = observation.match[item.assigned_camera[k], k] >= 0
            assert matched or views[0, BOX_AREA] == 0.0
            detected = views[0, BOX_AREA] * (1 - 1e-3) + views[0, VISIBLE_AREA] * 1e-3
            row[1] += (max(0.5 - detected / around, 0.0) / 0.5 if around else 1.0) / len(cars)
            yaw = float(POSE[item.assigned_camera[k], YAW_RAD])
            ends = thesis.merged_bearings(
                *views[:, [AMODAL_AREA, LEFT, RIGHT]].T, yaw_rad=yaw, fov_rad=math.pi / 2, width_px=MODEL.width_px
            )
            bearings.append(ends and (*ends, yaw, views[0, AMODAL_AREA] > 0))
        row[0] = thesis.in_frame_rotation_loss(bearings, 1e-3)
        assert alone == pytest.approx(row[0] + 10.0 * row[1], rel=1e-5)
    np.testing.assert_allclose(result.terms["detected_area"], expected[:, 1].mean(), rtol=1e-5)
    np.testing.assert_allclose(result.terms["in_frame_rotation"], expected[:, 0].mean(), rtol=1e-4)
    assert result.objective == pytest.approx(
        1.0 * result.terms["in_frame_rotation"] + 10.0 * result.terms["detected_area"], rel=1e-5
    )
    assert result.terms["detected_area"] > 0.1
    assert result.terms["in_frame_rotation"] > 0.001


def test_observation_puts_every_box_on_its_own_car(device):
    objective = objective_of(FamiliarDetector(device), device)
    observation, measures, *_ = look(objective, assigned_scenes(device)[0])
    assert isinstance(observation, Observation)
    box = observation.matched_box_px()
    value = measures.value.numpy()
    found = 0
    for camera, k in np.ndindex(observation.match.shape):
        ahead = value[camera * 4, k]
        if observation.match[camera, k] < 0:
            assert ahead[BOX_AREA] == 0.0
            assert not box[camera, k].any()
        else:
            found += 1
            assert 0.5 * ahead[VISIBLE_AREA] < ahead[BOX_AREA] < ahead[VISIBLE_AREA]
    assert found == 6
    # boxes count straight ahead only
    assert not value[np.arange(12) % 4 != 0][..., BOX_AREA].any()


def test_only_images_of_a_camera_that_sees_its_own_cars_are_detected_and_none_twice(device):
    detector = FamiliarDetector(device)
    objective = objective_of(detector, device)
    scenes = [
        *assigned_scenes(device),
        *(AssignedScene(each.scene, each.assigned_camera) for each in assigned_scenes(device)),
    ]
    sees_its_own = []
    for item in scenes:
        truth_px = look(objective, item)[0].truth_box_px
        mine = item.assigned_camera == np.arange(3)[:, None]
        sees_its_own.append((np.isfinite(truth_px[..., 0]) & mine).any(axis=1))
    wanted = int(np.sum(sees_its_own))
    detector.calls.clear()
    first = objective.evaluate(POSE, scenes)
    assert sum(detector.calls) == wanted
    if device == "cpu":
        assert len(detector.calls) == 2  # two scenes at a time
    assert objective.evaluate(POSE, scenes).terms == first.terms
    assert sum(detector.calls) == wanted
    moved = POSE.copy()
    moved[1, X_M] += 0.01
    objective.evaluate(moved, scenes)
    assert sum(detector.calls) == wanted + int(np.sum(sees_its_own, axis=0)[1])


def test_gradients_of_single_losses_add_up_to_that_of_the_objective(device):
    scales = {"in_frame_rotation": 1.5, "detected_area": 10.0, "surface_blockage": 3.0, "angular_coverage": 0.7}
    objective = objective_of(FamiliarDetector(device), device, min_unblocked_area=1.0, **scales)
    pose = FAR_SIDE.copy()
    pose[1, :2] = pose[0, :2] + [0.05, 0.02]  # too close
    pose[2, X_M] = 2.25  # out of bounds
    scenes = assigned_scenes(device)
    single = objective.gradients(pose, scenes)
    assert set(single) == {*scales, "out_of_bounds", "camera_spacing"}
    assert all(gradient.any() for gradient in single.values())
    multiplier = np.array([0.3, 0.2], np.float32)
    whole = objective.evaluate(pose, scenes, multiplier=multiplier, gradient=True).gradient
    scales["out_of_bounds"], scales["camera_spacing"] = 10.0 * 4 * multiplier
    expected = sum(scales[name] * gradient for name, gradient in single.items())
    np.testing.assert_allclose(whole, expected, atol=2e-5 * np.abs(expected).max())
    assert not objective_of(SilentDetector(), device, detected_area=0.0).gradients(POSE, scenes)["camera_spacing"].any()


def test_multipliers_ascend_along_the_constraints(device):
    # two cameras too close, one out of bounds
    pose = POSE.copy()
    pose[1, :2] = pose[0, :2] + [0.05, 0.0]
    pose[2, 0] = -0.1
    objective = objective_of(SilentDetector(), device)
    scenes = assigned_scenes(device)[:1]
    with_none = objective.evaluate(pose, scenes)
    result = objective.evaluate(pose, scenes, multiplier=np.array([0.7, 0.4], np.float32), gradient=True)
    constraints = np.array([result.terms["out_of_bounds"], result.terms["camera_spacing"]])
    assert (constraints > 0.0).all()
    # scaled by the largest objective's scale, and once for each of the two objectives
    np.testing.assert_allclose(result.multiplier_gradient, 2 * 10.0 * constraints, rtol=1e-5)
    assert result.total == pytest.approx(result.objective + 20.0 * np.dot([0.7, 0.4], constraints), rel=1e-5)
    assert with_none.total == pytest.approx(with_none.objective, rel=1e-6)
    assert result.objective == with_none.objective


def test_rig_and_mount_pose_are_inverse(device, rng):
    mount = CameraMount(roof(), camera=MODEL, height_offset_m=0.25, device=device)
    pose = np.c_[rng.uniform(*roof().bounds_m, (5, 2)), rng.uniform(-3, 3, 5), rng.uniform(-1, 1, (5, 2))]
    pose = np.c_[pose, rng.uniform(-0.2, 0.5, (5, 2))].astype(np.float32)
    rig = mount.rig(pose)
    # worst seen 3e-7: the height of the surface in single precision
    np.testing.assert_allclose(mount.mount_pose_of_rig(rig), pose, atol=1e-6)
    height = roof().height_at_m(pose[:, :2]) + 0.25 + pose[:, 5]
    tangent = [math.tan(0.5 * camera.model.fov_rad) for camera in rig.cameras]
    np.testing.assert_allclose(tangent, math.tan(0.5 * MODEL.fov_rad) * np.exp(-pose[:, 6].astype(float)), rtol=1e-6)
    np.testing.assert_allclose([camera.position_m[2] for camera in rig.cameras], height, atol=1e-6)


def test_views_of_a_rig_are_those_of_the_mount(device, rng):
    mount = CameraMount(roof(), camera=MODEL, height_offset_m=0.25, device=device)
    pose = np.c_[rng.uniform(*roof().bounds_m, (4, 2)), rng.uniform(-3, 3, 4), rng.uniform(-1, 1, (4, 2))]
    pose = np.c_[pose, rng.uniform(-0.2, 0.5, (4, 2))]
    rig = mount.rig(pose.astype(np.float32))
    assert isinstance(rig, Rig)
    ours = views_of_rig(
        rig, rotation_count=mount.rotation_count, rotation_step_rad=mount.rotation_step_rad, device=device, mount=mount
    )
    placed = mount.place(wp.array(pose.astype(np.float32), dtype=float, device=device))
    np.testing.assert_allclose(ours.position_ego_m.numpy(), placed.position_ego_m.numpy(), atol=2e-6)
    np.testing.assert_allclose(ours.camera_from_ego.numpy(), placed.camera_from_ego.numpy(), atol=2e-6)
    np.testing.assert_allclose(ours.mount_pose.numpy(), pose, atol=1e-6)
    np.testing.assert_allclose(ours.log_zoom.numpy(), placed.log_zoom.numpy(), atol=1e-6)
