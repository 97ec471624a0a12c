"""Areas, extents and masks against brute-force counts of embree silhouettes."""

import dataclasses
import math

import numpy as np
import pytest
import warp as wp

from tests.driving_scene import block, camera_pose, car, on_device, packed_street, random_poses, street, vehicle
from tests.oracle.occlusion import extents, pairwise_hidden
from tests.oracle.ray_cast import Silhouettes, cast_scene
from tests.raster.test_renderer import FAR_AWAY, poses_on_ego
from warpav.raster.areas import AMODAL_AREA, BOTTOM, BOX_AREA, LEFT, RIGHT, TOP, VISIBLE_AREA
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.mesh import merge
from warpav.raster.renderer import Renderer
from warpav.scene import DeviceScene, Scene

MODEL = CameraModel(96, 72, math.pi / 2, 0.1)


@pytest.fixture(scope="module")
def street_silhouettes():
    return Silhouettes(street())


def rendered(scene, poses, model=MODEL, *, device="cpu", box_px=None, **settings):
    renderer = Renderer([model] * len(poses), device=device, **settings)
    frame = renderer.render(scene, *on_device(poses, device))
    box = None if box_px is None else wp.array(np.asarray(box_px, np.float32), dtype=wp.vec4, device=device)
    return frame, frame.measure(box).value.numpy()


def full_masks(frame, scene, views, shape):
    """`Frame.visible_masks` pasted into whole images, bool [view, vehicle, row, column]."""
    masks = np.zeros((len(views), scene.object_count, *shape), bool)
    for v, row_of_masks in enumerate(frame.visible_masks(views)):
        for k, (left, top, mask) in enumerate(row_of_masks):
            assert left >= 0
            assert top >= 0
            masks[v, k, top : top + mask.shape[0], left : left + mask.shape[1]] = mask
    return masks


@pytest.mark.parametrize("supersampling", [1, 2])
def test_areas_extents_and_masks_equal_counts(device, rng, street_silhouettes, supersampling):
    poses = np.r_[poses_on_ego(rng, 4), random_poses(rng, 4)]
    scene = packed_street(device).raster
    boxes = np.sort(rng.uniform(-20, 110, (8, 10, 2, 2)), axis=2).reshape(8, 10, 4)
    frame, value = rendered(scene, poses, device=device, box_px=boxes, supersampling=supersampling)
    masks = full_masks(frame, scene, range(8), (72 * supersampling, 96 * supersampling))
    rays = cast_scene(street())
    centre_x, centre_y = np.meshgrid(
        (np.arange(96 * supersampling) + 0.5) / supersampling, (np.arange(72 * supersampling) + 0.5) / supersampling
    )
    per_sample = 1.0 / supersampling**2
    slack = 2 * per_sample  # worst seen 0 samples; embree and the rasteriser may differ on an edge
    seen_extents = 0
    for v, pose in enumerate(poses):
        alone, _ = street_silhouettes.look(pose, MODEL, supersampling)
        together = rays.look(pose, MODEL, supersampling).object_index
        for k in range(10):
            amodal, visible = np.isfinite(alone[k]), together == 2 + k
            x0, y0, x1, y1 = boxes[v, k]
            in_box = (centre_x >= x0) & (centre_x < x1) & (centre_y >= y0) & (centre_y < y1)
            assert value[v, k, AMODAL_AREA] == pytest.approx(amodal.sum() * per_sample, abs=slack)
            assert value[v, k, VISIBLE_AREA] == pytest.approx(visible.sum() * per_sample, abs=slack)
            assert value[v, k, BOX_AREA] == pytest.approx((visible & in_box).sum() * per_sample, abs=slack)
            assert np.count_nonzero(masks[v, k] != visible) <= 2
            ends = extents(amodal)
            if ends is None:
                assert value[v, k, [LEFT, RIGHT, TOP, BOTTOM]] == pytest.approx([96, 0, 72, 0])
            else:
                seen_extents += 1
                assert value[v, k, [LEFT, RIGHT, TOP, BOTTOM]] == pytest.approx(
                    np.array(ends) / supersampling, abs=1.0 / supersampling
                )
    assert seen_extents >= 15


def test_pairwise_occlusion_equals_medians(device, rng, street_silhouettes):
    # where cars hide one another
    poses = [
        camera_pose([rng.uniform(0, 2), rng.uniform(-0.7, 0.7), 1.7], (k % 4) * 0.5 * math.pi + rng.uniform(-0.3, 0.3))
        for k in range(12)
    ]
    scene = packed_street(device).raster
    frame, value = rendered(scene, poses, device=device, occlusion=Occlusion.PAIRWISE)
    masks = full_masks(frame, scene, range(12), (72, 96))
    overlaps = 0
    for v, pose in enumerate(poses):
        alone, ego = street_silhouettes.look(pose, MODEL)
        hidden = pairwise_hidden(alone, ego)
        truth = np.isfinite(alone) & ~hidden
        overlaps += np.count_nonzero((hidden & ~np.isfinite(ego)).any(axis=(1, 2)))
        # worst seen 0 pixels
        assert np.abs(value[v, :, VISIBLE_AREA] - truth.sum(axis=(1, 2))).max() <= 2
        assert np.count_nonzero(masks[v] != truth) <= 2
    assert overlaps >= 8


def place_cars(*places):
    """A scene of equal cars and nothing else."""
    rng = np.random.default_rng(4)
    prototype = car(rng)
    vehicles = tuple(vehicle(k + 1, prototype, x, y, yaw) for k, (x, y, yaw) in enumerate(places))
    return Scene("cars", FAR_AWAY, FAR_AWAY, vehicles)


@pytest.mark.parametrize("swapped", [False, True])
def test_a_silhouette_inside_another_is_hidden_or_hides_by_depth(device, swapped):
    # straight behind: the far car's silhouette lies wholly inside the near one's
    places = [(8.0, 0.0, 0.0), (20.0, 0.0, 0.0)]
    scene = place_cars(*(places[::-1] if swapped else places))
    near, far = (1, 0) if swapped else (0, 1)
    pose = camera_pose([0.0, 0.0, 0.6], 0.0)
    alone, _ = Silhouettes(scene).look(pose, MODEL)
    assert not (np.isfinite(alone[far]) & ~np.isfinite(alone[near])).any()
    packed = DeviceScene.pack(scene, device=device).raster
    for occlusion in Occlusion:
        _, value = rendered(packed, [pose], device=device, occlusion=occlusion)
        is_ghost = occlusion is Occlusion.OCCLUDERS
        assert value[0, far, VISIBLE_AREA] == (value[0, far, AMODAL_AREA] if is_ghost else 0.0)
        assert value[0, near, VISIBLE_AREA] == value[0, near, AMODAL_AREA] > 100
        assert value[0, far, AMODAL_AREA] > 10


def test_only_the_parts_outside_the_overlap_are_compared(device):
    # a vehicle of two parts: the large one, before the other vehicle, overlaps it; the small one, behind, does not
    rng = np.random.default_rng(4)
    split = vehicle(1, merge([block(rng, [1, 2, 2], [5, 0, 1]), block(rng, [1, 4, 2], [20, 13, 1])]), 0.0, 0.0, 0.0)
    whole = vehicle(2, block(rng, [1, 8, 8], [10, 0, 1]), 0.0, 0.0, 0.0)
    scene = Scene("split", FAR_AWAY, FAR_AWAY, (split, whole))
    pose = camera_pose([0.0, 0.0, 1.0], 0.0)
    alone, ego = Silhouettes(scene).look(pose, MODEL)
    truth = np.isfinite(alone) & ~pairwise_hidden(alone, ego)
    assert 0 < truth[0].sum() < 0.3 * np.isfinite(alone[0]).sum()  # hidden as the printed rule has it
    _, value = rendered(
        DeviceScene.pack(scene, device=device).raster, [pose], device=device, occlusion=Occlusion.PAIRWISE
    )
    np.testing.assert_allclose(value[0, :, VISIBLE_AREA], truth.sum(axis=(1, 2)), atol=2)


def test_pairwise_occlusion_ignores_the_environment_and_exact_does_not(device):
    rng = np.random.default_rng(4)
    wall = block(rng, [0.2, 40.0, 10.0], [4.0, 0.0, 0.0])
    scene = dataclasses.replace(place_cars((10.0, 0.0, 0.5)), environment=wall)
    packed = DeviceScene.pack(scene, device=device).raster
    pose = camera_pose([0.0, 0.0, 0.8], 0.0)
    visible = {
        occlusion: rendered(packed, [pose], device=device, occlusion=occlusion)[1][0, 0, VISIBLE_AREA]
        for occlusion in Occlusion
    }
    assert visible[Occlusion.EXACT] == 0.0
    assert visible[Occlusion.PAIRWISE] > 50
