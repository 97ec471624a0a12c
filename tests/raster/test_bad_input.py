"""What cannot be drawn or measured is refused, with the array and the place; nothing is read out of bounds."""

import numpy as np
import pytest
import warp as wp

from tests.driving_scene import camera_pose, on_device, packed_street
from warpav.core.errors import InputError
from warpav.raster import buffers as buffers_module
from warpav.raster.areas import AMODAL_AREA
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.renderer import Renderer

MODEL = CameraModel(64, 48)
POSES = np.array([camera_pose([0.0, 0.0, 1.8], yaw) for yaw in (0.0, 1.0, 2.0)])


@pytest.mark.parametrize(
    ("size", "supersampling", "message"),
    [
        ((0, 48), 1, "at least 8 x 8 whole pixels, got 0 x 48"),
        ((64, 0), 1, "at least 8 x 8 whole pixels, got 64 x 0"),
        ((64, -48), 1, "at least 8 x 8 whole pixels, got 64 x -48"),
        ((64, 48), 0, "a whole number of at least 1, got 0"),
        ((64, 48), 1.5, "a whole number of at least 1, got 1.5"),
        ((64, 48), 1000, "64 x 48 pixels with supersampling 1000 are more than"),
        ((2**31, 8), 1, "2147483648 x 8 pixels with supersampling 1 are more than"),
    ],
)
def test_images_without_pixels_or_with_too_many_are_refused(size, supersampling, message):
    with pytest.raises(ValueError, match=message):
        Renderer([CameraModel(*size)], supersampling=supersampling)


def test_every_array_of_a_view_fits_strides_of_32_bits():
    # keys have 8 bytes, colours 12, reaches 8 for each of four directions in rows of their own
    assert 12 * buffers_module._MAX_VIEW_SAMPLES < 2**31
    assert 8 * buffers_module._MAX_ATLAS_SAMPLES < 2**31
    # 4K images with four samples along each axis fit
    assert buffers_module._MAX_VIEW_SAMPLES > (4 * 3840 + 2) * (4 * 2160 + 2)


def test_silhouettes_that_do_not_fit_are_refused(device, monkeypatch):
    monkeypatch.setattr(buffers_module, "_MAX_ATLAS_SAMPLES", 1000)
    with pytest.raises(ValueError, match=r"3 views of 66 x 50 samples need \d+ samples, more than 800; render fewer"):
        Renderer([MODEL] * 3, device=device).render(packed_street(device).raster, *on_device(POSES, device))


def test_what_was_not_rendered_is_not_measured(device):
    scene, other = packed_street(device).raster, packed_street(device, 3).raster
    renderer = Renderer([MODEL] * 3, device=device)
    weight = wp.ones((48, 64), dtype=float, device=device)
    calls = (
        lambda it: it.measure(),
        lambda it: it.areas(),
        lambda it: it.extents(),
        lambda it: it.weighted_area(weight, visible=False),
        lambda it: it.window_area(visible=False),
        lambda it: it.colours(),
        lambda it: it.depths_and_ids(),
        lambda it: it.depths(background_m=100.0),
        lambda it: it.silhouettes(),
        lambda it: it.visible_masks([0]),
        lambda it: it.depth_m,
        lambda it: it.rgb,
    )
    frame = renderer.render(scene, *on_device(POSES, device))
    for call in calls[:-2]:
        call(frame)
    renderer.render(other, *on_device(POSES, device))
    for call in calls:
        with pytest.raises(InputError, match="frame: expected the last render of its renderer, got a stale one"):
            call(frame)
    images = renderer.render(scene, *on_device(POSES, device), content=Content.IMAGES)
    with pytest.raises(InputError, match="with content objects, got one that holds images only"):
        images.measure()
    alone = renderer.render(scene, *on_device(POSES, device), content=Content.OBJECTS)
    alone.window_area(visible=False)
    with pytest.raises(InputError, match="with content measures, got one that holds objects only"):
        alone.window_area(visible=True)


def test_arrays_of_another_shape_are_refused(device):
    scene = packed_street(device, 3).raster
    renderer = Renderer([MODEL] * 3, device=device)
    frame = renderer.render(scene, *on_device(POSES, device))
    for shape in ((3, 2), (2, 3), (0, 0)):
        with pytest.raises(ValueError, match=r"box_px must be \(3, 3\), got"):
            frame.measure(wp.zeros(shape, dtype=wp.vec4, device=device))
    for shape in ((64, 48), (2, 48, 64)):
        with pytest.raises(ValueError, match=r"must be \(48, 64\), \(3, 48, 64\) or \(3, 3, 48, 64\), got"):
            frame.weighted_area(wp.ones(shape, dtype=float, device=device), visible=True)
    with pytest.raises(ValueError, match="weight_image must hold float32, got float64"):
        frame.weighted_area(wp.ones((48, 64), dtype=wp.float64, device=device), visible=True)
    measures = frame.measure()
    with pytest.raises(ValueError, match=r"must be \(3, 3, 1\), got \(3, 3, 7\)"):
        frame.weighted_area(wp.ones((48, 64), dtype=float, device=device), visible=True, into=measures)
    for shown in ([3], [-1], [0, 7]):
        with pytest.raises(ValueError, match=r"views must be 0\.\.2, got"):
            frame.colours(views=shown)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30, -1e30])
@pytest.mark.parametrize("part", [np.s_[1, :3, 3], np.s_[1, :3, :3], np.s_[1, 2, 3]], ids=["place", "turn", "height"])
def test_a_pose_without_meaning_sees_nothing_and_harms_no_other(device, value, part):
    scene = packed_street(device).raster
    renderer = Renderer([MODEL] * 3, device=device)
    frame = renderer.render(scene, *on_device(POSES, device))
    expected = [frame.measure().value.numpy(), frame.colours().numpy()]
    poses = POSES.copy()
    poses[part] = value
    frame = renderer.render(scene, *on_device(poses, device))
    value = frame.measure().value.numpy()
    for one, other in zip(expected, (value, frame.colours().numpy()), strict=True):
        np.testing.assert_array_equal(one[[0, 2]], other[[0, 2]])
    assert not value[1, :, AMODAL_AREA].any()
