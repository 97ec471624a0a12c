"""Descent on small problems: it falls, stays feasible, repeats, and says no to nonsense."""

import dataclasses
import math

import numpy as np
import pytest
import warp as wp
from hypothesis import assume, given
from hypothesis import strategies as st

from tests.driving_scene import ConstantDetector, packed_street, roof
from tests.optimisation.objectives import rig_objective, thesis_losses
from tests.oracle import thesis
from warpav.core.errors import InputError
from warpav.detection import DetectionProbability
from warpav.optimisation import (
    X_M,
    Y_M,
    YAW_RAD,
    AssignedScene,
    CameraMount,
    Evaluation,
    LossSchedule,
    LossSettings,
    NotFiniteError,
    OptimiserSettings,
    ZoneAndSpacing,
)
from warpav.optimisation.losses._lagrangian import lagrangian_of
from warpav.raster.camera import CameraModel
from warpav.thesis import BoundsAndSpacing, Descent, affordable_iterations, descent_camera_renders
from warpav.thesis._descent import MultiplierAscent

MODEL = CameraModel(64, 64, math.pi / 2)
START = np.array([[1.7, 0.4, 1.2, 0.0, 0.0, 0.0, 0.0], [0.5, -0.4, -1.9, 0.0, 0.0, 0.0, 0.0]])
SETTINGS = OptimiserSettings(
    learning_rate_position_m=0.04,
    learning_rate_yaw_deg=math.degrees(0.08),
    schedule="cosine",
    keep="best",
    check_every=5,
    panorama_until=0.0,
    detector_from=0.0,
    weight_decay=1e-3,
    starts=1,
)
LONG_STEPS = {"learning_rate_position_m": 0.25, "learning_rate_yaw_deg": math.degrees(0.25), "schedule": "constant"}


def changed(**settings):
    """The settings with other numbers, also such as no configuration may have."""
    return SETTINGS.model_copy(update=settings)


class WholeImageDetector:
    """One box over the lower half of every image: what is in frame counts as found, if it is large."""

    names = ("car",)

    def detect(self, images_rgb):
        size = images_rgb.shape[1]
        box = [0.0, 0.3 * size, size, 0.8 * size]
        return ConstantDetector([[box]] * len(images_rgb), [[0.9]] * len(images_rgb)).answer


def street_objective(device="cpu", **settings):
    mount = CameraMount(roof(), camera=MODEL, height_offset_m=0.25, device=device)
    return rig_objective(mount, WholeImageDetector(), camera_count=2, settings=thesis_losses(**settings), iou_min=0.01)


def street_scenes(device="cpu"):
    # camera 0 answers for the cars ahead, camera 1 for those behind; both start looking elsewhere
    camera_of_car = np.array([0, 0, 0, 0, 1, 1, -1, -1, -1, 1], np.int32)
    return [AssignedScene(packed_street(device, 10, seed), camera_of_car) for seed in (0, 1, 2)]


def run(settings=SETTINGS, seed=0, start=START, objective=None, scenes=None, device="cpu", iterations=25, batch_size=2):
    descent = Descent(
        objective or street_objective(device),
        scenes or street_scenes(device),
        settings,
        start,
        np.random.default_rng(seed),
        iterations=iterations,
        batch_size=batch_size,
    )
    records = [descent.step() for _ in range(iterations)]
    return descent, records, descent.finish()


@pytest.fixture(scope="module")
def finished():
    return run()


def test_training_objective_falls_and_result_is_feasible(finished):
    descent, records, result = finished
    start = records[0].training_objective
    assert result.training_objective < 0.9 * start  # seen 7.1 of 10.3
    assert BoundsAndSpacing(roof()).violation_m(descent.objective.mount.rig(result.mount_pose)) == 0.0
    # what is claimed is what the objective says of that rig
    again = descent.objective.evaluate(result.mount_pose, descent.scenes).objective
    assert again == pytest.approx(result.training_objective, rel=1e-6)


def test_same_seed_same_result_other_seed_other_batches(finished):
    runs = [run(seed=seed, iterations=6, batch_size=1) for seed in (0, 0, 1)]
    positions = [[r.positions_m for r in records] for _, records, _ in runs]
    assert positions[0] == positions[1]
    assert positions[0] != positions[2]
    np.testing.assert_array_equal(runs[0][2].mount_pose, runs[1][2].mount_pose)


class Slope:
    """A stand-in for the objective: a linear loss, so that every step of the optimiser can be followed by hand."""

    device = "cpu"
    final_schedule = LossSchedule()

    def __init__(self, total=1.0):
        self.mount = CameraMount(roof(), camera=MODEL, height_offset_m=0.25)
        self.needs_panorama = True
        self.constraints = BoundsAndSpacing(roof())
        self.total = total
        self.multipliers = []

    def object_weight(self, scenes):
        return None

    def evaluate(
        self, mount_pose, scenes, *, multiplier=None, gradient=False, schedule=None, detection_probability=False
    ):
        if gradient:
            self.multipliers.append(multiplier)
        slope = np.arange(1, 15, dtype=np.float32).reshape(2, 7) * [[1], [-1]]
        return Evaluation(
            total=self.total,
            objective=float(len(self.multipliers)),
            terms={},
            gradient=slope.astype(np.float32) if gradient else None,
            multiplier_gradient=np.array([0.5, 0.0], np.float32) if gradient else None,
            seconds={},
        )


@pytest.mark.parametrize("schedule", ["constant", "cosine"])
def test_cameras_descend_and_multipliers_ascend_as_adamw_says(schedule):
    settings = changed(**LONG_STEPS | {"schedule": schedule, "keep": "last", "multiplier_weight_decay": 0.05})
    slope = Slope()
    descent, records, _ = run(settings, objective=slope, scenes=street_scenes(), iterations=8, batch_size=4)
    pose = thesis.AdamW(START, weight_decay=settings.weight_decay)
    multiplier = thesis.AdamW(np.zeros(2), weight_decay=0.05)
    gradient = slope.evaluate(None, None, gradient=True).gradient
    for i, record in enumerate(records):
        np.testing.assert_allclose(np.array(record.positions_m)[:, :2], pose.value[:, [X_M, Y_M]], atol=1e-5)
        np.testing.assert_allclose(np.radians(record.yaw_deg), pose.value[:, YAW_RAD], atol=1e-5)
        np.testing.assert_allclose(list(record.multipliers.values()), multiplier.value, atol=1e-5)
        np.testing.assert_allclose(slope.multipliers[i], multiplier.value, atol=1e-5)
        share = 1.0 if schedule == "constant" else 0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * i / 7))
        pose.step(gradient * [1, 1, 1, 0, 0, 0, 0], np.array([0.25] * 3 + [0.0] * 4) * share)
        multiplier.step(np.array([0.5, 0.0]), np.full(2, -0.25))
    # the thesis turns cameras about the vertical only
    np.testing.assert_array_equal(descent.mount_pose[:, 3:], START[:, 3:])
    assert records[-1].multipliers["out_of_bounds"] > 1.0
    assert records[-1].multipliers["camera_spacing"] == 0.0


@pytest.mark.parametrize("keep", ["best", "last"])
def test_cameras_that_run_away_end_the_run_at_the_best_rig(keep):
    far = changed(learning_rate_position_m=1e9, keep=keep, check_every=1)
    descent = Descent(street_objective(), street_scenes(), far, START, np.random.default_rng(0), iterations=3)
    assert descent.step().training_objective is not None
    with pytest.raises(NotFiniteError, match="iteration 1: expected a finite loss"):
        descent.step()
    assert "iteration 1: expected a finite loss" in descent.stop_reason
    found = descent.finish()
    assert np.isfinite(found.mount_pose).all()
    assert found.training_objective == min(each.training_objective for each in descent.candidates)


class Scripted(Slope):
    """The same with a training objective that was written down beforehand, look by look."""

    def __init__(self, looks):
        super().__init__()
        self.looks = list(looks)
        self.checked = []

    def evaluate(self, mount_pose, scenes, **options):
        found = super().evaluate(mount_pose, scenes, **options)
        if options.get("gradient"):
            return found
        self.checked.append(mount_pose)
        return dataclasses.replace(found, objective=self.looks.pop(0))


def scripted(looks, further_starts=(), *, iterations=6, **settings):
    settings = changed(**{"check_every": 1, "descents": 1 + len(further_starts), **LONG_STEPS, **settings})
    return Descent(
        Scripted(looks),
        street_scenes(),
        settings,
        START,
        np.random.default_rng(0),
        iterations,
        1,
        further_starts=further_starts,
    )


def steps_until_verdict(descent, at_most):
    records = []
    while len(records) < at_most and descent.stop_reason is None:
        records.append(descent.step())
    return records


def test_a_run_without_a_better_rig_ends_and_says_so():
    descent = scripted([0.5, 0.4, 0.45, 0.41, 0.4, 0.3], patience=3)
    records = steps_until_verdict(descent, 6)
    assert len(records) == 5  # 0.4 again is no better
    assert descent.stop_reason == "no better rig in 3 evaluations on the validation scenes since iteration 1"
    assert descent.finish().training_objective == 0.3  # the last rig is evaluated as well
    endless = scripted([0.5, 0.4, 0.45, 0.41, 0.4, 0.3])
    assert len(steps_until_verdict(endless, 6)) == 6
    assert endless.stop_reason is None


def test_every_descent_begins_anew_with_its_share_of_the_steps():
    others = [START + 0.1, START + 0.2]
    descent = scripted(
        [0.5, 0.4, 0.45, 0.2, 0.3, 0.41, 0.4], others, iterations=5, check_every=2, schedule="cosine", weight_decay=0.0
    )
    records = [descent.step() for _ in range(5)]
    result = descent.finish()
    assert [record.descent for record in records] == [0, 0, 1, 1, 2]
    assert [record.iteration for record in records] == [0, 1, 2, 3, 4]
    assert [candidate.iteration for candidate in descent.candidates] == [0, 2, 2, 4, 4, 5]
    begins = [records[k].positions_m[0][0] for k in (0, 2, 4)]
    np.testing.assert_allclose(begins, START[0, 0] + np.array([0.0, 0.1, 0.2]), atol=1e-6)
    # the second of two steps under a cosine is a hundredth of the first
    along = np.array([[record.yaw_deg[0] for record in records[k : k + 2]] for k in (0, 2)])
    np.testing.assert_allclose(along[1] - along[0], np.degrees(0.1), atol=1e-4)
    assert all(not multiplier.any() for multiplier in np.array(descent.objective.multipliers)[[0, 2, 4]])
    assert result.training_objective == 0.2
    np.testing.assert_array_equal(result.mount_pose, descent.objective.checked[3])


def test_a_descent_that_loses_patience_makes_room_for_the_next():
    descent = scripted([0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.3, 0.2, 0.1], [START + 0.1], iterations=8, patience=2)
    records = steps_until_verdict(descent, 8)
    assert [record.descent for record in records] == [0, 0, 0, 1, 1, 1, 1, 1]
    assert descent.stop_reason is None
    lost = scripted([0.5, 0.6, 0.7, 0.8, 0.3, 0.4, 0.5], [START + 0.1], iterations=8, patience=2)
    assert len(steps_until_verdict(lost, 8)) == 6
    assert lost.stop_reason == "no better rig in 2 evaluations on the validation scenes since iteration 3"


def test_cameras_of_several_descents_are_mixed_in_the_end():
    class Pairs(Scripted):
        """The first descent's camera 0 and the second's camera 1 find everything; nobody else finds anything."""

        def evaluate(self, mount_pose, scenes, **options):
            found = super().evaluate(mount_pose, scenes, **options)
            if options.get("gradient"):
                return found
            assert options["detection_probability"]
            is_second = mount_pose[0, YAW_RAD] > START[0, YAW_RAD] + 0.5
            chance = np.array([[0.0, 0.9 * (not is_second)], [0.9 * is_second, 0.0]])
            return dataclasses.replace(found, detection_probability=chance)

    descent = scripted([0.5, 0.6, 0.4, 0.7, 0.1], [START + 1.0], iterations=2, check_every=9)
    descent.objective = Pairs(descent.objective.looks)
    for _ in range(2):
        descent.step()
    result = descent.finish()
    assert result.training_objective == 0.1
    first, second = (descent.objective.checked[k] for k in (0, 2))
    np.testing.assert_array_equal(result.mount_pose[:, YAW_RAD], [first[0, YAW_RAD], second[1, YAW_RAD]])
    assert descent.finish() is result  # nothing is evaluated twice


@given(
    st.integers(1, 5),
    st.integers(1, 40),
    st.integers(1, 6),
    st.sampled_from(["best", "last"]),
    st.integers(1, 7),
)
def test_renders_of_a_run_are_counted(descents, iterations, check_every, keep, starts):
    descent = scripted(
        [0.5] * 200, [START] * (descents - 1), iterations=iterations, check_every=check_every, keep=keep, starts=starts
    )
    for _ in range(iterations):
        descent.step()
    descent.finish()
    looks = len(descent.candidates) + (starts if starts > 1 else 0)
    assume(iterations >= descents)
    # as many as there can be; here no mixture is evaluated
    spent = iterations + 3 * looks
    counted = descent_camera_renders(descent.settings, 3, camera_count=2, iterations=iterations, batch_size=1)
    assert 2 * spent <= counted
    if descents == 1:
        assert 2 * spent == counted


@pytest.mark.parametrize("budget", [0, 30, 100, 1000])
def test_a_budget_pays_for_as_many_iterations_as_it_can(budget):
    options = {"camera_count": 2, "batch_size": 2}
    count = affordable_iterations(SETTINGS, 3, budget, **options)
    assert descent_camera_renders(SETTINGS, 3, iterations=count + 1, **options) > budget
    assert count == 0 or descent_camera_renders(SETTINGS, 3, iterations=count, **options) <= budget
    assert (count > 0) == (budget > 0)


@pytest.mark.parametrize("is_informed", [True, False])
@pytest.mark.parametrize("stop", [1, 4, 6])
def test_a_descent_that_is_restored_goes_on_as_if_it_had_never_stopped(tmp_path, is_informed, stop):
    """Two descents of four steps, batches of two of three scenes, so that an order of scenes is half used up."""

    def fresh():
        objective = street_objective()
        if not is_informed:
            objective = rig_objective(
                objective.mount,
                WholeImageDetector(),
                camera_count=2,
                settings=LossSettings(expected_miss_rate=1.0),
                constraints=ZoneAndSpacing(roof(), camera_count=2),
                probability=DetectionProbability.unfitted(),
            )
        assert objective.needs_panorama == is_informed
        return Descent(
            objective,
            street_scenes(),
            changed(descents=2, starts=2, check_every=2),
            START,
            np.random.default_rng(3),
            8,
            2,
            further_starts=[START + 0.2],
        )

    def told(records):
        return [{**dataclasses.asdict(record), "seconds": None} for record in records]

    whole = fresh()
    expected = [whole.step() for _ in range(8)]
    first = fresh()
    for _ in range(stop):
        first.step()
    np.savez(tmp_path / "last.npz", **first.state())
    second = fresh()
    with np.load(tmp_path / "last.npz", allow_pickle=False) as state:
        second.restore(state)
    assert told(second.step() for _ in range(8 - stop)) == told(expected[stop:])
    one, other = whole.finish(), second.finish()
    np.testing.assert_array_equal(other.mount_pose, one.mount_pose)
    assert other.training_objective == one.training_objective
    assert len(second.candidates) == len(whole.candidates)


def test_a_step_is_taken_whole_or_not_at_all(monkeypatch):
    """Ctrl-C in the middle of one, where random numbers are used up and the rig was looked at."""

    def fresh():
        return Descent(Slope(), street_scenes(), changed(check_every=1), START, np.random.default_rng(3), 8, 1)

    def told(state):
        return {name: value.tolist() for name, value in state.items()}

    def interrupted(*_):
        raise KeyboardInterrupt

    stopped, whole = fresh(), fresh()
    for descent in (stopped, whole):
        for _ in range(3):
            descent.step()
    with monkeypatch.context() as patch:
        patch.setattr(Descent, "_record", interrupted)
        with pytest.raises(KeyboardInterrupt):
            stopped.step()
    assert told(stopped.state()) == told(whole.state())
    assert [stopped.step().loss for _ in range(2)] == [whole.step().loss for _ in range(2)]


def test_a_state_of_something_else_is_refused():
    descent = Descent(Slope(), street_scenes(), SETTINGS, START, np.random.default_rng(0))
    state = descent.state()
    with pytest.raises(InputError, match="checkpoint: expected the state of a run of 2 cameras, got 1 x 7 numbers"):
        descent.restore({**state, "pose_value": state["pose_value"][:1]})
    with pytest.raises(InputError, match="got no multiplier_value"):
        descent.restore({name: value for name, value in state.items() if name != "multiplier_value"})


# --- inequalities ----------------------------------------------------------------------------------------------------


def saddle_point(slope, excess, start, multiplier, *, damping, steps=600, rate=0.05, ascent=1.0):
    """Descend and ascend on a problem in closed form; the last places and multipliers, one row a step."""
    weight = wp.array([1.0, 0.0], dtype=float, device="cpu")
    ascender, x, track = MultiplierAscent(np.array(multiplier)), np.array(start, float), []
    for _ in range(steps):
        value, jacobian = excess(x)
        constraint, multipliers = (
            wp.array(np.asarray(numbers, np.float32), dtype=float, device="cpu", requires_grad=True)
            for numbers in (value, ascender.value)
        )
        tape = wp.Tape()
        with tape:
            nothing = wp.zeros(2, dtype=float, device="cpu")
            total = lagrangian_of(nothing, constraint, multipliers, weight=weight, damping=damping)
        tape.backward(total)
        track.append(np.r_[x, ascender.value])
        x = x - rate * (slope(x) + np.asarray(jacobian).T @ constraint.grad.numpy())
        ascender.step(multipliers.grad.numpy(), np.full(len(value), -ascent))
    return np.array(track)


def test_damped_multipliers_reach_the_constrained_optimum():
    """Nearest point to (2, 1) with x <= 1, y <= 3 and x + y <= 5: (1, 1), and only the first inequality pulls, by 1."""

    def excess(x):
        return [x[0] - 1.0, x[1] - 3.0, x[0] + x[1] - 5.0], [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]

    # from beyond all of them, and with a multiplier that has to go
    last = saddle_point(lambda x: x - [2.0, 1.0], excess, [4.0, 4.0], [0.0, 2.0, 0.0], damping=4.0)[-1]
    np.testing.assert_allclose(last, [1.0, 1.0, 1.0, 0.0, 0.0], atol=1e-4)


def test_descent_under_inequalities_ends_in_the_zone():
    """A roof of two halves; the start stands between them."""
    surface = dataclasses.replace(roof(), is_mountable=np.ones((111, 71), bool))
    surface.is_mountable[50:60] = False
    mount = CameraMount(surface, camera=MODEL, height_offset_m=0.25)
    constraints = ZoneAndSpacing(surface, camera_count=2, margin_m=0.03)
    objective = rig_objective(
        mount,
        WholeImageDetector(),
        camera_count=2,
        settings=thesis_losses(),
        multiplier_damping=20.0,
        constraints=constraints,
        iou_min=0.01,
    )
    start = START.copy()
    start[:, :2] = [[1.06, 0.1], [1.1, 0.0]]
    assert constraints.violation_m(mount.rig(start)) > 0.2
    settings = changed(multiplier_learning_rate=2.0)
    _, records, result = run(settings, iterations=10, objective=objective, start=start)
    assert constraints.violation_m(mount.rig(result.mount_pose)) == 0.0
    assert tuple(records[0].multipliers) == constraints.names == tuple(records[0].terms)[-3:]
    assert records[0].terms["zone_0"] > 0.05
    assert records[1].multipliers["zone_0"] == pytest.approx(2.0 * records[0].terms["zone_0"])
    assert max(records[-1].terms[name] for name in constraints.names) < 0.02
