"""Detection range: against the model asked by hand, and for what distance, azimuth and rigs must do."""

import math

import numpy as np
import pytest
import warp as wp

from tests.view.stand_ins import ego
from warpav.detection import DetectionProbability, render_images, whole_solid_angle
from warpav.optimisation import LEAST_HEIGHT_PX, DetectionRange
from warpav.optimisation.evaluation._detection_range import _alone, average_contrast
from warpav.raster.camera import CameraModel
from warpav.rig import Rig, RigCamera

MODEL = CameraModel(256, 192, math.radians(70.0))
NEAR_M = (6.0, 15.0, 40.0, 120.0)


def rig(*yaw_deg, model=MODEL, place_m=(1.35, 0.0, 1.5)):
    return Rig(
        RigCamera(f"cam_{k}", np.array(place_m), math.radians(each), 0.0, 0.0, model) for k, each in enumerate(yaw_deg)
    )


@pytest.fixture(scope="module")
def found():
    return DetectionRange.of(rig(0.0), ego(), categories=("saloon",), azimuth_count=8, distances_m=NEAR_M)


def test_the_probability_is_the_models_of_the_area_that_a_render_shows(found):
    """Straight ahead the features are known: the area of the object alone, all of it in the image."""
    model, place_m = DetectionProbability.builtin(MODEL), 15.0
    scene = _alone("saloon", "cpu")
    moved = RigCamera("moved", np.array([-place_m, 0.0, 1.5]), 0.0, 0.0, 0.0, MODEL)
    [image] = render_images(scene, [moved], supersampling=4)
    row, column = np.nonzero(image.object_index == 2)
    extent_px = np.ptp(column) + 1.0, np.ptp(row) + 1.0
    border_px = [column.min(), 256 - column.max() - 1, row.min(), 192 - row.max() - 1]
    least_px = min(border_px) - math.log(sum(math.exp(min(border_px) - each) for each in border_px))
    box_sr = scene.upright_box
    at = wp.array(np.array([[-place_m, 0.0, 1.5]], np.float32), dtype=wp.vec3, device="cpu")
    middle_m = float(box_sr.centre_ego_m.numpy()[0, 2])
    whole_sr = whole_solid_angle(at, box_sr, vehicle_count=1).numpy()[0, 0]
    ray = MODEL.rays(np.stack([column + 0.5, row + 0.5], axis=-1))
    focal_px = float(MODEL.intrinsics[0, 0])
    seen_sr = (np.linalg.norm(ray, axis=1) ** -3).sum() / focal_px**2
    feature = [
        math.log(1.0 + float(image.amodal_area_px[0])),
        1.0,
        seen_sr / whole_sr,
        math.log((extent_px[0] + 1.0) / (extent_px[1] + 1.0)),
        math.log(4.0 + least_px),
        average_contrast(model),
        (middle_m - 1.5) / math.hypot(place_m, middle_m - 1.5),
        1.0,  # the camera is level
    ]
    assert found.probability[0, 0, 1] == pytest.approx(
        float(model.of_features(np.array(feature))), abs=2e-3
    )  # seen 1e-4


def test_the_best_camera_counts_and_pixels_bring_distance(found):
    asked = {"categories": ("saloon",), "azimuth_count": 8, "distances_m": NEAR_M}
    both = DetectionRange.of(rig(0.0, 180.0), ego(), **asked)
    assert both.probability[0, 0] == pytest.approx(found.probability[0, 0])
    assert both.range_m(0.5)[0, 4] > 15.0
    fine = DetectionRange.of(rig(0.0, model=MODEL.resized(384, 288)), ego(), **asked)
    assert fine.range_m(0.5)[0, 0] > 1.2 * found.range_m(0.5)[0, 0]


def test_wide_images_are_drawn_with_fewer_pixels_to_the_same_numbers(monkeypatch):
    asked = {"categories": ("saloon",), "azimuth_count": 8, "distances_m": (8.0, 30.0, 80.0)}
    wide = rig(0.0, model=CameraModel(800, 600, math.radians(70.0)))
    small = DetectionRange.of(wide, ego(), **asked)
    monkeypatch.setattr("warpav.optimisation.evaluation._detection_range._WIDTH_PX_MAX", 800)
    whole = DetectionRange.of(wide, ego(), **asked)
    assert small.probability == pytest.approx(whole.probability, abs=0.02)  # worst seen 0.0013


def test_between_two_distances_the_logit_is_linear():
    logit = np.array([[[2.0, 1.0, -1.0]]])
    table = DetectionRange(("x",), np.zeros(1), (10.0, 20.0, 40.0), 1.0 / (1.0 + np.exp(-logit)))
    assert table.range_m(0.5) == pytest.approx(np.array([[20.0 * 2.0**0.5]]))
    assert table.range_m(0.95) == pytest.approx(np.array([[0.0]]))
    assert table.range_m(0.3)[0, 0] < 40.0
    assert table.range_m(0.1)[0, 0] == 40.0


def test_nothing_is_promised_of_images_smaller_than_the_fit_speaks_for(found):
    """Of a car straight ahead the height in the image is known: it falls with the distance."""
    height_m = float(_alone("saloon", "cpu").upright_box.half_size_m.numpy()[0, 2]) * 2.0
    focal_px = float(MODEL.intrinsics[0, 0])
    limit_m = focal_px * height_m / LEAST_HEIGHT_PX  # from the camera, 0.0 m before the vehicle's middle
    assert found.limit_m()[0, 0] == pytest.approx(limit_m, rel=0.02)
    assert found.limit_m()[0, 4] == 0.0
    assert found.size[0, 0, 1] > 1.0 > found.size[0, 0, 3]
