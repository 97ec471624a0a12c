"""What of this machine a process may use: its cores, its memory, and its part of a GPU."""

from __future__ import annotations

import contextlib
import os
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

_THREAD_VARIABLES = ("OPENCV_FOR_THREADS_NUM", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_PROCESS_BYTES = 2**30
"""What a process of a pool takes, at most but for large scenes."""
_ENDLESS_BYTES = 2**60  # what the first version of control groups writes where there is no limit


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


def available_processes() -> int:
    """Processes that are worth their start: a core each, and room in the memory of the control group."""
    limit_bytes = _limit_bytes()
    cores = available_cores()
    return cores if limit_bytes is None else max(1, min(cores, limit_bytes // _PROCESS_BYTES))


_GROUPS, _OWN = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


@cache
def _quota_cores(groups: Path = _GROUPS, own: Path = _OWN) -> int | None:
    """Cores that the limits of control groups leave to this process, at least 1; None where there is no limit."""
    old = ("cpu.cfs_quota_us", "cpu.cfs_period_us")
    found = [max(1, quota // period) for quota, period in _limits("cpu", ("cpu.max",), old, groups, own) if quota > 0]
    return min(found, default=None)


@cache
def _limit_bytes(groups: Path = _GROUPS, own: Path = _OWN) -> int | None:
    """Memory that the limits of control groups leave to this process and others in it; None where there is no limit."""
    found = _limits("memory", ("memory.max",), ("memory.limit_in_bytes",), groups, own)
    return min((limit for limit, *_ in found if limit < _ENDLESS_BYTES), default=None)


def _limits(kind: str, new: Sequence[str], old: Sequence[str], groups: Path, own: Path) -> list[list[int]]:
    """The numbers in the files of this process's control groups, by the names that both versions give these."""
    found: list[list[int]] = []
    with contextlib.suppress(OSError):
        for line in own.read_text().splitlines():
            _, kinds, path = line.split(":", 2)
            if kinds and kind not in kinds.split(","):
                continue
            # a container sees its own group as the root, whatever the path says
            top = groups / kind if kinds else groups
            inside = top / path.strip("/")
            for group in (inside, *inside.parents):
                with contextlib.suppress(OSError, ValueError):  # no such group, or "max"
                    texts = [(group / name).read_text() for name in (old if kinds else new)]
                    found.append([int(word) for word in " ".join(texts).split()])
                if group == top:
                    break
    return found


def gpu_share(count: int) -> int:
    """This process's share of what a GPU does ``count`` of at once, at least 1: all but in a pool of processes."""
    return max(1, count // _share.gpu_processes)


def gpu_processes() -> int:
    """Processes of this program that share a GPU, this one among them."""
    return _share.gpu_processes


def peak_bytes() -> int | None:
    """Peak resident memory of this process so far; None if the system does not report it."""
    status = Path("/proc/self/status")
    if status.is_file():  # getrusage includes the parent process there
        found = re.search(r"VmHWM:\s*(\d+) kB", status.read_text())
        if found:
            return int(found[1]) * 2**10
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 2**10
