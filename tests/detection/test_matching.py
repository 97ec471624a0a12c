"""The thesis's true positive against a twin that follows the text, and ground-truth boxes against flood fill."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warpav.detection._matching import (
    covered_fraction,
    iou_matrix,
    largest_component_box,
    match_detections,
    visible_boxes,
)


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


HALF = [[0, 0, 5.0, 10.0]]  # of BOX, nothing beside it: IoU 0.5 to the last bit
BOX = [[0, 0, 10.0, 10.0]]


@pytest.mark.parametrize(
    ("truth", "detection", "confidence", "options", "expected"),
    [
        (BOX, [[0, 0, 10, 8.0], [0, 0, 10, 9.0]], [0.9, 0.2], {}, [1]),  # the highest IoU goes first
        (BOX, [[0, 0, 10, 8.0], [0, 0, 10, 9.0]], [0.9, 0.05], {}, [0]),
        (BOX, BOX * 3, [0.4, 0.9, 0.5], {}, [1]),  # of equal boxes the more confident
        ([[np.nan] * 4, *BOX], [[np.nan] * 4, *BOX], [1.0, 1.0], {}, [-1, 1]),
        ([[np.nan] * 4, *BOX], np.zeros((0, 4)), [], {}, [-1, -1]),
        (BOX, BOX, [0.5], {"confidence_min": 0.5}, [0]),  # the least confidence is enough
        (BOX, BOX, [0.5], {"confidence_min": 0.51}, [-1]),
        (BOX, HALF, [1.0], {}, [0]),  # and so is the least IoU
        (BOX, [[0, 0, 4.99, 10.0]], [1.0], {}, [-1]),
        # the second object's better box is taken by the first, with which it shares more
        ([*BOX, [2, 0, 12, 10.0]], [[0.5, 0, 10.5, 10.0], [3.5, 0, 13.5, 10.0]], [0.2, 0.9], {}, [0, 1]),
        ([*BOX, [2, 0, 12, 10.0]], [[0.5, 0, 10.5, 10.0]], [0.2], {}, [0, -1]),
        (BOX, BOX, [1.0], {"seen_inside": np.array([[False]])}, [-1]),
    ],
)
def test_matches_by_hand(truth, detection, confidence, options, expected):
    found = match_detections(np.array(truth, float), np.array(detection, float), np.array(confidence), **options)
    assert found.tolist() == expected


def _components(mask):
    """Every 8-connected component as a list of (row, column), by flood fill."""
    left = {tuple(cell) for cell in np.argwhere(mask)}
    while left:
        stack, component = [left.pop()], []
        while stack:
            row, column = stack.pop()
            component.append((row, column))
            for near in [(row + i, column + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]:
                if near in left:
                    left.remove(near)
                    stack.append(near)
        yield component


def test_parts_that_touch_at_a_corner_are_one():
    mask = np.zeros((20, 20), bool)
    mask[0:4, 0:4] = True
    mask[4:8, 4:8] = True
    np.testing.assert_array_equal(largest_component_box(mask), [0, 0, 8, 8])


def test_too_small_has_no_box():
    mask = np.zeros((20, 20), bool)
    mask[0, :15] = True
    assert largest_component_box(mask) is None
    mask[0, 15] = True
    np.testing.assert_array_equal(largest_component_box(mask), [0, 0, 16, 1])
    assert largest_component_box(mask, min_area_px=17) is None
    assert largest_component_box(np.zeros((5, 5), bool)) is None


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1))
def test_visible_boxes_match_flood_fill(seed):
    rng = np.random.default_rng(seed)
    vehicle_count = int(rng.integers(0, 5))
    coarse = rng.integers(-1, 2 + max(vehicle_count, 1) + 1, (6, 8))  # an index too many belongs to no vehicle
    object_index = coarse.repeat(4, axis=0).repeat(4, axis=1)
    object_index[rng.random(object_index.shape) < 0.1] = 0
    box_px = visible_boxes(object_index, vehicle_count)
    assert box_px.shape == (vehicle_count, 4)
    assert box_px.dtype == np.float32
    for vehicle in range(vehicle_count):
        parts = [np.array(part) for part in _components(object_index == 2 + vehicle)]
        size = max((len(part) for part in parts), default=0)
        if size < 16:
            assert np.isnan(box_px[vehicle]).all()
            continue
        expected = [[*part.min(0)[::-1], *(part.max(0)[::-1] + 1)] for part in parts if len(part) == size]
        assert box_px[vehicle].tolist() in expected
