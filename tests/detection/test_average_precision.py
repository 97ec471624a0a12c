"""Average precision against pycocotools, against a twin written out, and its invariants."""

import contextlib
import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warpav.detection.average_precision import (
    ImageScore,
    average_precision,
    mean_image_average_precision,
    score_image,
)

# COCO's numbers pass through its own float64; worst difference seen 3e-16.
TOLERANCE = 1e-6


def _boxes(rng, count):
    corner = rng.uniform(0, 150, (count, 2))
    return np.concatenate([corner, corner + rng.uniform(6, 60, (count, 2))], axis=1)


def _images(rng, count=12):
    """Objects, some of them crowds, and detections: shaken objects and false alarms, with confidences that tie."""
    for _ in range(count):
        truth = _boxes(rng, rng.integers(0, 7))
        found = [truth[rng.random(len(truth)) < 0.8] for _ in range(2)]
        shaken = np.concatenate(found) + rng.normal(0, 2.5, (sum(map(len, found)), 4))
        shaken[:, 2:] = np.maximum(shaken[:, 2:], shaken[:, :2] + 1.0)
        detection = np.concatenate([shaken, _boxes(rng, rng.integers(0, 5))])
        yield truth, rng.random(len(truth)) < 0.2, detection, np.round(rng.random(len(detection)), 2)


def _coco(images, area_px2=None):
    """AP50 of one class by pycocotools; flagged objects are crowds, or out of the area's range."""
    coco_module = pytest.importorskip("pycocotools.coco")
    from pycocotools.cocoeval import COCOeval

    def corner_and_size(box):
        return [box[0], box[1], box[2] - box[0], box[3] - box[1]]

    coco = coco_module.COCO()
    annotations, results = [], []
    for image, (truth, crowd, detection, confidence) in enumerate(images):
        for box, is_crowd in zip(truth, crowd, strict=True):
            x, y, width, height = corner_and_size(box)
            annotations.append(
                {
                    "id": len(annotations) + 1, "image_id": image, "category_id": 1, "bbox": [x, y, width, height],
                    "area": width * height, "iscrowd": int(is_crowd and area_px2 is None), "ignore": 0,
                }
            )  # fmt: skip
        for box, score in zip(detection, confidence, strict=True):
            results.append({"image_id": image, "category_id": 1, "bbox": corner_and_size(box), "score": float(score)})
    coco.dataset = {
        "images": [{"id": image} for image in range(len(images))],
        "categories": [{"id": 1, "name": "vehicle"}],
        "annotations": annotations,
    }
    with contextlib.redirect_stdout(io.StringIO()):
        coco.createIndex()
        evaluation = COCOeval(coco, coco.loadRes(results), "bbox")
        evaluation.params.iouThrs = np.array([0.5])
        if area_px2 is not None:
            evaluation.params.areaRng, evaluation.params.areaRngLbl = [list(area_px2)], ["range"]
        evaluation.evaluate()
        evaluation.accumulate()
    precision = evaluation.eval["precision"][0, :, 0, 0, -1]
    return float(precision.mean())


@pytest.mark.parametrize("seed", range(6))
def test_pooled_precision_with_crowds_matches_pycocotools(seed):
    images = list(_images(np.random.default_rng(seed)))
    scores = [
        score_image(truth[~crowd], detection, confidence, ignore_region_px=truth[crowd])
        for truth, crowd, detection, confidence in images
    ]
    assert average_precision(scores) == pytest.approx(_coco(images), abs=TOLERANCE)


@pytest.mark.parametrize("seed", range(6))
def test_precision_of_a_size_range_matches_pycocotools(seed):
    images = list(_images(np.random.default_rng(100 + seed)))
    low_px2, high_px2 = 400.0, 1800.0
    scores = []
    for truth, _, detection, confidence in images:
        truth_px2, found_px2 = (np.prod(box[:, 2:] - box[:, :2], axis=1) for box in (truth, detection))
        scores.append(
            score_image(
                truth,
                detection,
                confidence,
                truth_ignored=(truth_px2 < low_px2) | (truth_px2 > high_px2),
                detection_ignored_unless_matched=(found_px2 < low_px2) | (found_px2 > high_px2),
            )
        )
    assert average_precision(scores) == pytest.approx(_coco(images, (low_px2, high_px2)), abs=TOLERANCE)


def _twin(scores):
    """The definition, point by point."""
    pairs = [pair for score in scores for pair in zip(score.confidence, score.true_positive, strict=True)]
    pairs.sort(key=lambda pair: -pair[0])
    objects = sum(score.object_count for score in scores)
    total = 0.0
    for point in range(101):
        best = 0.0
        for count in range(1, len(pairs) + 1):
            found = sum(hit for _, hit in pairs[:count])
            if found / objects >= np.linspace(0, 1, 101)[point]:
                best = max(best, found / count)
        total += best
    return total / 101


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_precision_matches_its_twin(seed):
    rng = np.random.default_rng(seed)
    scores = []
    for _ in range(3):
        count = int(rng.integers(0, 8))
        hit = rng.random(count) < 0.6
        confidence = np.sort(rng.random(count))[::-1]
        scores.append(ImageScore(confidence, hit, int(hit.sum() + rng.integers(0, 3))))
    if sum(score.object_count for score in scores):
        assert average_precision(scores) == pytest.approx(_twin(scores), abs=1e-12)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_precision_depends_on_the_order_of_confidence_alone(seed):
    images = list(_images(np.random.default_rng(seed), 4))
    first = [score_image(truth, detection, confidence) for truth, _, detection, confidence in images]
    second = [score_image(truth, detection, confidence**3 / 7) for truth, _, detection, confidence in images]
    value = average_precision(first)
    assert np.isnan(value) or 0.0 <= value <= 1.0
    np.testing.assert_allclose(average_precision(second), value)


def test_perfect_detections_give_one_and_none_give_zero(rng):
    truth = np.array([[0, 0, 20, 20], [40, 40, 90, 80.0]])
    assert average_precision([score_image(truth, truth, np.array([0.3, 0.9]))]) == 1.0
    assert average_precision([score_image(truth, np.zeros((0, 4)), np.zeros(0))]) == 0.0
    assert np.isnan(average_precision([score_image(np.zeros((0, 4)), truth, np.ones(2))]))
    assert np.isnan(average_precision([]))


def test_a_false_alarm_below_every_hit_costs_nothing():
    truth = np.array([[0, 0, 20, 20.0]])
    detection = np.concatenate([truth, truth + 100])
    assert average_precision([score_image(truth, detection, np.array([0.9, 0.5]))]) == 1.0
    assert average_precision([score_image(truth, detection, np.array([0.5, 0.9]))]) == pytest.approx(0.5)


def test_objects_without_a_box_take_no_part():
    truth = np.array([[np.nan] * 4, [0, 0, 20, 20.0]])
    score = score_image(truth, truth[1:], np.ones(1))
    assert (score.object_count, score.true_positive.tolist()) == (1, [True])


def test_only_so_many_detections_count():
    truth = np.array([[0, 0, 20, 20.0]])
    detection = np.concatenate([truth + 100, truth])
    assert average_precision([score_image(truth, detection, np.array([0.9, 0.5]), detection_max=1)]) == 0.0


def test_thesis_mean_leaves_out_images_that_miss_everything_or_hold_nothing():
    hit = ImageScore(np.array([0.9]), np.array([True]), 2)
    missed = ImageScore(np.zeros(0), np.zeros(0, bool), 3)
    empty = ImageScore(np.array([0.9]), np.array([False]), 0)
    assert mean_image_average_precision([hit, missed, empty]) == average_precision([hit])
    assert np.isnan(mean_image_average_precision([missed, empty]))
    assert average_precision([hit, missed, empty]) < average_precision([hit])
