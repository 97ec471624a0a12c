"""Rigs that mix modules: images of different size and lens in one mount, and limits of numbers and cost."""

import functools
import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from tests.detection.test_probability import model_of
from tests.driving_scene import ConstantDetector, street
from tests.optimisation.calls import pool_search, select
from tests.optimisation.test_pool import streets
from tests.optimisation.test_zones import chart as chart_without_modules
from tests.optimisation.test_zones import zones
from warpav.core.errors import InputError
from warpav.detection import SUREST, Fusion, LidarProbability
from warpav.optimisation import (
    PITCH_RAD,
    X_M,
    Y_M,
    YAW_RAD,
    AssignedScene,
    CameraMount,
    CameraProbability,
    ExpectedMissRate,
    Importance,
    ImportanceSettings,
    ObjectiveOptions,
    PoolSearchSettings,
    RigLimits,
    RigObjective,
    SearchSpace,
    ZoneAndSpacing,
    highest_mount_pose,
)
from warpav.optimisation._mount import views_of_rig
from warpav.optimisation._pool import spread_mount_poses
from warpav.optimisation._single_cameras import SingleCameras
from warpav.raster.beams import Beams
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.lens import Lens
from warpav.raster.renderer import Renderer
from warpav.rig import NORMALS, Housing, Module, Price, Rig, Zone, chart_of, read_rig, write_rig
from warpav.scene import DeviceScene

NEAR_M = 0.01
SMALL = PoolSearchSettings(pool_cameras=30, rounds=1, priced_cameras=2, gap=0.0)


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


def test_bounds_of_a_module_hold_its_zones_and_no_more():
    surface = chart()
    place_m = surface.origin_m + surface.cell_m * np.argwhere(surface.is_mountable)
    for number in range(3):
        own_m = place_m[surface.module_at(place_m) == number]
        np.testing.assert_allclose(surface.bounds_of(number), [own_m.min(axis=0), own_m.max(axis=0)])
    assert np.ptp(surface.bounds_of(0), axis=0).prod() < np.ptp(surface.bounds_m, axis=0).prod()


def test_the_highest_point_of_a_module_is_in_its_zones():
    surface = chart()
    place_m = surface.place_m[surface.inside]
    height_m = surface.point_m(place_m, surface.height_at_m(place_m))[:, 2]
    for number in range(3):
        own_m = height_m[surface.module_at(place_m) == number]
        top_m = surface.highest_point_m(number)[None, :2]
        assert surface.module_at(top_m)[0] == number
        assert surface.point_m(top_m, surface.height_at_m(top_m))[0, 2] == pytest.approx(own_m.max(), abs=0.002)


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


@pytest.mark.parametrize("is_frozen", [False, True])
def test_the_objective_of_modules_is_that_of_single_cameras_with_its_gradient(is_frozen):
    pose, scenes = spread()[[0, 4, 2]].astype(np.float32), [*streets(), DeviceScene.pack(street(0))]
    mount = mount_of()
    if is_frozen:
        rig = mount.rig(pose)
        mount = mount.freezing(rig, [rig.cameras[1].name])
    importance = Importance(ImportanceSettings(distance_m={0: 3.0, 9: 1.0}))
    objective = RigObjective(
        mount,
        ConstantDetector.silent(3),
        camera_count=3,
        losses=[(2.0, ExpectedMissRate())],
        camera_probability=probabilities(),
        constraints=constraints_of([0, 1, 2]),
        importance=importance,
        options=ObjectiveOptions(occlusion=Occlusion.EXACT),
    )
    assigned = [AssignedScene(scene, np.full(scene.vehicle_count, -1, np.int32)) for scene in scenes]
    probability, jacobian = cameras_of().with_jacobian(pose, scenes)
    missed = 1.0 - np.minimum(probability, 0.9999)
    share = importance.weights_of(scenes) / importance.weights_of(scenes).sum()
    expected = float(missed.prod(axis=0) @ share)
    slope = np.stack([-(np.delete(missed, k, axis=0).prod(axis=0) * share) @ jacobian[k] for k in range(3)])
    slope[1] *= not is_frozen
    found = objective.evaluate(pose, assigned, gradient=True, detection_probability=True)
    assert (found.total, found.objective, found.terms["expected_miss_rate"]) == pytest.approx(
        (2 * expected,) * 2 + (expected,), rel=1e-5
    )
    np.testing.assert_allclose(found.gradient, 2.0 * slope, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(found.detection_probability, probability, atol=1e-6)
    assert found.multiplier_gradient is None
    assert 0.0 < found.seconds["render"] == found.seconds["total"] < 60.0
    plain = objective.evaluate(pose, assigned)
    assert plain.objective == pytest.approx(2.0 * expected, abs=2e-3)
    assert plain.gradient is None
    one = probability[:, :6]
    alone = float(missed[:, :6].prod(axis=0) @ share[:6] / share[:6].sum())
    assert objective.value_of(one, assigned[0]) == pytest.approx(2.0 * alone, rel=1e-5)
    assert objective.value_of(probability[:, :0], assigned[1]) == 0.0
    assert objective.evaluate(pose, assigned[1:2]).objective == 0.0


@pytest.mark.parametrize("within_m", [12.0, math.inf])
def test_a_camera_and_a_lidar_must_both_find_what_is_near(within_m):
    """Objective and gradient against the formula, with what each sensor finds by itself and its slopes."""
    beams = Beams(tuple(np.radians(np.linspace(-25.0, 15.0, 16))), math.radians(0.4))
    common = {"housing": Housing((0.1, 0.1, 0.1)), "price": Price(1.0), "source": "made up"}
    modules = (MODULES[1], Module.of_beams("lidar", beams, 0.3, **common))
    surface = chart_of(zones(), street().ego, modules=modules, cell_m=0.05, min_upward_normal=0.6, min_zone_normal=0.7)
    mount = CameraMount(surface, camera=[models()[1], modules[1].camera_model()], height_offset_m=0.0)
    of_module = np.array([0, 0, 1, 1])
    constraints = ZoneAndSpacing(surface, camera_count=4, margin_m=0.02, module=of_module)
    of_sensors = (probabilities()[1], LidarProbability(beams))
    objective = RigObjective(
        mount,
        ConstantDetector.silent(4),
        camera_count=4,
        losses=[(1.0, ExpectedMissRate())],
        camera_probability=of_sensors,
        constraints=constraints,
        options=ObjectiveOptions(occlusion=Occlusion.EXACT, fusion=Fusion(within_m)),
    )
    spread = spread_mount_poses(mount, constraints, 24, seed=0)
    pose = spread[np.concatenate([np.flatnonzero(mount.module_of(spread) == k)[:2] for k in (0, 1)])]
    scenes = [scene for scene in streets() if scene.vehicle_count]
    p, jacobian = SingleCameras(mount, of_sensors).with_jacobian(pose, scenes)
    near = np.concatenate([scene.distance_m for scene in scenes]) < within_m
    assert near.any()
    assert near.all() == (within_m == math.inf)

    def missed(p):
        by_cameras, by_lidars = ((1.0 - np.minimum(p[of_module == k], SUREST)).prod(axis=0) for k in (0, 1))
        return np.where(near, 1.0 - (1.0 - by_cameras) * (1.0 - by_lidars), by_cameras * by_lidars)

    assigned = [AssignedScene(scene, np.full(scene.vehicle_count, -1, np.int32)) for scene in scenes]
    found = objective.evaluate(pose, assigned, gradient=True, detection_probability=True)
    assert found.objective == pytest.approx(missed(p).mean(), rel=1e-5)
    np.testing.assert_allclose(found.detection_probability, p, atol=1e-6)
    for camera, number in itertools.product(range(4), (X_M, Y_M, YAW_RAD)):
        step = np.zeros_like(p)
        step[camera] = 1e-4 * jacobian[camera, :, number]
        slope = (missed(p + step) - missed(p - step)).mean() / 2e-4
        assert found.gradient[camera, number] == pytest.approx(slope, rel=1e-3, abs=1e-5)
    assert np.abs(found.gradient[of_module == 1]).max() > 1e-3
    ends = np.cumsum([scene.vehicle_count for scene in scenes])[:-1]
    of_scene = zip(np.split(p, ends, 1), assigned, strict=True)
    alone = [objective.value_of(each, scene, mount.rig(pose).is_lidar) for each, scene in of_scene]
    assert alone == pytest.approx([each.mean() for each in np.split(missed(p), ends)], rel=1e-6)


def test_rigs_keep_their_modules_through_files(tmp_path):
    mount = mount_of()
    rig = mount.rig(spread()[:5])
    assert [camera.module for camera in rig.cameras] == ["narrow", "wide", "fisheye", "narrow", "wide"]
    assert [camera.model.width_px for camera in rig.cameras] == [96, 48, 56, 96, 48]
    write_rig(rig, tmp_path / "rig.yaml")
    found = read_rig(tmp_path / "rig.yaml")
    assert [camera.module for camera in found.cameras] == [camera.module for camera in rig.cameras]
    pose = mount.mount_pose_of_rig(found)
    np.testing.assert_array_equal(mount.module_of(pose), mount.module_of(spread()[:5]))
    # where zones overlap a camera may be found in the other one, at the same point
    np.testing.assert_allclose(mount.position_m(pose), mount.position_m(spread()[:5]), atol=2e-5)


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


@pytest.mark.parametrize("seed", range(40))
def test_limits_are_those_of_all_rigs_counted_one_by_one(seed):
    """Random limits of two modules, the first in pairs or single where rigs are symmetric, the other in pairs."""
    rng = np.random.default_rng(seed)
    low = rng.integers(0, 3, 2)
    of_module = {name: (int(a), int(a + rng.integers(0, 4))) for name, a in zip("ab", low, strict=True)}
    count = tuple(np.sort(rng.integers(1, 7, 2)).tolist()) if seed % 3 else None
    price = {"a": float(rng.integers(1, 4)), "b": float(rng.integers(0, 4))}
    kinds = [("a", 2), ("a", 1), ("b", 2)] if seed % 2 else [("a", 1), ("b", 1)]
    cost_max = float(rng.integers(4, 12)) if seed % 4 > 1 else None
    low, high = count or (max(low.sum(), 1), sum(most for _, most in of_module.values()))

    def is_whole(a, b):
        inside = all(least <= n <= most for n, (least, most) in zip((a, b), of_module.values(), strict=True))
        return inside and low <= a + b <= high

    rigs = {n: n[0] * price["a"] + n[1] * price["b"] for n in itertools.product(range(7), repeat=2) if is_whole(*n)}
    if not rigs or (cost_max is not None and min(rigs.values()) > cost_max):
        with pytest.raises(InputError, match=r"rig\.(max_cost|cameras|modules): expected"):
            RigLimits.of(of_module, count=count, price=price, cost_max=cost_max, kinds=kinds)
        return
    limits = RigLimits.of(of_module, count=count, price=price, cost_max=cost_max, kinds=kinds)
    dearest = max(rigs.values())
    assert limits.cost_range() == (min(rigs.values()), dearest if cost_max is None else min(dearest, cost_max))
    assert limits.count == (min(map(sum, rigs)), max(map(sum, rigs)))
    fewest = min(n for n, cost in rigs.items() if cost == min(rigs.values()) and sum(n) == limits.count[0])
    if seed % 2 and any(n[1] % 2 for n, cost in rigs.items() if sum(n) == limits.count[0]):
        return  # an odd number of the one that is there in pairs alone
    first = limits.first_kinds()
    assert limits.size(first) == sum(fewest)
    assert limits.cost([kinds[k][0] for k in first for _ in range(kinds[k][1])]) == min(rigs.values())
    column = np.repeat([*range(len(kinds)), -1], [4] * len(kinds) + [1])
    assert limits.size(column) == 4 * sum(size for _, size in kinds)
    rows = limits.rows(column)
    for taken in itertools.product(range(4), repeat=len(kinds)):
        kind = np.repeat(np.arange(len(kinds)), taken)
        number = tuple(sum(n * size for n, (m, size) in zip(taken, kinds, strict=True) if m == name) for name in "ab")
        cost = number[0] * price["a"] + number[1] * price["b"]
        cheap = cost_max is None or cost <= cost_max
        fits = cheap and sum(number) <= limits.count[1]
        fits = fits and all(n <= most for n, (_, most) in zip(number, of_module.values(), strict=True))
        assert limits.holds(kind) == (number in rigs and cheap)
        assert limits.holds(kind, is_whole=False) == fits
        chosen = np.concatenate([4 * k + np.arange(n) for k, n in enumerate(taken)]).astype(int)
        sums = [(row.low, row.coefficient[chosen].sum(), row.high) for row in rows]
        is_kept = all(least <= value <= most for least, value, most in sums)
        if seed % 2 or limits.count[0] <= len(kind) <= limits.count[1]:  # what the selection counts itself
            assert is_kept == (number in rigs and cheap)
    most_absent = limits.count[1] - -(-limits.count[0] // max(size for _, size in kinds))
    assert limits.absent == most_absent
    fewer = limits.within(count=(limits.count[0],) * 2)
    assert (fewer.count, fewer.cost_max, fewer.kinds) == ((limits.count[0],) * 2, cost_max, tuple(kinds))
    assert limits.within(cost_max=99.0).cost_range() == (min(rigs.values()), min(dearest, 99.0))


@pytest.mark.parametrize("cost_max", [None, 4.0])
def test_a_search_keeps_the_limits(cost_max):
    limits = RigLimits.of(LIMITS, count=(2, 4), price=PRICES, cost_max=cost_max)
    scenes = streets()
    start = highest_mount_pose(constraints_of(limits.first_kinds()), 2)
    options = {"start": start, "settings": replace(SMALL, rounds=int(cost_max is not None)), "limits": limits}
    states = list(pool_search(cameras_of(), scenes, constraints_of(limits.first_kinds()), 4, **options))
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


# --- symmetric rigs --------------------------------------------------------------------------------------------------


SPACING_M = 0.3


@functools.cache
def symmetric_chart():
    everywhere = zones()
    middle = [Zone("middle", NORMALS["rear"], stand_off_m=(0.0, 0.03), pitch_rad=(-0.2, 0.5), is_centred=True)]
    options = {"cell_m": 0.05, "min_upward_normal": 0.6, "min_zone_normal": 0.7, "pair_spacing_m": SPACING_M}
    modules = [replace(each, zones=()) for each in MODULES]
    return chart_of([*everywhere, *middle], street().ego, modules=modules, **options)


def symmetric_mount():
    surface = symmetric_chart()
    of_name = dict(zip([each.name for each in MODULES], models(), strict=True))
    return CameraMount(surface, camera=[of_name[name] for name in surface.modules], height_offset_m=0.0)


def symmetric_cameras(**options):
    of_name = dict(zip([each.name for each in MODULES], probabilities(), strict=True))
    probability = tuple(of_name[name] for name in symmetric_chart().modules)
    return SingleCameras(symmetric_mount(), probability, **options)


@functools.cache
def columns(count=36):
    constraints = ZoneAndSpacing(symmetric_chart(), camera_count=1, margin_m=0.02)
    return spread_mount_poses(symmetric_mount(), constraints, count, seed=0)


def test_a_cache_tells_pairs_from_single_cameras():
    cameras = symmetric_cameras()
    surface = replace(symmetric_chart(), pairs=(False,) * 6)
    single = CameraMount(surface, camera=cameras.mount.cameras, height_offset_m=0.0)
    assert replace(cameras, mount=single).identity["vehicle"] != cameras.identity["vehicle"]
    assert replace(cameras, mount=symmetric_mount()).identity == cameras.identity


def test_pairs_are_mirror_images_and_the_others_stand_in_the_middle():
    mount = symmetric_mount()
    assert symmetric_chart().modules == ("narrow", "narrow", "wide", "wide", "fisheye", "fisheye")
    assert symmetric_chart().pairs == (True, False) * 3
    is_pair = mount.is_pair(columns())
    assert 0 < is_pair.sum() < len(is_pair)
    rig = mount.rig(columns())
    row = mount.rows_of_cameras(columns())
    assert len(rig.cameras) == len(row) == len(is_pair) + is_pair.sum()
    for number, pair in enumerate(is_pair):
        cameras = [camera for camera, of in zip(rig.cameras, row, strict=True) if of == number]
        if not pair:
            [camera] = cameras
            assert abs(camera.position_m[1]) < 1e-6
            assert abs(abs(camera.yaw_rad) - math.pi) < 1e-6
            continue
        left, right = cameras
        assert left.position_m[1] >= 0.5 * SPACING_M - 0.1
        np.testing.assert_allclose(right.position_m, left.position_m * [1.0, -1.0, 1.0], atol=1e-12)
        mirror = np.diag([1.0, -1.0, 1.0])
        expected = mirror @ left.ego_from_camera[:3, :3] @ np.diag([-1.0, 1.0, 1.0])
        np.testing.assert_allclose(right.ego_from_camera[:3, :3], expected, atol=1e-12)


def test_a_pair_detects_what_one_of_its_cameras_does():
    """Against both cameras placed by their own poses in the ego frame, rendered one by one."""
    mount, cameras = symmetric_mount(), symmetric_cameras()
    pose = columns()[:12]
    rig, row = mount.rig(pose), mount.rows_of_cameras(pose)
    of_model = dict(zip(models(), probabilities(), strict=True))
    for scene in streets():
        alone = []
        for camera in rig.cameras:
            views = views_of_rig(Rig([camera]), rotation_count=1, rotation_step_rad=0.0)
            frame = Renderer([camera.model]).render(scene.raster, views.position_ego_m, views.camera_from_ego)
            found = of_model[camera.model].model.of_coverage(frame, scene, views.position_ego_m, views.camera_from_ego)
            alone.append(found.probability.numpy()[0])
        expected = [1.0 - np.prod(1.0 - np.array(alone)[row == k], axis=0) for k in range(len(pose))]
        found = cameras.detection_probability(pose, scene)
        np.testing.assert_allclose(found, expected, atol=2e-3)  # worst seen 3e-4


def test_the_jacobian_of_a_pair_is_that_of_both_cameras():
    """The image on the right in a scene is the camera on the left in the mirrored scene; and the product rule."""
    mount, cameras = symmetric_mount(), symmetric_cameras(supersampling=4)
    alone = SingleCameras(mount, cameras.probability, supersampling=4, is_mirrored=True)
    pose = columns()[mount.is_pair(columns())][:8]
    scenes = [DeviceScene.pack(street(count, seed)) for seed, count in enumerate((6, 4))]
    mirrored = [DeviceScene.pack(street(count, seed).mirrored()) for seed, count in enumerate((6, 4))]
    own, own_slope = alone.with_jacobian(pose, scenes)
    image, image_slope = alone.with_jacobian(pose, mirrored)
    found, slope = cameras.with_jacobian(pose, scenes)
    np.testing.assert_allclose(
        found, 1.0 - (1.0 - own) * (1.0 - image), atol=6e-3
    )  # worst seen 3e-3: edges on sample centres
    expected = (1.0 - image)[..., None] * own_slope + (1.0 - own)[..., None] * image_slope
    for column in (X_M, Y_M, YAW_RAD, PITCH_RAD):
        one, other = slope[..., column].ravel(), expected[..., column].ravel()
        cosine = one @ other / (np.linalg.norm(one) * np.linalg.norm(other))
        assert cosine > 0.97, column  # worst seen .985


def test_a_symmetric_search_ends_with_a_symmetric_rig():
    mount, surface = symmetric_mount(), symmetric_chart()
    kinds = [(name, 1 + pair) for name, pair in zip(surface.modules, surface.pairs, strict=True)]
    limits = RigLimits.of({"narrow": (0, 1), "wide": (2, 2), "fisheye": (0, 2)}, count=(3, 5), kinds=kinds)
    constraints = ZoneAndSpacing(surface, camera_count=1, margin_m=0.02, module=limits.first_kinds())
    start = highest_mount_pose(constraints, len(limits.first_kinds()))
    states = list(
        pool_search(symmetric_cameras(), streets(), constraints, 5, start=start, settings=SMALL, limits=limits)
    )
    rig = mount.rig(states[-1].mount_pose)
    names = [camera.module for camera in rig.cameras]
    assert 3 <= len(names) <= 5
    assert names.count("wide") == 2
    positions = np.array([camera.position_m for camera in rig.cameras])
    for camera in rig.cameras:
        mirrored = camera.position_m * [1.0, -1.0, 1.0]
        assert np.linalg.norm(positions - mirrored, axis=1).min() < 1e-6
    assert constraints.violation_m(rig) == 0.0
    assert states[-1].objective < states[0].objective
    np.testing.assert_allclose(
        mount.position_m(mount.mount_pose_of_rig(rig)), mount.position_m(states[-1].mount_pose), atol=1e-4
    )
