"""W1, W2 and W3 on a small workload against rays and against differences."""

import dataclasses
import functools
import math

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from tests.driving_scene import camera_pose
from tests.experiments.bench.small_workload import small_workload
from tests.oracle.ray_cast import RayCaster
from warpav.core.frames import EGO_FROM_THESIS
from warpav.experiments.bench._items import Bench, _hit_rgb, object_type, view_rays
from warpav.experiments.bench._workload import (
    ROTATION_COUNT,
    WEIGHT_NAMES,
    embedded_truth,
    embedded_workload,
    pack_workload,
    read_workload,
)
from warpav.raster import chunks
from warpav.raster.mesh import Mesh

STEP = np.array([0.003, 0.003, 0.0004])  # of differences: m, m, rad


@pytest.fixture(scope="module")
def workloads(tmp_path_factory):
    """Workloads by `visible`."""
    found = {}
    for visible in (0, 1):
        file = tmp_path_factory.mktemp("workload") / "small.npz"
        np.savez(file, **small_workload(visible=visible))
        found[visible] = read_workload(file)
    return found


@functools.cache
def meshes():
    """Meshes of all objects in the ego frame."""
    arrays = small_workload()
    found, vertex_first, face_first = [], 0, 0
    for end, count in zip(arrays["vert_ends"], arrays["face_counts"], strict=True):
        vertex = arrays["verts"][vertex_first:end] @ EGO_FROM_THESIS.T
        faces = arrays["faces"][face_first : face_first + count] - vertex_first
        found.append(Mesh.create(vertex, faces, np.round(255 * arrays["colors"][vertex_first:end])))
        vertex_first, face_first = end, face_first + count
    return found


def poses_of(workload, pose, camera):
    """``ego_from_camera`` of the four views of one camera."""
    x, z, yaw = pose
    return [camera_pose([z, x, workload.height_m[camera]], yaw + k * 0.5 * math.pi) for k in range(ROTATION_COUNT)]


def bench_of(workload, device):
    return Bench(workload, pack_workload(workload, device=device), device=device)


def test_images_are_those_of_rays(device, workloads):
    workload = workloads[1]
    bench = bench_of(workload, device)
    ((first, index, depth),) = list(bench.depth_and_object())
    ((_, rgb),) = list(bench.rgb())
    assert first == 0
    assert index.dtype == np.int8
    assert depth.dtype == rgb.dtype == np.float32
    caster = RayCaster(meshes())
    same, depth_error, rgb_error = [], [], []
    for camera, pose in enumerate(workload.pose):
        model = workload.models([camera])[0]
        for rotation, at in enumerate(poses_of(workload, pose, camera)):
            view = ROTATION_COUNT * camera + rotation
            ray = caster.look(at, model)
            same.append(index[view] == ray.object_index)
            seen = same[-1] & (ray.object_index >= 0)
            depth_error.append(np.abs(depth[view][seen] / ray.depth_m[seen] - 1.0))
            rgb_error.append(np.abs(rgb[view] - ray.rgb)[seen])
            # where rays hit nothing
            missed = same[-1] & (ray.object_index == -1)
            assert (depth[view][missed] == -1.0).all()
            assert (rgb[view][missed] == 0.0).all()
    same = np.array(same)
    assert same.mean() > 0.9999  # seen 1.0
    assert (index >= 40).any()  # objects beyond the vehicles, each by its own number
    assert set(np.unique(index)) >= {40, 41, 42}
    assert (index == -1).any()
    assert np.concatenate(depth_error).max() < 1e-4  # seen 1e-5
    # the oracle's colours are rounded to bytes
    assert np.quantile(np.concatenate(rgb_error), 0.999) < 0.5 / 255 + 1e-3


def test_loss_is_the_weighted_area_that_rays_see(device, workloads):
    workload = workloads[1]
    workload = dataclasses.replace(workload, scored_pose=workload.scored_pose[:3])
    _, loss = bench_of(workload, device).score_silhouettes(2)
    caster, fine = RayCaster(meshes()), 4
    for i, pose in enumerate(workload.scored_pose):
        camera = i % 3
        model = workload.models([camera])[0]
        share = np.zeros((workload.size_px, workload.size_px))
        for at in poses_of(workload, pose, camera):
            index = caster.look(at, model, fine).object_index
            known = (index >= 0) & (index < workload.vehicle_count)
            weight = np.where(known, workload.vehicle_weight[np.where(known, index, 0)], 0.0)
            share += weight.reshape(workload.size_px, fine, workload.size_px, fine).mean(axis=(1, 3))
        for name in WEIGHT_NAMES:
            expected = (share * workload.weight[name]).sum()
            assert abs(loss[name][i] / expected - 1.0) < 0.012, (name, i)  # seen .0067


def scanline_loss(workload, pose, camera, sub_scanlines=64):
    """The loss of convex vehicles alone, by weight: exact along x."""
    size = workload.size_px
    model = workload.models([camera])[0]
    y = (np.arange(size * sub_scanlines) + 0.5) / sub_scanlines
    row = np.arange(len(y)) // sub_scanlines
    # integral of the weights from the image's left border
    integral = {n: np.c_[np.zeros(size), np.cumsum(w, axis=1, dtype=np.float64)] for n, w in workload.weight.items()}
    loss = dict.fromkeys(WEIGHT_NAMES, 0.0)
    for at in poses_of(workload, pose, camera):
        for k, mesh in enumerate(meshes()[: workload.vehicle_count]):
            point = (mesh.vertex_m - at[:3, 3]) @ at[:3, :3]
            before, behind = point[point[:, 2] > model.near_m], point[point[:, 2] <= model.near_m]
            if len(before) == 0:
                continue
            # where lines between the two sides meet the near plane: they all lie in the convex body
            a, b = before[:, None], behind[None]
            cut = a + (a[..., 2:] - model.near_m) / (a[..., 2:] - b[..., 2:]) * (b - a)
            point = np.concatenate([before, cut.reshape(-1, 3)])
            image = model.intrinsics[0, 0] * point[:, :2] / point[:, 2:] + 0.5 * size
            corner = image[ConvexHull(image).vertices]
            low, high = np.full(len(y), np.inf), np.full(len(y), -np.inf)
            for (x0, y0), (x1, y1) in zip(corner, np.roll(corner, -1, axis=0), strict=True):
                meets = (y - y0) * (y - y1) <= 0
                crossing = x0 + (y[meets] - y0) / (y1 - y0) * (x1 - x0)
                low[meets], high[meets] = np.minimum(low[meets], crossing), np.maximum(high[meets], crossing)
            seen = np.flatnonzero(high > low)
            for name in WEIGHT_NAMES:
                for end, sign in ((high, 1.0), (low, -1.0)):
                    x = np.clip(end[seen], 0.0, size)
                    column = np.minimum(x.astype(int), size - 1)
                    weight = workload.weight[name][row[seen], column]
                    total = (integral[name][row[seen], column] + (x - column) * weight).sum()
                    loss[name] += sign * workload.vehicle_weight[k] * total / sub_scanlines
    return loss


@pytest.mark.parametrize(
    ("supersampling", "value_tolerance", "gradient_tolerance"),
    # seen .0104 and (.039, .0061, .0029); .0020 and (.013, .0051, .0024)
    [(1, 0.015, (0.06, 0.01, 0.006)), (4, 0.004, (0.025, 0.01, 0.006))],
)
def test_gradient_matches_differences_of_exact_areas(
    device, workloads, supersampling, value_tolerance, gradient_tolerance
):
    check_gradient(device, workloads[0], supersampling, value_tolerance, gradient_tolerance)


def test_gradient_of_vehicles_cut_by_the_near_plane_matches_differences(device, workloads):
    workload = dataclasses.replace(workloads[0], near_m=np.array([6.0, 7.0, 8.0]))
    check_gradient(device, workload, 4, 0.01, (0.03, 0.02, 0.02))  # seen .65 of white weights


def check_gradient(device, workload, supersampling, value_tolerance, gradient_tolerance):
    """Compare the first three scored poses with differences of exact areas."""
    workload = dataclasses.replace(workload, scored_pose=workload.scored_pose[:3])
    gradient, loss = bench_of(workload, device).score_silhouettes(supersampling)
    expected = {name: np.zeros((3, 3)) for name in WEIGHT_NAMES}
    for i, pose in enumerate(workload.scored_pose):
        for name, value in scanline_loss(workload, pose, i).items():
            assert abs(loss[name][i] / value - 1.0) < value_tolerance, (name, i)
        for column in range(3):
            step = STEP[column] * np.eye(3)[column]
            high, low = (scanline_loss(workload, pose + sign * step, i) for sign in (1.0, -1.0))
            for name in WEIGHT_NAMES:
                expected[name][i, column] = (high[name] - low[name]) / (2.0 * STEP[column])
    scale = np.array([1.0, 1.0, 0.1])
    for name, bound in zip(WEIGHT_NAMES, gradient_tolerance, strict=True):
        error = np.linalg.norm((gradient[name] - expected[name]) * scale) / np.linalg.norm(expected[name] * scale)
        assert error < bound, (name, error)


@pytest.mark.parametrize(
    ("supersampling", "x_z", "x_z_yaw"),
    # relative error over all poses with white, smooth and all-ones weights; seen (.0211, .0020, .0017) and
    # (.0551, .0017, .0018); (.0057, .0009, .0009) and (.0108, .0008, .0011)
    [
        (1, (0.025, 0.003, 0.003), (0.065, 0.0025, 0.0025)),
        pytest.param(4, (0.009, 0.0015, 0.0015), (0.015, 0.0015, 0.0015), marks=pytest.mark.slow),
    ],
)
def test_gradient_matches_the_embedded_truth(device, supersampling, x_z, x_z_yaw):
    workload = embedded_workload()
    truth = embedded_truth(workload)
    gradient, _ = bench_of(workload, device).score_silhouettes(supersampling)
    for columns, bounds in ((2, x_z), (3, x_z_yaw)):
        for name, bound in zip(WEIGHT_NAMES, bounds, strict=True):
            ours, theirs = gradient[name][:, :columns], truth.gradient[name][:, :columns]
            assert np.linalg.norm(ours - theirs) / np.linalg.norm(theirs) < bound, (columns, name)


def test_chunks_change_nothing(device, workloads, monkeypatch):
    workload = workloads[1]
    whole = bench_of(workload, device)
    expected = [np.concatenate(parts) for parts in zip(*((i, z) for _, i, z in whole.depth_and_object()), strict=True)]
    colour = np.concatenate([rgb for _, rgb in whole.rgb()])
    gradient, loss = whole.score_silhouettes(1)
    monkeypatch.setattr(chunks, "MAX_CHUNK_VIEWS", 5)
    bench = bench_of(workload, device)
    found = list(bench.depth_and_object())
    assert [first for first, _, _ in found] == [0, 5, 10]
    np.testing.assert_array_equal(np.concatenate([i for _, i, _ in found]), expected[0])
    np.testing.assert_array_equal(np.concatenate([z for _, _, z in found]), expected[1])
    np.testing.assert_array_equal(np.concatenate([rgb for _, rgb in bench.rgb()]), colour)
    for together, alone in zip((gradient, loss), bench.score_silhouettes(1), strict=True):
        for name in WEIGHT_NAMES:
            np.testing.assert_array_equal(together[name], alone[name])
    for time in (functools.partial(bench.time_silhouettes, 1), bench.time_depth_and_object, bench.time_rgb):
        timing = time(repeat=2)
        assert len(timing.times_ms) == 2
        assert min(timing.times_ms) > 0


def test_a_workload_without_vehicles_has_no_loss(device, workloads):
    arrays = small_workload(vehicle_count=0)
    empty = dataclasses.replace(
        workloads[1],
        vertex_m=arrays["verts"],
        triangle=arrays["faces"],
        vertex_rgb=arrays["colors"],
        triangle_count=arrays["face_counts"],
        vertex_end=arrays["vert_ends"],
        vehicle_count=0,
        vehicle_weight=np.zeros(0),
    )
    for workload in (empty, dataclasses.replace(empty, is_visible=False)):
        bench = bench_of(workload, device)
        gradient, loss = bench.score_silhouettes(1)
        assert not any(values.any() for values in (*gradient.values(), *loss.values()))
    ((_, index, _),) = list(bench.depth_and_object())
    assert set(np.unique(index)) == {-1, 0, 1, 2}


def test_two_runs_agree_bit_for_bit(device, workloads):
    workload = dataclasses.replace(workloads[1], scored_pose=workloads[1].scored_pose[:3])
    one, other = (bench_of(workload, device).score_silhouettes(2) for _ in range(2))
    for name in WEIGHT_NAMES:
        np.testing.assert_array_equal(one[0][name], other[0][name])
        np.testing.assert_array_equal(one[1][name], other[1][name])


def test_embrees_rays_are_the_workloads(workloads):
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    workload = workloads[1]
    scene = EmbreeScene()
    TriangleMesh(scene, workload.vertex_m, workload.triangle)
    bench = bench_of(workload, "cpu")
    ((_, index, depth),) = list(bench.depth_and_object())
    ((_, rgb),) = list(bench.rgb())
    for view, (origin, direction) in enumerate(view_rays(workload)):
        hit = scene.run(origin, direction, output=1)
        seen = hit["primID"] >= 0
        found = np.where(seen, workload.triangle_object[hit["primID"]], -1)
        assert (found == index[view].ravel()).mean() > 0.999
        seen &= found == index[view].ravel()
        along = hit["tfar"][seen] + workload.near_m[view // ROTATION_COUNT]
        np.testing.assert_allclose(along, depth[view].ravel()[seen], rtol=1e-4)
        error = np.abs(_hit_rgb(workload, hit)[seen] - rgb[view].reshape(-1, 3)[seen])
        assert np.quantile(error, 0.999) < 1e-3


def test_objects_get_the_smallest_type_that_holds_them():
    assert [object_type(count) for count in (1, 127, 128, 32767, 32768)] == [
        np.int8, np.int8, np.int16, np.int16, np.int32,
    ]  # fmt: skip
