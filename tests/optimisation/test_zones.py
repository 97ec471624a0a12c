"""Cameras in zones anywhere on a body: places, ranges, constraints, pools, Jacobians."""

import functools
import math

import numpy as np
import pytest
import warp as wp

from tests.driving_scene import street
from tests.optimisation.calls import polish
from tests.optimisation.test_pool import cameras_of
from warpav.core.errors import InputError
from warpav.optimisation import HEIGHT_DELTA_M, PITCH_RAD, X_M, Y_M, YAW_RAD, CameraMount, ZoneAndSpacing
from warpav.optimisation._mount import ROLL_RAD
from warpav.optimisation._pool import spread_mount_poses
from warpav.raster.camera import CameraModel
from warpav.rig import NORMALS, Rig, RigCamera, Zone, chart_of
from warpav.scene import DeviceScene

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
    first, *_, last = polish(
        pose, lambda each: cameras.with_jacobian(each, scenes), mount=cameras.mount, constraints=constraints_of(4),
        scene_count=1, step_count=4,
    )  # fmt: skip
    assert last.objective < first.objective
    np.testing.assert_array_equal(chart().zone_at(last.mount_pose[:, [X_M, Y_M]]), [0, 1, 3, 4])
    np.testing.assert_array_equal(cameras.mount.clipped(last.mount_pose), last.mount_pose)
    assert constraints_of(4).violation_m(cameras.mount.rig(last.mount_pose)) == 0.0


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


def place_by_hand(surface, point_m, modules):
    """The zone whose surface and stand-off are nearest, of those of a module the deepest; else the nearest cell."""
    best = None
    for number, zone in enumerate(surface.zones):
        module = surface.module_of_zone[number] if surface.modules else 0
        local_m = zone.axes @ (point_m - surface.plane_m[number])
        if surface.zone_at(local_m[:2]) != number or not modules[module]:
            continue
        above_m = local_m[2] - float(surface.height_at_m(local_m[:2]))
        inside_m = float(surface.zone_distance_m(local_m[:2]))
        beyond_m = max(zone.rise_m[0] - above_m, above_m - zone.rise_m[1], 0.0)
        away_m = round(max(-inside_m, 0.0) + beyond_m, 6)
        if best is None or away_m < best[0] or (away_m == best[0] and module == best[1] and inside_m > best[2]):
            best = away_m, module, inside_m, local_m[:2], above_m
    if best is not None:
        return best[3], best[4]
    place_m = surface.place_m[surface.inside]
    place_m = place_m[np.array(modules)[surface.module_at(place_m)]]
    cell_m = surface.point_m(place_m, surface.height_at_m(place_m))
    near = np.linalg.norm(cell_m - point_m, axis=1).argmin()
    return place_m[near], (point_m - cell_m[near]) @ surface.axes[surface.zone_at(place_m[near]), 2]


@pytest.mark.parametrize("has_modules", [False, True])
def test_any_point_has_the_place_of_the_nearest_zone_that_carries_its_module(has_modules):
    from tests.optimisation.test_modules import chart as chart_of_modules

    surface = chart_of_modules() if has_modules else chart()
    rng = np.random.default_rng(4)
    point_m = np.concatenate([rng.uniform([-1.5, -1.5, 0.0], [4.0, 1.5, 2.0], (80, 3)), rng.uniform(-30, 30, (40, 3))])
    carriers = rng.random((len(point_m), 3)) < 0.6 if has_modules else None
    if has_modules:
        carriers[~carriers.any(axis=1)] = True
    place_m, rise_m = surface.place_of(point_m, carriers)
    for k, point in enumerate(point_m):
        expected_m, above_m = place_by_hand(surface, point, [True] if carriers is None else carriers[k])
        np.testing.assert_allclose(place_m[k], expected_m, atol=1e-6)
        assert rise_m[k] == pytest.approx(above_m, abs=1e-6)
    one_m, one_rise_m = surface.place_of(point_m[90], None if carriers is None else carriers[90])
    np.testing.assert_allclose(one_m, place_m[90])
    assert float(one_rise_m) == pytest.approx(rise_m[90])


def test_seen_from_above_a_chart_is_the_highest_of_its_cells():
    surface = chart()
    place_m = surface.place_m[surface.inside]
    point_m = surface.point_m(place_m, surface.height_m[surface.inside])
    above = surface.over_ground
    assert above.over_ground is above
    for centre_m, height_m in zip(above.place_m.reshape(-1, 2), above.height_m.ravel(), strict=True):
        away = np.abs(point_m[:, :2] - centre_m).max(axis=1) / surface.cell_m
        surely, maybe = point_m[away < 0.499, 2], point_m[away < 0.501, 2]  # those on an edge are of either cell
        if math.isnan(height_m):
            assert not len(surely)
        else:
            assert surely.max(initial=-math.inf) <= height_m + 1e-6
            assert np.abs(maybe - height_m).min() < 1e-6
    np.testing.assert_array_equal(above.inside, np.isfinite(above.height_m))
    assert not above.inside[[0, -1]].any()
    assert not above.inside[:, [0, -1]].any()
