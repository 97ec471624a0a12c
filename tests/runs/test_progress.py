"""What a run shows, in a terminal and when piped."""

import dataclasses
import io
import math
import time

import pytest

from warpav.optimisation.constraints import Margin
from warpav.runs import progress
from warpav.runs.progress import RunDisplay, iteration_rows
from warpav.runs.terminal import Terminal
from warpav.runs.verdict import ARM_ROWS, show_verdict, worse_than_start

REFRESH_S = 0.025


@pytest.fixture(autouse=True)
def _is_refreshed_often(monkeypatch):
    monkeypatch.setattr(progress, "REFRESH_PER_SECOND", 1.0 / REFRESH_S)


@dataclasses.dataclass
class Record:
    loss: float
    terms: dict
    multipliers: dict
    gradient_norm: dict
    min_camera_distance_m: float | None = 0.75
    best_training_objective: float | None = None


def _records(count):
    return [
        Record(10.0 - k, {"detected_area": 0.5}, {"camera_spacing": 0.25}, {"position": 0.125}) for k in range(count)
    ]


def _shown(terminal, act):
    stream = io.StringIO()
    console = Terminal(file=stream, force_terminal=terminal, width=100, soft_wrap=not terminal)
    with RunDisplay(console) as display:
        act(display)
    return stream.getvalue()


def test_steps_pass_through_in_order():
    with RunDisplay(Terminal(file=io.StringIO())) as display:
        assert list(display.steps("scenes", "abc", count=3)) == ["a", "b", "c"]
        records = _records(4)
        assert list(display.iterations(records, count=4, min_spacing_m=0.2)) == records


def test_piped_output_is_one_line_for_about_every_tenth_iteration():
    text = _shown(False, lambda display: list(display.iterations(_records(100), count=100, min_spacing_m=0.2)))
    assert "\x1b" not in text
    lines = text.splitlines()
    assert lines[0] == "optimising: 100"
    assert [line.split()[1] for line in lines[1:]] == ["1/100", *(f"{k}/100" for k in range(10, 101, 10))]
    assert "loss 10" in lines[1]
    assert "detected_area 0.5" in lines[1]
    assert "closest cameras 0.75 m (limit 0.2 m)" in lines[1]
    assert "s/it" in lines[1]


def test_piped_steps_show_some_progress():
    text = _shown(False, lambda display: list(display.steps("scenes", range(40), count=40)))
    assert text.splitlines() == ["scenes: 40", *(f"scenes: {k}/40" for k in range(4, 40, 4))]


def test_a_terminal_shows_the_table_while_it_runs():
    def watch(display):
        for _ in display.iterations(_records(2), count=2, min_spacing_m=0.2):
            time.sleep(2.0 * REFRESH_S)

    text = _shown(True, watch)
    for word in ("optimising", "loss", "multiplier camera_spacing", "gradient position", "closest cameras"):
        assert word in text


def _states():
    stages = ["start", "selection", "polish", "polish", "pricing", "selection", "settled"]
    for k, stage in enumerate(stages):
        record = Record(0.2 - 0.01 * k, {}, {}, {}, best_training_objective=0.2 - 0.01 * k)
        record.stage, record.camera_renders = stage, 100 * k
        record.bound, record.pool_cameras = (0.15, 40) if k else (None, None)
        yield record


def test_piped_output_of_a_search_by_a_pool_is_a_line_for_every_stage():
    text = _shown(False, lambda display: list(display.iterations(_states(), count=None, min_spacing_m=0.2)))
    first, *lines = text.splitlines()
    assert first == "searching"
    assert [line.split()[1] for line in lines] == ["start", "selection", "polish", "pricing", "selection", "settled"]
    assert "bound -" in lines[0]
    assert "objective 0.17  bound 0.15 (of any rig of 40 cameras)  camera renders 300" in lines[2]  # the last of two
    assert "objective 0.16  bound 0.15 (of any rig of 40 cameras)  camera renders 400" in lines[3]


def test_the_start_of_a_search_by_a_pool_is_shown_before_the_pool_is_drawn():
    def states(display):
        start, *others = _states()
        list(display.steps("scenes seen by the start", "ab", count=2))
        yield start
        list(display.steps("scenes seen by the pool", "ab", count=2))
        yield from others

    def watch(display):
        list(display.iterations(states(display), count=None, min_spacing_m=0.2))

    lines = [line.partition("  ")[0] for line in _shown(False, watch).splitlines()]
    stages = ["scenes seen by the start: 2", "done start", "scenes seen by the pool: 2", "done selection"]
    assert lines[:5] == ["searching", *stages]
    assert lines.count("done start") == 1


def test_a_terminal_shows_the_start_while_the_pool_is_drawn():
    def states(display):
        yield next(_states())
        for _ in display.steps("scenes seen by the pool", "ab", count=2):
            time.sleep(2.0 * REFRESH_S)

    text = _shown(True, lambda display: list(display.iterations(states(display), count=None, min_spacing_m=0.2)))
    assert "objective" in text.partition("scenes seen by the pool")[2]


def test_an_interrupted_search_by_a_pool_says_what_it_has_come_to():
    def interrupt(display):
        states = display.iterations(_states(), count=None, min_spacing_m=0.2)
        for _ in range(4):
            next(states)
        states.close()

    assert _shown(False, interrupt).splitlines()[-1].startswith("done polish  objective 0.17")


def test_a_terminal_shows_objective_bound_and_what_was_spent():
    def watch(display):
        for record in display.iterations(_states(), count=None, min_spacing_m=0.2):
            list(display.steps("scenes seen by the pool", "ab", count=2) if record.stage == "start" else ())
            time.sleep(4.0 * REFRESH_S)

    text = _shown(True, watch)
    for word in ("searching", "done", "polish", "bound", "0.15 (of any rig of 40 cameras)", "camera renders", "600"):
        assert word in text
    assert "optimising" not in text.rpartition("settled")[2]


def test_inequalities_with_room_to_spare_are_left_out():
    record = Record(1.0, {"detected_area": 0.5, "zone_0": -0.3, "zone_1": -0.1, "spacing_0_1": 0.02}, {}, {})
    record.multipliers = {"zone_0": 0.0, "zone_1": 0.7, "spacing_0_1": 0.0}
    rows = iteration_rows(record, min_spacing_m=0.2)
    assert "zone_0" not in rows
    assert "multiplier zone_0" not in rows
    assert {"detected_area", "zone_1", "multiplier zone_1", "spacing_0_1"} <= set(rows)


@pytest.mark.parametrize(("violation", "words"), [(0.0, "constraints met"), (0.5, "constraints broken by 0.5 m")])
def test_the_verdict_says_what_matters(violation, words):
    stream = io.StringIO()
    metrics = {**dict.fromkeys(ARM_ROWS, 0.25), "constraint_violation": violation, "objective": None}
    alone = {"mean": None, "low": None, "high": None}
    evaluation = {
        "scenes": {"test": 7},
        "arms": {"optimised": metrics, "highest": metrics, "random": metrics},
        "paired": {
            "highest": {"tp_detection_rate": {"mean": 0.1, "low": -0.05, "high": 0.2}},
            "random": {"tp_detection_rate": alone},
        },
        "training_objective": {"start": 2.0, "optimised": 1.5},
    }
    show_verdict(Terminal(file=stream, width=80, soft_wrap=True), evaluation)
    text = stream.getvalue()
    assert words in text
    assert "7 test scenes" in text
    assert "2.0000 at the start, 1.5000 at the end (-25.0%)" in text
    assert "optimised - highest: +0.1000 (95 % of resampled scene sets: -0.0500 to +0.2000)" in text
    assert "optimised - random" not in text
    for heading in ARM_ROWS.values():
        assert heading in text


def comparison_of(count, *, scenes=7, width=80, **of_the_last):
    """What is printed of some rigs side by side."""
    stream = io.StringIO()
    metrics = {**dict.fromkeys(ARM_ROWS, 0.25), "constraint_violation": 0.0}
    arms = {f"rig_with_a_name_{k}": metrics for k in range(count - 1)} | {"last": {**metrics, **of_the_last}}
    sure = {"tp_detection_rate": {"mean": 0.1, "low": 0.05, "high": 0.2}}
    evaluation = {"scenes": {"test": scenes}, "arms": arms, "paired": dict.fromkeys(list(arms)[1:], sure)}
    show_verdict(Terminal(file=stream, width=width), evaluation)
    return stream.getvalue()


def test_rigs_that_do_not_fit_side_by_side_come_in_parts_beside_the_first():
    text = comparison_of(5)
    assert text.count("7 test scenes") == 4  # two names of 17 letters and the headings take 80 columns
    assert text.count("rig_with_a_name_0") > 4
    for name in ("rig_with_a_name_3", "last"):
        assert name in text
    assert "…" not in text
    assert comparison_of(5, width=300).count("7 test scenes") == 1


def test_differences_of_few_scenes_come_with_a_caution():
    assert "no difference can be proven" in comparison_of(2, scenes=5)
    assert "no difference can be proven" not in comparison_of(2, scenes=6)


def test_a_rig_that_sees_nothing_but_its_vehicle_is_told():
    blind = {"tp_detection_rate": 0.0, "body_share_max": 0.97}
    assert "last detects nothing: the vehicle's own body covers up to 97% of an image" in comparison_of(2, **blind)
    assert "detects nothing" not in comparison_of(2, tp_detection_rate=0.01, body_share_max=0.97)
    assert "detects nothing" not in comparison_of(2, tp_detection_rate=0.0, body_share_max=0.2)


def verdict_of(**found):
    """What is printed of an optimised rig and its start, in one line."""
    stream = io.StringIO()
    metrics = {**dict.fromkeys(ARM_ROWS, 0.25), "constraint_violation": 0.15}
    show_verdict(
        Terminal(file=stream, width=80, soft_wrap=True),
        {"scenes": {"test": 7}, "arms": {"optimised": metrics, "start": metrics}, **found},
    )
    return stream.getvalue()


def test_the_worst_of_the_broken_constraints_is_named():
    margins = [Margin("border", ("left",), 0.0, 0.02, -0.02, False)]
    margins.append(Margin("spacing", ("left", "right"), 0.07, 0.2, -0.13, False))
    margins.append(Margin("border", ("right",), 0.5, 0.02, 0.48, True))
    text = verdict_of(constraints={"optimised": [dataclasses.asdict(each) for each in margins]})
    assert "constraints broken by 0.15 m in all; the distance between left and right is 0.13 m too short\n" in text


@pytest.mark.parametrize("start", [None, math.inf])
def test_a_start_that_is_not_allowed_has_no_objective(start):
    training = {"start": start, "optimised": 0.0011}
    need = {"share": 1.0}
    outcome = {"points": 4, "share": 0.5, "is_met": False, "worst": [], "need": need}
    outcomes = [{**outcome, "name": "rear", "hard": True}, {**outcome, "name": "doors", "hard": False}]
    text = verdict_of(training_objective=training, requirements={"optimised": [], "start": outcomes})
    assert "scenes: 0.0011 at the end; the start is not allowed, as it does not meet rear\n" in text
    assert "scenes: 0.0011 at the end; the start is not allowed\n" in verdict_of(training_objective=training)
    without_end = verdict_of(training_objective={"start": 0.5, "optimised": None})
    assert "scenes: 0.5000 at the start, - at the end\n" in without_end


def test_constraints_that_are_met_do_not_hide_a_requirement_that_is_not():
    outcome = {"name": "near", "points": 4, "share": 0.5, "is_met": False, "hard": False, "worst": []}
    arms = {"optimised": {**dict.fromkeys(ARM_ROWS, 0.25), "constraint_violation": 0.0}}
    outcome["need"] = {"share": 1.0}
    text = verdict_of(arms=arms, requirements={"optimised": [outcome]})
    assert "REQUIREMENT NOT MET: near at 50.0% of 4 points\n" in text
    with_gap = {**outcome, "gap": {"sector": "rear left", "area_m2": 1.2345}}
    text = verdict_of(arms=arms, requirements={"optimised": [with_gap]})
    assert "REQUIREMENT NOT MET: near at 50.0% of 4 points; largest gap: 1.23 m², rear left\n" in text
    assert "constraints of spacing and mount met: " in text
    assert "\nconstraints met: " in verdict_of(arms=arms, requirements={"optimised": [{**outcome, "is_met": True}]})


def test_no_difference_is_minus_nothing():
    found = {"mean": -1e-6, "low": -2e-6, "high": 1e-6}
    text = verdict_of(paired={"start": {"tp_detection_rate": found}})
    assert "+0.0000 (95 % of resampled scene sets: +0.0000 to +0.0000)" in text


def test_nothing_is_redrawn_where_there_is_no_terminal_whatever_colours_are_asked_for(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # as Jupyter does for commands in its cells
    console = RunDisplay().console
    assert not console.is_terminal
    assert not console.is_jupyter


@pytest.mark.parametrize(
    ("training", "recall", "expected"),
    [
        ({"start": 0.2, "optimised": 0.1}, {"mean": 0.1, "low": 0.0, "high": 0.2}, []),
        ({"start": 0.2, "optimised": 0.2}, {"mean": -0.1, "low": -0.3, "high": 0.1}, []),  # nothing is certain
        ({"start": 0.2, "optimised": 0.3}, {"mean": 0.1, "low": 0.0, "high": 0.2}, ["objective 0.3, its start 0.2"]),
        ({"start": 0.2, "optimised": None}, {"mean": None, "low": None, "high": None}, ["objective -"]),
        ({"start": 0.2, "optimised": 0.1}, {"mean": -0.2, "low": -0.3, "high": -0.1}, ["recall 0.7000"]),
    ],
)
def test_what_is_worse_than_its_start_is_said(training, recall, expected):
    evaluation = {
        "arms": {"optimised": {"tp_detection_rate": 0.7}, "start": {"tp_detection_rate": 0.9}},
        "paired": {"start": {"tp_detection_rate": recall}},
        "training_objective": training,
    }
    found = worse_than_start(evaluation)
    assert len(found) == len(expected)
    assert all(text in line for text, line in zip(expected, found, strict=True))


@pytest.mark.parametrize("is_terminal", [False, True])
def test_names_are_shown_and_not_obeyed(is_terminal):
    name, visible = "e\x1b[35mvil\nEVIL [bold]x[/] [/]", "e\\x1b[35mvil\\nEVIL [bold]x[/] [/]"
    record = Record(1.0, {name: 0.5}, {}, {})

    def act(display):
        display.say(name)
        display.stage(name)
        list(display.steps(name, range(2), count=2))
        for _ in display.iterations([record], count=1, min_spacing_m=0.2):
            time.sleep(2.0 * REFRESH_S if is_terminal else 0.0)

    text = _shown(is_terminal, act)
    assert "\x1b[35m" not in text
    assert text.count(visible) >= (2 if is_terminal else 4)
    assert not any(line.startswith("EVIL") for line in text.splitlines())
