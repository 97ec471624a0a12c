"""Truth boxes and matches of rendered scenes against brute force on embree images."""

import math

import numpy as np
import pytest
import warp as wp
from scipy import ndimage

from tests.driving_scene import ConstantDetector, camera_pose, on_device, packed_street, street
from tests.oracle.ray_cast import cast_scene
from warpav.detection import Detections, DetectorInLoop, RenderedImage, observe
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer

MODEL = CameraModel(160, 120, math.pi / 2)
POSES = [camera_pose([1.2, 0.1, 1.8], 0.05), camera_pose([0.8, -0.2, 1.8], 3.1), camera_pose([1.0, 0.5, 1.8], 1.5)]


def observed(detector, device, *, supersampling=1, forward_view=(0, 1, 2), **limits):
    renderer = Renderer([MODEL] * 3, supersampling=supersampling, occlusion=Occlusion.EXACT, device=device)
    frame = renderer.render(packed_street(device).raster, *on_device(POSES, device))
    limits = {"confidence_min": 0.1, "iou_min": 0.5, **limits}
    return observe(frame, packed_street(device), detector, forward_view=list(forward_view), **limits)


def true_boxes(object_index, samples, min_area_px=16):
    """Box round the largest 8-connected part of every vehicle, NaN where it is too small."""
    boxes = np.full((10, 4), np.nan)
    for k in range(10):
        label, count = ndimage.label(object_index == 2 + k, structure=np.ones((3, 3)))
        sizes = [np.count_nonzero(label == part) for part in range(1, count + 1)]
        if sizes and max(sizes) >= min_area_px * samples**2:
            row, column = np.nonzero(label == 1 + int(np.argmax(sizes)))
            boxes[k] = np.array([column.min(), row.min(), column.max() + 1, row.max() + 1]) / samples
    return boxes


@pytest.fixture(scope="module")
def boxes_at_pixels():
    rays = cast_scene(street())
    return np.array([true_boxes(rays.look(pose, MODEL).object_index, 1) for pose in POSES])


@pytest.mark.parametrize("supersampling", [1, 2])
def test_truth_boxes_hold_the_largest_visible_part(device, supersampling):
    rays = cast_scene(street())
    expected = [true_boxes(rays.look(pose, MODEL, supersampling).object_index, supersampling) for pose in POSES]
    observation = observed(ConstantDetector.silent(3), device, supersampling=supersampling)
    np.testing.assert_array_equal(np.isnan(observation.truth_box_px), np.isnan(expected))
    np.testing.assert_allclose(observation.truth_box_px, expected, atol=1.0 / supersampling)
    assert np.isfinite(observation.truth_box_px[:, :, 0]).sum() >= 5
    assert (observation.match == -1).all()
    assert not observation.matched_box_px().any()
    assert np.isnan(observation.matched_confidence()).all()


def test_detections_find_their_vehicles(device, boxes_at_pixels):
    # the detector gives every true box in reverse order, plus a false alarm
    cars = [np.flatnonzero(np.isfinite(boxes[:, 0]))[::-1] for boxes in boxes_at_pixels]
    found = [np.r_[boxes[car], [[0, 0, 5, 5]]] for boxes, car in zip(boxes_at_pixels, cars, strict=True)]
    confidence = [np.linspace(0.9, 0.3, len(boxes)) for boxes in found]
    detector = ConstantDetector(found, confidence)
    observation = observed(detector, device)
    for camera, order in enumerate(cars):
        expected = np.full(10, -1)
        expected[order] = np.arange(len(order))
        np.testing.assert_array_equal(observation.match[camera], expected)
        np.testing.assert_allclose(observation.matched_box_px()[camera, order], found[camera][:-1])
        np.testing.assert_allclose(observation.matched_confidence()[camera, order], confidence[camera][:-1], rtol=1e-6)
    # the detector saw the pictures
    rays = cast_scene(street())
    truth = np.array([rays.look(pose, MODEL).rgb for pose in POSES])
    assert detector.images[0].shape == (3, 120, 160, 3)
    assert np.quantile(np.abs(detector.images[0] / 255.0 - truth), 0.999) < 0.5 / 255.0 + 1e-3


def test_weak_and_misplaced_detections_do_not_match(device, boxes_at_pixels):
    boxes = boxes_at_pixels[0][np.isfinite(boxes_at_pixels[0][:, 0])]
    nothing = [np.zeros((0, 4))] * 2
    weak = ConstantDetector([boxes, *nothing], [np.full(len(boxes), 0.09), [], []])
    assert (observed(weak, device).match == -1).all()
    shift = np.tile(0.5 * (boxes[:, 2:] - boxes[:, :2]), 2)
    misplaced = ConstantDetector([boxes + shift, *nothing], [np.full(len(boxes), 0.9), [], []])
    assert (observed(misplaced, device).match == -1).all()
    # the same with a laxer limit: 1/7 of the union is shared
    assert (observed(misplaced, device, iou_min=0.1).match[0] >= 0).any()


def test_a_detection_must_hold_something_of_the_vehicle(device):
    # a post splits the first car: its truth box may overlap a detection that holds only the post
    observation = observed(ConstantDetector.silent(3), device)
    box = observation.truth_box_px[0, 0]
    assert np.isfinite(box).all()
    empty = np.array([box[0], box[1] - 40.0, box[2], box[1] - 1.0])
    detector = ConstantDetector([[empty], [], []], [[0.9], [], []])
    assert (observed(detector, device, iou_min=0.0).match == -1).all()


def test_what_is_found_up_to_a_confidence_is_found_at_all_lower_ones(device, boxes_at_pixels, rng):
    """Against matching again at every threshold, with boxes about every car that contend for it."""
    found, confidence = [], []
    for boxes in boxes_at_pixels:
        cars = boxes[np.isfinite(boxes[:, 0])]
        some = np.repeat(cars, 4, axis=0) + rng.uniform(-6.0, 6.0, (4 * len(cars), 4))
        found.append(some)
        confidence.append(np.sort(rng.uniform(0.1, 0.95, len(some)))[::-1])
    observation = observed(ConstantDetector(found, confidence), device)
    up_to = observation.detected_up_to(0.5)
    assert np.isfinite(up_to).any()
    assert (np.isfinite(up_to) == (observation.match >= 0)).all()
    for threshold in np.r_[0.1, np.concatenate(confidence).astype(np.float32), 0.99]:
        np.testing.assert_array_equal(up_to >= threshold, observation.at(float(threshold), 0.5).match >= 0)


def test_a_detector_that_drops_more_says_the_same_of_the_rest(device, boxes_at_pixels):
    boxes = [each[np.isfinite(each[:, 0])] for each in boxes_at_pixels]
    confidence = [np.linspace(0.9, 0.3, len(each)) for each in boxes]
    observation = observed(ConstantDetector(boxes, confidence), device, confidence_min=0.6)
    fewer = observation.at(0.6, 0.5)
    assert sum(map(len, fewer.detections)) < sum(map(len, observation.detections))
    assert min(found.confidence.min() for found in fewer.detections if len(found)) >= 0.6
    np.testing.assert_array_equal(fewer.match, observation.match)
    np.testing.assert_array_equal(fewer.matched_confidence(), observation.matched_confidence())


class Scene:
    """Something that can be told apart."""


class BrightnessDetector:
    """One box, as sure as the image is bright; fails on black ones."""

    names = ("car",)

    def __init__(self):
        self.calls = []

    def detect(self, images_rgb):
        self.calls.append(len(images_rgb))
        brightness = images_rgb.mean(axis=(1, 2, 3)) / 255.0
        if (brightness == 0.0).any():
            raise ValueError("too dark")
        return [
            Detections(np.array([[1, 1, 5, 5]], np.float32), np.array([b], np.float32), np.zeros(1, np.int32), ("car",))
            for b in brightness
        ]


def picture(scene, camera, pose, brightness):
    image = wp.array(np.full((1, 8, 8, 3), brightness, np.float32), dtype=wp.vec3, device="cpu")
    return RenderedImage(scene, camera, pose, image)


def confidences(found):
    return [round(float(each.confidence[0]), 1) for each in found]


def test_only_what_is_new_is_asked_and_answers_keep_their_order():
    detector, one, other = BrightnessDetector(), Scene(), Scene()
    loop = DetectorInLoop(detector)
    first = loop.ask([picture(one, 0, b"a", 0.2), picture(other, 0, b"a", 0.4)])
    second = loop.ask([picture(one, 1, b"a", 0.6)])
    assert confidences(second()) == [0.6]
    assert confidences(first()) == [0.2, 0.4]
    # an image is known by its scene, camera and pose alone; the middle one has moved
    again = loop.ask([picture(one, 1, b"a", 0.9), picture(one, 0, b"b", 0.8), picture(other, 0, b"a", 0.9)])
    assert confidences(again()) == [0.6, 0.8, 0.4]
    assert detector.calls == [2, 1, 1]
    assert loop.ask([])() == []
    # only the last pose is kept
    assert confidences(loop.ask([picture(one, 0, b"a", 0.1)])()) == [0.1]


def test_what_the_detector_raises_is_raised_and_not_remembered():
    detector, scene = BrightnessDetector(), Scene()
    loop = DetectorInLoop(detector)
    dark = loop.ask([picture(scene, 0, b"a", 0.0), picture(scene, 1, b"a", 0.5)])
    with pytest.raises(ValueError, match="too dark"):
        dark()
    assert confidences(loop.ask([picture(scene, 0, b"a", 0.3), picture(scene, 1, b"a", 0.4)])()) == [0.3, 0.4]


def test_the_image_may_be_written_over_at_once():
    loop, scene = DetectorInLoop(BrightnessDetector()), Scene()
    asked = picture(scene, 0, b"a", 0.7)
    answers = loop.ask([asked])
    asked.image.zero_()
    assert confidences(answers()) == [0.7]
