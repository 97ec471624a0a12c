"""What real scenes contain and textbooks leave out: empty, thin, tiny, huge, broken, many and inside out."""

import math

import numpy as np
import pytest
import warp as wp

from tests.driving_scene import camera_pose, on_device, packed_street
from tests.oracle import closed_forms
from tests.oracle.ray_cast import RayCaster, cast_scene
from tests.raster.bodies import (
    cuboid,
    depth_and_index,
    edges_of,
    error,
    jacobian,
    poses_towards,
    rendered,
    scene_of,
)
from tests.raster.test_renderer import poses_on_ego
from warpav.raster.areas import AMODAL_AREA, BOX_AREA, LEFT, VISIBLE_AREA
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.mesh import Mesh, merge
from warpav.raster.renderer import Renderer

MODEL = CameraModel(64, 48, math.radians(75.0), 0.1)
WHOLE_IMAGE = [0.0, 64.0, 0.0, 48.0]
AHEAD = camera_pose([0.0, 0.0, 0.0], 0.0)
AREAS = [VISIBLE_AREA, AMODAL_AREA]
BOX = cuboid([1.6, 2.4, 1.1], [5.0, 0.4, 0.2], (0.1, 0.2, 0.3))


def with_triangles(mesh, corner_m):
    """The mesh and more triangles, whose corners follow one another."""
    return merge([mesh, Mesh.create(corner_m, np.arange(len(corner_m)).reshape(-1, 3), [200, 10, 10])])


def poses_round_the_box(count=12, seed=21):
    return poses_towards(np.random.default_rng(seed), [5.0, 0.4, 0.2], count, distance_m=(4.0, 6.0))


# --- broken meshes


NO_AREA = {
    "one point": [[5.0, 0.5, 0.2]] * 3,
    "one line": [[4.6, 0.1, -0.9], [4.7, 0.0, -0.5], [4.85, -0.15, 0.1]],
    "a corner twice": [[4.6, 0.1, -0.9], [4.6, 1.9, -0.9], [4.6, 1.9, -0.9]],
    "seen from the side": [[4.0, 0.4, 0.0], [5.0, 0.5, 0.0], [6.0, 0.9, 0.0]],  # in a plane with the first camera
}


@pytest.mark.parametrize("kind", NO_AREA)
def test_triangles_without_area_change_nothing(device, kind):
    poses = np.array([AHEAD]) if kind == "seen from the side" else poses_round_the_box()
    _, frame = rendered(scene_of([with_triangles(BOX, NO_AREA[kind])]), poses, MODEL, device)
    _, clean_frame = rendered(scene_of([BOX]), poses, MODEL, device)
    for one, other in zip(frame.depths_and_ids(), clean_frame.depths_and_ids(), strict=True):
        np.testing.assert_array_equal(one.numpy(), other.numpy())
    measures, expected = frame.measure(), clean_frame.measure()
    np.testing.assert_array_equal(measures.value.numpy(), expected.value.numpy())
    # worst seen .043: in 32 bits the three points of a line are not quite on it
    assert error(jacobian(measures), jacobian(expected), 1.0).max() < 0.1


# --- nothing, everything, inside


def poison(measures):
    """Fill earlier results with NaN."""
    for name in ("value", "jac_translation", "jac_rotation", "jac_log_focal"):
        array = getattr(measures, name)
        array.assign(np.full_like(array.numpy(), np.nan))


@pytest.mark.parametrize("occlusion", Occlusion)
def test_old_results_do_not_show_through(device, occlusion):
    # a full view after an empty one and the other way round, into poisoned results
    packed = packed_street(device, 4).raster
    full = camera_pose([1.0, 0.0, 1.9], 0.0), camera_pose([1.0, 0.0, 1.9], math.pi)
    empty = camera_pose([0.0, 0.0, 30.0], 0.0, -math.pi / 2), camera_pose([0.0, 0.0, -3.0], 0.0, -1.5)
    renderer = Renderer([MODEL] * 2, occlusion=occlusion, device=device)
    weight = wp.array(np.random.default_rng(0).normal(size=(48, 64)).astype(np.float32), dtype=float, device=device)
    results = []
    for poses in (full, empty, full):
        frame = renderer.render(packed, *on_device(poses, device))
        if not results:
            measures, weighted = frame.measure(), frame.weighted_area(weight, visible=True)
        poison(measures)
        poison(weighted)
        frame.measure(into=measures)
        frame.weighted_area(weight, visible=True, into=weighted)
        arrays = [measures.value.numpy(), jacobian(measures), weighted.value.numpy(), jacobian(weighted)]
        results.append([np.array(array) for array in arrays])  # on the CPU NumPy shares the memory
    assert not results[1][0][..., :BOX_AREA].any()
    assert results[0][0][..., VISIBLE_AREA].max() > 50
    for one, other in zip(results[0], results[2], strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_camera_inside_a_vehicle_sees_it_everywhere(device):
    around = cuboid([3.0, 2.0, 1.6], [0.2, 0.1, 0.0], (0.1, 0.0, 0.2))
    poses = [camera_pose([0.0, 0.0, 0.0], yaw, pitch, 0.3) for yaw in (0.0, 1.5, 3.0) for pitch in (-1.0, 0.2)]
    _, frame = rendered(scene_of([around]), poses, MODEL, device)
    measures = frame.measure()
    np.testing.assert_array_equal(measures.value.numpy()[:, 0, AREAS], np.full((6, 2), 64 * 48))
    np.testing.assert_array_equal(measures.value.numpy()[:, 0, LEFT:], np.tile(WHOLE_IMAGE, (6, 1)))
    assert not jacobian(measures)[:, 0].any()
    depth_m, object_index = depth_and_index(frame)
    assert (object_index == 2).all()
    caster = RayCaster([around])
    truth = np.array([caster.look(pose, MODEL).depth_m for pose in poses])
    np.testing.assert_allclose(depth_m, truth, rtol=1e-5)


# --- thin, tiny, huge, many


def test_two_hundred_vehicles_are_told_apart(device):
    rng = np.random.default_rng(10)
    cars = [
        cuboid(
            [1.0, 0.6, 0.5],
            [8.0 + 2.2 * (k // 20), -16.0 + 1.7 * (k % 20), rng.uniform(-0.5, 0.5)],
            rng.uniform(0, 1, 3),
        )
        for k in range(200)
    ]
    scene, model = scene_of(cars), CameraModel(160, 120, math.radians(90.0), 0.1)
    poses = [camera_pose([0.0, 0.0, 4.0], 0.0, 0.25), camera_pose([15.0, -18.0, 5.0], 1.4, 0.3, 0.1)]
    _, frame = rendered(scene, poses, model, device)
    measures = frame.measure()
    value, slope = measures.value.numpy(), jacobian(measures)
    _, object_index = depth_and_index(frame)
    caster = cast_scene(scene)
    assert (
        np.mean([np.mean(object_index[v] == caster.look(pose, model).object_index) for v, pose in enumerate(poses)])
        > 0.9999
    )
    for k in range(200):
        np.testing.assert_array_equal(value[:, k, VISIBLE_AREA], (object_index == 2 + k).sum(axis=(1, 2)))
    assert (value[0, :, AMODAL_AREA] > 0).sum() > 170
    truth = [closed_forms.convex_area(car.vertex_m, edges_of(car), poses[0], model) for car in cars]
    derivative = np.array([d for _, d in truth])
    difference = slope[0, :, AMODAL_AREA] - derivative
    assert np.linalg.norm(difference) < 0.03 * np.linalg.norm(derivative)  # seen .0088


def test_a_ground_of_ten_kilometres_has_the_planes_depth(device):
    size = 1e4
    ground = Mesh.create(
        [[-size, -size, 0], [size, -size, 0], [size, size, 0], [-size, size, 0]], [[0, 1, 2], [0, 2, 3]], [9, 9, 9]
    )
    rng = np.random.default_rng(3)
    poses = [
        camera_pose([rng.uniform(-5, 5), rng.uniform(-5, 5), 1.5], *rng.uniform([-0.3, 0.0, -0.3], [0.3, 0.6, 0.3]))
        for _ in range(20)
    ]
    _, frame = rendered(scene_of([], ground), poses, MODEL, device)
    depth_m, object_index = depth_and_index(frame)
    column, row = np.meshgrid(np.arange(64) + 0.5 - 32, np.arange(48) + 0.5 - 24)
    ray = np.stack([column, row, np.full(column.shape, closed_forms.focal_px(MODEL))], axis=-1) / closed_forms.focal_px(
        MODEL
    )
    for pose, depth, index in zip(poses, depth_m, object_index, strict=True):
        down = ray @ pose[2, :3]
        sure = np.abs(down) > 2e-3  # pixels off the horizon
        np.testing.assert_array_equal(index[sure], np.where(down < 0, 0, -1)[sure])
        ground_depth = -pose[2, 3] / down[sure & (down < 0)]
        # worst seen 5e-4; it grows with the size of a triangle over the distance
        np.testing.assert_allclose(depth[sure & (down < 0)], ground_depth, rtol=2e-3)


# --- the same bits


@pytest.mark.parametrize("occlusion", Occlusion)
def test_repeats_and_threads_give_the_same_bits(occlusion, device):
    scene, poses = packed_street(device).raster, poses_on_ego(np.random.default_rng(2), 7)
    weight = wp.array(np.random.default_rng(0).normal(size=(7, 48, 64)).astype(np.float32), dtype=float, device=device)
    results = []
    for thread_count, repeats in ((1, 2), (2, 2), (3, 1)):
        renderer = Renderer([MODEL] * 7, supersampling=2, occlusion=occlusion, thread_count=thread_count, device=device)
        for _ in range(repeats):
            frame = renderer.render(scene, *on_device(poses, device))
            found = [frame.measure()]
            found += [frame.weighted_area(weight, visible=visible) for visible in (True, False)]
            results.append([array for each in found for array in (each.value.numpy(), jacobian(each))])
    assert all(np.isfinite(array).all() for array in results[0])
    assert np.count_nonzero(results[0][1].any(axis=(1, 2, 3))) >= 5
    for one, *others in zip(*results, strict=True):
        for other in others:
            np.testing.assert_array_equal(one, other)


# --- images against rays


def test_large_triangles_leave_no_holes_between_them(device):
    rng = np.random.default_rng(5)
    count, half_m = 1000, 50.0
    # seen from inside, often from so near that the near plane cuts its walls
    room = cuboid([2.0 * half_m] * 3, [0.0] * 3)
    place_m = rng.uniform(-1.0, 1.0, (count, 3)) * (half_m - rng.choice([0.1, 1.0, 10.0], (count, 3)))
    angles_rad = rng.uniform([-math.pi, -1.5, -math.pi], [math.pi, 1.5, math.pi], (count, 3))
    poses = np.stack([camera_pose(place, *angles) for place, angles in zip(place_m, angles_rad, strict=True)])
    _, frame = rendered(scene_of([], room), poses, CameraModel(64, 48, math.radians(90.0), 0.05), device)
    assert np.count_nonzero(frame.object_id.numpy() == -1) == 0
