"""Ways to find a rig: every arm keeps its budget, says what it spent, and hands over a rig that may stand there."""

import importlib.util
import math
from dataclasses import replace

import pytest

from tests.experiments.small_experiment import config
from warpav.core.errors import InputError
from warpav.experiments import arms as module
from warpav.experiments.arms import METHODS, Arm, common_arms, find_arm, find_rig_of
from warpav.optimisation.objective import RigObjective
from warpav.optimisation.rivals import gradient_renders
from warpav.runs.config import load_config, option_values
from warpav.runs.placement import Placement
from warpav.runs.progress import RunDisplay

needs_cma = pytest.mark.skipif(importlib.util.find_spec("cma") is None, reason="cma is not installed")
BUDGET = 60


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    with RunDisplay() as display:
        return Placement.from_config(config(tmp_path_factory.mktemp("scenes") / "street")).prepare(display)


@pytest.fixture
def rendered(monkeypatch):
    """Scenes that were drawn so far."""
    count = []
    evaluate, observe_rig = RigObjective.evaluate, RigObjective.observe_rig

    def count_evaluate(self, pose, scenes, **options):
        count.extend(scenes)
        return evaluate(self, pose, scenes, **options)

    def count_observe_rig(self, rig, scene):
        count.append(scene)
        return observe_rig(self, rig, scene)

    monkeypatch.setattr(RigObjective, "evaluate", count_evaluate)
    monkeypatch.setattr(RigObjective, "observe_rig", count_observe_rig)
    monkeypatch.setattr(module, "constraint_loss", lambda *_: 0.0)  # it is no part of the search
    return count


SEARCHES = ["gradient", "random_batches", "random", "sobol", "differential_evolution", "greedy_cover"]


# without a budget there is as much as the gradient takes: too little here for a grid, or for two searches
WITHOUT_BUDGET = [(name, None) for name in SEARCHES if name != "greedy_cover"]
WITHOUT_BUDGET += [pytest.param("cma", None, marks=needs_cma)]
WITH_BUDGET = [(name, BUDGET) for name in SEARCHES]
WITH_BUDGET += [pytest.param(name, BUDGET, marks=needs_cma) for name in ("cma", "cma_then_gradient")]


@pytest.mark.parametrize(("name", "budget"), [*WITHOUT_BUDGET, *WITH_BUDGET])
def test_budgets_are_kept_and_told(problem, rendered, name, budget):
    equal = gradient_renders(problem.config.optimiser, len(problem.train), iterations=2, batch_size=2)
    assert equal == 2 * 2 + 2 * 2  # two steps, and two looks at all scenes
    found = find_rig_of(Arm(name, name), problem, budget)
    assert found.renders == len(rendered)
    assert found.renders <= (budget or equal)
    if name != "greedy_cover":  # its grid has nearly square cells
        assert found.renders > (budget or equal) - 6 or name == "random_batches"
    assert problem.objective.constraints.violation_m(found.rig) == 0.0
    best = [value for value in found.history["best_value"] if value is not None]
    assert best == sorted(best, reverse=True) or name == "cma_then_gradient"  # whose two halves look at other scenes
    assert found.history["renders"] == sorted(found.history["renders"])
    assert len({len(column) for column in found.history.values()}) == 1
    again = find_rig_of(Arm(name, name), problem, budget)
    assert again.mount_pose.tobytes() == found.mount_pose.tobytes()


@pytest.mark.parametrize("name", ["highest", "start", "nuscenes", "edgar"])
def test_rigs_that_need_no_search_cost_nothing(problem, rendered, name):
    found = find_rig_of(Arm(name, name), problem, None)
    assert (found.renders, rendered) == (0, [])
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
    own = {"sgd_ifr": Arm("sgd_ifr", "gradient")}
    assert find_arm("sgd_ifr", own) is own["sgd_ifr"]
    assert find_arm("sobol", own).method == "sobol"
    with pytest.raises(
        InputError, match=r"arms: expected names out of sgd_ifr, .*got 'sgd_irf'; did you mean sgd_ifr\?"
    ):
        find_arm("sgd_irf", own)
    with pytest.raises(InputError, match=r"got 'nuscene'; did you mean nuscenes\?"):
        find_arm("nuscene", own)
    assert set(METHODS) < set(common_arms())


def test_what_cannot_work_is_refused_before_it_starts(problem, monkeypatch):
    settings = problem.config
    for name in common_arms():
        if name not in ("cma", "cma_then_gradient"):
            find_arm(name, {}).check(settings, None)
    with pytest.raises(InputError, match="arm gradient: `budget`: expected at least 6 scene renders, got 5"):
        Arm("gradient", "gradient").check(settings, 5)
    with pytest.raises(InputError, match="arm random_batches: `budget`: expected at least 2 scene renders, got 1"):
        Arm("random_batches", "random_batches").check(settings, 1)
    with pytest.raises(InputError, match="arm greedy_cover: `budget`: expected at least 5 scene renders, got 4"):
        Arm("greedy_cover", "greedy_cover").check(settings, 4)
    assert find_rig_of(Arm("greedy_cover", "greedy_cover"), problem, 5).renders == 5  # two cameras, eight directions
    Arm("sobol", "sobol").check(settings, 1)
    Arm("highest", "highest").check(settings, 1)
    with pytest.raises(InputError, match=r"losses\.detected_are"):
        Arm("odd", "gradient", ("losses.detected_are=1",)).check(settings, None)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"arm cma: expected the package cma .* pip install 'warpav\[rivals\]'"):
        Arm("cma", "cma").check(settings, None)


def test_the_thesis_searches_its_way_and_is_judged_like_all_others(problem):
    arm = common_arms()["thesis_gradient"]
    base = problem.config.model_copy(update={"method": "default"})
    assert arm.evaluation_config(base).method == "default"
    assert arm.search_config(base).method == "thesis"
    assert arm.search_config(base).optimiser.learning_rate_yaw_deg == pytest.approx(math.degrees(0.25))
    assert arm.search_config(base).run == base.run


def test_the_thesis_as_printed_is_the_shipped_configuration_on_the_task_of_the_experiment():
    arm, printed = common_arms()["thesis_as_printed"], option_values(load_config("thesis"))
    changes = ["rig.cameras=6", "rig.free.pitch_deg=[-20, 20]", "camera.fov_deg=60", "mount.margin_m=0.1"]
    task = load_config("default", [*changes, "detector.classes.vehicle=[car]", "scenes.validation_seeds=150..159"])
    found, asked = option_values(arm.search_config(task)), option_values(task)
    own = ("scenes", "camera", "capture", "reconstruction", "baselines", "device", "executor", "run.seed", "run.out")
    own = (
        *own,
        "rig.cameras",
        "rig.freeze",
        "detector.model",
        "detector.format",
        "detector.labels",
        "detector.classes",
    )
    own = (*own, "detector.input_px", "detector.provider")
    for name, value in found.items():
        assert value == (asked if name.startswith(own) else printed)[name], name
    assert (found["run.batch_size"], found["rig.start"], found["detector.confidence_min"]) == (4, "random", 0.1)
    assert arm.evaluation_config(task) == task


def test_the_thesis_as_printed_takes_its_own_steps(problem):
    arm = common_arms()["thesis_as_printed"]
    small = ("run.iterations=1", "run.batch_size=2")
    one_step = replace(arm, search_overrides=(*arm.search_overrides, *small))
    placement = problem.with_config(one_step.search_config(problem.config))
    found = find_rig_of(one_step, placement, None)
    assert found.renders == 2 + 2 * len(placement.validation)  # one batch of two, first and last rig
