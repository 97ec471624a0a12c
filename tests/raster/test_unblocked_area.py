"""What the ego vehicle's silhouette leaves free of other vehicles."""

import math

import numpy as np
import pytest

from tests.driving_scene import camera_pose
from tests.raster.bodies import cuboid, rendered, scene_of
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion


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
