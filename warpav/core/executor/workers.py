"""What every executor has in common: the outcome of a task, and how workers are asked for it."""

from __future__ import annotations

import contextlib
import importlib
import os
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from warpav.core.errors import InputError, OptionError, install_text, is_out_of_memory

Task = TypeVar("Task")
Result = TypeVar("Result")
_EXTRA = {"ray": "ray", "submitit": "slurm"}
_THREAD_VARIABLES = ("OPENCV_FOR_THREADS_NUM", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass
class Share:
    """What of this machine a process may use.

    Attributes:
        cores: Processor cores; None: all.
        gpu_processes: Processes that share its GPU, this one among them.
    """

    cores: int | None = None
    gpu_processes: int = 1

    def among(self, processes: int, gpus: int) -> Share:
        """The share of each of so many processes that have this one and, together, so many GPUs."""
        return Share(max(1, available_cores() // processes), self.gpu_processes * -(-processes // max(1, gpus)))


_share = Share()


@dataclass(frozen=True)
class Outcome(Generic[Task, Result]):
    """What became of a task.

    Attributes:
        task: The task.
        result: Its result; None if it failed.
        error: Why it failed; None if it did not.
        lacks_memory: Whether it failed for want of memory, which it may find when fewer run.
    """

    task: Task
    result: Result | None = None
    error: str | None = None
    lacks_memory: bool = False


class WorkerKilledError(Exception):
    """The process that ran a task ended without an outcome."""


class Workers(Protocol):
    """Where tasks run; a handle stands for a task that was started."""

    def start(self, tasks: Sequence[Any]) -> Sequence[Any]:
        """Start tasks; returns a handle for each."""
        ...

    def wait(self, handles: Collection[Any]) -> Collection[Any]:
        """Wait until some of the tasks have ended; returns their handles."""
        ...

    def outcome(self, handle: Any) -> Outcome[Any, Any]:  # noqa: ANN401
        """The outcome of a task that has ended; its field ``task`` does not count.

        Raises:
            WorkerKilledError: There is none.
        """
        ...

    def close(self, handles: Collection[Any]) -> None:
        """Stop the tasks that are still under way, and let go of everything."""
        ...


def own_share() -> Share:
    """What this process may use."""
    return _share


def take_share(share: Share) -> None:
    """Let this process use its share alone: before it loads libraries that start a thread for every core they find."""
    vars(_share).update(vars(share))
    cores = available_cores()
    if cores < (os.cpu_count() or 1):
        for variable in _THREAD_VARIABLES:
            given = os.environ.get(variable, "")  # what a larger share inherited may be more
            if not (given.isdecimal() and 1 <= int(given) <= cores):
                os.environ[variable] = str(cores)


def available_cores() -> int:
    """Processor cores that this process may use: of its affinity, its control group and, in a pool, its share."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(each for each in (cores, quota_cores(), _share.cores) if each is not None)


@cache
def quota_cores(groups: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> int | None:
    """Cores that the limits of control groups leave to this process, at least 1; None where there is no limit."""
    found = []
    with contextlib.suppress(OSError):
        for line in own.read_text().splitlines():
            _, kinds, path = line.split(":", 2)
            if kinds and "cpu" not in kinds.split(","):
                continue
            # a container sees its own group as the root, whatever the path says
            top = groups / "cpu" if kinds else groups
            inside = top / path.strip("/")
            for group in (inside, *inside.parents):
                with contextlib.suppress(OSError, ValueError):  # no such group, or "max"
                    if kinds:
                        quota = int((group / "cpu.cfs_quota_us").read_text())
                        period = int((group / "cpu.cfs_period_us").read_text())
                    else:
                        quota, period = map(int, (group / "cpu.max").read_text().split())
                    if quota > 0:
                        found.append(max(1, quota // period))
                if group == top:
                    break
    return min(found, default=None)


def gpu_share(count: int) -> int:
    """This process's share of what a GPU does ``count`` of at once, at least 1: all but in a pool of processes."""
    return max(1, count // _share.gpu_processes)


def gpu_processes() -> int:
    """Processes of this program that share a GPU, this one among them."""
    return _share.gpu_processes


def outcome_of(function: Callable[[Task], Result], task: Task) -> Outcome[Task, Result]:
    """Run a task here; an error becomes part of the outcome."""
    try:
        return Outcome(task, function(task))
    except InputError as error:
        return Outcome(task, error=str(error))
    except Exception as error:  # the others go on
        lacks_memory = isinstance(error, MemoryError) or is_out_of_memory(error)
        return Outcome(task, error=f"{type(error).__name__}: {one_line(error)}", lacks_memory=lacks_memory)


def one_line(error: Exception) -> str:
    """What an error says, in one line."""
    return " ".join(str(error).split())


def executor_package(name: str) -> Any:  # noqa: ANN401 (a module that the type checker may not find)
    """The package ``ray`` or ``submitit``.

    Raises:
        OptionError: It is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise OptionError(
            "executor.name",
            f"expected the package {name} to be installed, got: {error}; {install_text(_EXTRA[name])}",
        ) from None
