"""What a run shows, in a terminal and when piped."""

import dataclasses
import io
import time

import pytest

from warpav.runs import RunDisplay
from warpav.runs import _progress as progress
from warpav.runs._progress import iteration_rows
from warpav.runs._terminal import Terminal

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
    assert (
        "objective 0.17  bound 0.15 (of any rig of the 40 candidate cameras)  camera renders 300" in lines[2]
    )  # the last of two
    assert "objective 0.16  bound 0.15 (of any rig of the 40 candidate cameras)  camera renders 400" in lines[3]


def test_an_interrupted_search_by_a_pool_says_what_it_has_come_to():
    def interrupt(display):
        states = display.iterations(_states(), count=None, min_spacing_m=0.2)
        for _ in range(4):
            next(states)
        states.close()

    assert _shown(False, interrupt).splitlines()[-1].startswith("done polish  objective 0.17")


def test_inequalities_with_room_to_spare_are_left_out():
    record = Record(1.0, {"detected_area": 0.5, "zone_0": -0.3, "zone_1": -0.1, "spacing_0_1": 0.02}, {}, {})
    record.multipliers = {"zone_0": 0.0, "zone_1": 0.7, "spacing_0_1": 0.0}
    rows = iteration_rows(record, min_spacing_m=0.2)
    assert "zone_0" not in rows
    assert "multiplier zone_0" not in rows
    assert {"detected_area", "zone_1", "multiplier zone_1", "spacing_0_1"} <= set(rows)


def test_nothing_is_redrawn_where_there_is_no_terminal_whatever_colours_are_asked_for(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # as Jupyter does for commands in its cells
    console = RunDisplay().console
    assert not console.is_terminal
    assert not console.is_jupyter


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
