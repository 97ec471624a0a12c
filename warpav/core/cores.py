"""What of this machine a process may use: its cores, and its part of a GPU."""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path

_THREAD_VARIABLES = ("OPENCV_FOR_THREADS_NUM", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass
class Share:
    """Cores of a process (None: all), and the processes that share its GPU, this one among them."""

    cores: int | None = None
    gpu_processes: int = 1

    def among(self, processes: int, gpus: int) -> Share:
        """The share of each of so many processes that have this one and, together, so many GPUs."""
        return Share(max(1, available_cores() // processes), self.gpu_processes * -(-processes // max(1, gpus)))


_share = Share()


def own_share() -> Share:
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
    return min(each for each in (cores, _quota_cores(), _share.cores) if each is not None)


@cache
def _quota_cores(groups: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> int | None:
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
