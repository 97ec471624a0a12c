"""The picture of requirements, looked at by its colours and places."""

import dataclasses
import math

import numpy as np
from PIL import Image

import warpav as wa
from tests.sight.test_area import box
from warpav.raster.camera import CameraModel
from warpav.sight import Requirement
from warpav.sight._requirement import SIZES_M, Band, Polygon, TestObject
from warpav.view import requirement_map
from warpav.view._palette import COVERAGE_RGB


def count_of(image, rgb):
    return int((np.abs(image.astype(int) - rgb).max(axis=2) <= 2).sum())


def drawn(path, rig, wanted):
    ego = box()
    result = wa.check_requirements(rig, ego, wanted)
    requirement_map(path, result=result, rig=rig, ego=ego)
    with Image.open(path) as image:
        return result, np.array(image.convert("RGB"))


def test_the_colours_are_the_numbers_of_cameras(tmp_path):
    model = CameraModel(320, 240, math.radians(120.0))
    cameras = [wa.Camera(f"c{k}", np.array([2.9, 0.3 * k, 1.8]), 0.0, 0.5, 0.0, model) for k in range(3)]
    post = TestObject("post", SIZES_M["post"])
    # every ghost alone in its box: seen by all, and by none
    ahead = Requirement("ahead", Polygon(((5.0, -1.0), (6.0, -1.0), (6.0, 1.0), (5.0, 1.0))), 0.5, post)
    behind = dataclasses.replace(
        ahead, name="behind", area=Polygon(((-3.0, -1.0), (-2.0, -1.0), (-2.0, 1.0), (-3.0, 1.0)))
    )
    result, image = drawn(tmp_path / "both.png", wa.Rig(cameras), [ahead, behind])
    assert set(result.camera_count.tolist()) == {0, 3}
    _, one = drawn(tmp_path / "one.png", wa.Rig(cameras[:1]), [ahead, behind])
    # beside the legend, which has each colour once
    legend = [count_of(image, COVERAGE_RGB[k]) for k in (1, 2)]
    assert count_of(image, COVERAGE_RGB[0]) > 5 * max(legend)
    assert count_of(image, COVERAGE_RGB[3]) > 5 * max(legend)
    assert count_of(one, COVERAGE_RGB[1]) > 5 * count_of(one, COVERAGE_RGB[3])
    red = np.argwhere(np.abs(image.astype(int) - COVERAGE_RGB[0]).max(axis=2) <= 2)
    blue = np.argwhere(np.abs(image.astype(int) - COVERAGE_RGB[3]).max(axis=2) <= 2)
    assert np.median(red[:, 0]) > 0.6 * image.shape[0] > 0.4 * image.shape[0] > np.median(blue[:, 0])


def test_long_and_round_areas_keep_their_proportions(tmp_path):
    post = TestObject("post", SIZES_M["post"])
    rig = wa.Rig([wa.Camera("c", np.array([2.9, 0.0, 1.8]), 0.0, 0.5, 0.0, CameraModel(320, 240))])
    sizes = []
    for name, area in (
        ("long", Polygon(((-30.0, 2.0), (30.0, 2.0), (30.0, 3.0), (-30.0, 3.0)))),
        ("round", Band((0, 9))),
    ):
        _, image = drawn(tmp_path / f"{name}.png", rig, [Requirement(name, area, 1.5, post)])
        sizes.append(image.shape)
    assert [size[1] for size in sizes] == [1350, 1350]
    assert sizes[1][0] < sizes[0][0] == 1650
