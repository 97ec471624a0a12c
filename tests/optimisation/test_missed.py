"""The expected share of missed road users: its value from probabilities, its gradient against finer renders."""

import math

import numpy as np
import pytest

from tests.driving_scene import ConstantDetector, on_device, packed_street, roof
from tests.optimisation.objectives import rig_objective
from warpav.detection import CONTRAST, Appearance, DetectionProbability
from warpav.detection._probability import FEATURE_COUNT, IN_FRAME_SHARE, VISIBLE_SHARE
from warpav.optimisation import (
    HEIGHT_DELTA_M,
    LOG_ZOOM,
    PITCH_RAD,
    YAW_RAD,
    AssignedScene,
    CameraMount,
    FreeRanges,
    LossSchedule,
    LossSettings,
)
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer

END, PANORAMA = LossSchedule(), LossSchedule(1.0)
MODEL = CameraModel(128, 128)
POSE = np.array([[1.61, 0.31, 0.15, 0.0, 0.0, 0.0, 0.0], [0.43, -0.27, 3.35, 0.05, 0.0, 0.0, 0.0]], np.float32)
KNOTS = 7
TRUTH_SAMPLES, JITTERS = 4, 8
FREE = FreeRanges(
    pitch_rad=(math.radians(-20.0), math.radians(20.0)),
    height_m=(0.05, 0.6),
    fov_rad=(math.radians(60.0), math.radians(110.0)),
)


def probability_model(rng):
    """Curves that rise with what helps: what shows a pixel is never found.

    Colours do not matter, for their differences are no part of the gradient.
    """
    start = np.array([1.0, 0.0, 0.0, -1.5, 1.2, 0.0, -1.0, -1.0])
    step = np.array([8.0, 1.0, 0.8, 3.0, 3.6, 0.6, 2.0, 2.0]) / (KNOTS - 1)
    rise = np.array([12.0, 4.0, 3.0, 1.5, 0.5, 0.0, 1.0, 1.0])
    coefficient = rise[:, None] * np.linspace(-0.5, 0.5, KNOTS) + rng.normal(0.0, 0.1, (FEATURE_COUNT, KNOTS))
    coefficient[CONTRAST] = 0.0
    return DetectionProbability(start, step, coefficient, -0.5)


def objective_of(
    device="cpu", *, model=None, detector=None, supersampling=1, cameras=2, free=None, others=(), **settings
):
    scales = {"expected_miss_rate": 1.0, **settings}
    return rig_objective(
        CameraMount(roof(), camera=MODEL, height_offset_m=0.25, device=device, free=free),
        detector or ConstantDetector.silent(cameras),
        camera_count=cameras,
        settings=LossSettings(**scales),
        occlusion=Occlusion.EXACT,
        supersampling=supersampling,
        probability=model or probability_model(np.random.default_rng(3)),
        **dict(others),
    )


def scenes_of(device="cpu", *counts):
    return [
        AssignedScene(packed_street(device, count, seed), np.full(count, -1, np.int32))
        for seed, count in enumerate(counts or (10,))
    ]


def probabilities(objective, pose, scene, model):
    """Of every camera and vehicle where the camera really looks, from features as they are."""
    poses = np.array([camera.ego_from_camera for camera in objective.mount.rig(pose).cameras])
    renderer = Renderer([MODEL] * len(pose), occlusion=Occlusion.EXACT, device=objective.device)
    position, rotation = on_device(poses, objective.device)
    frame = renderer.render(scene.raster, position, rotation)
    return model.on_tape(Appearance.of(frame, scene), position, rotation).probability.numpy().astype(float)


def test_value_is_the_mean_of_products_over_all_objects_of_all_scenes(device, rng):
    model = probability_model(rng)
    objective, scenes = objective_of(device, model=model), scenes_of(device, 10, 4)
    missed = [np.prod(1.0 - probabilities(objective, POSE, each.scene, model), axis=0) for each in scenes]
    result = objective.evaluate(POSE, scenes)
    assert result.terms["expected_miss_rate"] == pytest.approx(np.concatenate(missed).mean(), rel=1e-5)
    assert result.objective == pytest.approx(result.terms["expected_miss_rate"], rel=1e-6)
    assert set(result.terms) == {"expected_miss_rate", "out_of_bounds", "camera_spacing"}
    # whatever the scale, and whoever answers for a vehicle
    double = objective_of(device, model=model, expected_miss_rate=2.0)
    assigned = [AssignedScene(each.scene, np.zeros_like(each.assigned_camera)) for each in scenes]
    assert double.evaluate(POSE, assigned).objective == pytest.approx(2.0 * result.objective, rel=1e-6)


def test_the_detector_corrects_the_probabilities(device, rng):
    model = probability_model(rng)
    boxes = [np.array([[0.0, 0.0, 128.0, 128.0]])] * 2
    detector = ConstantDetector(boxes, [np.array([0.9])] * 2)
    objective = objective_of(device, model=model, detector=detector, detector_share=0.5)
    [scene] = scenes_of(device, 10)
    observation, *_ = objective.observe_rig(objective.mount.rig(POSE), scene)
    found = (observation.match >= 0).astype(float)
    p = 0.5 * probabilities(objective, POSE, scene.scene, model) + 0.5 * found
    assert objective.evaluate(POSE, [scene]).terms["expected_miss_rate"] == pytest.approx(
        np.prod(1.0 - p, axis=0).mean(), rel=1e-5
    )
    without = objective.evaluate(POSE, [scene], schedule=LossSchedule()).terms["expected_miss_rate"]
    assert without == pytest.approx(
        np.prod(1.0 - probabilities(objective, POSE, scene.scene, model), axis=0).mean(), rel=1e-5
    )


def features(objective, pose, scene, model):
    """Of every camera and vehicle where the camera really looks."""
    poses = np.array([camera.ego_from_camera for camera in objective.mount.rig(pose).cameras])
    renderer = Renderer([MODEL] * len(pose), occlusion=Occlusion.EXACT, device=objective.device)
    position, rotation = on_device(poses, objective.device)
    frame = renderer.render(scene.raster, position, rotation)
    return model.on_tape(Appearance.of(frame, scene), position, rotation).feature.numpy().astype(float)


def test_the_surest_camera_alone_may_count(device, rng):
    model = probability_model(rng)
    objective, [scene] = objective_of(device, model=model, combine="best"), scenes_of(device, 10)
    pose = POSE.copy()
    pose[1, YAW_RAD] = 0.7  # so that both see some
    p = probabilities(objective, pose, scene.scene, model)
    assert ((p > 0.0).sum(axis=0) > 1).any()
    result = objective.evaluate(pose, [scene], gradient=True)
    assert result.terms["expected_miss_rate"] == pytest.approx((1.0 - p.max(axis=0)).mean(), rel=1e-5)
    # a camera that is the surest of none has no gradient
    same = np.repeat(POSE[:1], 2, axis=0)
    gradient = objective.evaluate(same, [scene], gradient=True).gradient
    assert np.abs(gradient[0]).max() > 1e-4
    assert not gradient[1].any()


@pytest.mark.parametrize("name", ["visible_share", "in_frame_share"])
def test_a_share_of_the_box_may_stand_for_the_probability(device, rng, name):
    model = probability_model(rng)
    objective, [scene] = objective_of(device, model=model, probability=name), scenes_of(device, 10)
    feature = features(objective, POSE, scene.scene, model)
    hiding = feature[:, :, VISIBLE_SHARE]
    assert ((hiding > 0.0) & (hiding < 0.9)).any()  # so that the two differ
    share = np.minimum(feature[:, :, IN_FRAME_SHARE] * (hiding if name == "visible_share" else 1.0), 0.9999)
    assert share.max() > 0.5
    result = objective.evaluate(POSE, [scene], gradient=True)
    assert result.terms["expected_miss_rate"] == pytest.approx(np.prod(1.0 - share, axis=0).mean(), rel=1e-5)
    assert np.abs(result.gradient).max() > 1e-4


def test_what_lies_outside_the_image_pulls_over_the_panorama_alone(device):
    objective = objective_of(device, cameras=1)
    [scene] = scenes_of(device, 1)
    middle = np.asarray(scene.scene.upright_box.centre_ego_m.numpy()[0][:2], float)
    place = np.array([1.0, 0.0])
    bearing = math.atan2(*(middle - place)[::-1])
    pose = np.array([[*place, bearing + math.radians(75.0), 0.0, 0.0, 0.0, 0.0]], np.float32)
    end = objective.evaluate(pose, [scene], gradient=True, schedule=LossSchedule())
    assert end.terms["expected_miss_rate"] == pytest.approx(1.0, abs=1e-3)
    assert np.abs(end.gradient).max() < 1e-3
    early = objective.evaluate(pose, [scene], gradient=True, schedule=LossSchedule(1.0))
    assert early.terms["expected_miss_rate"] < 1.0
    assert early.gradient[0, YAW_RAD] > 0.02  # a turn to the right finds it
    turned = pose.copy()
    turned[0, YAW_RAD] = bearing
    seen = objective.evaluate(turned, [scene], schedule=LossSchedule())
    assert seen.terms["expected_miss_rate"] < 0.5


def test_recorded_steps_follow_cameras_that_are_free(rng, monkeypatch):
    scenes = scenes_of("cpu", 10, 4)
    change = np.zeros((3, *POSE.shape), np.float32)
    change[:, :, [PITCH_RAD, HEIGHT_DELTA_M, LOG_ZOOM]] = rng.uniform(-0.15, 0.15, (3, 2, 3))

    def results():
        objective = objective_of(free=FREE)
        return [
            objective.evaluate(POSE + each, scenes, gradient=True, schedule=schedule)
            for each in change
            for schedule in (LossSchedule(), LossSchedule(0.6))
        ]

    launched = results()
    monkeypatch.setattr("warpav.raster.buffers.available_cores", lambda: 1)  # one thread records
    for one, other in zip(launched, results(), strict=True):
        assert one.terms == other.terms
        np.testing.assert_array_equal(one.gradient, other.gradient)
    assert len({each.total for each in launched}) == len(launched)
