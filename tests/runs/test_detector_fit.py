"""`warpav detector fit`: what it takes, refuses, writes and uses again."""

import json
import re

import pytest

from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.core.progress import NullProgress
from warpav.detection import probability
from warpav.detection.probability import DetectionProbability, stored_file
from warpav.runs import detector_fit
from warpav.runs.config import load_config
from warpav.runs.detector_fit import TOWN_HELD_OUT, TOWN_SEEDS, chosen_seeds
from warpav.runs.networks import detector_use


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setattr(probability, "cache_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache"


def refused(capsys, *words):
    """The one line with which a command is refused."""
    assert main(["detector", "fit", *words]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


def test_embedded_scenes_of_its_own_are_the_default():
    seeds = chosen_seeds(load_config("quick"), None, None)
    assert (seeds.fit, seeds.held_out) == (TOWN_SEEDS, TOWN_HELD_OUT)
    assert not set(TOWN_SEEDS) & set(TOWN_HELD_OUT)


def test_scenes_of_files_are_shared_out(tmp_path):
    config = load_config("quick", ["scenes.source=folder", f"scenes.folder={tmp_path}", "scenes.train_seeds=0..9"])
    seeds = chosen_seeds(config, None, None)
    assert sorted((*seeds.fit, *seeds.held_out)) == list(range(10))
    assert len(seeds.fit) == 6
    few = load_config(
        "quick",
        ["scenes.source=folder", f"scenes.folder={tmp_path}", "scenes.train_seeds=[1]", "run.batch_size=1"],
    )
    with pytest.raises(InputError, match=r"scenes\.train_seeds: expected at least 4"):
        chosen_seeds(few, None, None)


def test_a_fit_is_for_what_is_free():
    level = "rig.free.pitch_deg=null"
    fixed = detector_use(load_config("quick", [level]))
    assert "rig.free" not in fixed.settings
    free = detector_use(load_config("quick", [level, "rig.free.height_m=[0.1, 0.4]"]))
    assert free.settings["rig.free"] == {"height_m": [0.1, 0.4]}
    wider = detector_use(load_config("quick", [level, "rig.free.height_m=[0.05, 0.4]"]))
    assert len({fixed.identity, free.identity, wider.identity}) == 3


@pytest.mark.parametrize("words", [["quick"], ["quick", "rig.free.pitch_deg=null"], ["default"]])
def test_what_is_shipped_needs_no_fit(words, tmp_path, monkeypatch):
    """A first run of a shipped configuration finds the model of detection probability that the package holds."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    found = stored_file(detector_use(load_config(words[0], words[1:])))
    assert found is not None
    assert found.parent.name == "models"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ("--scenes", "1..5", "--held-out", "5..9"),
            "--held-out.*expected scenes .* not fitted on, got 1 .* as 5",
        ),
        (("--scenes", "5000..5003"), "--scenes.*expected other scenes than scenes.test_seeds, got 4 .* such as 5000"),
        (("--scenes", "9..1"), "command line .--scenes.: expected a range"),
        (("--out", "/dev/null/fit"), "command line .--out.: expected a folder to write to, got '/dev/null/fit'"),
        (("--held-out", "x"), "command line .--held-out.: expected seeds"),
        (("detector.model=none.onnx",), "detector.model: expected builtin or the path of an ONNX file"),
    ],
)
def test_bad_words_are_refused(capsys, words, message):
    line = refused(capsys, *words)
    assert re.search(message, line), line


@pytest.mark.slow
def test_too_few_objects_are_refused(capsys, monkeypatch):
    monkeypatch.setattr(detector_fit, "VIEWS_PER_SCENE", 2)
    line = refused(capsys, "--scenes", "1", "--held-out", "2", "camera.width_px=64", "camera.height_px=64")
    assert "detection probability: --scenes: expected at least 200 visible objects" in line
    assert line.endswith("give more --scenes, or other sizes of image")


@pytest.fixture
def small_fit(monkeypatch):
    monkeypatch.setattr(detector_fit, "VIEWS_PER_SCENE", 6)
    monkeypatch.setattr("warpav.detection.probability_fit.MIN_OBJECTS", 30)
    monkeypatch.setattr("warpav.detection.probability_fit.MIN_OF_EACH", 2)
    # small images, so that some objects are missed
    return ["--scenes", "1..3", "--held-out", "[4, 5, 6]", "camera.width_px=96", "camera.height_px=96"]


@pytest.mark.slow
def test_a_fit_is_written_and_used_again(small_fit, own_cache, capsys):
    assert main(["detector", "fit", *small_fit]) == 0
    said = capsys.readouterr().out
    assert "AUC" in said
    assert "expected calibration error" in said
    (file,) = own_cache.glob("*.json")
    assert len(list(own_cache.glob("*.png"))) == 2
    data = json.loads(file.read_text())
    assert data["fit"]["seeds"] == [1, 2, 3]
    assert data["command"].startswith("warpav detector fit quick camera.width_px=96")
    assert data["held_out"]["objects"] == sum(each["count"] for each in data["held_out"]["bins"])
    # used again, whoever asks
    before = file.stat().st_mtime_ns
    assert main(["detector", "fit", *small_fit]) == 0
    assert "fits this detector, camera and source of scenes already" in capsys.readouterr().out
    assert file.stat().st_mtime_ns == before
    config = load_config("quick", small_fit[-2:])
    assert DetectionProbability.find(detector_use(config), unseen=config.scenes.test_seeds).record["fit"]["seeds"]
    # a damaged one is named, and can be replaced
    file.write_text(file.read_text()[:100])
    assert "run warpav detector fit --again" in refused(capsys, *small_fit)
    assert main(["detector", "fit", *small_fit, "--again"]) == 0
    assert json.loads(file.read_text())["curves"] == data["curves"]


def test_without_a_fit_the_error_says_what_to_run():
    with pytest.raises(InputError, match="run warpav detector fit with the same configuration"):
        DetectionProbability.find(detector_use(load_config("quick", ["camera.fov_deg=77"])))


def test_a_fit_without_progress_is_announced_in_the_log(monkeypatch, caplog):
    """Who called without progress learns why it takes minutes; the fit itself is cut short here."""

    class StoppedError(Exception):
        pass

    def stop(*_, **__):
        raise StoppedError

    monkeypatch.setattr(detector_fit, "_sample_scenes", stop)
    config = load_config("quick", ["camera.fov_deg=77"])
    with pytest.raises(StoppedError):
        detector_fit.ensure_fit(config)
    (line,) = [record.getMessage() for record in caplog.records]
    assert "fitting it once, in 80 scenes; the fit is stored for later runs; this takes minutes" in line
    caplog.clear()
    said = []

    class Said(NullProgress):
        def say(self, text):
            said.append(text)

    with pytest.raises(StoppedError):
        detector_fit.ensure_fit(config, progress=Said())
    assert caplog.records == []
    assert "in 80 scenes" in said[0]
