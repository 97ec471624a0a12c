"""Metrics of a rig on a case whose answers are known."""

import dataclasses
import math

import numpy as np
import pytest

from tests.driving_scene import SKY, ConstantDetector, block, car, ego_mesh, roof, vehicle
from tests.optimisation.objectives import evaluate_rig, rig_objective, thesis_losses
from tests.raster.test_renderer import FAR_AWAY
from warpav.detection import DetectionProbability, observe
from warpav.optimisation import (
    PAIRED_METRICS,
    AssignedScene,
    CameraMount,
    FreeRanges,
    LossSettings,
    ObjectiveOptions,
    ObjectOutcome,
    RigObserver,
    observe_scenes,
)
from warpav.optimisation._mount import views_of_rig
from warpav.optimisation.evaluation._metrics import GroupRecall
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer
from warpav.rig import Rig, RigCamera
from warpav.runs import RigEvaluation
from warpav.scene import DeviceScene, Scene
from warpav.sight import body_shares
from warpav.thesis import assign_to_nearest_cameras

MODEL = CameraModel(128, 96, math.pi / 2)
WIDE = CameraModel(96, 96, 2.0)
MISSED_ALONE = LossSettings(expected_miss_rate=1.0)


def scene_of(*places, wall=None, name="case"):
    rng = np.random.default_rng(1)
    prototype = car(rng, subdivisions=2)
    vehicles = tuple(vehicle(k + 1, prototype, x, y, yaw) for k, (x, y, yaw) in enumerate(places))
    return DeviceScene.pack(Scene(name, wall or FAR_AWAY, FAR_AWAY, vehicles, SKY))


AHEAD, BEHIND, LEFT_SIDE = (9.0, 0.0, 0.4), (-9.0, 0.0, 0.4), (0.0, 9.0, 0.4)
FAR_LEFT_AHEAD = (8.0, 4.5, 0.2)
SCENES = (
    lambda: scene_of(AHEAD, BEHIND, LEFT_SIDE),  # the last is in no picture
    lambda: scene_of(AHEAD, FAR_LEFT_AHEAD, BEHIND),
)


def rig_of(models=(MODEL, MODEL), yaw=(0.0, math.pi)):
    places = ([1.6, 0.0, 1.7], [0.6, 0.0, 1.7])
    return Rig(
        [
            RigCamera(f"camera_{i}", np.array(place), angle, 0.0, 0.0, model)
            for i, (place, angle, model) in enumerate(zip(places, yaw, models, strict=True))
        ]
    )


def truth_boxes(rig, scene):
    """True boxes [camera, vehicle, 4], one camera at a time."""
    boxes = []
    for camera in rig.cameras:
        renderer = Renderer([camera.model], occlusion=Occlusion.EXACT)
        views = views_of_rig(Rig([camera]), rotation_count=1, rotation_step_rad=0.0)
        frame = renderer.render(scene.raster, views.position_ego_m, views.camera_from_ego)
        seen = observe(frame, scene, ConstantDetector.silent(1), forward_view=[0], confidence_min=0.1, iou_min=0.5)
        boxes.append(seen.truth_box_px[0])
    return np.array(boxes)


class ScriptedDetector:
    """Answers call after call with the next detector of a list."""

    names = ("car",)

    def __init__(self, detectors):
        self.detectors = list(detectors)

    def detect(self, images_rgb):
        return self.detectors.pop(0).detect(images_rgb)


def objective_of(detector, camera_count=2, free=None):
    mount = CameraMount(roof(), camera=MODEL, height_offset_m=0.25, free=free)
    return rig_objective(
        mount,
        detector,
        camera_count=camera_count,
        settings=thesis_losses() if free is None else MISSED_ALONE,
        occlusion=Occlusion.EXACT,
        probability=DetectionProbability.unfitted(),
    )


@pytest.fixture(scope="module")
def scenes():
    return [
        AssignedScene(SCENES[0](), np.array([0, 1, -1], np.int32)),
        AssignedScene(SCENES[1](), np.array([0, 0, 1], np.int32)),
    ]


def answers(rig, scenes):
    """Camera 0 finds the car ahead in both scenes and has one false alarm; camera 1 finds its car in scene 0 only.

    Boxes and confidences, [scene][camera].
    """
    first, second = (truth_boxes(rig, item.scene) for item in scenes)
    false_alarm = [2.0, 2.0, 12.0, 12.0]
    return (([[first[0, 0], false_alarm], [first[1, 1]]], [[0.8, 0.95], [0.6]]), ([[second[0, 0]], []], [[0.7], []]))


def check(metrics, *, has_objective):
    """The numbers of `answers` by hand."""
    assert metrics.objects == 6
    # found: ahead and behind in scene 0, ahead in scene 1; in frame: all but the one to the left
    assert metrics.tp_detection_rate == pytest.approx(3 / 6)
    assert metrics.tp_in_frame_rate == pytest.approx(5 / 6)
    assert metrics.detection_confidence == pytest.approx((0.8 + 0.6 + 0.7) / 3)
    assert (metrics.tp_detection_rate, metrics.visible_rate) == (3 / 6, 5 / 6)
    assert metrics.rig_recall_visible == pytest.approx(3 / 5)
    assert (metrics.frames, metrics.false_alarms_per_frame) == (4, 1 / 4)
    assert metrics.misses_per_100 == pytest.approx(100 * 3 / 6)
    assert metrics.per_scene["misses_per_100"] == pytest.approx([100 / 3, 200 / 3])
    assert (metrics.redundant_rate, metrics.per_scene["redundant_rate"]) == (0.0, [0.0, 0.0])  # each by one camera
    # one false alarm in four images is fewer than half a one per image: the threshold stays
    assert metrics.recall_at_equal_false_alarms == pytest.approx(3 / 6)
    assert metrics.misses_at_equal_false_alarms == pytest.approx(100 * 3 / 6)
    # the false alarm has the highest confidence: nothing is found below .25 an image, three of six from there on
    assert metrics.log_average_miss_rate == pytest.approx(0.5 ** (3 / 9))
    # of the rig: false, true, true, true over 6 objects
    assert metrics.ap50_rig == pytest.approx(51 / 101 * 0.75)
    assert metrics.per_scene["false_alarms_per_frame"] == [1 / 2, 0.0]
    assert metrics.recall_by["category"]["hatchback"] == GroupRecall(6, 5, 3, 3 / 6, 3 / 5)
    # camera 0: the false alarm comes first, so AP 0.5 in scene 0; one of two cars in scene 1: 51 of 101 recall points
    ap_camera_0 = (0.5 + 51 / 101) / 2
    assert metrics.map50_min_camera == pytest.approx(ap_camera_0)
    # camera 1: AP 1 in scene 0; scene 1 has no detection and does not count
    assert metrics.map50_max_camera == pytest.approx(1.0)
    assert metrics.map50_average == pytest.approx((ap_camera_0 + 1.0) / 2)
    # pooled: false, true, true, true over 5 objects: precision 3/4 up to recall 3/5
    assert metrics.ap50_pooled == pytest.approx(61 / 101 * 0.75)
    assert metrics.min_camera_distance_m == pytest.approx(1.0)
    assert metrics.constraint_violation == 0.0
    assert metrics.per_scene["tp_detection_rate"] == pytest.approx([2 / 3, 1 / 3])
    assert metrics.per_scene["tp_in_frame_rate"] == pytest.approx([2 / 3, 1.0])
    assert metrics.per_scene["detection_confidence"] == pytest.approx([0.7, 0.7])
    # false, true, true over 2 objects; then one true of 3 objects
    assert metrics.per_scene["ap50_pooled"] == pytest.approx([2 / 3, 34 / 101])
    assert metrics.per_scene["objects"] == [3, 3]
    assert set(metrics.per_scene) - {"object_weight"} == {*PAIRED_METRICS, "redundant_rate", "objects"}
    if has_objective:
        assert metrics.objective == pytest.approx(np.mean(metrics.per_scene["objective"]))
    else:
        assert metrics.objective is None
        assert metrics.per_scene["objective"] == [None, None]


def test_metrics_of_a_known_case(scenes):
    rig = rig_of()
    detectors = [ConstantDetector(*answer) for answer in answers(rig, scenes)]
    objective = objective_of(ScriptedDetector(detectors))
    metrics = evaluate_rig(rig, scenes, objective)
    check(metrics, has_objective=True)
    expected = objective_of(ScriptedDetector([ConstantDetector(*answer) for answer in answers(rig, scenes)]))
    losses = [expected.observe_rig(rig, item)[2] for item in scenes]
    assert metrics.per_scene["objective"] == pytest.approx(losses)
    assert losses[0] < losses[1]


def test_metrics_of_cameras_of_different_models(scenes):
    rig = rig_of((MODEL, WIDE))
    # the two models are rendered and detected one after the other
    calls = []
    for boxes, confidences in answers(rig, scenes):
        calls += [ConstantDetector([box], [confidence]) for box, confidence in zip(boxes, confidences, strict=True)]
    check(evaluate_rig(rig, scenes, objective_of(ScriptedDetector(calls))), has_objective=False)


def test_metrics_of_a_rig_with_another_number_of_cameras(scenes):
    rig = rig_of()
    one = Rig([rig.cameras[0]])
    calls = [ConstantDetector([boxes[0]], [confidences[0]]) for boxes, confidences in answers(rig, scenes)]
    metrics = evaluate_rig(one, scenes, objective_of(ScriptedDetector(calls)))
    assert metrics.tp_detection_rate == pytest.approx(2 / 6)
    assert metrics.min_camera_distance_m is None
    assert metrics.objective is None
    assert metrics.map50_min_camera == metrics.map50_max_camera == metrics.map50_average


def test_what_becomes_of_every_object():
    rig = rig_of((MODEL, WIDE))
    wall = block(np.random.default_rng(0), [0.2, 6.0, 20.0], [-5.0, 0.0, 0.0])
    scene = scene_of(AHEAD, FAR_LEFT_AHEAD, BEHIND, LEFT_SIDE, wall=wall)
    box_px = truth_boxes(rig, scene)[0, 0]
    calls = [ConstantDetector([[box_px]], [[0.8]]), ConstantDetector.silent(1)]
    look = observer_of(rig, calls).observe(scene)
    assert look.outcomes == [
        ObjectOutcome.DETECTED,
        ObjectOutcome.MISSED,
        ObjectOutcome.HIDDEN,
        ObjectOutcome.OUT_OF_FRAME,
    ]
    np.testing.assert_allclose(look.confidence, [0.8, np.nan, np.nan, np.nan], rtol=1e-6)
    assert observer_of(rig, [ConstantDetector.silent(1)] * 2).observe(scene_of()).outcomes == []


def observer_of(rig, calls):
    return RigObserver(rig, ScriptedDetector(calls), ObjectiveOptions(occlusion=Occlusion.EXACT), device="cpu")


def test_violations_are_reported(scenes):
    rig = rig_of()
    moved = [dataclasses.replace(rig.cameras[0], position_m=np.array([0.6, 0.1, 1.7])), rig.cameras[1]]
    metrics = evaluate_rig(Rig(moved), scenes[:1], objective_of(ConstantDetector.silent(2)))
    assert metrics.constraint_violation == pytest.approx(0.1)
    assert metrics.min_camera_distance_m == pytest.approx(0.1)


def test_a_rig_of_other_zooms_has_an_objective_where_they_are_free(scenes):
    rig = rig_of((MODEL, MODEL.zoomed(0.2)))
    fixed = evaluate_rig(rig, scenes[:1], objective_of(ConstantDetector.silent(1)))
    assert fixed.objective is None
    free = objective_of(ConstantDetector.silent(2), free=FreeRanges(fov_rad=(1.2, 1.8)))
    found = evaluate_rig(rig, scenes[:1], free)
    assert found.objective is not None
    assert found.tp_in_frame_rate == fixed.tp_in_frame_rate


@pytest.mark.parametrize("with_objective", [True, False])
def test_a_camera_sees_the_housing_of_the_one_before_it(scenes, with_objective):
    ahead, behind = rig_of().cameras
    rig = Rig([ahead, dataclasses.replace(behind, position_m=ahead.position_m - [0.4, 0.0, 0.0], yaw_rad=0.0)])
    images = []
    for has_bodies in (False, True):
        objective = objective_of(ConstantDetector.silent(2))
        objective.options = dataclasses.replace(objective.options, cameras_have_bodies=has_bodies)
        seen = observe_scenes(rig, scenes[:1], objective, with_objective=with_objective)
        images.append([camera.image_rgb.astype(int) for camera in seen.observations[0].cameras])
    changed = [(np.abs(one - other).max(axis=-1) > 0).mean() for one, other in zip(*images, strict=True)]
    assert changed[0] == 0.0
    assert 0.005 < changed[1] < 0.1


def test_the_own_body_is_measured_once_a_camera(scenes):
    # one camera looks steeply down onto the roof, the other away from the vehicle
    traffic = Scene("own", FAR_AWAY, ego_mesh(np.random.default_rng(0)), (), SKY)
    around = AssignedScene(DeviceScene.pack(traffic), np.zeros(0, np.int32))
    down = RigCamera("down", np.array([1.1, 0.0, 2.0]), 0.0, math.radians(90.0), 0.0, MODEL)
    rig = Rig([down, RigCamera("ahead", np.array([4.5, 0.0, 1.2]), 0.0, 0.0, 0.0, MODEL)])
    objective = objective_of(ConstantDetector.silent(2))
    metrics = evaluate_rig(rig, [around, around], objective, with_objective=False)
    assert metrics.body_share == body_shares(rig, around.scene)
    assert (metrics.body_share["ahead"], metrics.body_share_max) == (0.0, metrics.body_share["down"])
    assert metrics.body_share_max > 0.9
    evaluation = RigEvaluation.of({"rig": rig}, {"rig": metrics}, ("own", "own"), ())
    assert evaluation.to_json()["arms"]["rig"]["body_share"] == metrics.body_share


def test_vehicles_follow_the_camera_that_looks_their_way(scenes):
    # orientations 0 and 1 look ahead and behind; the rig lists its cameras the other way round, turned a little
    yaw = np.array([0.0, math.pi])
    swapped = rig_of(yaw=(-math.pi + 0.3, 2 * math.pi - 0.2))
    result = assign_to_nearest_cameras(scenes, yaw, swapped)
    assert [item.assigned_camera.tolist() for item in result] == [[1, 0, -1], [1, 1, 0]]
    same = assign_to_nearest_cameras(scenes, yaw, rig_of())
    assert [item.assigned_camera.tolist() for item in same] == [[0, 1, -1], [0, 0, 1]]
    assert all(a.scene is b.scene for a, b in zip(result, scenes, strict=True))
    assert result[0].assigned_camera.dtype == np.int32


def test_orientations_are_shared_out_one_to_one(scenes):
    # both cameras look ahead: one of them still has to take what lies behind
    result = assign_to_nearest_cameras(scenes, np.array([0.0, math.pi]), rig_of(yaw=(0.1, 0.5)))
    assert result[0].assigned_camera.tolist() == [0, 1, -1]


def test_rounding_does_not_pair_anew(scenes):
    # both pairings need turns of 100 degrees in all; only one of them turns both cameras about equally
    orientation = np.radians([0.0, 40.0])
    for rounding in (-1e-7, 0.0, 1e-7):
        rig = rig_of(yaw=(math.radians(50.0) + rounding, math.radians(90.0) - rounding))
        assert assign_to_nearest_cameras(scenes, orientation, rig)[0].assigned_camera.tolist() == [0, 1, -1]
