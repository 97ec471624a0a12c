"""A detector that nobody trained on these scenes recognises their traffic: see `realism` for the measure."""

import pytest

from tests.scene.realism import CONFIDENCE_MIN, FIRST_UNSEEN_SEED, judge
from warpav.detection.onnx_detector import OnnxDetector
from warpav.scene.town import town_scene


@pytest.fixture
def detector(asset_folder):
    return OnnxDetector(asset_folder / "yolox_nano_coco.onnx", confidence_min=CONFIDENCE_MIN)


def test_recall_on_three_scenes(detector):
    found = judge(detector, map(town_scene, range(FIRST_UNSEEN_SEED + 100, FIRST_UNSEEN_SEED + 103)))
    recall, count = found.recall()
    assert count >= 8
    assert recall >= 0.75  # few vehicles: the honest number is the next test's


@pytest.mark.slow
def test_recall_on_forty_unseen_scenes(detector, capsys):
    found = judge(detector, map(town_scene, range(FIRST_UNSEEN_SEED, FIRST_UNSEEN_SEED + 40)))
    with capsys.disabled():
        print("\n" + found.table())  # noqa: T201 (the figures are what this test is run for)
    recall, count = found.recall()
    assert count >= 160
    assert recall >= 0.95
    assert found.recall("lorry")[0] >= 0.90
    assert found.background_count <= 0.05 * found.detection_count
