"""Independent tasks: the same outcomes in one process and in several, failures that stay where they are."""

import os
import signal
import time

import pytest

from warpav.errors import InputError
from warpav.executor import Outcome, run_tasks


def square(number):
    if number == 2:
        raise InputError("two.png: expected three, got two")
    if number == 3:
        raise ValueError("three\n  is odd")
    return number * number


def process_of(_):
    time.sleep(0.2)
    return os.getpid()


def square_or_die(task):
    number, deadly = task
    if number == deadly:
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.05)
    return number * number


def die_once(file):
    """Kill the first process that comes by."""
    if not file.exists():
        file.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "survived"


EXPECTED = [
    Outcome(0, 0),
    Outcome(1, 1),
    Outcome(2, error="two.png: expected three, got two"),
    Outcome(3, error="ValueError: three is odd"),
    Outcome(4, 16),
]


def test_serial_keeps_the_order_and_goes_on_after_failures():
    assert list(run_tasks(square, range(5))) == EXPECTED


def test_processes_give_the_same_outcomes():
    found = list(run_tasks(square, range(5), executor="process", worker_count=2))
    assert sorted(found, key=lambda outcome: outcome.task) == EXPECTED


def test_serial_runs_a_task_only_when_its_outcome_is_asked_for():
    seen = []
    outcomes = run_tasks(seen.append, [1, 2, 3])
    next(outcomes)
    assert seen == [1]


def test_no_tasks_start_no_process():
    assert list(run_tasks(process_of, [], executor="process")) == []


def test_there_are_as_many_processes_as_asked_for():
    found = {outcome.result for outcome in run_tasks(process_of, range(6), executor="process", worker_count=2)}
    assert len(found) == 2
    assert os.getpid() not in found


def test_a_task_that_kills_its_process_fails_alone():
    # the deadly task comes while others run and wait: they must not be blamed
    tasks = [(number, 3) for number in range(8)]
    found = {
        outcome.task[0]: outcome for outcome in run_tasks(square_or_die, tasks, executor="process", worker_count=2)
    }
    assert sorted(found) == list(range(8))
    assert found.pop(3).error == "its process was killed; is there enough memory?"
    assert all(outcome.error is None and outcome.result == number**2 for number, outcome in found.items())


def test_a_task_whose_process_is_killed_once_succeeds(tmp_path):
    tasks = [tmp_path / "mark"]
    assert list(run_tasks(die_once, tasks, executor="process", worker_count=1)) == [Outcome(tasks[0], "survived")]


def test_leaving_early_waits_for_no_further_task():
    began = time.perf_counter()
    for outcome in run_tasks(time.sleep, [0.01, *[0.5] * 20], executor="process", worker_count=1):
        assert outcome.error is None
        break
    assert time.perf_counter() - began < 8.0  # worst seen 1 s; all tasks together take 10 s


def test_ctrl_c_is_no_failure_of_a_task():
    def interrupted(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        next(run_tasks(interrupted, [1]))
