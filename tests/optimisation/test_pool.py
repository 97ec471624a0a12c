"""Pools of single cameras: the objective's own probabilities, on every executor and from every cache the same bytes."""

import functools
import importlib.util
import math
import os
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.stats import qmc

from tests.detection.test_probability import model_of
from tests.driving_scene import ConstantDetector, packed_street, roof
from tests.optimisation.calls import draw
from tests.optimisation.objectives import rig_objective
from tests.optimisation.test_missed import FREE, scenes_of
from warpav.core.errors import InputError
from warpav.core.executor import Executor
from warpav.core.progress import NullProgress
from warpav.optimisation import (
    HEIGHT_DELTA_M,
    LOG_ZOOM,
    PITCH_RAD,
    X_M,
    Y_M,
    YAW_RAD,
    CameraMount,
    CameraProbability,
    LossSettings,
    ZoneAndSpacing,
)
from warpav.optimisation import _pool as module
from warpav.optimisation._mount import ROLL_RAD
from warpav.optimisation._pool import spread_mount_poses
from warpav.optimisation._single_cameras import SingleCameras
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.lens import Lens
from warpav.raster.renderer import Renderer
from warpav.rig import MountSurface
from warpav.thesis import BoundsAndSpacing

MODEL = CameraModel(64, 64, math.pi / 2)


def mount_of(device="cpu", *, free=FREE, model=MODEL, surface=None):
    return CameraMount(surface or roof(), camera=model, height_offset_m=0.25, device=device, free=free)


def cameras_of(device="cpu", *, mount=None, probability="fitted", seed=1, **options):
    model = model_of(np.random.default_rng(seed), 0.3)
    return SingleCameras(mount or mount_of(device), CameraProbability(model, probability), **options)


def poses_of(count, mount=None, seed=0):
    mount = mount or mount_of()
    return spread_mount_poses(mount, BoundsAndSpacing(mount.surface), count, seed=seed)


@functools.cache
def streets(device="cpu"):
    """Scenes of different numbers of objects, none among them."""
    return tuple(packed_street(device, count, seed) for seed, count in enumerate((6, 0, 4)))


def drawn(count=12, **options):
    options = {"scenes": streets(), "cameras": cameras_of(), **options}
    return draw(poses_of(count), **options)


def files(cache):
    return sorted(file.name for file in cache.glob("pool_*.npz"))


# --- where the cameras stand -----------------------------------------------------------------------------------------


def zone():
    """A roof of which a ring can carry cameras."""
    surface = roof()
    row, column = np.ogrid[: surface.height_m.shape[0], : surface.height_m.shape[1]]
    away = np.hypot((row - 55) / 45.0, (column - 35) / 28.0)
    return MountSurface(surface.height_m, surface.origin_m, surface.cell_m, (away < 1.0) & (away > 0.5))


def test_cameras_cover_what_is_free_and_nothing_else():
    mount = mount_of(surface=zone())
    constraints = ZoneAndSpacing(mount.surface, camera_count=1, margin_m=0.03)
    pose = spread_mount_poses(mount, constraints, 700, seed=3)
    assert pose.dtype == np.float32
    assert constraints.contains(pose[:, [X_M, Y_M]]).all()
    assert (mount.surface.zone_distance_m(pose[:, [X_M, Y_M]]) >= 0.03 - 1e-6).all()
    assert not pose[:, ROLL_RAD].any()
    for number in (PITCH_RAD, HEIGHT_DELTA_M, LOG_ZOOM):
        low, high = mount.low[number], mount.high[number]
        assert (pose[:, number] >= low).all()
        assert (pose[:, number] <= high).all()
        share = np.histogram(pose[:, number], 7, (low, high))[0]
        assert np.abs(share - 100).max() <= 25  # independent points: 27 in every other draw of seven bins
    sector = np.histogram(pose[:, YAW_RAD], 7, (-math.pi, math.pi))[0]
    assert np.abs(sector - 100).max() <= 25
    # all sides of the ring, which an even spread fills by its area
    around = np.arctan2(pose[:, Y_M], pose[:, X_M] - 1.1)
    assert np.histogram(around, 8, (-math.pi, math.pi))[0].min() >= 50
    fixed = spread_mount_poses(mount_of(free=None), BoundsAndSpacing(roof()), 64, seed=3)
    assert not fixed[:, PITCH_RAD:].any()


def test_cameras_are_spread_more_evenly_than_random_ones():
    pose = poses_of(256, mount_of(free=None))
    low_m, high_m = roof().bounds_m
    unit = (np.c_[pose[:, :YAW_RAD], pose[:, YAW_RAD]] - [*low_m, -math.pi]) / [*(high_m - low_m), 2.0 * math.pi]
    random = [qmc.discrepancy(np.random.default_rng(k).random((256, 3))) for k in range(20)]
    assert qmc.discrepancy(np.clip(unit, 0.0, 1.0)) < 0.5 * min(random)


# --- what they detect ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["fitted", "visible_share", "in_frame_share"])
@pytest.mark.parametrize("occlusion", list(Occlusion), ids=lambda occlusion: occlusion.value)
def test_probabilities_are_those_of_the_objective(device, kind, occlusion):
    cameras = cameras_of(device, probability=kind, occlusion=occlusion)
    assigned = scenes_of(device, 6, 1, 10)
    pose = poses_of(9)
    objective = rig_objective(
        cameras.mount,
        ConstantDetector.silent(9),
        camera_count=9,
        settings=LossSettings(expected_miss_rate=1.0, probability=kind),
        occlusion=occlusion,
        probability=cameras.probability.model,
    )
    expected = objective.evaluate(pose, assigned, detection_probability=True).detection_probability
    found = draw(pose, scenes=[each.scene for each in assigned], cameras=cameras)
    if device == "cpu":
        np.testing.assert_array_equal(found.detection_probability, expected)
    np.testing.assert_allclose(found.detection_probability, expected, atol=1e-5)
    assert found.scene_index.tolist() == [0] * 6 + [1] + [2] * 10
    assert np.count_nonzero(expected) > 25
    assert np.ptp(expected) > 0.5


@pytest.mark.parametrize("lens", [Lens.FISHEYE, Lens.BROWN_CONRADY])
@pytest.mark.parametrize("supersampling", [1, 2])
def test_lenses_and_samples_are_those_of_the_objective(device, lens, supersampling):
    model = CameraModel(48, 40, math.radians(80.0), lens=lens, distortion=(0.05, -0.01, 0.0, 0.0))
    mount = mount_of(device, free=None, model=model)
    cameras = cameras_of(mount=mount, supersampling=supersampling)
    objective = rig_objective(
        mount,
        ConstantDetector.silent(4),
        camera_count=4,
        settings=LossSettings(expected_miss_rate=1.0),
        occlusion=Occlusion.EXACT,
        supersampling=supersampling,
        probability=cameras.probability.model,
    )
    pose, [assigned] = poses_of(4, mount), scenes_of(device, 8)
    expected = objective.evaluate(pose, [assigned], detection_probability=True).detection_probability
    found = draw(pose, scenes=[assigned.scene], cameras=cameras).detection_probability
    np.testing.assert_allclose(found, expected, atol=0.0 if device == "cpu" else 1e-5)
    assert expected.any()


def test_neither_chunks_nor_threads_nor_neighbours_change_a_bit(monkeypatch):
    pose = poses_of(37)
    expected = drawn(37).detection_probability
    monkeypatch.setattr("warpav.optimisation._single_cameras._CPU_VIEWS", 5)
    for chunk, threads in ((1, 1), (7, 2), (100, 3)):
        found = drawn(37, cameras=cameras_of(thread_count=threads), chunk_cameras=chunk)
        np.testing.assert_array_equal(found.detection_probability, expected)
    backwards = draw(pose[::-1], scenes=streets(), cameras=cameras_of())
    np.testing.assert_array_equal(backwards.detection_probability[::-1], expected)
    assert (backwards.drawn_count, backwards.cached_count) == (37 * 3, 0)


def is_missing(package):
    return pytest.mark.skipif(importlib.util.find_spec(package) is None, reason=f"{package} is not installed")


@pytest.mark.parametrize(
    "executor",
    [
        pytest.param(Executor("process", worker_count=2), id="process"),
        pytest.param(Executor("ray", worker_count=2), id="ray", marks=[is_missing("ray"), pytest.mark.slow]),
        pytest.param(Executor("slurm", address="local"), id="slurm", marks=[is_missing("submitit"), pytest.mark.slow]),
    ],
)
def test_every_executor_gives_the_same_bytes(tmp_path, executor):
    here, cache = drawn(12), tmp_path / "cache"
    executor = replace(executor, folder=tmp_path / "jobs")
    there = drawn(12, executor=executor, cache=cache, chunk_cameras=5)
    np.testing.assert_array_equal(there.detection_probability, here.detection_probability)
    assert not [path for path in cache.iterdir() if path.is_dir()]  # scenes that travelled are gone
    # what others have drawn is found here
    again = drawn(12, cache=cache)
    assert (again.drawn_count, again.cached_count) == (0, 12 * 3)
    np.testing.assert_array_equal(again.detection_probability, here.detection_probability)


@pytest.mark.gpu
@pytest.mark.skipif(wp.get_cuda_device_count() < 2, reason="needs two GPUs")
def test_two_gpus_give_the_same_bytes_as_one():
    cameras, scenes = cameras_of("cuda:0"), streets("cuda:0")
    alone = drawn(scenes=scenes, cameras=cameras, chunk_cameras=4)
    shared = drawn(
        scenes=scenes, cameras=cameras, chunk_cameras=4, executor=Executor("process", worker_count=2, gpu_count=2)
    )
    assert shared.detection_probability.tobytes() == alone.detection_probability.tobytes()


def test_a_renderer_without_room_draws_fewer_cameras_at_once(monkeypatch, caplog):
    """The same bytes; as Warp tells it on a GPU."""
    expected, rendered = drawn(10), Renderer.render
    expected_pose = draw(poses_of(10), scenes=streets(), cameras=cameras_of()).mount_pose

    def render(self, *args, **options):
        if self.view_count > 3:
            raise RuntimeError("Failed to allocate 4294967296 bytes on device 'cuda:0'")
        return rendered(self, *args, **options)

    monkeypatch.setattr(Renderer, "render", render)
    cameras = cameras_of()
    found = drawn(10, cameras=cameras)
    np.testing.assert_array_equal(found.detection_probability, expected.detection_probability)
    assert caplog.records[-1].getMessage().endswith("going on with 2 views at once")
    slope = cameras.with_jacobian(expected_pose[:8], streets())
    monkeypatch.setattr(Renderer, "render", rendered)
    for fewer, all_at_once in zip(slope, cameras_of().with_jacobian(expected_pose[:8], streets()), strict=True):
        np.testing.assert_array_equal(fewer, all_at_once)


def test_large_pools_are_kept_in_half_precision(monkeypatch):
    exact = drawn(20)
    assert exact.detection_probability.dtype == np.float32
    monkeypatch.setattr(module, "_HALF_ABOVE_BYTES", 4 * 20 * 10 - 1)
    half = drawn(20)
    assert half.detection_probability.dtype == np.float16
    error = np.abs(half.detection_probability.astype(float) - exact.detection_probability)
    assert 0.0 < error.max() <= 1.0 / 4096.0
    # a small pool grows into a large one
    grown = drawn(5).extended(poses_of(20)[5:])
    assert grown.detection_probability.dtype == np.float16
    np.testing.assert_array_equal(grown.detection_probability, half.detection_probability)
    # one more camera joins in the same precision
    assert half.extended(poses_of(21)[20:]).detection_probability.dtype == np.float16


# --- what is kept ----------------------------------------------------------------------------------------------------


def test_a_larger_pool_draws_only_what_is_new(tmp_path):
    pose = poses_of(30)
    small = draw(pose[:10], scenes=streets(), cameras=cameras_of(), cache=tmp_path, chunk_cameras=4)
    assert (small.drawn_count, small.cached_count) == (30, 0)
    large = small.extended(pose[10:])
    assert (large.drawn_count, large.cached_count) == (90, 0)
    np.testing.assert_array_equal(large.mount_pose, pose)
    fresh = draw(pose, scenes=streets(), cameras=cameras_of())
    np.testing.assert_array_equal(large.detection_probability, fresh.detection_probability)
    # one that the pool has, twice one that it has not
    again = large.extended(np.concatenate([pose[[3]], poses_of(31)[[30, 30]]]))
    assert again.drawn_count == 93
    np.testing.assert_array_equal(again.detection_probability[30], large.detection_probability[3])
    np.testing.assert_array_equal(again.detection_probability[31], again.detection_probability[32])
    # other chunks, another order, fewer scenes: every camera is found by itself
    cached = draw(pose[::-2], scenes=streets()[::-1], cameras=cameras_of(), cache=tmp_path, chunk_cameras=3)
    assert (cached.drawn_count, cached.cached_count) == (0, 45)
    order = np.r_[6:10, 0:6]
    np.testing.assert_array_equal(cached.detection_probability, fresh.detection_probability[::-2][:, order])


class StopError(Exception):
    """The program is killed."""


class Killed(NullProgress):
    """Stops it when some tasks are done."""

    def __init__(self, done):
        self.done = done

    def steps(self, description, items, *, count):
        for k, item in enumerate(super().steps(description, items, count=count)):
            if k == self.done:
                raise StopError
            yield item


def test_an_interrupted_pool_goes_on_where_it_stopped(tmp_path):
    options = {"cache": tmp_path, "chunk_cameras": 5}
    with pytest.raises(StopError):
        drawn(20, progress=Killed(7), **options)
    assert len(files(tmp_path)) == 7
    found = drawn(20, **options)
    # 12 chunks of 5 cameras in 3 scenes
    assert (found.drawn_count, found.cached_count) == (5 * 5, 7 * 5)
    np.testing.assert_array_equal(found.detection_probability, drawn(20).detection_probability)


class Told(NullProgress):
    """Keeps what stages say."""

    def __init__(self):
        self.text = []

    def stage(self, description):
        self.text.append(description)


def test_a_pool_that_the_cache_holds_says_so(tmp_path):
    first, again = Told(), Told()
    found = [drawn(8, cache=tmp_path, progress=progress) for progress in (first, again)]
    assert not any("cache" in text for text in first.text)
    assert any(text.endswith(": all from the cache") for text in again.text)
    assert (found[1].drawn_count, found[1].cached_count) == (0, 24)
    np.testing.assert_array_equal(*(each.detection_probability for each in found))


def test_files_that_are_read_again_count_as_used(tmp_path):
    drawn(8, cache=tmp_path)
    for name in files(tmp_path):
        os.utime(tmp_path / name, (0, 0))
    drawn(8, cache=tmp_path)
    assert all((tmp_path / name).stat().st_mtime > 0 for name in files(tmp_path))


def test_damaged_files_are_drawn_again(tmp_path):
    whole = drawn(8, cache=tmp_path)
    first, second, _ = (tmp_path / name for name in files(tmp_path))
    first.write_bytes(first.read_bytes()[:300])
    second.write_bytes(b"")
    again = drawn(8, cache=tmp_path)
    assert (again.drawn_count, again.cached_count) == (16, 8)
    np.testing.assert_array_equal(again.detection_probability, whole.detection_probability)
    assert drawn(8, cache=tmp_path).drawn_count == 0


def another(name):
    """Scenes and cameras that differ from the usual ones in one thing."""
    scenes, cameras = streets(), cameras_of()
    if name == "scenes":
        scenes = (packed_street("cpu", 6, 5), *scenes[1:])
    elif name == "vehicle":
        surface = roof()
        higher = MountSurface(surface.height_m + 0.01, surface.origin_m, surface.cell_m)
        cameras = cameras_of(mount=mount_of(surface=higher))
    elif name == "camera":
        cameras = cameras_of(mount=mount_of(model=CameraModel(64, 48, math.pi / 2)))
    elif name == "detector":
        cameras = cameras_of(seed=2)
    return scenes, cameras


@pytest.mark.parametrize("name", ["scenes", "vehicle", "camera", "detector"])
def test_a_cache_has_nothing_for_something_else(tmp_path, name):
    scenes, cameras = another(name)
    drawn(8, cache=tmp_path / "cache")
    other = drawn(8, scenes=scenes, cameras=cameras, cache=tmp_path / "cache")
    assert other.cached_count == (16 if name == "scenes" else 0)


# --- what cannot be --------------------------------------------------------------------------------------------------


def test_bad_input_is_refused(tmp_path):
    pose = poses_of(2)
    options = {"scenes": streets(), "cameras": cameras_of()}
    for bad, message in (
        (pose[:0], r"mount_pose: expected at least one camera \[camera, 7\], got \(0, 7\)"),
        (pose[0], r"got \(7,\)"),
        (pose[:, :6], r"got \(2, 6\)"),
        (np.where(np.arange(7) == 2, np.nan, pose), "mount_pose: expected finite numbers, got nan"),
    ):
        with pytest.raises(InputError, match=message):
            draw(bad, **options)
    for changes, message in (
        ({"scenes": ()}, "scenes: expected at least one object, got none in 0 scenes"),
        ({"scenes": streets()[1:2]}, "scenes: expected at least one object, got none in 1 scenes"),
        ({"chunk_cameras": 0}, "chunk_cameras: expected at least 1, got 0"),
        ({"cameras": cameras_of(supersampling=0)}, "cameras: expected supersampling of at least 1, got 0"),
        ({"cameras": cameras_of(supersampling=10**4)}, "pool: street_0: 64 x 64 pixels .* are more than .* samples"),
        ({"executor": Executor("ray")}, "cache: expected a folder that all machines see, with executor ray, got none"),
    ):
        with pytest.raises(InputError, match=message) as caught:
            draw(pose, **{**options, **changes})
        assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="at least 8 x 8 whole pixels, got 0 x 64"):
        CameraModel(0, 64)


def test_cameras_that_see_nothing_are_refused():
    pose = poses_of(3)
    pose[:, PITCH_RAD] = -math.pi / 2  # at the sky
    with pytest.raises(InputError, match="got 3 of which none sees any of the 10 objects of 3 scenes") as caught:
        draw(pose, scenes=streets(), cameras=cameras_of())
    assert "\n" not in str(caught.value)
    # where others join them they are refused with these
    blind = draw(pose, scenes=streets(), cameras=cameras_of(), may_see_nothing=True)
    assert not blind.detection_probability.any()
    with pytest.raises(InputError, match="got 4 of which none sees any of the 10 objects of 3 scenes"):
        blind.extended(pose[:1])
    assert blind.extended(poses_of(4)).detection_probability[3:].any()
    # beside others they may be there
    assert not drawn(4).extended(pose).detection_probability[4:].any()
