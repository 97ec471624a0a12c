"""Independent tasks, one after the other in this process or spread over several."""

from __future__ import annotations

import concurrent.futures
import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

from warpav.errors import InputError

ExecutorName = Literal["serial", "process"]
Task = TypeVar("Task")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Outcome(Generic[Task, Result]):
    """What became of a task.

    Attributes:
        task: The task.
        result: Its result; None if it failed.
        error: Why it failed; None if it did not.
    """

    task: Task
    result: Result | None = None
    error: str | None = None


def run_tasks(
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    executor: ExecutorName = "serial",
    worker_count: int | None = None,
) -> Iterator[Outcome[Task, Result]]:
    """Run a function on every task; one that fails does not keep the others from running.

    Args:
        function: Importable from a module, as another process has to find it.
        tasks: What it is called with; small, as it travels to the processes.
        executor: ``serial``, or ``process`` for processes of their own. The results are the same.
        worker_count: Processes; None: one for each core.

    Yields:
        Outcomes, in the order of the tasks with ``serial`` and as they finish with ``process``. Tasks that were under
        way when a process was killed are tried once more, one at a time, so that only the one that kills fails.
    """
    if executor == "serial":
        for task in tasks:
            yield _outcome(function, task)
        return
    waiting = deque(tasks)
    while waiting:
        suspects = yield from _run_until_killed(function, waiting, worker_count or os.cpu_count() or 1)
        for task in suspects:
            alone = deque([task])
            if (yield from _run_until_killed(function, alone, 1)):
                yield Outcome(task, error="its process was killed; is there enough memory?")


def _run_until_killed(
    function: Callable[[Task], Result], waiting: deque[Task], worker_count: int
) -> Generator[Outcome[Task, Result], None, list[Task]]:
    """Take tasks and yield their outcomes until none is left or a process is killed; returns what was under way."""
    context = multiprocessing.get_context("spawn")  # a forked child could not use Warp
    running: dict[concurrent.futures.Future[Outcome[Task, Result]], Task] = {}
    suspects: list[Task] = []
    with concurrent.futures.ProcessPoolExecutor(min(worker_count, len(waiting)), context) as pool:
        try:
            while running or (waiting and not suspects):
                while waiting and len(running) < worker_count and not suspects:
                    try:
                        running[pool.submit(_outcome, function, waiting[0])] = waiting[0]
                        waiting.popleft()
                    except BrokenProcessPool:
                        suspects.append(waiting.popleft())
                for future in concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED).done:
                    task = running.pop(future)
                    try:
                        outcome = future.result()
                    except BrokenProcessPool:
                        suspects.append(task)
                    else:
                        yield outcome
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return suspects


def _outcome(function: Callable[[Task], Result], task: Task) -> Outcome[Task, Result]:
    try:
        return Outcome(task, function(task))
    except InputError as error:
        return Outcome(task, error=str(error))
    except Exception as error:  # the others go on
        return Outcome(task, error=f"{type(error).__name__}: {' '.join(str(error).split())}")
