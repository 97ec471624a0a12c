"""Fitting the probability of detection: known curves are found again, scores equal their definitions."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit
from scipy.stats import binomtest

from tests.driving_scene import ALL_CARS, ConstantDetector, on_device, packed_street, roof
from warpav.detection import (
    MONOTONE,
    VISIBLE_SIZE,
    DetectionSamples,
    fit_probability,
    observe,
    random_cameras,
    sample_detections,
    score,
)
from warpav.detection._probability import FEATURE_COUNT, IN_FRAME_SHARE, VISIBLE_SHARE
from warpav.raster.camera import CameraModel
from warpav.raster.renderer import Renderer

MODEL = CameraModel(128, 128, math.radians(90.0))


def true_logit(feature):
    """Rises with size to a ceiling, with what is visible, and has a hump over the aspect."""
    return 9.0 * expit(feature[:, 0] - 4.0) - 6.0 + 2.0 * feature[:, 1] - 1.5 * feature[:, 3] ** 2


def made_up(rng, count, first_seed=0):
    feature = rng.uniform([0, 0, 0, -1, 1, 0, -0.5, 0.8], [8, 1, 0.7, 1, 5, 0.6, 0.1, 1], (count, FEATURE_COUNT))
    kind = rng.integers(0, 2, count)
    is_detected = rng.random(count) < expit(true_logit(feature) - 2.0 * kind)
    return DetectionSamples(feature, is_detected, first_seed + np.arange(count) % 20, kind)


def test_known_curves_are_found_again(rng):
    model, penalties = fit_probability(made_up(rng, 16000), rng=rng)
    fresh = made_up(rng, 8000, 100)
    found = model.of_features(fresh.feature, fresh.kind)
    error = found - expit(true_logit(fresh.feature) - 2.0 * fresh.kind)
    # worst seen .016 and .008
    assert np.sqrt(np.mean(error**2)) < 0.03
    assert score(found, fresh.is_detected).calibration_error < 0.02
    assert min(penalties) > 0.0


def test_more_to_see_never_lowers_the_probability(rng):
    # outcomes that fall with size and with what is visible, which no fit may follow
    samples = made_up(rng, 1000)
    falling = rng.random(1000) < expit(3.0 - samples.feature[:, 0] - 2.0 * samples.feature[:, 1])
    model, _ = fit_probability(dataclasses.replace(samples, is_detected=falling), rng=rng)
    for f in MONOTONE:
        assert np.diff(model.curve(f, np.linspace(-1.0, 9.0, 300))).min() >= -1e-9


@pytest.mark.parametrize(
    ("count", "chance", "message"),
    [
        (150, 0.5, "200 visible objects.* got 150"),
        (400, 1.0, "400 detected and 0 missed"),
        (400, 0.0, "got 400, 0 det"),
    ],
)
def test_too_little_to_fit_is_refused(rng, count, chance, message):
    samples = made_up(rng, count)
    with pytest.raises(ValueError, match=message):
        fit_probability(dataclasses.replace(samples, is_detected=rng.random(count) < chance), rng=rng)


@given(st.lists(st.tuples(st.floats(0, 1), st.booleans()), min_size=15, max_size=80))
def test_scores_are_what_they_are_called(pairs):
    probability, is_detected = np.array([p for p, _ in pairs]), np.array([d for _, d in pairs])
    if is_detected.all() or not is_detected.any():
        with pytest.raises(ValueError, match="some detected and some not"):
            score(probability, is_detected)
        return
    found = score(probability, is_detected)
    higher = [(p > q) + 0.5 * (p == q) for p in probability[is_detected] for q in probability[~is_detected]]
    assert found.auc == pytest.approx(np.mean(higher))
    assert found.brier == pytest.approx(np.mean((probability - is_detected) ** 2))
    assert found.brier_base_rate == pytest.approx(np.mean((is_detected.mean() - is_detected) ** 2))
    assert sum(each.count for each in found.bins) == len(pairs)
    assert max(each.count for each in found.bins) - min(each.count for each in found.bins) <= 1
    for each in found.bins:
        interval = binomtest(round(each.detected * each.count), each.count).proportion_ci(0.95, method="wilson")
        assert (each.low, each.high) == pytest.approx((interval.low, interval.high), abs=1e-6)
    # no calibration error is larger than the largest gap of a bin, and none smaller than that of all together
    assert found.calibration_error <= max(abs(each.predicted - each.detected) for each in found.bins) + 1e-12
    assert found.calibration_error >= abs(probability.mean() - is_detected.mean()) - 1e-12


def test_what_is_seen_and_found_is_counted(device, rng):
    renderer = Renderer([MODEL] * 6, device=device)
    cameras = random_cameras(rng, roof(), MODEL, height_offset_m=0.2, count=6)
    scene = packed_street(device)
    limits = {"seed": 8, "confidence_min": 0.1, "iou_min": 0.5}
    blind = sample_detections(renderer, scene, cameras, ConstantDetector.silent(6), **limits)
    assert 6 <= len(blind) <= 6 * ALL_CARS
    assert not blind.is_detected.any()
    assert (blind.seed == 8).all()
    assert (blind.feature[:, VISIBLE_SIZE] >= math.log(2.0) - 1e-6).all()
    assert ((blind.feature[:, VISIBLE_SHARE] > 0.0) & (blind.feature[:, VISIBLE_SHARE] <= 1.0 + 1e-6)).all()
    assert ((blind.feature[:, IN_FRAME_SHARE] > 0.0) & (blind.feature[:, IN_FRAME_SHARE] < 1.02)).all()
    # a detector that finds exactly the second camera's objects
    views = on_device([camera.ego_from_camera for camera in cameras], device)
    frame = renderer.render(scene.raster, *views)
    truth = observe(frame, scene, ConstantDetector.silent(6), forward_view=range(6), confidence_min=0.1, iou_min=0.5)
    boxes = truth.truth_box_px[1][np.isfinite(truth.truth_box_px[1, :, 0])]
    answer = [[], boxes, [], [], [], []]
    keen = ConstantDetector(answer, [np.full(len(box), 0.9) for box in answer])
    sharp = sample_detections(renderer, scene, cameras, keen, **limits)
    assert sharp.is_detected.sum() == len(boxes) >= 1
    np.testing.assert_array_equal(sharp.feature, blind.feature)
    assert len(DetectionSamples.join([blind, sharp]).of_seeds([8])) == 2 * len(blind)
    assert len(blind.of_seeds([9])) == 0


def test_cameras_fill_the_free_ranges_and_level_ones_stay_the_same(rng):
    surface = roof()
    ranges = {"pitch_rad": (-0.3, 0.2), "height_m": (0.05, 0.6), "fov_rad": (1.0, 1.9)}
    count = 400
    cameras = random_cameras(np.random.default_rng(1), surface, MODEL, height_offset_m=0.25, count=count, **ranges)
    place = np.array([camera.position_m for camera in cameras])
    height = place[:, 2] - surface.height_at_m(place[:, :2])
    found = [[camera.pitch_rad for camera in cameras], height, [camera.model.fov_rad for camera in cameras]]
    for values, (low, high) in zip(found, ranges.values(), strict=True):
        assert low - 1e-9 <= np.min(values) < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < np.max(values) <= high + 1e-9
    assert np.median(np.log(np.tan(0.5 * np.array(found[2])))) == pytest.approx(
        0.5 * (math.log(math.tan(0.5)) + math.log(math.tan(0.95))), abs=0.1
    )
    level = random_cameras(np.random.default_rng(1), surface, MODEL, height_offset_m=0.25, count=count)
    np.testing.assert_array_equal([camera.position_m[:2] for camera in level], place[:, :2])
    assert [camera.yaw_rad for camera in level] == [camera.yaw_rad for camera in cameras]
    assert {camera.model for camera in level} == {MODEL}
