"""Ways to find a rig: every arm keeps its budget, says what it spent, and hands over a rig that may stand there."""

import importlib.util
import math
from dataclasses import replace

import numpy as np
import pytest

from tests.experiments.small_experiment import config
from warpav.core.errors import InputError
from warpav.experiments import _arms as module
from warpav.experiments._arms import METHODS, Arm, _common_arms, find_arm, find_rig_of
from warpav.optimisation import LOSSES, BudgetedValue, RigObjective, SearchSpace
from warpav.optimisation._single_cameras import SingleCameras
from warpav.rig import Rig, RigCamera, builtin_modules, write_rig
from warpav.runs import Placement, RunDisplay
from warpav.runs.config import load_config, option_values
from warpav.thesis import descent_camera_renders

needs_cma = pytest.mark.skipif(importlib.util.find_spec("cma") is None, reason="cma is not installed")
BUDGET = 72
MISSES = (
    "method=default",
    *(f"losses.{name}={float(name == 'expected_miss_rate')}" for name in LOSSES),
    "losses.probability=visible_share",
    "optimiser.selection_time_s=2",
    "optimiser.pool_cameras=16",
    "rig.start=highest",
    "optimiser.keep=best",
    "optimiser.check_every=1",
)
"""The expected miss rate alone, by a model that needs no fit."""


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    with RunDisplay() as display:
        return Placement.from_config(config(tmp_path_factory.mktemp("scenes") / "street")).prepare(display)


@pytest.fixture(scope="module")
def missing(tmp_path_factory):
    """The same under the expected miss rate."""
    with RunDisplay() as display:
        folder = tmp_path_factory.mktemp("scenes") / "street"
        alone = ("requirements=null", "rules=none", "rig.symmetric=false")
        return Placement.from_config(config(folder, *MISSES, *alone)).prepare(display)


@pytest.fixture
def rendered(monkeypatch):
    """The camera renders that were made so far, one entry each."""
    count = []

    def counts(owner, name, renders_of):
        real = getattr(owner, name)

        def counting(self, *given, **options):
            count.extend([name] * renders_of(self, *given))
            return real(self, *given, **options)

        monkeypatch.setattr(owner, name, counting)

    counts(RigObjective, "evaluate", lambda self, pose, scenes: len(pose) * len(scenes))
    counts(RigObjective, "observe_rig", lambda self, rig, scene: len(rig.cameras))
    counts(SingleCameras, "detection_probability", lambda self, pose, scene: len(pose))
    counts(SingleCameras, "with_jacobian", lambda self, pose, scenes: len(pose) * len(scenes))
    monkeypatch.setattr(module, "constraint_loss", lambda *_: 0.0)  # it is no part of the search
    return count


SEARCHES = ["descent", "random_batches", "random", "sobol", "greedy_cover"]


# without a budget there is as much as the gradient takes: too little here for a grid, or for two searches
WITHOUT_BUDGET = [("descent", None), ("random", None)]
WITH_BUDGET = [(name, BUDGET) for name in SEARCHES]
WITH_BUDGET += [pytest.param(name, BUDGET, marks=needs_cma) for name in ("cma",)]


def found_by(name, placement, budget):
    arm = find_arm(name, {})
    return find_rig_of(arm, placement.with_config(arm.search_config(placement.config)), budget)


@pytest.mark.parametrize(("name", "budget"), [*WITHOUT_BUDGET, *WITH_BUDGET])
def test_budgets_are_kept_and_told(problem, rendered, name, budget):
    options = {"camera_count": 2, "iterations": 2, "batch_size": 2}
    equal = descent_camera_renders(problem.config.optimiser, len(problem.train), **options)
    assert equal == 2 * (2 * 2 + 2 * 2)  # two cameras; two steps, and two looks at all scenes
    found = found_by(name, problem, budget)
    check(found, problem, budget or equal, rendered)
    if name != "greedy_cover":  # its grid has nearly square cells, asked rig by rig
        assert found.camera_renders > (budget or equal) - 12 or name == "random_batches"
    again = found_by(name, problem, budget)
    assert again.mount_pose.tobytes() == found.mount_pose.tobytes()


def check(found, placement, budget, rendered):
    """What every search promises."""
    assert found.camera_renders == len(rendered) <= budget
    assert placement.objective.constraints.violation_m(found.rig) == 0.0
    best = [value for value in found.history["best_value"] if value is not None]
    assert best == sorted(best, reverse=True)
    assert found.history["camera_renders"] == sorted(found.history["camera_renders"])
    assert found.history["camera_renders"][-1] <= found.camera_renders
    assert len({len(column) for column in found.history.values()}) == 1


RIVALS = ["default", "pool_only", "descent", "random", "random_selected", "sobol", "sobol_selected", "greedy_cover"]
LITTLE = [("default", 46), ("pool_only", 46)]
ENOUGH = [*((name, 91) for name in RIVALS), pytest.param("cma", 91, marks=needs_cma)]


@pytest.mark.parametrize(("name", "budget"), [*LITTLE, *ENOUGH])
def test_the_arms_of_the_rivals_keep_their_budget(missing, rendered, name, budget):
    found = found_by(name, missing, budget)
    check(found, missing, budget, rendered)
    per_rig = 2 * 2
    if name not in ("default", "greedy_cover"):  # the first may settle before
        assert found.camera_renders > budget - (16 if name == "descent" else per_rig)
    # the best value that a search claims is its rig's, on all training scenes
    value = missing.objective.evaluate(found.mount_pose, missing.train).objective
    assert found.history["best_value"][-1] == pytest.approx(value, abs=1e-6)
    if name in ("default", "pool_only") or name.endswith("_selected"):
        assert found.notes["gap"] == pytest.approx(value - found.notes["bound"], abs=1e-6)
    if name == "pool_only":
        assert found.history["stage"] == ["start", "selection", "settled"]
        assert found.notes["pool_cameras"] == budget // 2
    again = found_by(name, missing, budget)
    assert again.mount_pose.tobytes() == found.mount_pose.tobytes()


@pytest.mark.parametrize("name", ["random", "sobol"])
def test_mixing_the_cameras_of_rigs_is_never_worse(missing, name):
    mixed = found_by(f"{name}_selected", missing, 121)
    # the same look at the rigs themselves, before any of them is mixed
    *alone, last = mixed.history["best_value"]
    assert mixed.history["camera_renders"][-2:] == [120, 120]
    assert last <= min(alone)
    assert last >= mixed.notes["bound"] - 1e-9


def test_values_of_single_cameras_are_those_of_the_objective(missing, rng):
    space = SearchSpace.over(missing.objective.mount, 2, constraints=missing.objective.constraints)
    rigs = np.array([space.feasible(space.random(rng)) for _ in range(5)])
    value = BudgetedValue.of(missing.objective, missing.train, space, camera_renders_max=20)
    found = value.of_rigs(rigs)
    expected = [missing.objective.evaluate(pose, missing.train).objective for pose in rigs]
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-6)
    assert len(set(expected)) > 1
    double = missing.with_config(load_config(missing.config, ["losses.expected_miss_rate=2"]))
    again = BudgetedValue.of(double.objective, double.train, space, camera_renders_max=20).of_rigs(rigs)
    np.testing.assert_allclose(again, 2.0 * found, rtol=1e-6)


@pytest.mark.parametrize("name", ["default", "pool_only", "random_selected", "sobol_selected", "sobol"])
def test_frozen_cameras_stay(missing, tmp_path, name):
    start = find_rig_of(Arm("random_rig", "random_rig"), missing, None).rig
    write_rig(start, tmp_path / "mine.yaml")
    held = [f"rig.start={tmp_path / 'mine.yaml'}", f"rig.freeze={start.cameras[1].name}"]
    placement = missing.with_config(load_config(missing.config, held))
    placement = Placement.from_config(placement.config).prepare()
    found = find_rig_of(Arm(name, name) if name != "default" else find_arm(name, {}), placement, 90)
    frozen, free = found.rig.cameras[1], found.rig.cameras[0]
    np.testing.assert_allclose(frozen.position_m, start.cameras[1].position_m, atol=1e-5)
    assert frozen.yaw_rad == pytest.approx(start.cameras[1].yaw_rad, abs=1e-5)
    assert free.position_m != pytest.approx(start.cameras[0].position_m, abs=1e-3)
    assert placement.objective.constraints.violation_m(found.rig) == 0.0
    value = placement.objective.evaluate(found.mount_pose, placement.train).objective
    assert found.history["best_value"][-1] == pytest.approx(value, abs=1e-6)


def test_losses_that_single_cameras_do_not_know_are_refused(problem, missing):
    with pytest.raises(InputError, match="losses: expected expected_miss_rate alone"):
        find_rig_of(Arm("random_selected", "random_selected"), problem, None)
    best = missing.with_config(load_config(missing.config, ["losses.combine=best"]))
    with pytest.raises(InputError, match=r"optimiser\.search: expected descent"):
        find_rig_of(Arm("pool_only", "pool_only"), best, 60)
    # but its values are there, one rig after the other
    assert find_rig_of(Arm("random", "random"), best, 60).camera_renders == 60


@pytest.mark.parametrize("name", ["descent_by_hand", pytest.param("cma_by_hand", marks=needs_cma)])
def test_searches_around_rigs_by_hand_are_never_behind_them(missing, rendered, name):
    placement = missing.with_config(load_config(missing.config, ["rig.start=by_hand"]))
    by_hand = found_by("cross", placement, None)
    assert 0 < by_hand.camera_renders == len(rendered)
    rendered.clear()
    found = found_by(name, placement, 480)
    assert by_hand.camera_renders < found.camera_renders == len(rendered) <= 480
    assert placement.objective.constraints.violation_m(found.rig) == 0.0
    values = [placement.objective.evaluate(each.mount_pose, placement.train).objective for each in (found, by_hand)]
    assert found.training_objective == pytest.approx(values[0], abs=1e-6)
    assert values[0] < values[1] - 1e-4


def test_a_layout_as_built_and_a_rig_of_its_cost(missing, tmp_path):
    """The layout keeps its modules, all or its cameras alone; the found rig costs no more, at as many false alarms."""
    catalogue = builtin_modules()
    wanted = {"left": ("surround_1_4mp_70", 0.6, 90.0), "right": ("surround_1_4mp_70", -0.6, -90.0)}
    wanted["ahead"] = ("lidar_flat_90", 0.0, 0.0)
    cameras = [
        RigCamera(name, [0.8, y_m, 1.6], math.radians(yaw_deg), model=catalogue[module].camera_model(), module=module)
        for name, (module, y_m, yaw_deg) in wanted.items()
    ]
    write_rig(Rig(cameras), tmp_path / "layout.yaml")
    options = [f"baselines.rigs=[{tmp_path / 'layout.yaml'}]", "rig.modules={surround_1_4mp_70: 2, lidar_flat_90: 1}"]
    placement = Placement.from_config(load_config(missing.config, options)).prepare()
    built = find_rig_of(Arm("as_built", "as_built"), placement, None).rig
    assert [camera.module for camera in built.cameras] == [module for module, *_ in wanted.values()]
    assert [camera.yaw_rad for camera in built.cameras] == pytest.approx([camera.yaw_rad for camera in cameras])
    found = find_rig_of(Arm("found", "within_cost"), placement, None)
    cost = [sum(catalogue[camera.module].price.value for camera in rig.cameras) for rig in (built, found.rig)]
    assert 0.0 < cost[1] <= cost[0] == pytest.approx(6.8)
    images = len(found.rig.cameras) - sum(found.rig.is_lidar)
    assert images >= 1
    assert found.notes["false_alarms_per_image"] * images == pytest.approx(0.5 * 2)
    alone = Placement.from_config(load_config(placement.config, ["rig.modules={surround_1_4mp_70: 2}"])).prepare()
    built = find_rig_of(Arm("as_built", "as_built"), alone, None).rig
    assert [camera.name for camera in built.cameras] == ["left", "right"]


@pytest.mark.parametrize("name", ["highest", "start", "nuscenes", "edgar"])
def test_rigs_that_need_no_search_cost_nothing(problem, rendered, name):
    found = find_rig_of(Arm(name, name), problem, None)
    assert (found.camera_renders, rendered) == (0, [])
    assert problem.objective.constraints.violation_m(found.rig) == 0.0
    assert Arm(name, name).is_seeded == (name == "start")
    if name == "nuscenes":
        assert len(found.rig.cameras) == 6
        assert {camera.model.width_px for camera in found.rig.cameras} == {64}
        assert len(found.notes["moved_m"]) == 6


def test_a_search_that_ends_early_is_no_result(problem, monkeypatch):
    def stumbles(value, rng):
        value(value.space.random(rng))
        raise ValueError("stumbled")

    monkeypatch.setattr(module, "random_search", stumbles)
    with pytest.raises(RuntimeError, match="ended early: ValueError: stumbled"):
        find_rig_of(Arm("random", "random"), problem, None)


def test_unknown_arms_are_named_with_their_neighbour():
    own = {"sgd_ifr": Arm("sgd_ifr", "optimiser")}
    assert find_arm("sgd_ifr", own) is own["sgd_ifr"]
    assert find_arm("sobol", own).method == "sobol"
    with pytest.raises(
        InputError, match=r"arms: expected names out of sgd_ifr, .*got 'sgd_irf'; did you mean sgd_ifr\?"
    ):
        find_arm("sgd_irf", own)
    with pytest.raises(InputError, match=r"got 'nuscene'; did you mean nuscenes\?"):
        find_arm("nuscene", own)
    assert {name for name, method in METHODS.items() if method.is_arm} < set(_common_arms())


def test_what_cannot_work_is_refused_before_it_starts(problem, monkeypatch):
    settings = problem.config
    for name in _common_arms():
        if name not in ("cma", "thesis_as_printed"):
            find_arm(name, {}).check(settings, None)
    with pytest.raises(InputError, match=r"run\.batch_size: expected at most the 2 training scene"):
        find_arm("thesis_as_printed", {}).check(settings, None)  # it prints batches of four
    larger = load_config(settings, ["optimiser.search=pool", "run.batch_size=4"])
    find_arm("start", {}).check(larger, None)
    assert found_by("start", problem.with_config(larger), None).camera_renders == 0
    with pytest.raises(InputError, match=r"run\.batch_size: expected at most the 2 training scene"):
        find_arm("random_batches", {}).check(larger, None)
    for arm, least in (("descent", 12), ("random_batches", 4), ("greedy_cover", 20), ("default", 8), ("random", 4)):
        with pytest.raises(
            InputError, match=f"arm {arm}: `budget`: expected at least {least} camera renders, got {least - 1}"
        ):
            find_arm(arm, {}).check(settings, least - 1)
        find_arm(arm, {}).check(settings, least)
    assert found_by("greedy_cover", problem, 20).camera_renders == 20  # two cameras, eight directions
    Arm("sobol", "sobol").check(settings, 4)
    Arm("highest", "highest").check(settings, 1)
    with pytest.raises(InputError, match=r"losses\.detected_are"):
        Arm("odd", "optimiser", ("losses.detected_are=1",)).check(settings, None)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r'arm cma: expected the package cma .* pip install "warpav\[rivals\]"'):
        Arm("cma", "cma").check(settings, None)


def test_the_thesis_searches_its_way_and_is_judged_like_all_others(problem):
    arm = _common_arms()["thesis_gradient"]
    base = problem.config.model_copy(update={"method": "default"})
    assert arm.evaluation_config(base).method == "default"
    assert arm.search_config(base).method == "thesis"
    assert arm.search_config(base).optimiser.learning_rate_yaw_deg == pytest.approx(math.degrees(0.25))
    assert arm.search_config(base).run == base.run


def test_the_thesis_as_printed_is_the_shipped_configuration_on_the_task_of_the_experiment():
    arm, printed = _common_arms()["thesis_as_printed"], option_values(load_config("thesis"))
    changes = ["rig.cameras=6", "rig.free.pitch_deg=[-20, 20]", "camera.fov_deg=60", "mount.margin_m=0.1"]
    task = load_config("default", [*changes, "detector.classes.vehicle=[car]", "scenes.validation_seeds=150..159"])
    found, asked = option_values(arm.search_config(task)), option_values(task)
    own = ("scenes", "camera", "capture", "reconstruction", "baselines", "device", "executor", "run.seed", "run.out")
    own += ("rig.cameras", "rig.freeze", "detector.model", "detector.format", "detector.labels", "detector.classes")
    own += ("detector.input_px", "detector.provider")
    for name, value in found.items():
        assert value == (asked if name.startswith(own) else printed)[name], name
    assert (found["run.batch_size"], found["rig.start"], found["detector.confidence_min"]) == (4, "random", 0.1)
    assert arm.evaluation_config(task) == task


def test_the_thesis_as_printed_takes_its_own_steps(problem):
    arm = _common_arms()["thesis_as_printed"]
    small = ("run.iterations=1", "run.batch_size=2")
    one_step = replace(arm, search_overrides=(*arm.search_overrides, *small))
    placement = problem.with_config(one_step.search_config(problem.config))
    for budget in (None, 10_000):
        found = find_rig_of(one_step, placement, budget)
        # two cameras: one batch of two, first and last rig
        assert found.camera_renders == 2 * (2 + 2 * len(placement.validation))
