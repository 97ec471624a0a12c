"""One map over independent tasks: one after the other, in processes, on a Ray cluster, or as Slurm jobs."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from warpav.core.cores import available_cores
from warpav.core.errors import OptionError
from warpav.core.workers import (
    Outcome,
    Processes,
    RayCluster,
    Result,
    SlurmJobs,
    Task,
    WorkerKilledError,
    Workers,
    outcome_of,
)

__all__ = ["Executor", "Outcome"]

_ExecutorName = Literal["serial", "process", "ray", "slurm"]


@dataclass(frozen=True)
class Executor:
    """Where tasks run.

    Ray's workers and Slurm's jobs need the same warpav and the same paths as this process: an installation and a file
    system that they share.

    Attributes:
        worker_count: Tasks at a time, from 1. None: one for each core with ``process`` and a Ray of this machine, as
            many as there is room for on a Ray cluster, and one job array with ``slurm``.
        address: Of a running Ray cluster, as ``ray.init`` understands it: ``host:port`` from one of its machines,
            ``ray://host:port`` from elsewhere, ``auto``. None: that of ``RAY_ADDRESS``, else ``local``, a Ray of this
            machine that ends with the tasks. With ``slurm``, ``local`` means processes of this machine.
    """

    name: _ExecutorName = "serial"
    worker_count: int | None = None
    address: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    folder: Path | str = "slurm_jobs"
    gpu_count: int = 1

    def map(self, function: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[Outcome[Task, Result]]:
        """Call a function with every task; one that fails does not keep the others from running.

        Every executor calls the function once per task and adds nothing up, so the results are those of ``serial``, bit
        for bit where the function's own do not depend on the machine or on its number of threads.
        """
        if self.gpu_count > 1 and self.name != "process":
            raise OptionError(
                "executor.gpus", f"expected 1 with executor.name={self.name}, got {self.gpu_count}; take process"
            )
        if self.worker_count is not None and self.worker_count < 1:
            raise OptionError(
                "executor.workers", f"expected 1 or more, or nothing for as many as fit, got {self.worker_count}"
            )
        if self.name == "serial":
            for task in tasks:
                yield outcome_of(function, task)
            return
        count = available_cores() if self.name == "process" and self.worker_count is None else self.worker_count
        failed = (yield from _run_once(self._workers(function, count), tasks, count)) if tasks else []
        is_alone = False
        while failed and not is_alone:
            count = max(1, (count or len(failed)) // 4)
            is_alone = count == 1
            again = [outcome.task for outcome in failed]
            failed = yield from _run_once(self._workers(function, count), again, count)
        yield from failed

    def _workers(self, function: Callable[[Any], Any], count: int | None) -> Workers:
        if self.name == "ray":
            return RayCluster(function, self.address, self.options, count)
        if self.name == "slurm":
            return SlurmJobs(function, self.address, self.options, self.folder)
        return Processes(function, count or 1, self.gpu_count)


def _run_once(
    workers: Workers, tasks: Sequence[Task], worker_count: int | None
) -> Generator[Outcome[Task, Any], None, list[Outcome[Task, Any]]]:
    """Yield the outcomes of tasks; returns those of tasks whose workers were killed or had not the memory."""
    waiting = deque(tasks)
    running: dict[Any, Task] = {}
    failed: list[Outcome[Task, Any]] = []
    try:
        while waiting or running:
            room = len(waiting) if worker_count is None else min(worker_count - len(running), len(waiting))
            if room:
                batch = [waiting.popleft() for _ in range(room)]
                running.update(zip(workers.start(batch), batch, strict=True))
            for handle in workers.wait(running):
                task = running.pop(handle)
                try:
                    outcome = replace(workers.outcome(handle), task=task)
                except WorkerKilledError:
                    failed.append(Outcome(task, error="its process was killed; is there enough memory?"))
                    continue
                if outcome.lacks_memory:
                    failed.append(outcome)
                else:
                    yield outcome
    finally:
        workers.close(running)
    return failed
