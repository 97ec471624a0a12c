"""Cameras in zones anywhere on a body: places, ranges, constraints, pools, Jacobians."""

import functools
import math
import sys

import numpy as np
import pytest
import warp as wp

from tests.driving_scene import street
from tests.optimisation.calls import polish
from tests.optimisation.test_pool import cameras_of
from warpav.core.errors import InputError
from warpav.optimisation._camera_jacobians import placing_slope
from warpav.optimisation.constraints import ZoneAndSpacing
from warpav.optimisation.mount import HEIGHT_DELTA_M, PITCH_RAD, ROLL_RAD, X_M, Y_M, YAW_RAD, CameraMount
from warpav.optimisation.pool import spread_mount_poses
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.renderer import Renderer
from warpav.rig.chart import chart_of
from warpav.rig.rig import Rig, RigCamera
from warpav.rig.zone import NORMALS, Zone
from warpav.scene.device_scene import DeviceScene

MODEL = CameraModel(128, 128, math.pi / 2)
PITCH = (-0.2, 0.5)


def zones():
    flush = {"stand_off_m": (0.0, 0.03), "pitch_rad": PITCH, "roll_rad": (-0.1, 0.1)}
    slant = (0.6, 0.0, 0.8)
    return (*(Zone(name, normal, **flush) for name, normal in NORMALS.items()), Zone("slant", slant, **flush))


@functools.cache
def chart():
    return chart_of(zones(), street().ego, cell_m=0.05, min_upward_normal=0.6, min_zone_normal=0.7)


def mount_of(device="cpu", model=MODEL):
    return CameraMount(chart(), camera=model, height_offset_m=0.0, device=device)


def constraints_of(count):
    return ZoneAndSpacing(chart(), camera_count=count, margin_m=0.02)


@functools.cache
def spread(count=256):
    return spread_mount_poses(mount_of(), constraints_of(1), count, seed=0)


def test_a_pool_covers_all_zones_within_their_ranges():
    pose = spread()
    number = chart().zone_at(pose[:, [X_M, Y_M]])
    assert set(number.tolist()) == set(range(len(zones())))
    for zone, at in ((zones()[k], pose[number == k]) for k in range(len(zones()))):
        for column, pair in (
            (HEIGHT_DELTA_M, zone.stand_off_m), (PITCH_RAD, zone.pitch_rad), (ROLL_RAD, zone.roll_rad),
            (YAW_RAD, zone.yaw_range_rad or (-math.pi, math.pi)),
        ):  # fmt: skip
            assert at[:, column].min() >= pair[0] - 1e-6
            assert at[:, column].max() <= pair[1] + 1e-6
            if len(at) > 20:
                assert np.ptp(at[:, column]) > 0.6 * (pair[1] - pair[0])


def test_the_kernel_stands_cameras_where_the_chart_says(device):
    pose = spread(64)
    mount = mount_of(device)
    views = mount.place(wp.array(pose, dtype=float, device=device), 2)
    position_m = views.position_ego_m.numpy().reshape(64, 2, 3)
    np.testing.assert_allclose(position_m[:, 0], mount.position_m(pose), atol=2e-6)
    np.testing.assert_array_equal(position_m[:, 0], position_m[:, 1])
    # without the kernel: origin, axes and height of each zone
    for point_m, each, number in zip(position_m[:, 0], pose, chart().zone_at(pose[:, [X_M, Y_M]]), strict=True):
        zone, place_m = zones()[number], each[[X_M, Y_M]].astype(np.float64)
        rise_m = float(chart().height_at_m(place_m)) + each[HEIGHT_DELTA_M]
        local_m = np.array([*place_m, rise_m])
        np.testing.assert_allclose(point_m, chart().plane_m[number] + local_m @ zone.axes, atol=2e-6)


def test_cameras_keep_apart_across_zones():
    """Two cameras of roof and side that meet at the edge are parted, and the spacing's slope is that of differences."""
    constraints = constraints_of(2)
    surface = chart()
    pose = spread()
    number = surface.zone_at(pose[:, [X_M, Y_M]])
    point_m = mount_of().position_m(pose)
    roof, side = np.flatnonzero(number == 0), np.flatnonzero(number == 1)
    apart_m = np.linalg.norm(point_m[roof][:, None] - point_m[side][None], axis=-1)
    i, j = np.unravel_index(apart_m.argmin(), apart_m.shape)
    assert apart_m[i, j] < 0.5
    near = ZoneAndSpacing(surface, camera_count=2, margin_m=0.02, min_spacing_m=float(apart_m[i, j]) + 0.1)
    pair = pose[[roof[i], side[j]]]
    place_m, rise_m = pair[:, [X_M, Y_M]].astype(np.float64), pair[:, HEIGHT_DELTA_M].astype(np.float64)
    parted_m = near.project(place_m, rise_m)
    assert near.violation_m(mount_of().rig(pair)) > 0.05
    pair[:, [X_M, Y_M]] = parted_m
    assert near.violation_m(mount_of().rig(pair)) == 0.0
    np.testing.assert_array_equal(surface.zone_at(parted_m), [0, 1])

    slope = constraints.slack_slope(parted_m, rise_m)
    step_m = 1e-5
    for camera in range(2):
        for column in range(3):
            values = []
            for sign in (1.0, -1.0):
                at_m, at_rise_m = parted_m.copy(), rise_m.copy()
                if column < 2:
                    at_m[camera, column] += sign * step_m
                else:
                    at_rise_m[camera] += sign * step_m
                values.append(constraints.slack_m(at_m, at_rise_m))
            difference = (values[0] - values[1]) / (2.0 * step_m)
            np.testing.assert_allclose(slope[:, camera, column], difference, atol=2e-3)


def test_a_rig_in_all_zones_is_polished_within_them():
    cameras = cameras_of(mount=mount_of(model=CameraModel(64, 64, math.pi / 2)))
    pose = np.concatenate([spread()[chart().zone_at(spread()[:, [X_M, Y_M]]) == k][:1] for k in (0, 1, 3, 4)])
    scenes = (DeviceScene.pack(street(), device="cpu"),)
    *_, last = polish(
        pose, lambda each: cameras.with_jacobian(each, scenes), mount=cameras.mount, constraints=constraints_of(4),
        scene_count=1, step_count=4,
    )  # fmt: skip
    first, *_ = polish(
        pose, lambda each: cameras.with_jacobian(each, scenes), mount=cameras.mount, constraints=constraints_of(4),
        scene_count=1, step_count=0,
    )  # fmt: skip
    assert last.objective < first.objective
    np.testing.assert_array_equal(chart().zone_at(last.mount_pose[:, [X_M, Y_M]]), [0, 1, 3, 4])
    np.testing.assert_array_equal(cameras.mount.clipped(last.mount_pose), last.mount_pose)
    assert constraints_of(4).violation_m(cameras.mount.rig(last.mount_pose)) == 0.0


def areas_of(pose, mount, supersampling):
    """Visible areas of all objects [px^2], [camera, object], and their Jacobian to the views' poses."""
    scene = DeviceScene.pack(street(), device="cpu")
    renderer = Renderer([mount.camera] * len(pose), supersampling=supersampling)
    views = mount.place(wp.array(pose.astype(np.float32), dtype=float), 1)
    frame = renderer.render(
        scene.raster, views.position_ego_m, views.camera_from_ego, log_focal=views.log_zoom, content=Content.ALL
    )
    return frame.areas()


WEIGHT = {X_M: 1.0, Y_M: 1.0, YAW_RAD: 0.1, PITCH_RAD: 0.1, ROLL_RAD: 0.1, HEIGHT_DELTA_M: 1.0}


@pytest.mark.slow
@pytest.mark.parametrize("name", [*NORMALS, "slant"])
def test_jacobians_match_differences_of_supersampled_renders(name):
    """All six degrees of freedom of a flush camera in every kind of zone; areas at x4 and x8."""
    number = [zone.name for zone in zones()].index(name)
    pose = spread(1024)[chart().zone_at(spread(1024)[:, [X_M, Y_M]]) == number][:12].astype(np.float64)
    # away from the kinks of the height field between cells
    origin_m, cell_m = chart().origin_m, chart().cell_m
    pose[:, [X_M, Y_M]] = origin_m + (np.floor((pose[:, [X_M, Y_M]] - origin_m) / cell_m) + 0.5) * cell_m
    # the body is nearer to a flush camera than most near planes are
    mount = mount_of(model=CameraModel(512, 512, math.pi / 2, near_m=0.005))
    found = areas_of(pose, mount, 4)
    jacobian = found.jacobian.numpy().astype(np.float64)
    slope = placing_slope(mount, pose.astype(np.float32))
    ours = np.einsum("cok,ckn->con", jacobian[..., :3], slope.position)
    ours += np.einsum("cok,ckn->con", jacobian[..., 3:6], slope.rotation)
    numbers = list(WEIGHT)
    truth = np.zeros((*ours.shape[:2], len(numbers)))
    for k, column in enumerate(numbers):
        step = 0.003 * (1.0 if WEIGHT[column] == 1.0 else 0.5)
        ends = []
        for sign in (1.0, -1.0):
            moved = pose.copy()
            moved[:, column] += sign * step
            ends.append(areas_of(moved, mount, 8).visible.numpy().astype(np.float64))
        truth[..., k] = (ends[0] - ends[1]) / (2.0 * step)
    # of all objects together, as an objective has them, with weights of either sign
    share = np.random.default_rng(0).normal(size=(ours.shape[1], 4))
    mine, truth = (
        np.einsum("con,ow->cwn", each, share).reshape(-1, len(numbers)) * [*WEIGHT.values()]
        for each in (ours[..., numbers], truth)
    )
    for count, least in ((3, 0.999), (6, 0.99)):
        size = np.linalg.norm(truth[:, :count], axis=1) * np.linalg.norm(mine[:, :count], axis=1)
        seen = size > 1.0
        assert seen.sum() >= 24
        cosine = (mine * truth)[seen, :count].sum(axis=1) / size[seen]
        sys.stdout.write(f"{name}, {count} numbers: {np.median(cosine):.5f}\n")
        assert np.median(cosine) >= least


def test_cameras_that_stay_are_where_they_were_or_are_refused():
    """Far away a place of the chart may belong to another zone than the point was laid out in."""
    mount = mount_of()
    others = mount.rig(spread()[:2]).cameras
    kept = refused = 0
    for position_m in np.random.default_rng(0).uniform(-40.0, 40.0, (60, 3)):
        rig = Rig([RigCamera("far", position_m, model=MODEL), *others])
        try:
            frozen = mount.freezing(rig, ["far"]).frozen
        except InputError:
            refused += 1
            with pytest.raises(InputError, match=r"^camera 'far': expected one above a zone of mount\.zones"):
                mount.freezing(rig, ["far"])
            continue
        assert frozen is not None
        np.testing.assert_allclose(mount.position_m(frozen.mount_pose)[0], position_m, atol=1e-3)
        kept += 1
    assert kept > 5
    assert refused > 5
    place_m, rise_m = chart().place_of(np.random.default_rng(1).uniform(-40.0, 40.0, (60, 3)))
    assert np.isfinite(place_m).all()
    assert np.isfinite(rise_m).all()
