"""Captures on disk: what is written is read, interruptions cost nothing, trouble is named."""

import json
import shutil

import cv2
import numpy as np
import pytest

from tests.scene.capture.test_plan import EGO_BOX, ScriptedSimulator
from tests.scene.test_files import edit, remove, replace_image
from warpav.core.errors import InputError
from warpav.scene import CapturedImage, PlanSettings, read_capture
from warpav.scene.capture._folder import DESCRIPTION, check_capture, record_capture

SETTINGS = PlanSettings(
    vehicle_count=2, width_px=48, height_px=32, scene_heights_m=(12.0,), rotation_count=2, ego_side_count=0
)
IMAGE_COUNT = 1 + 2 + 2 + 1 + 2


class PaintingSimulator(ScriptedSimulator):
    """Images of random colours and depths, so that every file differs; counts them, and may be interrupted."""

    def __init__(self, stop_after=None):
        super().__init__()
        self.taken, self.stop_after = [], stop_after

    def begin(self, seed):
        self.seed = seed
        return EGO_BOX

    def capture(self, view):
        if view.name == "visibility":
            return super().capture(view)
        if self.stop_after == len(self.taken):
            raise KeyboardInterrupt
        self.taken.append(view.name)
        rng = np.random.default_rng([self.seed, sum(map(ord, view.name))])
        shape = (view.model.height_px, view.model.width_px)
        depth_m = rng.uniform(0.2, 120.0, shape).astype(np.float32)
        depth_m[rng.random(shape) < 0.2] = np.inf
        rgb = rng.integers(0, 256, (*shape, 3)).astype(np.uint8)
        return CapturedImage(view, rgb, depth_m, rng.choice([0, 1, 2, 65535], shape).astype(np.uint16))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return record_capture(PaintingSimulator(), 7, tmp_path_factory.mktemp("captures") / "scene_7", SETTINGS)


@pytest.fixture
def folder(recorded, tmp_path):
    """A copy that a test may spoil."""
    return shutil.copytree(recorded, tmp_path / "scene_7")


def test_what_is_written_is_read(recorded):
    capture = read_capture(recorded)
    assert (capture.name, capture.source) == ("scripted", "test")
    assert len(capture.images) == IMAGE_COUNT
    assert [vehicle.instance_id for vehicle in capture.vehicles] == [1, 2]
    np.testing.assert_allclose(capture.ego_box.center_m, EGO_BOX.center_m)
    simulator = PaintingSimulator()
    simulator.begin(7)
    for image in capture.images:
        original = simulator.capture(image.view)
        np.testing.assert_array_equal(image.rgb, original.rgb)
        np.testing.assert_array_equal(image.instance, original.instance)
        np.testing.assert_array_equal(np.isinf(image.depth_m), np.isinf(original.depth_m))
        near = np.isfinite(original.depth_m)
        np.testing.assert_allclose(image.depth_m[near], original.depth_m[near], atol=1.1e-3)
    assert list(check_capture(recorded)) == []


def test_depths_may_be_floats(folder):
    description = json.loads((folder / DESCRIPTION).read_text())
    depth_m = read_capture(folder).images[0].depth_m
    np.savez(folder / "images" / "exact.npz", depth_m=depth_m)
    description["images"][0]["depth"] = "images/exact.npz"
    (folder / DESCRIPTION).write_text(json.dumps(description))
    np.testing.assert_array_equal(read_capture(folder).images[0].depth_m, depth_m)


def _truncate(name):
    def spoil(folder):
        file = folder / "images" / name
        file.write_bytes(file.read_bytes()[:100])

    return spoil


def _claim_4_gb(name):
    """The first part behind the header says that it is 4 GB long."""

    def spoil(folder):
        file = folder / "images" / name
        data = file.read_bytes()
        file.write_bytes(data[:33] + b"\xed\x9f\x00\x24" + data[37:])

    return spoil


MIRROR = [[0, 0, 1, 0], [1, 0, 0, 0], [0, -1, 0, 2], [0, 0, 0, 1]]
STRETCHED = [[0, 0, 2, 0], [-1, 0, 0, 0], [0, -1, 0, 2], [0, 0, 0, 1]]
WRONG = [
    (remove("ego_top_rgb.png"), "ego_top_rgb.png: expected an image, got no such"),
    (_truncate("ego_top_depth.png"), "ego_top_depth.png: expected a PNG image, got a file that is truncated"),
    (_claim_4_gb("ego_top_rgb.png"), "ego_top_rgb.png: expected a PNG image, got a file that is truncated"),
    (replace_image("ego_top_depth.png", np.zeros((9, 9), np.uint16)), "ego_top_depth.png: expected 48 x 32 px as"),
    (replace_image("ego_top_rgb.png", np.zeros((32, 48), np.uint8)), r"ego_top_rgb.png: expected uint8 \[32, 48, 3\]"),
    (replace_image("ego_top_instance.png", np.full((32, 48), 9, np.uint16)), "got 9, which has no box there"),
    (edit(images__0__ego_from_camera=MIRROR), r"images\[0\]\.ego_from_camera: expected a rotation .*left-handed"),
    (edit(images__0__ego_from_camera=STRETCHED), r"images\[0\]\.ego_from_camera: expected a rotation .* off by 3"),
    (
        edit(images__0__intrinsics=[[9, 1, 5], [0, 9, 5], [0, 0, 1]]),
        r"images\[0\]\.intrinsics: expected focal lengths",
    ),
    (edit(images__0__intrinsics=[[9, 0, 1e300], [0, 9, 5], [0, 0, 1]]), r"images\[0\]\.intrinsics"),
    (edit(vehicles__0__box_size_m=[4.0, -1.0, 1.0]), r"vehicles\[0\]\.box_size_m\[1\]: expected more than 0, got -1"),
    (edit(vehicles__1__instance_id=1), "vehicles: instance_id: expected each once, got 1 2 times"),
    (edit(images__1__name="ego_top"), "images: name: expected each once, got ego_top 2 times"),
    (edit(vehicles__0__colour="red"), r"vehicles\[0\]\.colour: expected one of .*, got 'colour'"),
    (edit(images__0__rgb="/etc/hostname"), r"images\[0\]\.rgb: expected a file inside .* got '/etc/hostname'"),
    (edit(images__0__depth="../scene_8/d.png"), r"images\[0\]\.depth: expected a file inside the folder"),
    (edit(images__0__instance="a/..\\..\\b.png"), r"images\[0\]\.instance: expected a file inside the folder"),
    (edit(schema="warpav-capture/9"), "schema: expected warpav-capture/1, got 'warpav-capture/9'"),
    (lambda folder: (folder / DESCRIPTION).write_text("{"), r"capture\.json:1: expected valid JSON"),
    (lambda folder: (folder / DESCRIPTION).write_text("[3]"), r"capture\.json:1: expected an object with .* got \[3\]"),
    (lambda folder: (folder / "images" / "ego_top_rgb.png").write_bytes(b""), "ego_top_rgb.png: expected a PNG image"),
]


@pytest.mark.parametrize(("spoil", "message"), WRONG)
def test_trouble_is_named(folder, spoil, message):
    spoil(folder)
    troubles = list(check_capture(folder))
    assert len(troubles) == 1
    with pytest.raises(InputError, match=message):
        list(read_capture(folder).images)


def test_a_vehicle_that_no_image_shows_is_told(folder):
    for file in (folder / "images").glob("*_instance.png"):
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(file), np.where(image == 2, 0, image))
    (trouble,) = check_capture(folder)
    assert trouble.endswith(
        "vehicles: instance_id 2: expected it in some instance image, got none; remove it from the list"
    )


def test_a_box_elsewhere_than_its_pixels_is_told(folder):
    edit(vehicles__0__box_center_m=[0.0, 0.0, 500.0], ego__box_center_m=[0.0, 0.0, -500.0])(folder)
    ego, vehicle = check_capture(folder)
    assert "capture.json: ego: expected its pixels to lie in its 3D box, got none of " in ego
    assert "capture.json: vehicles: instance_id 1: expected its pixels to lie in its 3D box, got none of " in vehicle


def test_a_folder_without_a_capture_is_refused(tmp_path):
    with pytest.raises(InputError, match="expected the description of a capture, got no such file"):
        read_capture(tmp_path)
