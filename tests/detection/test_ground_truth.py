"""Ground-truth boxes against flood fill written out, and the thesis's third condition."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from warpav.detection.ground_truth import largest_component_box, seen_inside, visible_boxes


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


def test_box_edges_enclose_the_pixels():
    mask = np.zeros((20, 30), bool)
    mask[3:8, 10:16] = True
    np.testing.assert_array_equal(largest_component_box(mask), [10, 3, 16, 8])


def test_the_larger_part_has_the_box():
    mask = np.zeros((20, 30), bool)
    mask[2:7, 2:7] = True
    mask[2:12, 9:15] = True  # split from the first part by a pole
    np.testing.assert_array_equal(largest_component_box(mask), [9, 2, 15, 12])


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


def test_seen_inside_asks_for_a_pixel_centre(rng):
    object_index = rng.integers(-1, 5, (24, 32))
    corner = rng.uniform(-5, 30, (40, 2))
    box_px = np.concatenate([corner, corner + rng.uniform(0, 6, (40, 2))], axis=1)
    inside = seen_inside(object_index, 3, box_px)
    x, y = np.meshgrid(np.arange(32) + 0.5, np.arange(24) + 0.5)
    for vehicle in range(3):
        for box, got in zip(box_px, inside[vehicle], strict=True):
            held = (x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])
            assert got == (held & (object_index == 2 + vehicle)).any()
