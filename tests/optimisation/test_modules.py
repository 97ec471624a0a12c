"""Rigs that mix modules: images of different size and lens in one mount, and limits of numbers and cost."""

import functools
import itertools
import math
import pickle

import numpy as np
import pytest

from tests.detection.test_probability import model_of
from tests.driving_scene import street
from tests.optimisation.test_pool import streets
from tests.optimisation.test_zones import zones
from warpav.core.errors import InputError
from warpav.optimisation.baselines import highest_mount_pose
from warpav.optimisation.constraints import ZoneAndSpacing
from warpav.optimisation.losses.scene_on_tape import CameraProbability
from warpav.optimisation.mount import X_M, Y_M, CameraMount
from warpav.optimisation.pool import spread_mount_poses
from warpav.optimisation.pool_search import PoolSearchSettings, pool_search
from warpav.optimisation.rig_limits import RigLimits
from warpav.optimisation.search import SearchSpace
from warpav.optimisation.selection.select import select
from warpav.optimisation.single_cameras import SingleCameras
from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens
from warpav.rig.chart import chart_of
from warpav.rig.module import Housing, Module, Price
from warpav.rig.rig import Rig, RigCamera, read_rig, write_rig

NEAR_M = 0.01
SMALL = PoolSearchSettings(pool_cameras=30, rounds=1, priced_cameras=3, gap=0.0)


def module(name, px, fov_deg, lens="pinhole", fits=(), price=1.0):
    return Module(
        name=name,
        sensor_px=px,
        fov_rad=math.radians(fov_deg),
        lens=Lens(lens),
        housing=Housing((0.03, 0.03, 0.03)),
        price=Price(price),
        source="made up",
        zones=fits,
    )


MODULES = (
    module("narrow", (96, 48), 40.0, fits=("front", "up"), price=3.0),
    module("wide", (48, 64), 100.0, price=2.0),
    module("fisheye", (56, 56), 190.0, "fisheye", fits=("left", "right", "rear"), price=1.0),
)


@functools.cache
def chart():
    options = {"cell_m": 0.05, "min_upward_normal": 0.6, "min_zone_normal": 0.7}
    return chart_of(zones(), street().ego, modules=MODULES, **options)


def models():
    return tuple(
        CameraModel(*each.sensor_px, each.fov_rad, NEAR_M, each.lens, distortion=each.distortion) for each in MODULES
    )


def mount_of(device="cpu"):
    return CameraMount(chart(), camera=models(), height_offset_m=0.0, device=device)


def constraints_of(camera_module=None, count=4):
    of_module = None if camera_module is None else np.array(camera_module)
    count = count if of_module is None else len(of_module)
    return ZoneAndSpacing(chart(), camera_count=count, margin_m=0.02, module=of_module)


@functools.cache
def probabilities():
    return tuple(CameraProbability(model_of(np.random.default_rng(seed), 0.3)) for seed in range(3))


def cameras_of(**options):
    return SingleCameras(mount_of(), probabilities(), **options)


@functools.cache
def spread(count=48):
    return spread_mount_poses(mount_of(), constraints_of(), count, seed=0)


def test_modules_stand_in_the_zones_that_they_fit_and_in_equal_numbers():
    pose = spread()
    of_module = mount_of().module_of(pose)
    np.testing.assert_array_equal(np.bincount(of_module), [16, 16, 16])
    for number, each in enumerate(MODULES):
        names = {chart().zones[k].name for k in chart().zone_at(pose[of_module == number][:, [X_M, Y_M]])}
        assert names <= set(each.zones or [zone.name for zone in zones()])
        assert len(names) > 1


def test_places_of_one_zone_are_the_same_points_for_all_modules():
    """A rig's cameras lie in the ego frame, whatever sheet of the chart they are drawn on."""
    mount, plain = mount_of(), chart_of(zones(), street().ego, cell_m=0.05, min_upward_normal=0.6, min_zone_normal=0.7)
    for point in mount.position_m(spread()):
        place, rise = plain.place_of(point)
        np.testing.assert_allclose(plain.point_m(place, plain.height_at_m(place) + rise), point, atol=1e-6)
        assert plain.zone_distance_m(place) >= 0.0


def test_each_camera_detects_what_a_mount_of_its_module_alone_says():
    """Bit for bit, in whatever order they stand."""
    pose = np.random.default_rng(3).permutation(spread())
    found = [cameras_of().detection_probability(pose, scene) for scene in streets()]
    of_module = mount_of().module_of(pose)
    for number, model in enumerate(models()):
        alone = CameraMount(chart_without_modules(), camera=model, height_offset_m=0.0)
        single = SingleCameras(alone, probabilities()[number])
        rows = of_module == number
        moved = alone.mount_pose_of_rig(mount_of().rig(pose[rows]))
        for scene, every in zip(streets(), found, strict=True):
            expected = single.detection_probability(moved, scene)
            np.testing.assert_allclose(every[rows], expected, atol=2e-3)  # worst seen 4e-4: poses go through float32
    assert all(np.isfinite(each).all() for each in found)


@functools.cache
def chart_without_modules():
    return chart_of(zones(), street().ego, cell_m=0.05, min_upward_normal=0.6, min_zone_normal=0.7)


def test_the_jacobian_is_that_of_each_module():
    """Against differences of the probabilities of supersampled renders, which are as smooth as a raster gets."""
    pose = spread()[:6].astype(np.float64)
    scenes = [scene for scene in streets() if scene.vehicle_count]
    cameras = cameras_of(supersampling=4)
    probability, jacobian = cameras.with_jacobian(pose, scenes)
    one_by_one = [cameras.detection_probability(pose, scene) for scene in scenes]
    np.testing.assert_allclose(probability, np.concatenate(one_by_one, axis=1), atol=2e-3)
    for row in range(len(pose)):
        alone, slope = cameras.with_jacobian(pose[row : row + 1], scenes)
        np.testing.assert_array_equal(alone[0], probability[row])
        np.testing.assert_array_equal(slope[0], jacobian[row])
    assert np.abs(jacobian[..., [X_M, Y_M]]).max() > 0.01


def test_they_travel_to_other_processes():
    cameras = pickle.loads(pickle.dumps(cameras_of()))
    assert cameras.identity == cameras_of().identity
    scene = streets()[0]
    np.testing.assert_array_equal(
        cameras.detection_probability(spread()[:5], scene), cameras_of().detection_probability(spread()[:5], scene)
    )


def test_a_mount_without_one_model_for_each_module_is_refused():
    with pytest.raises(ValueError, match="one model for each of 3, got 2"):
        CameraMount(chart(), camera=models()[:2], height_offset_m=0.0)
    with pytest.raises(ValueError, match="one for each of 3"):
        SingleCameras(mount_of(), probabilities()[:2])


def test_a_module_that_fits_no_zone_is_named():
    lost = module("lost", (64, 64), 60.0, fits=("tow_bar",))
    with pytest.raises(InputError, match=r"^module 'lost': zones: expected one of the vehicle's, up, .*, got tow_bar"):
        chart_of(zones()[:2], street().ego, cell_m=0.05, modules=[lost])


def test_rigs_keep_their_modules_through_files(tmp_path):
    mount = mount_of()
    rig = mount.rig(spread()[:5])
    assert [camera.module for camera in rig.cameras] == ["narrow", "wide", "fisheye", "narrow", "wide"]
    assert [camera.name for camera in rig.cameras] == ["narrow_1", "wide_1", "fisheye", "narrow_2", "wide_2"]
    assert [camera.model.width_px for camera in rig.cameras] == [96, 48, 56, 96, 48]
    write_rig(rig, tmp_path / "rig.yaml")
    found = read_rig(tmp_path / "rig.yaml")
    assert [camera.module for camera in found.cameras] == [camera.module for camera in rig.cameras]
    pose = mount.mount_pose_of_rig(found)
    np.testing.assert_array_equal(mount.module_of(pose), mount.module_of(spread()[:5]))
    # where zones overlap a camera may be found in the other one, at the same point
    np.testing.assert_allclose(mount.position_m(pose), mount.position_m(spread()[:5]), atol=2e-5)


def test_a_camera_of_another_module_is_named():
    rig = Rig([RigCamera("front", np.array([2.0, 0.0, 1.0]), module="tele")])
    with pytest.raises(InputError, match=r"camera 'front': module: expected one of narrow, wide, fisheye, got tele"):
        mount_of().mount_pose_of_rig(rig)


def test_rigs_are_brought_to_zones_of_their_modules():
    constraints = constraints_of([0, 2, 2, 1])
    rng = np.random.default_rng(0)
    for _ in range(20):
        low, high = chart().bounds_m
        place = constraints.project(rng.uniform(low, high, (4, 2)))
        np.testing.assert_array_equal(chart().module_at(place), [0, 2, 2, 1])
        assert constraints.contains(place).all()
        drawn = constraints.random_place(4, rng)
        np.testing.assert_array_equal(chart().module_at(drawn), [0, 2, 2, 1])
    pose = highest_mount_pose(constraints, 4)
    np.testing.assert_array_equal(mount_of().module_of(pose), [0, 2, 2, 1])
    space = SearchSpace.over(mount_of(), 4, constraints=constraints)
    for _ in range(10):
        pose = space.pose_of(rng.uniform(0.0, 1.0, space.size))
        np.testing.assert_array_equal(mount_of().module_of(pose), [0, 2, 2, 1])
        assert space.violation_m(pose) == 0.0


LIMITS = {"narrow": (0, 1), "wide": (0, 2), "fisheye": (0, 2)}
PRICES = {"narrow": 3.0, "wide": 2.0, "fisheye": 1.0}


@pytest.mark.parametrize(
    ("count", "cost_max"), [((1, 4), None), ((1, 4), 5.0), ((2, 3), 6.0), ((3, 3), None), ((1, 1), 2.5)]
)
def test_the_selection_is_the_best_of_all_rigs_within_the_limits(count, cost_max):
    rng = np.random.default_rng(5)
    of_module = np.repeat([0, 1, 2], 4)
    found = rng.uniform(0.0, 0.9, (12, 25)) * (rng.uniform(size=(12, 25)) < 0.4)
    limits = RigLimits.of(LIMITS, count=count, price=PRICES, cost_max=cost_max)
    absent = limits.absent
    selection = select(
        np.pad(found, ((0, absent), (0, 0))),
        limits.count[1],
        rows=limits.rows(np.append(of_module, np.full(absent, -1))),
        gap=0.0,
    )
    chosen = selection.cameras[selection.cameras < 12]
    best = min(
        (float(np.prod(1.0 - found[list(rig)], axis=0).mean()), rig)
        for size in range(count[0], count[1] + 1)
        for rig in itertools.combinations(range(12), size)
        if all(low <= np.sum(of_module[list(rig)] == k) <= high for k, (low, high) in enumerate(LIMITS.values()))
        and (cost_max is None or sum(list(PRICES.values())[k] for k in of_module[list(rig)]) <= cost_max)
    )
    assert selection.objective == pytest.approx(best[0], abs=1e-12)
    assert tuple(chosen) == best[1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"count": (6, 7)}, r"^rig.cameras: expected 1 to 5, as many as rig.modules allows, got 6..7; change one"),
        ({"count": (3, 3), "cost_max": 3.5}, r"^rig.max_cost: expected at least 4, what the cheapest rig .* got 3.5"),
    ],
)
def test_limits_that_no_rig_satisfies(options, message):
    with pytest.raises(InputError, match=message):
        RigLimits.of(LIMITS, price=PRICES, **options)


def test_the_first_rig_is_the_cheapest():
    limits = RigLimits.of({"narrow": (1, 1), "wide": (0, 2), "fisheye": (0, 2)}, count=(4, 5), price=PRICES)
    np.testing.assert_array_equal(limits.first_modules(), [0, 1, 2, 2])
    assert limits.cost(["narrow", "fisheye", None]) == 4.0


@pytest.mark.parametrize("cost_max", [None, 4.0])
def test_a_search_keeps_the_limits(cost_max):
    limits = RigLimits.of(LIMITS, count=(2, 4), price=PRICES, cost_max=cost_max)
    scenes = streets()
    start = highest_mount_pose(constraints_of(limits.first_modules()), 2)
    states = list(
        pool_search(
            cameras_of(), scenes, constraints_of(limits.first_modules()), 4, start=start, settings=SMALL, limits=limits
        )
    )
    values = [state.objective for state in states]
    assert values == sorted(values, reverse=True)
    assert values[-1] < values[0]
    for state in states:
        names = [camera.module for camera in mount_of().rig(state.mount_pose).cameras]
        assert 2 <= len(names) <= 4
        assert all(names.count(name) <= high for name, (_, high) in LIMITS.items())
        assert cost_max is None or limits.cost(names) <= cost_max
        assert constraints_of(count=len(names)).violation_m(mount_of().rig(state.mount_pose)) == 0.0
    last = states[-1]
    found = np.concatenate([cameras_of().detection_probability(last.mount_pose, scene) for scene in scenes], axis=1)
    assert last.objective == pytest.approx(np.prod(1.0 - np.minimum(found, 0.9999), axis=0).mean(), abs=1e-5)
