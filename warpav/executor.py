"""Independent tasks, one after the other in this process or spread over several."""

from __future__ import annotations

import concurrent.futures
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

from warpav.errors import InputError

ExecutorName = Literal["serial", "process"]
Task = TypeVar("Task")
Result = TypeVar("Result")
_MAX_TRIES = 2  # of a task whose process was killed


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
        Outcomes, in the order of the tasks with ``serial`` and as they finish with ``process``. The task of a process
        that was killed is tried once more.
    """
    if executor == "serial":
        for task in tasks:
            yield _outcome(function, task)
        return
    waiting, tries = list(tasks), 0
    while waiting:
        tries += 1
        context = multiprocessing.get_context("spawn")  # a forked child could not use Warp
        with concurrent.futures.ProcessPoolExecutor(worker_count or os.cpu_count(), context) as pool:
            futures = {pool.submit(_outcome, function, task): task for task in waiting}
            try:
                for future in concurrent.futures.as_completed(futures):
                    try:
                        outcome = future.result()
                    except BrokenProcessPool:
                        if tries < _MAX_TRIES:
                            continue
                        outcome = Outcome(futures[future], error="its process was killed; is there enough memory?")
                    waiting.remove(futures[future])
                    yield outcome
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise


def _outcome(function: Callable[[Task], Result], task: Task) -> Outcome[Task, Result]:
    try:
        return Outcome(task, function(task))
    except InputError as error:
        return Outcome(task, error=str(error))
    except Exception as error:  # the others go on
        return Outcome(task, error=f"{type(error).__name__}: {' '.join(str(error).split())}")
