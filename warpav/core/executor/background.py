"""One task in another process while this one does something else."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import Future

from warpav.core.errors import InputError
from warpav.core.executor.processes import Processes
from warpav.core.executor.workers import Outcome, Result, Task, WorkerKilledError, available_cores


@contextlib.contextmanager
def in_background(function: Callable[[Task], Result], task: Task) -> Iterator[Future[Result]]:
    """Run a function on a task in a process of its own while the block does something else.

    On a machine with one core it runs here, after the block. Where the block fails, nobody waits for it.

    Args:
        function: Importable from a module, as another process has to find it.
        task: What it is called with; it travels to the process, as the result travels back.

    Yields:
        The result, there when the block has ended.

    Raises:
        InputError: The function failed; with its text.
    """
    promise: Future[Result] = Future()
    if available_cores() == 1:
        yield promise
        promise.set_result(function(task))
        return
    workers = Processes(function, 1, beside=1)
    handles = workers.start([task])
    try:
        yield promise
        try:
            outcome: Outcome[Task, Result] = workers.outcome(handles[0])
        except WorkerKilledError:
            promise.set_result(function(task))
        else:
            if outcome.error is not None:
                raise InputError(outcome.error)
            promise.set_result(outcome.result)  # pyright: ignore[reportArgumentType]
        handles = []
    finally:
        workers.close(handles)
