"""A function on every task: which executor, what is under way, and what to do where memory did not suffice."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from warpav.core.errors import OptionError
from warpav.core.executor.workers import Outcome, Result, Task, WorkerKilledError, Workers, available_cores, outcome_of

ExecutorName = Literal["serial", "process", "ray", "slurm"]


@dataclass(frozen=True)
class Executor:
    """Where tasks run, as `run_tasks` takes it.

    Attributes:
        name: ``serial``, ``process``, ``ray`` or ``slurm``.
        worker_count: Tasks at a time; None: as many as fit.
        address: Of a running Ray cluster.
        options: What a task needs.
        folder: For jobs and logs of ``slurm``.
        gpu_count: GPUs that the processes of ``process`` share; 0: they see none.
    """

    name: ExecutorName = "serial"
    worker_count: int | None = None
    address: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    folder: Path | str = "slurm_jobs"
    gpu_count: int = 1

    def run(self, function: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[Outcome[Task, Result]]:
        """Run a function on every task, as `run_tasks`."""
        return run_tasks(
            function,
            tasks,
            executor=self.name,
            worker_count=self.worker_count,
            address=self.address,
            options=self.options,
            folder=self.folder,
            gpu_count=self.gpu_count,
        )


def run_tasks(
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    executor: ExecutorName = "serial",
    worker_count: int | None = None,
    address: str | None = None,
    options: Mapping[str, Any] | None = None,
    folder: Path | str = "slurm_jobs",
    gpu_count: int = 1,
) -> Iterator[Outcome[Task, Result]]:
    """Run a function on every task; one that fails does not keep the others from running.

    Every executor calls the function once per task and adds nothing up, so the results are those of ``serial``, bit for
    bit where the function's own do not depend on the machine or on its number of threads. Ray's workers and Slurm's
    jobs need the same warpav and the same paths as this process: an installation and a file system that they share.

    Args:
        function: Importable from a module, as another process has to find it.
        tasks: What it is called with; small, as it travels to the processes.
        executor: ``serial``; ``process`` for processes of their own; ``ray``; ``slurm``.
        worker_count: Tasks at a time, from 1. None: one for each core with ``process`` and a Ray of this machine, as
            many as there is room for on a Ray cluster, and one job array with ``slurm``.
        address: Of a running Ray cluster, as ``ray.init`` understands it: ``host:port`` from one of its machines,
            ``ray://host:port`` from elsewhere, ``auto``. None: that of ``RAY_ADDRESS``, else ``local``, a Ray of this
            machine that ends with the tasks. With ``slurm``, ``local`` means processes of this machine.
        options: What a task needs: options of ``ray.remote`` such as ``num_gpus``, or of submitit's ``AutoExecutor``
            such as ``slurm_partition``, ``timeout_min`` (240 by default) and ``gpus_per_node``.
        folder: For jobs and logs of ``slurm``; all machines must see it.
        gpu_count: GPUs that the processes of ``process`` share in turn, from the tasks' own device on; the results
            stay the same. 0: they see none and start sooner. Ray and Slurm give a task its GPU by ``options``.

    Yields:
        Outcomes, in the order of the tasks with ``serial`` and as they finish with the others. With these, tasks that
        failed for want of memory, and all that were under way when a process was killed, are tried again after the
        rest, by a quarter as many processes and so on down to a single one: a task fails only if it does so alone.

    Raises:
        OptionError: The executor's package is not installed, nobody answers at the address, or an option is wrong;
            it names ``executor.name``, ``.workers``, ``.address``, ``.options`` or ``.gpus``.
    """
    if gpu_count > 1 and executor != "process":
        raise OptionError("executor.gpus", f"expected 1 with executor.name={executor}, got {gpu_count}; take process")
    if worker_count is not None and worker_count < 1:
        raise OptionError("executor.workers", f"expected 1 or more, or nothing for as many as fit, got {worker_count}")
    if executor == "serial":
        for task in tasks:
            yield outcome_of(function, task)
        return
    if executor == "process":
        worker_count = worker_count or available_cores()

    def opened(count: int | None) -> Workers:
        if executor == "ray":
            from warpav.core.executor.ray_cluster import RayCluster

            return RayCluster(function, address, options or {}, count)
        if executor == "slurm":
            from warpav.core.executor.slurm_jobs import SlurmJobs

            return SlurmJobs(function, address, options or {}, folder)
        from warpav.core.executor.processes import Processes

        return Processes(function, count or 1, gpu_count)

    if not tasks:
        return
    failed = yield from _run_once(opened(worker_count), tasks, worker_count)
    is_alone = False
    while failed and not is_alone:
        worker_count = max(1, (worker_count or len(failed)) // 4)
        is_alone = worker_count == 1
        failed = yield from _run_once(opened(worker_count), [outcome.task for outcome in failed], worker_count)
    yield from failed


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
