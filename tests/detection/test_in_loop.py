"""The detector in the loop: what it remembers, forgets and passes on."""

import gc
import weakref

import numpy as np
import pytest
import warp as wp

from warpav.detection.detector import Detections
from warpav.detection.observe import DetectorInLoop, RenderedImage


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


def test_scenes_are_not_kept_alive():
    loop, scene = DetectorInLoop(BrightnessDetector()), Scene()
    loop.ask([picture(scene, 0, b"a", 0.7)])()
    gone = weakref.ref(scene)
    del scene
    gc.collect()
    assert gone() is None
