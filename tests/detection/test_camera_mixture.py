"""Cameras of all kinds through windows of their images: a window shows what the whole image shows there."""

import math

import numpy as np
import pytest
import warp as wp

from tests.driving_scene import packed_street, roof
from warpav.detection import Window, mixed_camera, windows_of
from warpav.detection._camera_mixture import _WINDOWS_PX, window_model
from warpav.detection.families._family import ImagePlacement, Letterbox
from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens
from warpav.raster.renderer import Renderer
from warpav.rig import RigCamera


class Network:
    """Scales images as an ONNX detector does, whose input is ``input_px`` rows and columns; None: as the image."""

    def __init__(self, input_px=None, placement=ImagePlacement.CENTRED):
        self.input_px, self.placement = input_px, placement

    def input_size_px(self, height_px, width_px):
        return self.input_px or (math.ceil(height_px / 32) * 32, math.ceil(width_px / 32) * 32)

    def network_scale(self, height_px, width_px):
        box = Letterbox.fit(height_px, width_px, *self.input_size_px(height_px, width_px), self.placement)
        return box.scaled_width_px / width_px, box.scaled_height_px / height_px


def image_of(model, position_ego_m, camera_from_ego):
    scene = packed_street()
    renderer = Renderer([model])
    frame = renderer.render(
        scene.raster,
        wp.array(position_ego_m[None].astype(np.float32), dtype=wp.vec3),
        wp.array(camera_from_ego[None].astype(np.float32), dtype=wp.mat33),
    )
    return frame.rgb.numpy()[0], frame.object_id.numpy()[0]


@pytest.mark.parametrize("lens", [Lens.PINHOLE, Lens.FISHEYE])
def test_a_window_shows_what_the_whole_image_shows_there(lens):
    model = CameraModel(320, 240, math.radians(100.0 if lens is Lens.PINHOLE else 180.0), lens=lens)
    camera = RigCamera("camera", np.array([0.0, 0.0, 1.9]), 0.3, 0.1)
    transform = camera.ego_from_camera
    corner_px, size_px = np.array([170, 70]), np.array([96, 64])
    window = window_model(model, corner_px, size_px)
    whole_rgb, whole_id = image_of(model, transform[:3, 3], transform[:3, :3].T)
    rgb, object_id = image_of(window, transform[:3, 3], transform[:3, :3].T)
    part = (slice(70, 70 + 64), slice(170, 170 + 96))
    assert len(np.unique(object_id)) > 2
    # rounding moves an edge across a pixel's centre here and there: none seen of 6144 pixels
    assert np.mean(object_id != whole_id[part]) < 0.002
    assert np.mean(np.abs(rgb - whole_rgb[part]).max(axis=-1) > 0.02) < 0.005


def test_windows_are_small_and_reach_the_network_pixel_by_pixel():
    assert [(each.width_px, each.height_px, each.count) for each in windows_of(Network())] == list(_WINDOWS_PX)
    for network in (Network((640, 640)), Network((384, 640)), Network((640, 640), ImagePlacement.STRETCHED)):
        windows = windows_of(network)
        assert not any(window.is_cut for window in windows)
        # each pixel of the network has been one of the image, unless the network makes an image smaller
        assert all(max(network.network_scale(each.height_px, each.width_px)) <= 640 / 360 + 1e-9 for each in windows)
        assert network.network_scale(windows[0].height_px, windows[0].width_px)[0] <= 1.0
        pixels = sum(each.count for each in windows) * np.prod(network.input_size_px(256, 256))
        assert 1e6 < pixels < 1.2e7


def test_cut_windows_show_objects_and_stay_in_the_image(rng):
    scene = packed_street()
    middle_m = scene.upright_box.centre_ego_m.numpy()[: scene.vehicle_count].astype(float)
    window = Window(256, 256, 1, is_cut=True)
    showing, heights_m, lenses, focal_px = 0, [], set(), []
    for _ in range(200):
        camera = mixed_camera(
            rng, window, surface=roof(), ego_bounds_m=scene.ego_bounds_m, object_ego_m=middle_m, near_m=0.1
        )
        model = camera.model
        assert (model.width_px, model.height_px) == (256, 256)
        place_px = model.project((middle_m - camera.position_m) @ camera.ego_from_camera[:3, :3])
        showing += bool(((place_px >= 0) & (place_px <= 256)).all(axis=1).any())
        heights_m.append(camera.position_m[2])
        lenses.add(model.lens)
        focal_px.append(model.intrinsics[0, 0])
    assert showing > 190
    # bumpers and roofs of buses, wide fisheyes of few pixels and long lenses of many
    assert min(heights_m) < 0.6
    assert max(heights_m) > 2.8
    assert lenses == {Lens.PINHOLE, Lens.FISHEYE}
    assert min(focal_px) < 130.0
    assert max(focal_px) > 1000.0
