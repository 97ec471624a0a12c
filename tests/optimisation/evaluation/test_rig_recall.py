"""Recall of the rig, false alarms and AP by size in worlds whose answers can be told by hand."""

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest

from tests.driving_scene import SKY, ConstantDetector, car, vehicle
from tests.optimisation.evaluation.test_metrics import MODEL, ScriptedDetector, objective_of, rig_of, truth_boxes
from tests.optimisation.objectives import evaluate_rig
from tests.raster.test_renderer import FAR_AWAY
from warpav.detection import observe
from warpav.optimisation import AssignedScene, paired_differences
from warpav.optimisation._mount import views_of_rig
from warpav.optimisation.evaluation._metrics import DISTANCE_EDGES_M, GroupRecall
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer
from warpav.rig import Rig
from warpav.scene import ROAD_USERS, DeviceScene, Scene
from warpav.sight import SECTORS

AHEAD, ASIDE, TINY = (9.0, 0.0, 0.4), (0.0, 9.0, 0.4), (45.0, -6.0, 0.0)
BOTH_AHEAD = (0.0, 0.2)  # yaws of two cameras that see the same
NOTHING = ([[], []], [[], []])


def world(*places, categories=None, ego=FAR_AWAY):
    """Cars at the places, on the device; they are of other categories if ``categories`` says so."""
    prototype = car(np.random.default_rng(1), subdivisions=2)
    users = [vehicle(k + 1, prototype, *place) for k, place in enumerate(places)]
    for k, category in enumerate(categories or ()):
        users[k] = dataclasses.replace(users[k], category=category)
    scene = Scene("case", FAR_AWAY, ego, tuple(users), SKY).targeting(ROAD_USERS)
    return AssignedScene(DeviceScene.pack(scene), np.full(len(places), -1, np.int32))


def measured(rig, scenes, *answers):
    """Metrics where a detector says ``answers`` (boxes, confidences[, road users] by camera), one for each scene."""
    return evaluate_rig(rig, scenes, objective_of(ScriptedDetector(ConstantDetector(*each) for each in answers)))


def group(objects, visible, detected):
    return GroupRecall(
        objects, visible, detected, detected / objects if objects else None, detected / visible if visible else None
    )


def test_an_object_that_two_cameras_see_counts_once():
    rig, scene = rig_of(yaw=BOTH_AHEAD), world(AHEAD, ASIDE, categories=["lorry", "van"])
    boxes = truth_boxes(rig, scene.scene)
    assert np.isfinite(boxes[:, 0]).all()
    assert np.isnan(boxes[:, 1]).all()
    both = measured(rig, [scene], ([boxes[0, :1], boxes[1, :1]], [[0.5], [0.7]]))
    one = measured(rig, [scene], ([boxes[0, :1], []], [[0.5], []]))
    for metrics in (both, one):
        assert (metrics.objects, metrics.frames) == (2, 2)
        assert metrics.tp_detection_rate == 0.5
        assert (metrics.visible_rate, metrics.rig_recall_visible) == (0.5, 1.0)
        assert metrics.false_alarms_per_frame == 0.0
        assert metrics.recall_by["category"] == {"lorry": group(1, 1, 1), "van": group(1, 0, 0)}
        assert metrics.recall_by["sector"]["front"] == group(1, 1, 1)
        assert metrics.recall_by["sector"]["left"] == group(1, 0, 0)
        assert metrics.recall_by["road_user"] == {"vehicle": group(2, 1, 1)}
    # image by image the second camera's miss shows
    assert both.ap50_pooled == 1.0
    assert one.ap50_pooled == pytest.approx(51 / 101)


def test_recall_is_the_visible_share_times_the_recall_of_the_visible():
    rig = rig_of(yaw=BOTH_AHEAD)
    scenes = [world(AHEAD, ASIDE), world(AHEAD), world(ASIDE), world()]
    box = truth_boxes(rig, scenes[0].scene)[0, :1]
    metrics = measured(rig, scenes, ([box, []], [[0.5], []]), NOTHING, NOTHING, NOTHING)
    assert metrics.tp_detection_rate == pytest.approx(1 / 4)
    assert (metrics.visible_rate, metrics.rig_recall_visible) == (0.5, 0.5)
    assert metrics.per_scene["tp_detection_rate"] == [0.5, 0.0, 0.0, None]
    assert metrics.per_scene["rig_recall_visible"] == [1.0, 0.0, None, None]
    assert metrics.per_scene["false_alarms_per_frame"] == [0.0] * 4
    blind = measured(rig, scenes, *[NOTHING] * 4)
    difference = paired_differences(metrics, blind)
    found = difference["tp_detection_rate"]
    assert (found.mean, found.scenes) == (pytest.approx(1 / 4), 3)
    assert (difference["rig_recall_visible"].mean, difference["rig_recall_visible"].scenes) == (0.5, 2)


@pytest.fixture(scope="module")
def groups_of():
    """Tells the groups that an object is counted in, by where it is from the ego vehicle [m]."""
    assigned = world(AHEAD)

    def tell(from_ego_m):
        scene = dataclasses.replace(assigned.scene, from_ego_m=np.array([from_ego_m], float))
        silent = objective_of(ConstantDetector(*NOTHING))
        table = evaluate_rig(rig_of(), [AssignedScene(scene, assigned.assigned_camera)], silent).recall_by
        assert len(table["distance_m"]) == len(DISTANCE_EDGES_M) - 1
        assert list(table["sector"]) == list(SECTORS)
        found = {by: [name for name, each in groups.items() if each.objects] for by, groups in table.items()}
        assert all(len(names) == 1 for names in found.values())
        return {by: names[0] for by, names in found.items()}

    return tell


@pytest.mark.parametrize(
    ("distance_m", "name"),
    [(0.0, "0-10"), (9.999, "0-10"), (10.0, "10-20"), (29.999, "20-30"), (39.999, "30-40"), (40.0, "40+")],
)
def test_bins_of_distance_hold_their_lower_edge(groups_of, distance_m, name):
    assert groups_of([distance_m, 0.0])["distance_m"] == name


@pytest.mark.parametrize("turn", range(8))
def test_sectors_hold_their_edge_to_the_right(groups_of, turn):
    # 22.5 degrees to the right of a sector's middle is its own, to the left its neighbour's
    for offset, sector in ((-0.5 + 1e-9, turn), (0.0, turn), (0.5 - 1e-9, turn), (0.5 + 1e-9, turn + 1)):
        angle = (turn + offset) * math.pi / 4
        assert groups_of([20.0 * math.cos(angle), 20.0 * math.sin(angle)])["sector"] == SECTORS[sector % 8]


def test_a_false_alarm_on_the_ego_vehicle_and_a_second_box_count():
    rig, scene = rig_of(yaw=BOTH_AHEAD), world(AHEAD)
    boxes = truth_boxes(rig, scene.scene)
    bonnet = [20.0, 70.0, 110.0, 96.0]
    metrics = measured(rig, [scene], ([[bonnet, boxes[0, 0], boxes[0, 0]], [boxes[1, 0]]], [[0.4, 0.9, 0.3], [0.8]]))
    assert metrics.false_alarms_per_frame == 2 / 2
    assert metrics.tp_detection_rate == 1.0
    assert metrics.ap50_pooled == 1.0  # both come after every hit
    # a confidence that is too low for a true positive is too low for a false alarm
    weak = measured(rig, [scene], ([[bonnet, boxes[0, 0]], []], [[0.05, 0.9], []]))
    assert weak.false_alarms_per_frame == 0.0


@pytest.mark.parametrize("seed", range(6))
def test_recall_at_equal_false_alarms_is_that_of_the_lowest_threshold_that_is_quiet_enough(seed):
    """Against a search that evaluates the rig at every threshold there could be."""
    rng = np.random.default_rng([0xFA, seed])
    rig, scenes = rig_of(yaw=(0.0, 0.7)), [world(AHEAD, (8.0, 5.0, 0.2), (14.0, -3.0, 1.0)) for _ in range(2)]
    boxes = truth_boxes(rig, scenes[0].scene)
    answers = []
    for _ in scenes:
        found, confidence = [], []
        for true in boxes:
            near = [box + rng.normal(0.0, 1.5, 4) for box in true[np.isfinite(true).all(axis=1)] for _ in range(2)]
            corner = rng.uniform(0.0, 70.0, (int(rng.integers(0, 4)), 2))
            found.append([*near, *np.hstack([corner, corner + rng.uniform(5.0, 25.0, corner.shape)])])
            confidence.append(np.round(rng.uniform(0.1, 1.0, len(found[-1])), 2))  # some of them are equal
        answers.append((found, confidence))

    def at(threshold):
        objective = objective_of(ScriptedDetector(ConstantDetector(*each) for each in answers))
        objective.options = replace(objective.options, confidence_min=threshold)
        return evaluate_rig(rig, scenes, objective)

    metrics = at(0.1)
    said = np.concatenate([each for _, confidence in answers for each in confidence]).astype(np.float32)
    thresholds = [0.1, *np.nextafter(np.unique(said).astype(np.float64), 2.0)]
    quiet = [found for found in map(at, thresholds) if found.false_alarms_per_frame <= 0.5]
    assert metrics.recall_at_equal_false_alarms == quiet[0].tp_detection_rate
    assert metrics.per_scene["recall_at_equal_false_alarms"] == quiet[0].per_scene["tp_detection_rate"]
    assert metrics.false_alarms_per_frame > 0.5  # else there would be nothing to see


def too_small_box(rig, scene):
    camera = Rig(rig.cameras[:1])
    renderer = Renderer([MODEL], occlusion=Occlusion.EXACT)
    views = views_of_rig(camera, rotation_count=1, rotation_step_rad=0.0)
    frame = renderer.render(scene.raster, views.position_ego_m, views.camera_from_ego)
    seen = observe(frame, scene, ConstantDetector.silent(1), forward_view=[0], confidence_min=0.1, iou_min=0.5)
    assert np.isnan(seen.truth_box_px).all()
    return seen.too_small_box_px[0, 0]


def test_what_is_too_small_need_not_be_found_and_is_no_false_alarm():
    rig, scene = rig_of(yaw=(0.0, math.pi)), world(TINY)
    box = too_small_box(rig, scene.scene)
    assert 0.0 < np.prod(box[2:] - box[:2]) < 16.0
    metrics = measured(rig, [scene], ([[box], []], [[0.9], []]))
    assert (metrics.tp_detection_rate, metrics.visible_rate, metrics.tp_in_frame_rate) == (0.0, 0.0, 1.0)
    assert metrics.rig_recall_visible is None
    assert metrics.ap50_pooled is None
    assert metrics.false_alarms_per_frame == 0.0
    # one box only, and only one that fits
    wide = box + np.array([-20.0, 0.0, 0.0, 0.0], np.float32)
    metrics = measured(rig, [scene], ([[box, box, wide], []], [[0.9, 0.8, 0.7], []]))
    assert metrics.false_alarms_per_frame == 2 / 2


def test_a_detection_of_another_kind_finds_nothing():
    rig = rig_of(yaw=BOTH_AHEAD)
    scene = world(AHEAD, (8.0, 3.5, 0.2), categories=["pedestrian", "saloon"])
    boxes = truth_boxes(rig, scene.scene)[0]
    pedestrian = ROAD_USERS.index("pedestrian")
    right = measured(rig, [scene], ([boxes, []], [[0.9, 0.8], []], [[pedestrian, 0], []]))
    assert right.recall_by["road_user"] == {"vehicle": group(1, 1, 1), "pedestrian": group(1, 1, 1)}
    assert right.false_alarms_per_frame == 0.0
    wrong = measured(rig, [scene], ([boxes, []], [[0.9, 0.8], []], [[0, 0], []]))
    assert wrong.recall_by["road_user"] == {"vehicle": group(1, 1, 1), "pedestrian": group(1, 1, 0)}
    assert wrong.recall_by["category"] == {"pedestrian": group(1, 1, 0), "saloon": group(1, 1, 1)}
    assert wrong.false_alarms_per_frame == 1 / 2
    # the mean over both kinds, as COCO's over classes: the pedestrian is missed by both cameras; the car is seen by
    # both and found by one, after the false alarm
    assert wrong.ap50_pooled == pytest.approx((0.0 + 51 / 101 * 0.5) / 2)
    assert right.ap50_pooled == pytest.approx(51 / 101)


def test_ap_by_size_goes_by_the_true_box():
    rig, scene = rig_of(yaw=BOTH_AHEAD), world((3.7, 0.0, 1.5), (12.0, -7.0, 1.5))
    boxes = truth_boxes(rig, scene.scene)
    size_px = np.sqrt(np.prod(boxes[..., 2:] - boxes[..., :2], axis=2))
    assert (size_px[:, 0] > 32).all()
    assert (size_px[:, 1] < 32).all()
    found = measured(rig, [scene], ([boxes[0, :1], boxes[1, :1]], [[0.9], [0.9]]))
    assert found.ap50_95_medium == 1.0
    assert found.ap50_95_large is None
    assert found.ap50_95_small == 0.0
    shrunk = boxes[:, 0].copy()
    shrunk[:, 2] -= 0.32 * (shrunk[:, 2] - shrunk[:, 0])  # IoU 0.68: right at .50, .55, .60, .65
    partly = measured(rig, [scene], ([shrunk[:1], shrunk[1:]], [[0.9], [0.9]]))
    assert partly.ap50_95_medium == pytest.approx(0.4)
