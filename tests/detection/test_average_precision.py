"""Average precision against pycocotools, against a twin written out, and its invariants."""

import contextlib
import io
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warpav.detection import (
    COCO_AREA_PX2,
    COCO_IOU,
    ImageBoxes,
    ImageScore,
    average_precision,
    mean_image_average_precision,
    score_images,
)

# COCO's numbers pass through its own float64; worst difference seen on 200 random sets 2e-15.
TOLERANCE = 1e-6
EVERY_SIZE = tuple(COCO_AREA_PX2.values())


def _boxes(rng, count):
    corner = rng.uniform(0, 150, (count, 2))
    return np.concatenate([corner, corner + rng.uniform(6, 60, (count, 2))], axis=1)


def _images(rng, count=12):
    """Objects, some ignored, and detections: shaken objects and false alarms, with confidences that tie."""
    for _ in range(count):
        truth = _boxes(rng, rng.integers(0, 7))
        found = [truth[rng.random(len(truth)) < 0.8] for _ in range(2)]
        shaken = np.concatenate(found) + rng.normal(0, 2.5, (sum(map(len, found)), 4))
        shaken[:, 2:] = np.maximum(shaken[:, 2:], shaken[:, :2] + 1.0)
        detection = np.concatenate([shaken, _boxes(rng, rng.integers(0, 5))])
        ignored = rng.random(len(truth)) < 0.25
        yield truth, ignored, detection, np.round(rng.random(len(detection)), 2)


def _coco(images, *, iou_min=COCO_IOU, area_px2=EVERY_SIZE):
    """AP of one class by pycocotools, NaN without objects, [size range, threshold].

    Images are truth, whether it is ignored, detections and their confidence.
    """
    coco_module = pytest.importorskip("pycocotools.coco")
    evaluation_module: Any = pytest.importorskip("pycocotools.cocoeval")

    def corner_and_size(box):
        return [float(box[0]), float(box[1]), float(box[2] - box[0]), float(box[3] - box[1])]

    class WithIgnored(evaluation_module.COCOeval):
        # pycocotools itself drops the flag "ignore"
        def _prepare(self):
            super()._prepare()
            for objects in self._gts.values():
                for each in objects:
                    each["ignore"] = each["hidden"]

    coco = coco_module.COCO()
    annotations, results = [], []
    for image, (truth, hidden, detection, confidence) in enumerate(images):
        for box, is_hidden in zip(truth, hidden, strict=True):
            x, y, width, height = corner_and_size(box)
            annotations.append(
                {
                    "id": len(annotations) + 1, "image_id": image, "category_id": 1, "bbox": [x, y, width, height],
                    "area": width * height, "iscrowd": 0, "hidden": int(is_hidden),
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
        evaluation = WithIgnored(coco, coco.loadRes(results), "bbox")
        evaluation.params.iouThrs = np.array(iou_min)
        evaluation.params.areaRng = [list(limits) for limits in area_px2]
        evaluation.params.areaRngLbl = [str(limits) for limits in area_px2]
        evaluation.evaluate()
        evaluation.accumulate()
    precision = evaluation.eval["precision"][:, :, 0, :, -1].mean(axis=1).T
    return np.where(precision < 0.0, np.nan, precision)


def _ours(images, **options):
    return score_images(
        [
            ImageBoxes(truth, detection, confidence, truth_ignored=hidden)
            for truth, hidden, detection, confidence in images
        ],
        **options,
    ).average_precision()


@pytest.mark.parametrize("seed", range(6))
def test_every_size_and_threshold_matches_pycocotools(seed):
    images = list(_images(np.random.default_rng(seed), count=40))
    np.testing.assert_allclose(_ours(images), _coco(images), atol=TOLERANCE)


@pytest.mark.parametrize("seed", range(3))
def test_more_images_than_are_matched_at_once(seed):
    images = list(_images(np.random.default_rng([7, seed]), count=600))
    np.testing.assert_allclose(_ours(images), _coco(images), atol=TOLERANCE)


# Sides of which some make boxes of exactly 32^2 and 96^2 px, so that both ends of the size ranges are met.
_SIDES = [8, 16, 32, 33, 64, 96, 128, 144]


@st.composite
def _awkward_images(draw):
    """Images of few boxes on a coarse grid: equal boxes, equal IoUs, equal confidences, empty images, exact areas."""
    coordinate = st.integers(0, 5).map(lambda k: 16 * k)
    box = st.tuples(coordinate, coordinate, st.sampled_from(_SIDES), st.sampled_from(_SIDES)).map(
        lambda b: [b[0], b[1], b[0] + b[2], b[1] + b[3]]
    )
    images = []
    for _ in range(draw(st.integers(1, 5))):
        truth, found = draw(st.lists(box, max_size=5)), draw(st.lists(box, max_size=6))
        found += draw(st.lists(st.sampled_from(truth), max_size=4)) if truth else []
        ignored = np.array(draw(st.lists(st.booleans(), min_size=len(truth), max_size=len(truth))), bool)
        confidence = draw(st.lists(st.sampled_from([0.25, 0.5, 0.75]), min_size=len(found), max_size=len(found)))
        images.append(
            (
                np.array(truth, float).reshape(-1, 4), ignored, np.array(found, float).reshape(-1, 4),
                np.array(confidence),
            )
        )  # fmt: skip
    return images


@settings(deadline=None, max_examples=200)
@given(_awkward_images())
def test_ties_and_exact_sizes_match_pycocotools(images):
    if any(len(image[2]) for image in images):  # pycocotools takes no empty list of detections
        np.testing.assert_allclose(_ours(images), _coco(images), atol=TOLERANCE)
    else:
        assert np.nan_to_num(_ours(images)).max() == 0.0


def test_boxes_at_the_bounds_belong_to_both_ranges():
    def square(side):
        return np.array([[0, 0, side, side]], float)

    for side, ranges in ((31.9, "small"), (32.0, "small medium"), (96.0, "medium large"), (96.1, "large")):
        scores = score_images([ImageBoxes(square(side), square(side), np.ones(1))])
        named = [name for name, count in zip(COCO_AREA_PX2, scores.object_count[:, 0], strict=True) if count]
        assert named == ["all", *ranges.split()]


def test_the_scores_tell_the_images_apart():
    one, other = np.array([[0, 0, 40, 40.0]]), np.array([[0, 0, 20, 20.0]])
    images = [
        ImageBoxes(one, np.concatenate([one, one]), np.array([0.4, 0.9])),
        ImageBoxes(np.zeros((0, 4)), np.zeros((0, 4)), np.zeros(0)),
        ImageBoxes(other, one, np.array([0.7])),
    ]
    scores = score_images(images, iou_min=[0.5, 0.2])
    assert scores.image.tolist() == [0, 0, 2]
    assert scores.object_count.tolist() == [[1, 0, 1], [0, 0, 1], [1, 0, 0], [0, 0, 0]]
    first, nothing, last = scores.image_scores()
    assert (first.confidence.tolist(), first.true_positive.tolist()) == ([0.9, 0.4], [True, False])
    assert (nothing.object_count, len(nothing.confidence)) == (0, 0)
    assert last.true_positive.tolist() == [False]
    assert scores.image_scores(threshold=1)[2].true_positive.tolist() == [True]


def test_thesis_mean_leaves_out_images_that_miss_everything_or_hold_nothing():
    hit = ImageScore(np.array([0.9]), np.array([True]), 2)
    missed = ImageScore(np.zeros(0), np.zeros(0, bool), 3)
    empty = ImageScore(np.array([0.9]), np.array([False]), 0)
    assert mean_image_average_precision([hit, missed, empty]) == average_precision([hit])
    assert np.isnan(mean_image_average_precision([missed, empty]))
    assert average_precision([hit, missed, empty]) < average_precision([hit])


BOX = np.array([[0, 0, 20, 20.0]])
TWO = np.concatenate([BOX, BOX + 100])
NONE = np.zeros((0, 4))


@pytest.mark.parametrize(
    ("truth", "detection", "confidence", "options", "expected"),
    [
        (TWO, TWO, [0.3, 0.9], {}, 1.0),
        (TWO, NONE, [], {}, 0.0),
        (NONE, TWO, [1.0, 1.0], {}, np.nan),
        (BOX, TWO, [0.9, 0.5], {}, 1.0),  # a false alarm below every hit costs nothing
        (BOX, TWO, [0.5, 0.9], {}, 0.5),
        (BOX, TWO, [0.5, 0.9], {"detection_max": 1}, 0.0),
        (np.concatenate([BOX * np.nan, BOX]), BOX, [1.0], {}, 1.0),  # objects without a box take no part
    ],
)
def test_precision_by_hand(truth, detection, confidence, options, expected):
    scores = score_images(
        [ImageBoxes(truth, detection, np.array(confidence))], iou_min=[0.5], area_px2=[(0.0, np.inf)], **options
    )
    np.testing.assert_allclose(scores.average_precision(), [[expected]])
    np.testing.assert_allclose(average_precision(scores.image_scores()), expected)


def test_no_image_at_all():
    scores = score_images([])
    assert scores.image_scores() == []
    assert np.isnan(scores.average_precision()).all()
    assert np.isnan(average_precision([]))


def test_detections_that_count_only_if_they_find_something():
    """A size range of one's own, as by height, against pycocotools."""
    images = list(_images(np.random.default_rng(100)))
    low_px2, high_px2 = 400.0, 1800.0
    boxes = []
    for truth, hidden, detection, confidence in images:
        truth_px2, found_px2 = (np.prod(box[:, 2:] - box[:, :2], axis=1) for box in (truth, detection))
        out, waived = ((px2 < low_px2) | (px2 > high_px2) for px2 in (truth_px2, found_px2))
        boxes.append(ImageBoxes(truth, detection, confidence, hidden | out, waived))
    found = score_images(boxes, iou_min=[0.5], area_px2=[(0.0, np.inf)]).average_precision()
    expected = _coco(images, iou_min=[0.5], area_px2=[(low_px2, high_px2)])
    np.testing.assert_allclose(found, expected, atol=TOLERANCE)
