"""`warpav detector fit`: what it takes, refuses, writes and uses again."""

import json
import math
import re
from types import SimpleNamespace

import numpy as np
import pytest

from tests.cli.small_run import complaint
from tests.optimisation.test_numbers_that_break import Said
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.core.progress import NullProgress
from warpav.detection import DetectionProbability, DetectionSamples, score, stored_file
from warpav.detection import _probability as probability
from warpav.detection._probability import FEATURE_COUNT
from warpav.raster.camera import CameraModel
from warpav.runs import _detector_fit as detector_fit
from warpav.runs import _detector_samples as detector_samples
from warpav.runs._detector_fit import chosen_seeds
from warpav.runs._networks import any_camera_config, any_camera_use, detector_use
from warpav.runs.config import load_config
from warpav.scene.traffic.moments import search_and_test


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setattr(probability, "user_cache_folder", lambda _: tmp_path / "cache")
    return tmp_path / "cache"


def test_scenes_of_files_are_shared_out(tmp_path):
    config = load_config("quick", ["scenes.source=folder", f"scenes.folder={tmp_path}", "scenes.train_seeds=0..9"])
    fit, held_out = chosen_seeds(config)
    assert sorted((*fit, *held_out)) == list(range(10))
    assert len(fit) == 6
    few = load_config(
        "quick",
        ["scenes.source=folder", f"scenes.folder={tmp_path}", "scenes.train_seeds=[1]", "run.batch_size=1"],
    )
    with pytest.raises(InputError, match=r"scenes\.train_seeds: expected at least 4"):
        chosen_seeds(few)


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
    line = complaint(capsys, "detector", "fit", *words)
    assert re.search(message, line), line


@pytest.fixture
def small_fit(monkeypatch):
    monkeypatch.setattr(detector_samples, "VIEWS_PER_SCENE", 6)
    monkeypatch.setattr("warpav.detection._probability_fit._MIN_OBJECTS", 30)
    monkeypatch.setattr("warpav.detection._probability_fit._MIN_OF_EACH", 2)
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
    assert "run warpav detector fit --again" in complaint(capsys, "detector", "fit", *small_fit)
    assert main(["detector", "fit", *small_fit, "--again"]) == 0
    assert json.loads(file.read_text())["curves"] == data["curves"]


class StoppedError(Exception):
    """Ends a fit before it begins."""


@pytest.fixture
def sampled(monkeypatch):
    """Seeds of the scenes that were sampled, each in no time; what was found in them is made up."""
    seeds = []

    def samples(_, recipe, seed):
        seeds.append(seed)
        rng = np.random.default_rng(seed)
        feature = rng.normal(size=(40, FEATURE_COUNT))
        is_detected = rng.random(40) < 1.0 / (1.0 + np.exp(-2.0 * feature[:, 0]))
        return DetectionSamples(feature, is_detected, np.full(40, seed), np.zeros(40, int))

    monkeypatch.setattr(detector_samples._Sampling, "samples", samples)
    monkeypatch.setattr("warpav.detection._probability_fit._MIN_OBJECTS", 30)
    return seeds


FIT = ("--scenes", "1..3", "--held-out", "4..6", "executor.workers=1", "camera.width_px=64", "camera.height_px=64")


def curves(folder):
    (file,) = folder.glob("*.json")
    return json.loads(file.read_text())["curves"]


@pytest.mark.parametrize("share", [0.03, 0.3])
@pytest.mark.usefixtures("sampled")
def test_a_detector_that_finds_next_to_nothing_is_told(share, tmp_path, capsys, monkeypatch):
    def samples(_, recipe, seed):
        feature = np.random.default_rng(seed).normal(size=(400, FEATURE_COUNT))
        is_detected = feature[:, 0] > np.quantile(feature[:, 0], 1 - share)
        return DetectionSamples(feature, is_detected, np.full(400, seed), np.zeros(400, int))

    monkeypatch.setattr(detector_samples._Sampling, "samples", samples)
    assert main(["detector", "fit", *FIT, "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert (f"warning: builtin finds {share * 1200:.0f} of 1200 objects, fewer than 5%" in said) == (share < 0.05)


def test_a_fit_that_is_interrupted_goes_on(sampled, own_cache, tmp_path, capsys, monkeypatch):
    assert main(["detector", "fit", *FIT, "--out", str(tmp_path / "whole")]) == 0
    sample, stop = detector_samples._Sampling.samples, [True]

    def samples(sampling, recipe, seed):
        if seed == 3 and stop:
            stop.clear()
            raise KeyboardInterrupt
        return sample(sampling, recipe, seed)

    monkeypatch.setattr(detector_samples._Sampling, "samples", samples)
    sampled.clear()
    capsys.readouterr()
    assert main(["detector", "fit", *FIT]) == 130
    stopped = capsys.readouterr()
    assert "stopped; 2 of 6 scenes are kept, and the same command samples the rest" in stopped.out
    assert len(stopped.err.strip().splitlines()) == 1
    assert not list(own_cache.glob("*.json"))
    # one of the two is damaged
    kept = sorted(own_cache.rglob("*.npz"))
    kept[0].write_bytes(kept[0].read_bytes()[:200])
    assert main(["detector", "fit", *FIT]) == 0
    assert sampled[:2] == [1, 2]
    assert len(sampled[2:]) == 5
    assert {3, 4, 5, 6} < set(sampled[2:])
    assert curves(own_cache) == curves(tmp_path / "whole")
    assert not list(own_cache.rglob("*.npz"))  # the kept samples went


def test_recordings_of_ones_own_share_the_fit_of_those_that_ship(tmp_path, own_cache):
    """Unless they have a fit of their own, or test on what that fit has seen."""
    search, test = search_and_test(None, None)
    folder = tmp_path / "recordings"
    folder.mkdir()
    for number, file in enumerate(test):
        (folder / f"{number}.json.gz").write_bytes(file.read_bytes())
    words = [
        "scenes.source=traffic",
        f"scenes.recordings=[{folder}]",
        "scenes.train_seeds=1000..1059",
        "scenes.test_seeds=0..20",
    ]
    config, said = load_config("quick", words), Said()
    shipped = stored_file(any_camera_use(any_camera_config(load_config("quick", words[:1]))))
    assert same_fit(detector_fit.ensure_fit(config, progress=said), shipped)
    (line,) = said.lines
    assert "that of the recordings that ship with warpav" in line
    seen = load_config("quick", [*words, f"scenes.test_recordings=[{search[0]}]"])
    assert detector_fit.fit_config(seen, said) == seen
    own_cache.mkdir()
    (own_cache / any_camera_use(any_camera_config(config)).file_name).touch()
    assert detector_fit.fit_config(config, said) == config
    assert len(said.lines) == 1


def same_fit(found, file):
    """Whether a model is that of a file."""
    stored = DetectionProbability.read(file)
    return (found.coefficient == stored.coefficient).all() and found.record["identity"] == stored.record["identity"]


def test_the_fit_for_the_very_camera_comes_first():
    config = load_config("quick", ["rig.free.pitch_deg=null"])
    exact = stored_file(detector_use(config))
    found = detector_fit.ensure_fit(config)
    assert same_fit(found, exact)
    assert found.network_scale == (1.0, 1.0)
    # the same camera, asked for in a run whose cameras are others
    other = load_config("quick", ["rig.free.pitch_deg=null", "camera.fov_deg=120", "camera.width_px=640"])
    assert same_fit(detector_fit.ensure_fit(other, camera=CameraModel(256, 256, math.radians(90.0))), exact)
    assert not same_fit(detector_fit.ensure_fit(other), exact)


@pytest.mark.parametrize(
    ("words", "scale"),
    [
        (["camera.fov_deg=77"], (1.0, 1.0)),
        (["camera.width_px=1920", "camera.height_px=1080", "camera.fov_deg=120"], (1.0, 1.0)),
        (["camera.width_px=1920", "camera.height_px=1080", "detector.input_px=640"], (1 / 3, 1 / 3)),
        (["camera.lens=fisheye", "camera.fov_deg=190", "rig.height_offset_m=0.1"], (1.0, 1.0)),
        (["scenes.ego=bus", "rig.free.fov_deg=[50, 110]"], (1.0, 1.0)),
    ],
)
def test_other_cameras_share_one_fit(words, scale, monkeypatch):
    """What is shipped serves them without any sampling."""
    monkeypatch.setattr(detector_fit, "sample_scenes", None)
    config = load_config("quick", words)
    shared = stored_file(any_camera_use(any_camera_config(load_config("default"))))
    assert shared is not None
    assert shared.parent.name == "models"
    assert stored_file(detector_use(config)) is None
    found = detector_fit.ensure_fit(config)
    assert same_fit(found, shared)
    assert found.network_scale == pytest.approx(scale)


def test_another_network_threshold_or_target_needs_another_fit():
    options = [
        [],
        ["detector.confidence_min=0.3"],
        ["detector.nms_iou_max=0.6"],
        ["detector.iou_min=0.4"],
        ["scenes.targets=[vehicle, pedestrian]"],
        ["camera.supersampling=2"],
        ["visibility.occlusion=pairwise"],
    ]
    configs = [any_camera_config(load_config("quick", words)) for words in options]
    assert len({any_camera_use(config).identity for config in configs}) == len(options)


def outcomes(words, *, scene_count, model):
    """Probabilities of a model, and what the detector found, in scenes that nothing has been fitted on."""
    config = load_config("quick", words)
    seeds = range(500_200, 500_200 + scene_count)
    samples = detector_samples.sample_camera(config, seeds, model, progress=NullProgress())
    return model.of_features(samples.feature), samples.is_detected


def test_the_shipped_fit_is_calibrated_in_a_camera_that_it_has_not_seen():
    words = ["camera.fov_deg=75", "camera.width_px=256", "camera.height_px=192"]
    model = detector_fit.ensure_fit(load_config("quick", words))
    scores = score(*outcomes(words, scene_count=8, model=model), bin_count=5)
    # seen .021, .962 and .42 times that of the base rate, of 358 objects
    assert scores.calibration_error < 0.05
    assert scores.auc > 0.9
    assert scores.brier < 0.75 * scores.brier_base_rate


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["camera.fov_deg=100", "camera.width_px=1280", "camera.height_px=720"],
        ["camera.fov_deg=190", "camera.width_px=640", "camera.height_px=640", "camera.lens=fisheye"],
        ["camera.fov_deg=90", "camera.width_px=1280", "camera.height_px=960", "detector.input_px=640"],
    ],
)
def test_the_shipped_fit_is_calibrated_in_large_images(words, monkeypatch):
    monkeypatch.setattr(detector_samples, "VIEWS_PER_SCENE", 8)
    model = detector_fit.ensure_fit(load_config("quick", words))
    scores = score(*outcomes(words, scene_count=30, model=model))
    # seen .027, .963, .55 times the base rate's; .017, .982, .32; .040, .972, .59
    assert scores.calibration_error < 0.06
    assert scores.auc > 0.9
    assert scores.brier < 0.7 * scores.brier_base_rate


class ScalingObject:
    """A detector object that tells how it scales images."""

    names = ("car",)

    def input_size_px(self, height_px, width_px):
        return 320, 320

    def network_scale(self, height_px, width_px):
        return 320 / width_px, 320 / height_px

    def detect(self, images_rgb):
        raise AssertionError


class PlainObject:
    """A detector object that does not."""

    names = ("car",)

    def detect(self, images_rgb):
        raise AssertionError


def test_a_detector_object_that_tells_its_scale_is_fitted_once(monkeypatch):
    fitted = []

    def fit(config, *, any_camera=False, camera=None, **_):
        fitted.append((any_camera, camera))
        return SimpleNamespace(model=DetectionProbability.unfitted())

    monkeypatch.setattr(detector_fit, "fit", fit)
    cameras = [CameraModel(640, 320), CameraModel(160, 160)]
    scaling, plain = ScalingObject(), PlainObject()
    config = load_config("quick")
    found = [detector_fit.ensure_fit(config, detector=scaling, camera=camera) for camera in (*cameras, cameras[0])]
    assert [each.network_scale for each in found] == [(0.5, 1.0), (2.0, 2.0), (0.5, 1.0)]
    assert fitted == [(True, None)]
    for camera in (*cameras, cameras[0]):
        assert detector_fit.ensure_fit(config, detector=plain, camera=camera).network_scale == (1.0, 1.0)
    assert fitted[1:] == [(False, cameras[0]), (False, cameras[1])]
