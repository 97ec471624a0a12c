"""Tables I and V: which losses move what, and how the mean over numbers that are not 0 is taken."""

import math

import numpy as np
import pytest

from tests.driving_scene import SilentDetector, packed_street, roof
from tests.optimisation.objectives import rig_objective
from warpav.experiments._gradient_magnitude import LOSS_OF, measure_gradient_magnitudes
from warpav.optimisation import LOSSES, AssignedScene, CameraMount, LossSettings, OptimiserSettings
from warpav.raster.camera import CameraModel
from warpav.thesis import thesis_table
from warpav.thesis._tables import TABLES

YAW_RAD = np.array([0.1, 1.5, 3.2])
SETTINGS = OptimiserSettings(learning_rate_position_m=0.25, learning_rate_yaw_deg=math.degrees(0.25), weight_decay=1e-3)


def objective_of(device):
    mount = CameraMount(roof(), camera=CameraModel(64, 64, 0.5 * math.pi), height_offset_m=0.25, device=device)
    one_field = {name: 1.0 for name, loss in LOSSES.items() if loss.one_field}
    settings = LossSettings(**one_field, epsilon=0.05, min_unblocked_area=1.0)
    return rig_objective(mount, SilentDetector(), camera_count=3, settings=settings)


def scenes_of(device):
    camera_of_car = np.array([0, 0, 0, -1, 2, 2, 1, 2, 1, 2], np.int32)
    return [AssignedScene(packed_street(device, 10, seed), camera_of_car) for seed in (0, 1)]


class Remembering:
    """An objective that remembers the gradients that it gave."""

    def __init__(self, objective):
        self._objective, self.given, self.batches = objective, [], []

    def __getattr__(self, name):
        return getattr(self._objective, name)

    def gradients(self, mount_pose, scenes):
        self.given.append(self._objective.gradients(mount_pose, scenes))
        self.batches.append(len(scenes))
        return self.given[-1]


def test_magnitudes_are_means_of_what_is_not_zero(device):
    objective = Remembering(objective_of(device))
    magnitudes = measure_gradient_magnitudes(objective, scenes_of(device), YAW_RAD, settings=SETTINGS, iterations=8)
    assert objective.batches == [1] * 8
    assert set(magnitudes) == set(LOSS_OF.values())
    for name, ours in magnitudes.items():
        values = np.abs([gradient[name] for gradient in objective.given])
        for part, mean in ((values[:, :, :2], ours["positional"]), (values[:, :, 2], ours["rotational"])):
            assert mean == pytest.approx(part[part > 0.0].mean() if part.any() else 0.0, rel=1e-6)
    # what the thesis's tables say too
    for name in ("in_frame_rotation", "angular_coverage"):
        assert magnitudes[name]["positional"] == 0.0
    for name in ("out_of_bounds", "camera_spacing"):
        assert magnitudes[name]["rotational"] == 0.0
    for name in ("detected_area", "surface_blockage", "object_visibility"):
        assert magnitudes[name]["positional"] > 0.0
        assert magnitudes[name]["rotational"] > 0.0
    assert magnitudes["in_frame_rotation"]["rotational"] <= 1.0 / math.pi
    # three cameras of 90 degrees: 1 / (C_max - C_fov) wherever it is not 0
    assert magnitudes["angular_coverage"]["rotational"] == pytest.approx(1.0 / math.pi, rel=1e-5)


def test_runs_differ_and_repeat(device):
    arguments = (objective_of(device), scenes_of(device), YAW_RAD)
    first, again, other = (
        measure_gradient_magnitudes(*arguments, settings=SETTINGS, iterations=2, seed=seed) for seed in (3, 3, 4)
    )
    assert again == first
    assert other != first


def test_the_packaged_tables_are_whole():
    rows = {number: thesis_table(number)["rows"] for number in TABLES}
    assert [len(rows[number]) for number in TABLES] == [4, 7, 7, 2, 3]
    assert {row["loss"] for number in ("I", "V") for row in rows[number]} == set(LOSS_OF)
    best = rows["II"][3]
    assert (best["method"], best["loss"], best["avg_map50"]["mean"]) == ("SGD", "IFR+10*DOA", 0.5537)
    assert rows["II"][6]["tp_detection_rate"] == {"mean": 0.8961, "std": None}
    assert rows["III"][6]["min_pair_distance_m"]["mean"] == 0.2
    assert all(len(row) == 9 for number in ("II", "IV") for row in rows[number])
    with pytest.raises(ValueError, match="one of I, II, III, IV, V, got 'VI'"):
        thesis_table("VI")
