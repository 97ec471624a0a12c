"""The thesis's true positive against a twin that follows the text."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warpav.detection.matching import covered_fraction, iou_matrix, match_detections


def _boxes(rng, count, spread=60):
    corner = rng.uniform(0, spread, (count, 2))
    return np.concatenate([corner, corner + rng.uniform(4, 30, (count, 2))], axis=1)


def _iou(first, second):
    width = min(first[2], second[2]) - max(first[0], second[0])
    height = min(first[3], second[3]) - max(first[1], second[1])
    if width <= 0 or height <= 0:
        return 0.0
    area = [(box[2] - box[0]) * (box[3] - box[1]) for box in (first, second)]
    return width * height / (sum(area) - width * height)


def _twin(truth, detection, confidence, inside, confidence_min, iou_min):
    match = [-1] * len(truth)
    while True:
        best = None
        for i in range(len(truth)):
            for j in range(len(detection)):
                allowed = match[i] < 0 and j not in match and confidence[j] >= confidence_min and inside[i, j]
                iou = _iou(truth[i], detection[j])
                if allowed and iou >= iou_min and iou > 0 and (best is None or iou > best[0]):
                    best = (iou, i, j)
        if best is None:
            return match
        match[best[1]] = best[2]


def test_iou_of_known_boxes():
    first = np.array([[0, 0, 10, 10], [20, 20, 20, 30], [np.nan] * 4])
    second = np.array([[0, 0, 10, 10], [5, 0, 15, 10], [10, 0, 20, 10], [20, 20, 20, 30]])
    np.testing.assert_allclose(iou_matrix(first, second), [[1, 1 / 3, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])
    assert iou_matrix(np.zeros((0, 4)), second).shape == (0, 4)


def test_covered_fraction_of_known_boxes():
    np.testing.assert_allclose(covered_fraction([[0, 0, 10, 10]], [[5, 0, 50, 50], [20, 20, 30, 30]]), [[0.5, 0.0]])


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.9))
def test_matching_matches_its_twin(seed, iou_min):
    rng = np.random.default_rng(seed)
    truth, detection = _boxes(rng, rng.integers(0, 6)), _boxes(rng, rng.integers(0, 9))
    confidence = rng.random(len(detection))
    inside = rng.random((len(truth), len(detection))) < 0.8
    match = match_detections(truth, detection, confidence, confidence_min=0.3, iou_min=iou_min, seen_inside=inside)
    assert match.tolist() == _twin(truth, detection, confidence, inside, 0.3, iou_min)
    taken = match[match >= 0]
    assert len(set(taken.tolist())) == len(taken)


def test_the_highest_iou_goes_first_whatever_the_confidence():
    truth = np.array([[0, 0, 10, 10.0]])
    detection = np.array([[0, 0, 10, 8.0], [0, 0, 10, 9.0]])
    assert match_detections(truth, detection, np.array([0.9, 0.2])).tolist() == [1]
    assert match_detections(truth, detection, np.array([0.9, 0.05])).tolist() == [0]


def test_of_equal_boxes_the_more_confident_is_matched():
    truth = np.array([[0, 0, 10, 10.0]])
    assert match_detections(truth, truth.repeat(3, axis=0), np.array([0.4, 0.9, 0.5])).tolist() == [1]


def test_an_object_without_a_box_matches_nothing():
    truth = np.array([[np.nan] * 4, [0, 0, 10, 10]])
    assert match_detections(truth, truth, np.ones(2)).tolist() == [-1, 1]
    assert match_detections(truth, np.zeros((0, 4)), np.zeros(0)).tolist() == [-1, -1]


@pytest.mark.parametrize(("confidence_min", "expected"), [(0.5, 0), (0.51, -1)])
def test_the_least_confidence_is_enough(confidence_min, expected):
    box = np.array([[0, 0, 10, 10.0]])
    assert match_detections(box, box, np.array([0.5]), confidence_min=confidence_min).tolist() == [expected]


@pytest.mark.parametrize(("right_px", "expected"), [(5.0, 0), (4.99, -1)])
def test_the_least_iou_is_enough(right_px, expected):
    # half of the object, nothing beside it: IoU 0.5 to the last bit
    detection = np.array([[0, 0, right_px, 10.0]])
    assert match_detections(np.array([[0, 0, 10, 10.0]]), detection, np.ones(1)).tolist() == [expected]


def test_every_box_is_matched_once():
    # the second object's better box is taken by the first, with which it shares more
    truth = np.array([[0, 0, 10, 10.0], [2, 0, 12, 10.0]])
    detection = np.array([[0.5, 0, 10.5, 10.0], [3.5, 0, 13.5, 10.0]])
    assert match_detections(truth, detection, np.array([0.2, 0.9])).tolist() == [0, 1]
    assert match_detections(truth, detection[:1], np.array([0.2])).tolist() == [0, -1]


def test_an_object_that_is_not_seen_inside_does_not_match():
    box = np.array([[0, 0, 10, 10.0]])
    assert match_detections(box, box, np.ones(1), seen_inside=np.array([[False]])).tolist() == [-1]
