"""Processes of this machine."""

from __future__ import annotations

import concurrent.futures
import contextlib
import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.sharedctypes import Synchronized
from typing import Any, cast

from warpav.core.errors import OptionError
from warpav.core.executor.workers import Outcome, Share, WorkerKilledError, outcome_of, own_share, take_share


class Processes:
    """A pool of processes; one that is killed ends the pool, and the next task opens another."""

    def __init__(self, function: Callable[[Any], Any], worker_count: int, gpu_count: int = 1) -> None:
        """A pool without a process; they start with the tasks.

        Args:
            function: What is called with every task.
            worker_count: Processes.
            gpu_count: GPUs that they share: what a task calls ``cuda:0`` is to the k-th process the GPU k modulo this.
                0: they see none.

        Raises:
            OptionError: This machine has not so many GPUs.
        """
        self._function, self._worker_count = function, worker_count
        self._share = own_share().among(worker_count, gpu_count)
        self._orders = _gpu_orders(gpu_count)
        self._pool = self._open()

    def _open(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")  # a forked child could not use Warp
        started = context.Value("i", 0)
        begin = (started, self._orders, self._share)
        return ProcessPoolExecutor(self._worker_count, context, initializer=_begin, initargs=begin)

    def start(self, tasks: Sequence[Any]) -> Sequence[Future[Outcome[Any, Any]]]:
        """Start tasks, each in the pool that is open then."""
        return [self._submit(task) for task in tasks]

    def _submit(self, task: Any) -> Future[Outcome[Any, Any]]:  # noqa: ANN401
        while True:
            try:
                with _main_module_hidden():  # the first task starts the processes
                    return self._pool.submit(outcome_of, self._function, task)
            except BrokenProcessPool:
                self._pool.shutdown(wait=False)
                self._pool = self._open()

    def wait(self, handles: Collection[Future[Outcome[Any, Any]]]) -> Collection[Future[Outcome[Any, Any]]]:
        """Wait until some of the tasks have ended."""
        return concurrent.futures.wait(handles, return_when=concurrent.futures.FIRST_COMPLETED).done

    def outcome(self, handle: Future[Outcome[Any, Any]]) -> Outcome[Any, Any]:
        """The outcome of a task; `WorkerKilledError` where any process of its pool was killed."""
        try:
            return handle.result()
        except BrokenProcessPool:
            raise WorkerKilledError from None

    def close(self, handles: Collection[Future[Outcome[Any, Any]]]) -> None:
        """End the processes, without waiting for tasks that are under way."""
        # The pool forgets all of this as it shuts down; it has a method of its own for it from Python 3.14 on.
        busy = list(self._pool._processes.values()) if handles else []
        results = cast(Any, self._pool._result_queue)
        self._pool.shutdown(wait=not handles, cancel_futures=True)
        for process in busy:
            process.terminate()
        if busy:
            # The thread that reads a result whose process ended within it would wait for its rest for ever, and this
            # program for the thread: the pipe ends once nobody can write to it any more.
            results._writer.close()


def _gpu_orders(gpu_count: int) -> list[str]:
    """In which order processes see the GPUs, as CUDA_VISIBLE_DEVICES; empty where all see them as this one does.

    Raises:
        OptionError: This machine has not so many GPUs.
    """
    if gpu_count == 0:
        return [""]
    if gpu_count == 1:
        return []
    import warp

    found = warp.get_cuda_device_count()
    if gpu_count > found:
        raise OptionError("executor.gpus", f"expected at most {found}, the GPUs that Warp finds here, got {gpu_count}")
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")[:found]
    gpus = visible if len(visible) == found and all(visible) else [str(k) for k in range(found)]
    return [",".join(gpus[first:] + gpus[:first]) for first in range(gpu_count)]


def _begin(started: Synchronized[int], gpu_orders: Sequence[str], share: Share) -> None:
    """What a process does first: before Warp looks for GPUs."""
    take_share(share)
    if gpu_orders:
        with started.get_lock():
            os.environ["CUDA_VISIBLE_DEVICES"] = gpu_orders[started.value % len(gpu_orders)]
            started.value += 1
    _end_with_parent()


def _end_with_parent() -> None:
    """End this process when the one that started it is killed; it would wait for tasks for ever."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@contextlib.contextmanager
def _main_module_hidden() -> Iterator[None]:
    """Processes that start now do not import the program that started them once more.

    They would run a script from its first line on where it does not ask for ``__name__ == "__main__"``.
    """
    main = vars(sys.modules["__main__"])
    hidden = {name: main.pop(name) for name in ("__spec__", "__file__") if name in main}
    main["__spec__"] = None
    try:
        yield
    finally:
        main.update(hidden)
