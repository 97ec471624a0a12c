"""Chunks of views are the same views, and need no more memory the more there are."""

import math

import numpy as np
import pytest
import warp as wp

from tests.driving_scene import camera_pose, on_device, packed_street
from warpav.core.errors import InputError
from warpav.raster.camera import CameraModel
from warpav.raster.chunks import chunk_view_count, render_in_chunks
from warpav.raster.renderer import Renderer

VIEWS = 7


def poses(rng, count):
    places = np.c_[rng.uniform(0, 3, count), rng.uniform(-1, 1, count), np.full(count, 1.8)]
    return np.stack([camera_pose(place, rng.uniform(-3, 3), 0.1) for place in places])


def test_chunks_hold_the_views_of_one_render(device, rng):
    models = [CameraModel(96, 64, math.radians(fov_deg), 0.1) for fov_deg in rng.uniform(50, 110, VIEWS)]
    pose, scene = poses(rng, VIEWS), packed_street(device).raster
    whole = Renderer(models, device=device).render(scene, *on_device(pose, device))
    depth_m, object_id = (array.numpy() for array in whole.depths_and_ids())
    value = whole.measure().value.numpy()
    seen = np.zeros(VIEWS, int)
    for views, frame in render_in_chunks(
        scene, models, pose[:, :3, 3], pose[:, :3, :3].transpose(0, 2, 1), views_at_once=3, device=device
    ):
        count = views.stop - views.start
        seen[views] += 1
        chunk_depth_m, chunk_object = (array.numpy()[:count] for array in frame.depths_and_ids())
        np.testing.assert_array_equal(chunk_depth_m, depth_m[views])
        np.testing.assert_array_equal(chunk_object, object_id[views])
        np.testing.assert_array_equal(frame.measure().value.numpy()[:count], value[views])
    np.testing.assert_array_equal(seen, 1)


def test_images_can_be_written_over(device, rng):
    pose, scene = poses(rng, 2), packed_street(device).raster
    renderer = Renderer([CameraModel(64, 48)] * 2, device=device)
    frame = renderer.render(scene, *on_device(pose, device))
    fresh = [array.numpy() for array in (*frame.depths_and_ids(), frame.colours())]
    old = [wp.array(np.full_like(array, -7), dtype=dtype, device=device)
           for array, dtype in zip(fresh, (float, wp.int32, wp.vec3), strict=True)]  # fmt: skip
    images = frame.depths_and_ids(into=(old[0], old[1]))
    assert images == (old[0], old[1])
    assert frame.colours(into=old[2]) is old[2]
    for one, other in zip(fresh, old, strict=True):
        np.testing.assert_array_equal(one, other.numpy())
    # parts of larger images, and every other of their columns
    large_m = wp.full((2, 50, 140), -7.0, dtype=float, device=device)
    large_id = wp.full((2, 50, 140), -7, dtype=wp.int32, device=device)
    part = (slice(None), slice(1, 49), slice(3, 131, 2))
    frame.depths_and_ids(into=(large_m[part], large_id[part]))
    for one, other in zip(fresh, (large_m, large_id), strict=False):
        np.testing.assert_array_equal(one, other.numpy()[part])
        assert np.count_nonzero(other.numpy() == -7) == other.size - one.size
    with pytest.raises(ValueError, match=r"expected images of shape \(1, 48, 64\), got \(2, 48, 64\)"):
        frame.colours(views=[0], into=old[2])


def test_a_renderer_can_be_used_again(device, rng):
    model = CameraModel(64, 64)
    pose, scene = poses(rng, 4), packed_street(device).raster
    renderer = Renderer([model] * 2, device=device)
    chunks = list(
        render_in_chunks(
            scene, [model] * 4, pose[:, :3, 3], pose[:, :3, :3].transpose(0, 2, 1), renderer=renderer, device=device
        )
    )
    assert [views for views, _ in chunks] == [slice(0, 2), slice(2, 4)]
    with pytest.raises(InputError, match="got a stale one"):
        chunks[0][1].areas()
    assert chunks[1][1].areas().visible.shape[0] == 2


def test_chunks_are_bounded_in_memory():
    assert chunk_view_count(CameraModel(256, 256)) == 64
    assert chunk_view_count(CameraModel(1920, 1080), supersampling=2) == 4
    assert chunk_view_count(CameraModel(4096, 4096), supersampling=8) == 1


def test_wrong_numbers_of_views_are_refused(rng):
    pose, scene = poses(rng, 2), packed_street("cpu").raster
    rotation = pose[:, :3, :3].transpose(0, 2, 1)
    with pytest.raises(ValueError, match="got 3, 2 and 2"):
        next(render_in_chunks(scene, [CameraModel()] * 3, pose[:, :3, 3], rotation))
    with pytest.raises(ValueError, match="views_at_once must be at least 1, got 0"):
        next(render_in_chunks(scene, [CameraModel()] * 2, pose[:, :3, 3], rotation, views_at_once=0))
    with pytest.raises(ValueError, match="expected 2 camera models of 256 x 256"):
        Renderer([CameraModel()] * 2).set_lenses([CameraModel(64, 64)] * 2)
