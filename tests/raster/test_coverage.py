"""What a render without outlines and images says: the same as one with them, and colours as a reading of the images."""

import math

import numpy as np
import pytest
import warp as wp

from tests.driving_scene import camera_pose, on_device, packed_street, random_poses
from tests.raster.bodies import cuboid, rendered, scene_of
from tests.raster.test_lenses import MODELS as LENSES
from tests.raster.test_renderer import poses_on_ego
from warpav.raster.areas import BOTTOM, BOX_AREA, LEFT, RIGHT, TOP, VISIBLE_AREA
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer

MODEL = CameraModel(96, 72, math.pi / 2, 0.1)
POINTS = 24


def poses_of(rng):
    """On the roof, all round and below, and one that sees no car."""
    return np.r_[poses_on_ego(rng, 6), random_poses(rng, 6), [camera_pose([1.0, 0.0, 1.8], 0.3, -1.5)]]


def spoilt(renderer):
    """Fill what a render writes to with nonsense, so that only what it writes counts."""
    buffers = renderer
    for array in (buffers.key, buffers.layers.inverse_depth_bits, buffers.hiding.bits):
        array.fill_(-7)
    for array in buffers._kept.values():
        if array.dtype is wp.float32:
            array.fill_(math.nan)


@pytest.mark.parametrize("occlusion", list(Occlusion), ids=lambda occlusion: occlusion.value)
@pytest.mark.parametrize("supersampling", [1, 2, 3])
def test_coverage_is_what_is_measured_with_jacobians(device, rng, supersampling, occlusion):
    poses, scene = poses_of(rng), packed_street(device).raster
    options = {"supersampling": supersampling, "occlusion": occlusion, "device": device}
    whole = Renderer([MODEL] * len(poses), **options).render(scene, *on_device(poses, device))
    renderer = Renderer([MODEL] * len(poses), **options)
    renderer.render(scene, *on_device(poses[::-1], device), content=Content.COVERAGE)
    spoilt(renderer)
    frame = renderer.render(scene, *on_device(poses, device), content=Content.COVERAGE)
    found, expected = frame.coverage(), whole.measure()
    np.testing.assert_array_equal(found.value.numpy(), expected.value.numpy())
    assert not found.value.numpy()[..., BOX_AREA].any()
    # the lanes of a GPU add in another order
    np.testing.assert_allclose(
        found.solid_angle_sr.numpy(),
        whole.window_area(visible=False).value.numpy(),
        rtol=0.0 if device == "cpu" else 1e-5,
    )
    np.testing.assert_allclose(
        found.visible_sr.numpy(),
        whole.window_area(visible=True).value.numpy(),
        rtol=0.0 if device == "cpu" else 1e-5,
    )
    if occlusion is Occlusion.EXACT:
        weight = wp.array(rng.random((frame.height_px, frame.width_px)), dtype=float, device=device)
        weighed = whole.weighted_area(weight).value.numpy()
        np.testing.assert_allclose(frame.weighted_coverage(weight).numpy(), weighed, rtol=1e-5)
        images = Renderer([MODEL] * len(poses), **options)
        images = images.render(scene, *on_device(poses, device), content=Content.IMAGES)
        np.testing.assert_allclose(images.weighted_coverage(weight).numpy(), weighed, rtol=1e-5)
    contrast = whole.contrast(expected.value).numpy()
    np.testing.assert_array_equal(frame.contrast(found.value).numpy(), contrast)
    # a render of everything can be asked as well
    np.testing.assert_array_equal(whole.coverage().value.numpy(), expected.value.numpy())
    # images show no object where occluders alone hide
    assert np.count_nonzero(contrast) >= 15 or occlusion is Occlusion.OCCLUDERS
    assert not found.value.numpy()[-1, :, VISIBLE_AREA].any()


@pytest.mark.parametrize("name", LENSES)
def test_other_lenses_are_covered_alike(device, rng, name):
    poses, scene = poses_of(rng), packed_street(device, 4).raster
    models = [LENSES[name]] * len(poses)
    whole = Renderer(models, device=device).render(scene, *on_device(poses, device))
    frame = Renderer(models, device=device).render(scene, *on_device(poses, device), content=Content.COVERAGE)
    found, expected = frame.coverage(), whole.measure()
    np.testing.assert_array_equal(found.value.numpy(), expected.value.numpy())
    np.testing.assert_array_equal(frame.contrast(found.value).numpy(), whole.contrast(expected.value).numpy())
    np.testing.assert_allclose(
        found.solid_angle_sr.numpy(), whole.window_area(visible=False).value.numpy(), rtol=1e-5, atol=1e-9
    )
    assert (found.value.numpy()[..., VISIBLE_AREA] > 0).sum() >= 5


@pytest.mark.parametrize("supersampling", [1, 2])
def test_contrast_is_read_from_the_images(device, rng, supersampling):
    poses, scene = poses_of(rng), packed_street(device).raster
    renderer = Renderer([MODEL] * len(poses), supersampling=supersampling, device=device)
    frame = renderer.render(scene, *on_device(poses, device))
    value = frame.measure().value
    image, index = frame.colours().numpy().astype(float), frame.depths_and_ids()[1].numpy()
    found, measure = frame.contrast(value).numpy(), value.numpy().astype(float)
    compared = 0
    for v, k in np.ndindex(found.shape):
        left, right, top, bottom = measure[v, k, [LEFT, RIGHT, TOP, BOTTOM]]
        expected = 0.0
        if right > left and bottom > top:
            wide, high = 0.25 * (right - left) + 2, 0.25 * (bottom - top) + 2
            low = np.maximum([left - wide, top - high], 0.0)
            size = np.minimum([right + wide, bottom + high], [96, 72]) - low
            share = (np.arange(POINTS) + 0.5) / POINTS
            columns, rows = (low[:, None] + share * size[:, None]).astype(int)
            own = index[v][np.ix_(rows, columns)] == k
            colours = image[v][np.ix_(rows, columns)]
            if own.any() and not own.all():
                expected = np.linalg.norm(colours[own].mean(axis=0) - colours[~own].mean(axis=0))
                compared += 1
        # worst seen 2e-6; in single precision a point may fall into the next pixel
        assert found[v, k] == pytest.approx(expected, abs=2e-3 if expected else 0.0)
    assert compared >= 15


@pytest.mark.equation(17)
@pytest.mark.parametrize("occlusion", list(Occlusion))
def test_unblocked_area_is_what_lies_outside_the_ego_silhouette(device, occlusion):
    # a car behind the ego vehicle's bonnet and behind another car, and a pole between cameras and bonnet
    car, other = cuboid([4.2, 1.8, 1.5], [12.0, 0.8, 0.75]), cuboid([4.2, 1.8, 1.5], [8.0, 0.2, 0.75])
    bonnet, pole = cuboid([1.6, 1.0, 0.6], [1.9, 0.2, 1.2]), cuboid([0.05, 0.05, 1.0], [0.8, 0.3, 1.5])
    model = CameraModel(96, 64, math.radians(80.0))
    poses = np.array([camera_pose([0.1, 0.4 - 0.2 * k, 1.75], 0.05 * k, 0.1) for k in range(4)])
    scene = scene_of([car, other, pole], ego=bonnet)
    _, frame = rendered(scene, poses, model, device, occlusion=occlusion, foreground_layer=True)
    before = frame.measure().value.numpy().copy()
    # the bonnet as a vehicle of its own: what each covers alone, as pixels
    apart = scene_of([car, other, pole, bonnet])
    alone = []
    for k in range(4):
        _, drawn = rendered(scene_of([apart.vehicles[k].mesh]), poses, model, device)
        masks = np.zeros((4, 64, 96), bool)
        for view, [(left, top, mask)] in enumerate(drawn.visible_masks(range(4))):
            masks[view, top : top + mask.shape[0], left : left + mask.shape[1]] = mask
        alone.append(masks)
    expected = np.stack([(alone[k] & ~alone[3]).sum(axis=(1, 2)) for k in range(3)], axis=1)
    measures = frame.unblocked_area()
    np.testing.assert_array_equal(measures.value.numpy()[..., 0], expected)
    assert (expected[:, 0] < alone[0].sum(axis=(1, 2))).all()
    # the pole stands nearer than the bonnet, which hides it all the same, as printed
    assert (expected[:, 2] < alone[2].sum(axis=(1, 2))).all()
    # it leaves what the renderer holds alone, and writes over an earlier result
    np.testing.assert_array_equal(frame.measure().value.numpy(), before)
    measures.value.fill_(math.nan)
    assert frame.unblocked_area(into=measures) is measures
    np.testing.assert_array_equal(measures.value.numpy()[..., 0], expected)
