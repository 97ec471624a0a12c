"""Far ahead on motorways a narrow camera module finds more than a wide one: `docs/far_recall.py` has the measure."""

import numpy as np
import pytest

from far_recall import MODULES, far_vehicles
from network_recall import CONFIDENCE_MIN
from warpav.detection.onnx_detector import OnnxDetector
from warpav.rig.catalogue import read_modules
from warpav.scene.town.levels import level_scene

pytestmark = pytest.mark.slow
SEEDS = range(70_000, 70_010)


def test_both_modules_give_the_network_as_many_pixels():
    narrow, wide = (read_modules()[name].camera_model() for name in MODULES)
    assert (narrow.width_px, narrow.height_px) == (wide.width_px, wide.height_px)
    assert np.degrees([narrow.fov_rad, wide.fov_rad]) == pytest.approx([30.0, 120.0])


def check_at_100_to_200_m(model):
    """A narrow module finds more of the vehicles 100 to 200 m ahead: half as many again, with an interval above 0."""
    detector = OnnxDetector(model, confidence_min=CONFIDENCE_MIN, targets=("vehicle",))
    vehicles = far_vehicles([detector], (level_scene(seed, "motorway") for seed in SEEDS))
    far = [one for one in vehicles if 100.0 <= one.distance_m < 200.0]
    narrow, wide = np.array([one.is_found[0] for one in far]).T
    assert len(far) >= 40
    assert narrow.sum() >= 1.5 * wide.sum()
    only_narrow, only_wide = np.sum(narrow & ~wide), np.sum(wide & ~narrow)
    assert only_narrow - only_wide > 1.96 * np.sqrt(only_narrow + only_wide)  # as McNemar's test has it


def test_a_30_degree_module_beats_a_120_degree_one_by_the_shipped_detector():
    check_at_100_to_200_m("builtin")


@pytest.mark.parametrize("name", ["yolo11n_coco_dynamic"])
def test_a_30_degree_module_beats_a_120_degree_one_by_a_network_of_others(asset_folder, name):
    check_at_100_to_200_m(asset_folder / f"{name}.onnx")
