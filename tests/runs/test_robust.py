"""The section ``robust``: read, refused, left out of files, and in what a run says of itself."""

import math

import numpy as np
import pytest

import warpav as wa
from warpav.core.errors import InputError
from warpav.detection import expected_miss_rate
from warpav.experiments._result_folder import unseeded
from warpav.optimisation import MountErrors, single_cameras_of
from warpav.optimisation._camera_loss import RobustObjective
from warpav.optimisation._single_cameras import MisplacedCameras
from warpav.runs._rig_evaluation import Robust
from warpav.runs.config import Config, dump_config, load_config
from warpav.runs.report._statements import _robust_text

MEAN = ["robust.camera_loss=mean", "robust.weight=0.3"]
ERRORS = ["robust.mount_error_m=5 cm", "robust.mount_error_deg=3"]
SMALL = [
    "run.batch_size=1",
    "camera.width_px=64",
    "camera.height_px=64",
    "optimiser.pool_cameras=16",
    "optimiser.pool_rounds=0",
    "baselines.random_samples=1",
    "run.pictures=none",
]


def test_nothing_is_asked_for_unless_it_is_written():
    assert Config().robust.objective is None
    assert Config().robust.mount_errors is None


def test_what_is_written_is_read_again(tmp_path):
    config = load_config(Config(), MEAN, origin=None)
    assert config.robust.objective == RobustObjective("mean", 0.3)
    (tmp_path / "mine.yaml").write_text(dump_config(config))
    assert load_config(tmp_path / "mine.yaml") == config
    assert '"robust.weight": 0.3' in unseeded(config)


def test_errors_that_are_written_are_read_again(tmp_path):
    config = load_config(Config(), ERRORS, origin=None)
    assert config.robust.mount_errors == MountErrors(0.05, math.radians(3.0))
    (tmp_path / "mine.yaml").write_text(dump_config(config))
    assert load_config(tmp_path / "mine.yaml") == config
    assert '"robust.mount_error_m": 0.05' in unseeded(config)
    alone = load_config(Config(), ERRORS[1:], origin=None)
    assert alone.robust.mount_errors == MountErrors(0.0, math.radians(3.0))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["robust.camera_loss=median"], "robust.camera_loss: expected"),
        (["robust.camera_loss=worst", "robust.weight=0"], "robust.weight: expected"),
        (["robust.camera_loss=worst", "robust.weight=1.1"], "robust.weight: expected"),
        (["robust.weight=0.3"], "expected robust.camera_loss beside a weight"),
        ([*MEAN, "optimiser.search=descent"], "only the search by a pool"),
        ([*MEAN, "losses.detected_area=1"], "only the search by a pool"),
        (["robust.mount_error_m=0"], "robust.mount_error_m: expected"),
        (["robust.mount_error_m=0.3"], "robust.mount_error_m: expected"),
        (["robust.mount_error_deg=-1"], "robust.mount_error_deg: expected"),
        (["robust.mount_error_deg=31"], "robust.mount_error_deg: expected"),
        (["robust.mount_errors_m=0.02"], "mount_error_m"),
        ([*ERRORS, "optimiser.search=descent"], r"robust\.mount_error_m.*only the search by a pool"),
    ],
)
def test_what_cannot_be_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        load_config(Config(), options, origin=None)


@pytest.mark.parametrize(("option", "value"), [("camera_loss", "mean"), ("mount_error_deg", 2.0)])
def test_a_front_is_refused(option, value):
    placement = wa.Placement(list(wa.town([1])), cameras="2..3", robust={option: value})
    with pytest.raises(InputError, match=rf"^robust\.{option}: expected null.*got {value}"):
        wa.front(placement)


def test_a_result_says_what_its_objective_is_made_of(tmp_path):
    config = load_config(Config(), SMALL, origin=None)
    robust = {"camera_loss": "worst", "weight": 0.4}
    result = wa.optimise(wa.Placement(list(wa.town([1])), cameras=2, robust=robust, config=config))
    for name, objective in (("start", result.start_objective), ("optimised", result.found_objective)):
        each = result.robust[name]
        assert each["objective"] == pytest.approx(objective)
        in_parts = 0.6 * each["expected_miss_rate"] + 0.4 * each["without_camera"]
        assert each["objective"] == pytest.approx(in_parts)
        assert each["without_camera"] > each["expected_miss_rate"]
    terms, optimised = result.records[-1].terms, result.robust["optimised"]  # before and after numbers are rounded
    assert terms["expected_miss_rate"] == pytest.approx(optimised["expected_miss_rate"], abs=0.02)
    assert terms["expected_miss_rate_without_camera"] == pytest.approx(optimised["without_camera"], abs=0.02)
    assert result.bound <= result.objective
    folder = result.save(tmp_path / "run", test=list(wa.town([5])))
    evaluation = wa.read_run(folder).evaluation()
    assert evaluation["robust"] == result.robust
    text = _robust_text(Robust(**evaluation["robust"]))
    assert text.startswith("the objective is 0.6 x expected misses + 0.4 x those without")
    report = (folder / "report.html").read_text()
    assert text.replace("->", "-&gt;") in report
    assert "This bound is loose." in report


@pytest.mark.parametrize(
    "others", [{}, pytest.param({"camera_loss": "mean", "weight": 0.5}, marks=pytest.mark.nightly)]
)
def test_a_result_says_what_errors_cost(tmp_path, others):
    config = load_config(Config(), SMALL, origin=None)
    robust = {"mount_error_m": 0.05, "mount_error_deg": 3.0, **others}
    placement = wa.Placement(list(wa.town([1])), cameras=2, robust=robust, config=config)
    result = wa.optimise(placement)
    errors = MountErrors(0.05, math.radians(3.0))
    assert robust.items() <= result.robust.items()
    plain = single_cameras_of(placement.objective)
    for name, rig in (("start", result.start), ("optimised", result.found)):
        each, pose = result.robust[name], placement.mount_pose_of(rig)
        for number, cameras in (("expected_miss_rate", MisplacedCameras.of(plain, errors)), ("as_designed", plain)):
            found = [cameras.detection_probability(pose, scene.scene) for scene in placement.search_scenes]
            rate = expected_miss_rate(np.concatenate(found, axis=1))
            assert each[number] == pytest.approx(rate, abs=1e-4)
        assert each["expected_miss_rate"] != pytest.approx(each["as_designed"], abs=1e-4)
    if not others:
        assert result.robust["optimised"]["expected_miss_rate"] == pytest.approx(result.found_objective, abs=1e-6)
        assert result.robust["start"]["expected_miss_rate"] == pytest.approx(result.start_objective, abs=1e-6)
    folder = result.save(tmp_path / "run", test=list(wa.town([5])))
    evaluation = wa.read_run(folder).evaluation()
    assert evaluation["robust"] == result.robust
    assert evaluation["mount_tolerance"]["position_m"] == 0.05
    assert evaluation["mount_tolerance"]["angle_rad"] == pytest.approx(errors.angle_rad)
    report, text = (folder / "report.html").read_text(), _robust_text(Robust(**evaluation["robust"]))
    assert "in the mean over errors of mounting of +-5 cm and +-3 deg" in text
    assert text.replace("->", "-&gt;") in report
    assert ("This bound is loose." in report) == bool(others)
