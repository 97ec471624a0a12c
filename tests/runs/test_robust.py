"""The section ``robust``: read, refused, left out of files, and in what a run says of itself."""

import pytest

import warpav as wa
from warpav.core.errors import InputError
from warpav.experiments.result_folder import unseeded
from warpav.optimisation.camera_loss import RobustObjective
from warpav.runs.config import Config, changed_config, dump_config, load_config
from warpav.runs.verdict import robust_text

MEAN = ["robust.camera_loss=mean", "robust.weight=0.3"]


def test_files_and_hashes_without_it_stay_as_they_were():
    assert "robust" not in Config().model_dump()
    assert "robust" not in unseeded(Config())
    assert Config().robust.objective is None


def test_what_is_written_is_read_again(tmp_path):
    config = changed_config(Config(), MEAN, origin=None)
    assert config.robust.objective == RobustObjective("mean", 0.3)
    (tmp_path / "mine.yaml").write_text(dump_config(config))
    assert load_config(tmp_path / "mine.yaml") == config
    assert '"robust.weight": 0.3' in unseeded(config)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["robust.camera_loss=median"], "robust.camera_loss: expected"),
        (["robust.camera_loss=worst", "robust.weight=0"], "robust.weight: expected"),
        (["robust.camera_loss=worst", "robust.weight=1.1"], "robust.weight: expected"),
        (["robust.weight=0.3"], "expected robust.camera_loss beside a weight"),
        ([*MEAN, "optimiser.search=descent"], "only the search by a pool"),
        ([*MEAN, "losses.detected_area=1"], "only the search by a pool"),
    ],
)
def test_what_cannot_be_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        changed_config(Config(), options, origin=None)


def test_a_front_is_refused():
    placement = wa.Placement(list(wa.town([1])), cameras="2..3", robust={"camera_loss": "mean"})
    with pytest.raises(InputError, match=r"^robust\.camera_loss: expected null"):
        wa.front(placement)


def test_a_result_says_what_its_objective_is_made_of(tmp_path):
    options = ["camera.width_px=64", "camera.height_px=64", "optimiser.pool_cameras=16", "optimiser.pool_rounds=0"]
    config = changed_config(Config(), [*options, "baselines.random_samples=1"], origin=None)
    robust = {"camera_loss": "worst", "weight": 0.4}
    result = wa.optimise(wa.Placement(list(wa.town([1, 2])), cameras=3, robust=robust, config=config))
    for name, objective in (("start", result.start_objective), ("optimised", result.found_objective)):
        each = result.robust[name]
        assert each["objective"] == pytest.approx(objective)
        in_parts = 0.6 * each["expected_miss_rate"] + 0.4 * each["without_camera"]
        assert each["objective"] == pytest.approx(in_parts)
        assert each["without_camera"] > each["expected_miss_rate"]
    terms = result.records[-1].terms
    assert terms["expected_miss_rate"] == result.robust["optimised"]["expected_miss_rate"]
    assert terms["expected_miss_rate_without_camera"] == result.robust["optimised"]["without_camera"]
    assert result.bound <= result.objective
    folder = result.save(tmp_path / "run", test=list(wa.town([5])))
    evaluation = wa.read_run(folder).evaluation()
    assert evaluation["robust"] == result.robust
    assert robust_text(evaluation["robust"]).startswith("the objective is 0.6 x expected misses + 0.4 x those without")
    report = (folder / "report.html").read_text()
    assert robust_text(evaluation["robust"]).replace("->", "-&gt;") in report
    assert "has a robust objective" in report
