"""Cameras behind a pane of their own vehicle: it is clear for them and for nobody else, wherever a rig is judged."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warpav as wa
from tests.driving_scene import SilentDetector, packed_street, street
from tests.optimisation.test_pool import cameras_of
from warpav.core.errors import InputError
from warpav.optimisation import (
    HEIGHT_DELTA_M,
    PITCH_RAD,
    X_M,
    Y_M,
    YAW_RAD,
    CameraMount,
    ObjectiveOptions,
    RequiredPoints,
    RigObserver,
    ZoneAndSpacing,
)
from warpav.optimisation._camera_jacobians import placing_slope
from warpav.optimisation._pool import spread_mount_poses
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer
from warpav.rig import NORMALS, Rig, RigCamera, Zone, chart_of
from warpav.scene import DeviceScene
from warpav.sight import body_shares, read_requirements

MODEL = CameraModel(64, 64, math.radians(100.0), near_m=0.01)
PITCH = (-0.1, 0.3)
WINDSCREEN = Zone(
    "windscreen",
    NORMALS["front"],
    box_m=np.array([[2.0, -1.0, 0.9], [2.4, 1.0, 1.6]]),
    stand_off_m=(0.03, 0.15),
    yaw_rad=(-0.8, 0.8),
    pitch_rad=PITCH,
    is_behind_glass=True,
)
ROOF = Zone("roof", NORMALS["up"], box_m=np.array([[0.0, -1.0, 1.4], [2.4, 1.0, 1.6]]), pitch_rad=PITCH)


@functools.cache
def chart(pair_spacing_m=None):
    return chart_of((ROOF, WINDSCREEN), street().ego, cell_m=0.05)


def mount_of(device="cpu", model=MODEL):
    return CameraMount(chart(), camera=model, height_offset_m=0.0, device=device)


@functools.cache
def spread(count=64):
    constraints = ZoneAndSpacing(chart(), camera_count=1, margin_m=0.05)
    return spread_mount_poses(mount_of(), constraints, count, seed=0)


def inside(pose):
    return chart().zone_at(pose[:, [X_M, Y_M]]) == 1


@pytest.mark.parametrize("origin_m", [(0.0, 0.0, 0.0), (2.2, 0.3, 1.2)])
def test_a_pane_lies_in_its_zone_wherever_its_origin_is(origin_m):
    outline_m = np.array([[2.2, -0.6, 1.0], [2.2, 0.6, 1.0], [2.2, 0.6, 1.4], [2.2, -0.6, 1.4]])
    zone = replace(WINDSCREEN, origin_m=origin_m, outline_m=outline_m)
    pane = chart_of((ROOF, zone), street().ego, cell_m=0.05).panes[1]
    low_m, high_m = np.min(pane.outline_m, axis=0), np.max(pane.outline_m, axis=0)
    np.testing.assert_allclose([low_m[1:], high_m[1:]], [[-0.6, 1.0], [0.6, 1.4]], atol=0.03)
    assert low_m[0] == pytest.approx(high_m[0], abs=1e-5)
    assert 1.9 < low_m[0] < 2.5


@functools.cache
def opened(device="cpu", seed=0):
    """The street around a body that has no pane for anybody."""
    scene = street(seed=seed)
    return DeviceScene.pack(replace(scene, ego=chart().panes[1].opened(scene.ego)), device=device)


def test_cameras_stand_behind_the_skin():
    pose = spread()[inside(spread())]
    assert 5 < len(pose) < 60
    x_m = mount_of().position_m(pose)[:, 0]
    assert (x_m <= 2.2 - 0.03 + 1e-6).all()
    assert (x_m >= 2.2 - 0.15 - 1e-6).all()
    assert np.ptp(x_m) > 0.08
    rig = mount_of().rig(spread())
    assert [camera.behind_glass is not None for camera in rig.cameras] == inside(spread()).tolist()
    again = mount_of().mount_pose_of_rig(rig)
    np.testing.assert_allclose(again, spread(), atol=1e-5)
    assert WINDSCREEN.yaw_range_rad == (-0.8, 0.8)
    low, high = replace(WINDSCREEN, yaw_rad=None, normal=(0.6, 0.0, 0.8)).yaw_range_rad
    assert high - low == pytest.approx(math.radians(170.0))


def test_single_cameras_see_through_their_own_pane_alone(device):
    """Those inside detect as around a body without the pane, those on the roof as around the closed one."""
    pose, is_inside = spread(), inside(spread())
    cameras = cameras_of(mount=mount_of(device))
    found = cameras.detection_probability(pose, packed_street(device))
    around_closed, around_opened = (
        replace_panes(cameras).detection_probability(pose, scene) for scene in (packed_street(device), opened(device))
    )
    np.testing.assert_array_equal(found[~is_inside], around_closed[~is_inside])
    np.testing.assert_allclose(found[is_inside], around_opened[is_inside], atol=1e-5)
    assert found[is_inside].max() > 0.1
    assert around_closed[is_inside].max() == 0.0


def replace_panes(cameras):
    """The same cameras, to which the whole body is opaque."""
    mount = cameras.mount
    surface = replace(mount.surface, panes=())
    closed = CameraMount(surface, camera=mount.camera, height_offset_m=0.0, device=mount.device, free=mount.free)
    return replace(cameras, mount=closed)


def test_jacobians_are_those_around_a_body_without_the_pane(device):
    pose, is_inside = spread(), inside(spread())
    cameras = cameras_of(mount=mount_of(device))
    probability, jacobian = cameras.with_jacobian(pose, [packed_street(device)])
    expected, slope = replace_panes(cameras).with_jacobian(pose[is_inside], [opened(device)])
    np.testing.assert_allclose(probability[is_inside], expected, atol=1e-5)
    np.testing.assert_allclose(jacobian[is_inside], slope, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(probability, cameras.detection_probability(pose, packed_street(device)), atol=1e-4)


def test_the_jacobian_through_a_pane_is_that_of_finite_differences():
    """Of visible areas, at supersampling 4 against differences at 8: places, stand-off, yaw and pitch."""
    model = CameraModel(192, 192, math.radians(100.0), near_m=0.01)
    pose = spread()[inside(spread())][:8].astype(np.float64)
    origin_m, cell_m = chart().origin_m, chart().cell_m
    pose[:, [X_M, Y_M]] = origin_m + (np.floor((pose[:, [X_M, Y_M]] - origin_m) / cell_m) + 0.5) * cell_m
    mount, raster = mount_of(model=model), packed_street().raster.through(chart().panes[1])

    def areas_of(moved, supersampling):
        views = mount.place(wp.array(moved.astype(np.float32), dtype=float), 1)
        renderer = Renderer([model] * len(moved), supersampling=supersampling)
        return renderer.render(raster, views.position_ego_m, views.camera_from_ego).areas()

    by_view = areas_of(pose, 4).jacobian.numpy().astype(np.float64)
    slope = placing_slope(mount, pose.astype(np.float32))
    jacobian = np.einsum("cok,ckn->con", by_view[..., :3], slope.position)
    jacobian += np.einsum("cok,ckn->con", by_view[..., 3:6], slope.rotation)
    columns = {X_M: 0.004, Y_M: 0.004, HEIGHT_DELTA_M: 0.004, YAW_RAD: 0.003, PITCH_RAD: 0.003}
    weight = np.array([1.0, 1.0, 1.0, 0.1, 0.1])
    difference = []
    for column, step in columns.items():
        ends = []
        for sign in (1.0, -1.0):
            moved = pose.copy()
            moved[:, column] += sign * step
            ends.append(areas_of(moved, 8).visible.numpy().astype(np.float64))
        difference.append((ends[0] - ends[1]) / (2.0 * step))
    share = np.random.default_rng(0).normal(size=(by_view.shape[1], 4))  # of all objects together, of either sign
    truth, ours = (
        np.einsum("con,ow->cwn", each, share).reshape(-1, len(columns)) * weight
        for each in (np.stack(difference, axis=-1), jacobian[..., list(columns)])
    )
    cosine = (ours * truth).sum(axis=1) / (np.linalg.norm(ours, axis=1) * np.linalg.norm(truth, axis=1))
    assert len(cosine) == 32
    assert np.median(cosine) > 0.99, cosine


def test_metrics_and_pictures_know_the_pane(device):
    [camera] = mount_of().rig(spread()[inside(spread())][:1]).cameras
    on_roof = RigCamera("roof", np.array([2.19, 0.0, 1.7]), model=MODEL)
    rig = Rig([on_roof, replace(camera, name="in"), replace(camera, name="shut", behind_glass=None)])
    scene = packed_street(device)
    options = ObjectiveOptions(occlusion=Occlusion.EXACT)
    seen = RigObserver(rig, SilentDetector(), options, device=device).observe(scene)
    by_camera = np.concatenate([each.truth_box_px for each in seen.observations])[np.argsort(seen.camera)]
    visible = np.isfinite(by_camera[..., 0]).any(axis=1)
    assert visible.tolist() == [True, True, False]
    share = body_shares(rig, scene)
    assert share["shut"] == 1.0
    assert 0.0 < share["in"] < 0.9
    assert share["in"] == pytest.approx(
        body_shares(Rig([replace(camera, behind_glass=None)]), opened(device))[camera.name]
    )
    images = wa.render(rig, street(), device=device)
    assert set(np.unique(images["shut"].object_index)) == {1}
    assert len(np.unique(images["in"].object_index)) > 3


def test_requirements_are_seen_through_the_pane_by_its_camera_alone():
    pose = spread()[inside(spread())][:2]
    rig = mount_of().rig(pose)
    ego = street().ego
    requirements = read_requirements("near_field")
    result = wa.check_requirements(rig, ego, requirements)
    shut = Rig([replace(camera, behind_glass=None) for camera in rig.cameras])
    assert wa.check_requirements(shut, ego, requirements).visibility.pixels.max() == 0.0
    assert result.visibility.pixels.max() > 0.0
    ghosts = RequiredPoints(requirements, ego)
    found = cameras_of(mount=mount_of()).detection_probability(spread()[:6], ghosts)
    apart = [cameras_of(mount=mount_of()).detection_probability(spread()[k : k + 1], ghosts)[0] for k in range(6)]
    np.testing.assert_array_equal(found, apart)
    again, jacobian = cameras_of(mount=mount_of()).with_jacobian(pose, [ghosts])
    np.testing.assert_allclose(again, cameras_of(mount=mount_of()).detection_probability(pose, ghosts), atol=2e-2)
    assert np.abs(jacobian).max() > 0.0


def test_a_rig_file_says_what_its_cameras_look_through(tmp_path):
    rig = mount_of().rig(spread()[:8])
    wa.write_rig(rig, tmp_path / "rig.yaml")
    again = wa.read_rig(tmp_path / "rig.yaml")
    assert [camera.behind_glass for camera in again.cameras] == [camera.behind_glass for camera in rig.cameras]
    assert again.panes == rig.panes != {}
    wa.write_rig(again, tmp_path / "again.yaml")
    assert (tmp_path / "rig.yaml").read_bytes() == (tmp_path / "again.yaml").read_bytes()
    text = (tmp_path / "rig.yaml").read_text()
    for old, new, words in (
        ("behind_glass: windscreen", "behind_glass: windscren", "did you mean windscreen?"),
        ("panes:", "pane:", "did you mean panes?"),
        ("normal: [1.0, 0.0, 0.0]", "normal: [2.0, 0.0, 0.0]", "unit vector"),
    ):
        (tmp_path / "wrong.yaml").write_text(text.replace(old, new))
        with pytest.raises(InputError, match=words.replace("?", r"\?")):
            wa.read_rig(tmp_path / "wrong.yaml")
    camera = next(each for each in rig.cameras if each.behind_glass)
    other = replace(camera, name="other", behind_glass=replace(camera.behind_glass, reach_m=(-0.3, 0.3)))
    with pytest.raises(InputError, match="expected one pane called 'windscreen', got two"):
        Rig([camera, other])


def test_pairs_look_through_the_pane_on_either_side():
    """A pair detects what its two cameras do, each rendered by itself on a mount that knows no pairs."""
    from warpav.rig import Housing, Module, Price

    module = Module(
        name="eye",
        sensor_px=(64, 64),
        fov_rad=math.radians(100.0),
        housing=Housing((0.02, 0.02, 0.02)),
        price=Price(1.0),
        source="test",
    )
    model = replace(module.camera_model(), near_m=0.01)
    options = {"cell_m": 0.05, "modules": [module]}
    mounts = [
        CameraMount(chart_of((ROOF, WINDSCREEN), street().ego, **options, **more), camera=(model,), height_offset_m=0.0)
        for more in ({"pair_spacing_m": 0.3}, {})
    ]
    paired, single = mounts
    constraints = ZoneAndSpacing(paired.surface, camera_count=1, margin_m=0.05)
    pose = spread_mount_poses(paired, constraints, 24, seed=1)
    assert any(paired.panes_of(pose))
    assert not all(paired.panes_of(pose))
    rig = paired.rig(pose)
    assert len(rig.cameras) == 48
    assert len(rig.panes) == 1  # the windscreen lies across the middle
    found = cameras_of(mount=paired).detection_probability(pose, packed_street())
    each = cameras_of(mount=single).detection_probability(single.mount_pose_of_rig(rig), packed_street())
    expected = 1.0 - (1.0 - each[0::2]) * (1.0 - each[1::2])
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert found.max() > 0.1
