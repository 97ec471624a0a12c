"""What a step of an optimisation costs beside rendering: cameras placed once, one copy each way."""

import numpy as np
import pytest
import warp as wp

from tests.driving_scene import ConstantDetector, packed_street, roof
from tests.optimisation.objectives import rig_objective, thesis_losses
from tests.optimisation.test_missed import POSE, probability_model
from warpav.optimisation import AssignedScene, CameraMount, LossSchedule, LossSettings, ZoneAndSpacing
from warpav.raster.buffers import Buffers
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav_kernels.placement import mount_pose


def evaluate_of(device, settings, schedule):
    """A step on three scenes, whose launches are recorded already where they are."""
    mount = CameraMount(roof(), camera=CameraModel(64, 64), height_offset_m=0.25, device=device)
    objective = rig_objective(
        mount,
        ConstantDetector.silent(2),
        camera_count=2,
        settings=settings,
        constraints=ZoneAndSpacing(roof(), camera_count=2),
        multiplier_damping=10.0,
        occlusion=Occlusion.EXACT,
        probability=probability_model(np.random.default_rng(3)),
    )
    scenes = [AssignedScene(packed_street(device, 6, seed), np.arange(6, dtype=np.int32) % 2) for seed in range(3)]
    multiplier = np.full(len(objective.constraints.names), 0.1, np.float32)

    def evaluate(pose):
        return objective.evaluate(pose, scenes, multiplier=multiplier, gradient=True, schedule=schedule)

    for _ in range(3):
        evaluate(POSE)
    return evaluate


MISS_RATE = LossSettings(expected_miss_rate=1.0)
CASES = pytest.mark.parametrize(
    ("settings", "schedule"),
    [
        (MISS_RATE, LossSchedule()),
        (MISS_RATE, LossSchedule(0.5)),
        (thesis_losses(detected_area=0.0, angular_coverage=1.0, expected_miss_rate=1.0), LossSchedule()),
    ],
    ids=["images", "panorama", "with the thesis's"],
)


@CASES
def test_cameras_are_placed_once_a_step(monkeypatch, settings, schedule):
    evaluate = evaluate_of("cpu", settings, schedule)
    placed, launch = [], wp.launch

    def count(kernel, *arguments, **options):
        if kernel is mount_pose.place_on_surface_kernel:
            placed.append("backward" if options.get("adjoint") else "forward")
        return launch(kernel, *arguments, **options)

    monkeypatch.setattr(wp, "launch", count)
    assert np.abs(evaluate(POSE).gradient).max() > 0.0
    assert placed == ["forward", "backward"]


@CASES
def test_one_copy_to_the_device_and_one_back(monkeypatch, settings, schedule):
    evaluate = evaluate_of("cpu", settings, schedule)
    copies = []

    def counting(kind, function, *, is_copy=lambda *_: True):
        """The function, counted as one copy, whatever it does within."""

        def counted(self, *arguments, **options):
            before = [*copies, kind] if is_copy(*arguments, *options.values()) else list(copies)
            result = function(self, *arguments, **options)
            copies[:] = before
            return result

        return counted

    def is_of_numbers(*arguments):
        return any(isinstance(each, (np.ndarray, list, tuple)) and np.size(each) for each in arguments)

    monkeypatch.setattr(wp.array, "numpy", counting("back", wp.array.numpy))
    monkeypatch.setattr(wp.array, "assign", counting("there", wp.array.assign, is_copy=is_of_numbers))
    # launches that are not recorded ask after every render, which recorded ones need not
    counted_grew = counting("", Buffers.grew, is_copy=lambda *_: False)
    monkeypatch.setattr(Buffers, "grew", counted_grew)
    result = evaluate(POSE + np.float32(0.01))
    monkeypatch.undo()
    assert copies == ["there", "back"]
    assert np.isfinite(result.total)


@pytest.mark.gpu
@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device")
@CASES
def test_what_crosses_on_a_gpu(settings, schedule):
    """As the driver reports it: one copy there, one back."""
    evaluate = evaluate_of("cuda:0", settings, schedule)
    wp.timing_begin(cuda_filter=wp.TIMING_MEMCPY)
    evaluate(POSE + np.float32(0.01))
    names = [each.name for each in wp.timing_end()]
    there, back = (sum(way in name for name in names) for way in ("HtoD", "DtoH"))
    assert (there, back) == (1, 1), names
