"""`warpav detector score`: what it measures, writes and refuses."""

import json

import pytest

from tests.cli.small_run import complaint
from warpav.cli.app import main
from warpav.core.progress import NullProgress
from warpav.detection import score
from warpav.runs import _detector_fit as detector_fit
from warpav.runs import _detector_samples as detector_samples
from warpav.runs.config import load_config

SMALL = ("camera.width_px=192", "camera.height_px=192")


@pytest.fixture(autouse=True)
def few_views(monkeypatch):
    """A quarter of the views, and few resamples, for time."""
    monkeypatch.setattr(detector_samples, "VIEWS_PER_SCENE", 6)
    monkeypatch.setattr(detector_fit, "_RESAMPLES", 49)


def test_scores_are_those_of_the_fit_on_the_scenes_asked_for(tmp_path, capsys):
    out = tmp_path / "scores"
    words = ["quick", *SMALL, "scenes.level=dense", "--scenes", "5000..5001", "--out", str(out)]
    assert main(["detector", "score", *words]) == 0
    assert "Detection probability against what detectors find" in capsys.readouterr().out
    written = json.loads((out / "scores.json").read_text())
    assert written["scenes"] == {"source": "town", "level": "dense", "seeds": [5000, 5001]}
    (found,) = written["detectors"]
    config = load_config("quick", [*SMALL, "scenes.level=dense"])
    model = detector_fit.ensure_fit(config)
    samples = detector_samples.sample_camera(config, (5000, 5001), model, progress=NullProgress())
    expected = score(model.of_features(samples.feature), samples.is_detected)
    assert found["objects"] == len(samples)
    assert found["detected"] == samples.is_detected.sum()
    assert found["scores"]["auc"] == expected.auc
    assert found["auc"]["low"] < found["auc"]["value"] < found["auc"]["high"]
    assert found["scores"]["calibration_error"] == expected.calibration_error
    assert found["of_fit"]["auc"] == model.record["held_out"]["auc"]
    assert sum(each["count"] for each in found["scores"]["bins"]) == len(samples)
    assert "| builtin | 192 x 192 |" in (out / "scores.md").read_text()
    assert (out / "builtin_reliability.png").is_file()
    # the level counts
    easy = load_config("quick", SMALL)
    assert len(detector_samples.sample_camera(easy, (5000, 5001), model, progress=NullProgress())) != len(samples)


def test_recorded_traffic_is_a_source_like_others(tmp_path):
    out = tmp_path / "scores"
    words = ["quick", *SMALL, "scenes.source=traffic", "--scenes", "5000..5001", "--out", str(out)]
    assert main(["detector", "score", *words]) == 0
    written = json.loads((out / "scores.json").read_text())
    assert written["fitted_on"] == "town"
    assert written["scenes"]["source"] == "traffic"
    assert written["detectors"][0]["auc"]["value"] > 0.7


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--scenes", "500000..500001"], "(--scenes): expected scenes that builtin was not fitted on, got 2 of them"),
        (["--scenes", "5000", "camera.width_px=16", "camera.height_px=16"], "builtin: --scenes: expected at least"),
        (["--panel", "gone"], "gone: expected a folder of ONNX files, got none"),
        (["--panel", ".", "detector.model=a.onnx"], "(detector.model=a.onnx): expected an option that all networks"),
        (["--panel", "."], "expected ONNX files such as yolox_nano_coco.onnx, got none"),
    ],
)
def test_bad_words_are_refused(words, message, working_directory, capsys):
    assert message in complaint(capsys, "detector", "score", "quick", *words)
