"""Weights of road users: what they are, and that objective, gradient, pool, selection and polish all take them."""

import dataclasses
import itertools
import math

import numpy as np
import pytest

from tests.optimisation.calls import draw, pool_search, select
from tests.optimisation.test_missed import POSE, objective_of, probabilities, probability_model, scenes_of
from tests.optimisation.test_polish import zone_of
from tests.optimisation.test_pool import cameras_of, mount_of, streets
from warpav.core.errors import InputError
from warpav.optimisation import (
    X_M,
    YAW_RAD,
    Importance,
    ImportanceSettings,
    PoolSearchSettings,
    check_categories,
    rig_values_of,
)
from warpav.optimisation._pool import spread_mount_poses
from warpav.runs.config import Config, dump_config, load_config, option_values

COUNTS = (10, 0, 4)
SETTINGS = ImportanceSettings(
    category={"hatchback": 0.5},
    distance_m={0: 2.0, 10: 1.0, 15: 0.25},
    sector_deg=[{"from": -30, "to": 30, "weight": 3.0}, {"from": 150, "to": 210, "weight": 0.0}],
)


def weights_by_hand(scene):
    """Those of `SETTINGS`, one object at a time; all cars of the street are hatchbacks."""
    found = []
    for forward_m, left_m in scene.from_ego_m + np.mean(scene.ego_bounds_m[:, :2], axis=0):
        distance_m, azimuth_deg = math.hypot(forward_m, left_m), math.degrees(math.atan2(left_m, forward_m))
        weight = 0.5 * (2.0 if distance_m < 10.0 else 1.0 if distance_m < 15.0 else 0.25)
        found.append(weight * (3.0 if -30.0 <= azimuth_deg < 30.0 else 0.0 if abs(azimuth_deg) >= 150.0 else 1.0))
    return np.array(found)


# --- the weights -----------------------------------------------------------------------------------------------------


def test_a_weight_is_the_product_of_factors_from_the_origin_of_the_ego_frame():
    for assigned in scenes_of("cpu", *COUNTS):
        by_hand = weights_by_hand(assigned.scene)
        np.testing.assert_array_equal(Importance(SETTINGS).weights(assigned.scene), by_hand)
    scene = scenes_of()[0].scene
    assert len(set(weights_by_hand(scene))) > 3
    # the street's vehicle reaches from -0.85 m to 3.55 m: its middle is not the origin
    np.testing.assert_allclose(scene.ego_bounds_m[:, 0], [-0.85, 3.55], atol=1e-6)
    edge_m = float(np.hypot(*(scene.from_ego_m[0] + [1.35, 0.0])))
    for first_m, expected in ((edge_m - 0.1, 5.0), (edge_m + 0.1, 1.0)):
        steps = Importance(ImportanceSettings(distance_m={0: 1.0, first_m: 5.0}))
        assert steps.weights(scene)[0] == expected


def test_the_category_counts_before_the_kind_and_edges_belong_to_what_they_begin():
    importance = Importance(
        ImportanceSettings(
            category={"vehicle": 3.0, "Lorry": 5.0, "cyclist": 2.0},
            distance_m={0: 1.0, 10: 7.0},
            sector_deg=[{"from": 90, "to": 180, "weight": 11.0}, {"from": 180, "to": 200, "weight": 13.0}],
        )
    )
    category, kind = ["bus", "LORRY", "person", "bicyclist"], ["vehicle", "vehicle", "pedestrian", "cyclist"]
    ahead = np.array([[9.0, 0.0], [10.0, 0.0], [5.0, 0.0], [6.0, 8.0]])
    np.testing.assert_array_equal(importance.weights_at(category, kind, ahead), [3.0, 35.0, 1.0, 14.0])
    around = np.array([[0.0, 5.0], [-5.0, 0.0], [-5.0, -1e-3], [-5.0, -3.0]])
    np.testing.assert_array_equal(importance.weights_at(["van"] * 4, ["vehicle"] * 4, around), [33.0, 39.0, 39.0, 3.0])
    everywhere = Importance(ImportanceSettings(sector_deg=[{"from": 0, "to": 360, "weight": 2.0}]))
    assert (everywhere.weights_at(["van"] * 2, ["vehicle"] * 2, np.array([[5.0, -1e-300], [5.0, 0.0]])) == 2.0).all()


def test_the_time_to_collision_counts_where_it_is_known_and_comes():
    importance = Importance(
        ImportanceSettings(category={"bus": 10.0}, time_to_collision_s={0: 3.0, 2: 2.0, "4000 ms": 0.5})
    )
    time_s = np.array([0.0, 1.99, 2.0, 3.9, 4.0, 900.0, math.inf, math.nan])
    category, kind, place_m = ["bus"] + ["van"] * 7, ["vehicle"] * 8, np.full((8, 2), 9.0)
    found = importance.weights_at(category, kind, place_m, time_s)
    np.testing.assert_array_equal(found, [30.0, 3.0, 2.0, 2.0, 0.5, 0.5, 1.0, 1.0])
    np.testing.assert_array_equal(importance.weights_at(category, kind, place_m), [10.0] + [1.0] * 7)
    scene = dataclasses.replace(
        scenes_of("cpu", *COUNTS)[2].scene, time_to_collision_s=np.array([1.0, 3.0, math.nan, 5.0])
    )
    np.testing.assert_array_equal(importance.weights(scene), [3.0, 2.0, 1.0, 0.5])
    # a scene that tells no velocity has equal weights
    np.testing.assert_array_equal(importance.weights(scenes_of()[0].scene), np.ones(10))


# --- the objective ---------------------------------------------------------------------------------------------------


def test_the_objective_is_the_weighted_mean_of_products(device):
    model = probability_model(np.random.default_rng(3))
    objective, scenes = objective_of(device, others={"importance": Importance(SETTINGS)}), scenes_of(device, *COUNTS)
    pose = POSE.copy()
    pose[1, YAW_RAD] = 0.7
    seen = [scenes[0], scenes[2]]
    p = np.concatenate([probabilities(objective, pose, each.scene, model) for each in seen], axis=1)
    weight = np.concatenate([weights_by_hand(each.scene) for each in seen])
    expected = (weight * np.prod(1.0 - p, axis=0)).sum() / weight.sum()
    found = objective.evaluate(pose, scenes)
    assert found.terms["expected_miss_rate"] == pytest.approx(expected, rel=1e-5)
    assert found.objective == pytest.approx(expected, rel=1e-5)
    assert abs(expected - np.prod(1.0 - p, axis=0).mean()) > 0.02
    # only ratios count, also where the sum is below 1
    tiny = SETTINGS.model_copy(update={"category": {"hatchback": 0.5e-3}})
    assert objective_of(device, others={"importance": Importance(tiny)}).evaluate(
        pose, scenes
    ).objective == pytest.approx(expected, rel=1e-5)
    [values] = rig_values_of(objective, scenes)(pose[None])
    assert values == pytest.approx(expected, rel=1e-5)
    objective.options = dataclasses.replace(objective.options, false_alarms=0.5)
    [with_false_alarms] = rig_values_of(objective, scenes)(pose[None])
    doubtful = (p * (1.0 - p)).sum(axis=0)
    assert with_false_alarms - values == pytest.approx(0.5 * (weight * doubtful).sum() / weight.sum(), rel=1e-3)
    # of one scene, as metrics have it
    of_first = (weight[:10] * np.prod(1.0 - p[:, :10], axis=0)).sum() / weight[:10].sum()
    assert objective.observe_rig(objective.mount.rig(pose), scenes[0])[2] == pytest.approx(of_first, rel=1e-4)


def test_the_weighted_gradient_matches_differences(device):
    """Means over poses beside each other, as single renders are rough; `test_missed` does so for more numbers."""
    rng = np.random.default_rng(0)
    importance = Importance(ImportanceSettings(distance_m={0: 4.0, 10: 1.0, 15: 0.1}))
    ours, unweighted, truth = np.zeros((3, 2, 2))
    weighted, plain = (
        objective_of(device, supersampling=4, others={"importance": each}) for each in (importance, None)
    )
    scenes, numbers = scenes_of(device), ((X_M, 0.03), (YAW_RAD, 0.006))
    spread = np.array([0.05, 0.05, 0.02, 0.01, 0.0, 0.0, 0.0])
    for _ in range(8):
        at = (POSE + rng.uniform(-1.0, 1.0, POSE.shape) * spread).astype(np.float32)
        for total, objective in ((ours, weighted), (unweighted, plain)):
            total += objective.evaluate(at, scenes, gradient=True).gradient[:, [X_M, YAW_RAD]]
        for (camera, k), _ in np.ndenumerate(truth):
            number, step = numbers[k]
            ends = []
            for sign in (1.0, -1.0):
                moved = at.copy()
                moved[camera, number] += sign * step
                ends.append(weighted.evaluate(moved, scenes).objective)
            truth[camera, k] += (ends[0] - ends[1]) / (2.0 * step)
    ours, unweighted, truth = (each * [1.0, 0.2] for each in (ours, unweighted, truth))
    # seen 0.072 and 0.48 on the CPU
    assert np.linalg.norm(ours - truth) < 0.1 * np.linalg.norm(truth)
    assert np.linalg.norm(unweighted - truth) > 0.3 * np.linalg.norm(truth)


# --- the search by a pool --------------------------------------------------------------------------------------------


def rate(probability, weight):
    """Without kernels: the weighted share of the objects that a rig misses."""
    missed = np.prod(1.0 - np.minimum(np.asarray(probability, np.float64), 0.9999), axis=0)
    return (weight * missed).sum() / weight.sum()


def test_a_weight_of_pedestrians_moves_the_selection_of_a_small_pool():
    category, kind = ["van", "bus", "lorry", "pedestrian"], ["vehicle"] * 3 + ["pedestrian"]
    #                  van  bus  lorry person
    pool = np.array([[0.9, 0.0, 0.0, 0.0], [0.0, 0.8, 0.7, 0.0], [0.0, 0.0, 0.0, 0.9]])
    place_m = np.zeros((4, 2)) + 5.0
    chosen = {}
    for factor in (1.0, 3.0):
        weight = Importance(ImportanceSettings(category={"pedestrian": factor})).weights_at(category, kind, place_m)
        found = select(pool, 1, weight=weight, gap=0.0)
        best = min(range(3), key=lambda k, w=weight: rate(pool[[k]], w))
        assert found.cameras.tolist() == [best]
        assert found.objective == pytest.approx(rate(pool[[best]], weight))
        chosen[factor] = best
    assert chosen == {1.0: 1, 3.0: 2}


def test_the_weighted_selection_is_the_best_rig_of_the_pool_by_brute_force():
    mount, weight = mount_of(free=None), np.array([0.0, 1.0, 9.0, 0.3, 0.0, 1.0, 2.0, 0.1, 7.0, 1.0])
    constraints, settings = zone_of(mount), PoolSearchSettings(pool_cameras=24, gap=0.0, polishes=False)
    options = {"settings": settings, "object_weight": weight}
    chosen, _ = pool_search(cameras_of(mount=mount), streets(), constraints, 3, **options)
    pose = spread_mount_poses(mount, constraints, 24, seed=0)
    pool = draw(pose, scenes=streets(), cameras=cameras_of(mount=mount)).detection_probability
    point = np.c_[pose[:, :2], mount.surface.height_at_m(pose[:, :2])]
    rigs = [
        list(rig)
        for rig in itertools.combinations(range(len(pose)), 3)
        if all(np.linalg.norm(point[i] - point[j]) > 0.3 + 1e-6 for i, j in itertools.combinations(rig, 2))
    ]
    best = min(rate(pool[rig], weight) for rig in rigs)
    assert chosen.objective == pytest.approx(best, abs=1e-7)
    assert chosen.bound <= best + 1e-9
    # without the weights another rig would have been chosen
    alike = min(rigs, key=lambda rig: rate(pool[rig], np.ones(10)))
    assert rate(pool[alike], weight) > best + 1e-3


# --- the configuration -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        ("category=[car]", "expected a table of categories and weights, such as {pedestrian: 2.0}, got [car]"),
        ("category={lorry: -1}", "expected a finite weight of at least 0 for lorry, got -1"),
        ("category={lorry: .inf}", "expected a finite weight of at least 0 for lorry, got inf"),
        ("category={lorry: much}", "expected a finite weight of at least 0 for lorry, got 'much'"),
        ("category={cyclist: 2}", "expected road users out of scenes.targets, vehicle, got 'cyclist'; add cyclist to"),
        ("distance_m={0: 1, 30: 2, 20: 1}", "expected rising distances, got 20 after 30"),
        ("distance_m={5: 1}", "expected 0 as the first distance, got 5"),
        ("distance_m={0: 1, far: 2}", "got 'far' as a distance"),
        ("distance_m={0: 0, 20: 0}", "expected a weight above 0 at some distance, got only zeros"),
        (
            "time_to_collision_s=[2]",
            "expected a table of rising times from 0 s on and weights, such as {0: 3.0, 2: 2.0",
        ),
        ("time_to_collision_s={0: 2, 4: 1, 2: 1}", "expected rising times, got 2 after 4"),
        ("time_to_collision_s={-1: 2, 0: 1}", "expected 0 as the first time, got -1"),
        ("time_to_collision_s={0: 2, -3: 1}", "expected rising times, got -3 after 0"),
        ("time_to_collision_s={0: 2, 3: -1}", "expected a finite weight of at least 0 for 3 s, got -1"),
        ("time_to_collision_s={0: 2, 3 m: 1}", "got '3 m' as a time"),
        ("time_to_collision_s={0: 0}", "expected a weight above 0 at some time, got only zeros"),
        ("sector_deg=[{from: 0, to: 30}]", "expected a list of sectors, such as [{from: -30, to: 30, weight: 2.0}]"),
        ("sector_deg=[{from: 170, to: -170, weight: 1}]", "got 170 to -170; write 170 to 190"),
        (
            "sector_deg=[{from: 170, to: 190, weight: 1}, {from: -175, to: 0, weight: 2}]",
            "expected sectors that do not overlap, got 170 to 190 and -175 to 0",
        ),
        ("sector_deg=[{from: 0, to: 400, weight: 1}]", "that end above their start, by at most 360, got 0 to 400"),
        ("sector_deg=[{from: 0, to: 360, weight: 0}]", "expected a weight above 0 in some direction, got only zeros"),
        ("sector_deg=[{from: 0, to: 30, weight: -2}]", "expected a finite weight of at least 0 for the sector from 0"),
    ],
)
def test_a_wrong_weight_is_told_in_one_line(option, expected):
    with pytest.raises(InputError) as error:
        load_config(None, [f"importance.{option}"])
    assert f"importance.{option.partition('=')[0]}: " in str(error.value)
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


def test_weights_are_of_categories_that_there_are():
    check_categories(ImportanceSettings(category={"pedestrian": 2.0, "tram": 3.0}), ["tram"])
    with pytest.raises(
        InputError, match=r"importance\.category: expected some of .*, got 'pedestrians'; did you mean pe"
    ):
        check_categories(ImportanceSettings(category={"pedestrians": 2.0}))


def test_weights_are_written_and_read_back_and_what_is_not_set_is_not_written(tmp_path):
    options = [
        "scenes.targets=[vehicle, pedestrian]",
        "importance.category.pedestrian=2",
        "importance.distance_m={0: 2.0, 20.5: 1.0, 5000 cm: 0.5}",
        'importance.sector_deg=[{from: -30, to: "0.5 rad", weight: 2.0}]',
    ]
    config = load_config(None, options)
    assert config.importance.category == {"pedestrian": 2.0}
    assert config.importance.distance_m == {0.0: 2.0, 20.5: 1.0, 50.0: 0.5}
    assert config.importance.sector_deg[0].to_deg == pytest.approx(28.6479, abs=1e-4)
    file = tmp_path / "config.yaml"
    file.write_text(dump_config(config))
    assert load_config(file) == config
    assert load_config(config) == config
    assert option_values(Config())["importance.category"] == {}
