"""Depths and codes from what CARLA's cameras send."""

import numpy as np

from warpav.scene.capture.carla_client import code_from_bgra, depth_from_bgra


def test_depth_counts_red_lowest_over_one_kilometre():
    bgra = np.array([[[0, 0, 0, 255], [0, 1, 2, 255], [6, 0, 0, 255], [255, 255, 255, 255]]], np.uint8)
    expected_m = np.array([0.0, (2 + 256) * 1000 / (2**24 - 1), 6 * 65536 * 1000 / (2**24 - 1), np.inf])
    np.testing.assert_allclose(depth_from_bgra(bgra)[0], expected_m, rtol=1e-7)
    assert depth_from_bgra(bgra).dtype == np.float32


def test_code_keeps_tag_and_both_bytes():
    bgra = np.array([[[3, 2, 14, 255], [0, 0, 0, 255]]], np.uint8)
    assert code_from_bgra(bgra).tolist() == [[14 + 2 * 256 + 3 * 65536, 0]]
