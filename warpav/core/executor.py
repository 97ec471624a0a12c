"""One map over independent tasks: one after the other, in processes, on a Ray cluster, or as Slurm jobs."""

from __future__ import annotations

import concurrent.futures
import contextlib
import importlib
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Any, Generic, Literal, Protocol, TypeVar, cast

from warpav.core.cores import Share, available_processes, own_share, take_share
from warpav.core.errors import InputError, OptionError, install_text, is_out_of_memory

_Task = TypeVar("_Task")
_Result = TypeVar("_Result")

_CONNECT_S = 5.0
"""How long a Ray cluster may take to accept a connection [s]."""
_ANSWER_S = 20.0
"""How long a Ray cluster may take to let this program in, the import of ray included [s]; two are usual."""
_KNOCK_S = 2.0
"""How often the head is knocked at while tasks run [s]."""
_GONE_S = 20.0
"""A head that has not opened for so long is gone [s]; Ray would end this process after 60 s, without a word to it."""
_JOB_MIN = 240
"""How long a Slurm job may take unless ``timeout_min`` says so [min]."""
_POLL_S = 0.2
"""How often the folder of jobs is searched for results [s]; submitit asks Slurm itself far less often."""

_KNOCK = "import ray, sys; ray.init(sys.argv[1], log_to_driver=False, logging_level='ERROR'); ray.cluster_resources()"
_EXTRA = {"ray": "ray", "submitit": "slurm"}


@dataclass(frozen=True)
class Outcome(Generic[_Task, _Result]):
    task: _Task  # the task
    result: _Result | None = None  # its result; None if it failed
    error: str | None = None  # why it failed; None if it did not
    lacks_memory: bool = False  # whether it failed for want of memory, which it may find when fewer run


class _WorkerKilledError(Exception):
    """The process that ran a task ended without an outcome."""


class _Workers(Protocol):
    """Where tasks run; a handle stands for a task that was started."""

    def start(self, tasks: Sequence[Any]) -> Sequence[Any]:
        """Start tasks; returns a handle for each."""
        ...

    def wait(self, handles: Collection[Any]) -> Collection[Any]:
        """Wait until some of the tasks have ended; returns their handles."""
        ...

    def outcome(self, handle: Any) -> Outcome[Any, Any]:  # noqa: ANN401
        """The outcome of a task that has ended, whose field ``task`` does not count; or raises `_WorkerKilledError`."""
        ...

    def close(self, handles: Collection[Any]) -> None:
        """Stop the tasks that are still under way, and let go of everything."""
        ...


def outcome_of(function: Callable[[_Task], _Result], task: _Task) -> Outcome[_Task, _Result]:
    """Run a task here; an error becomes part of the outcome."""
    try:
        return Outcome(task, function(task))
    except InputError as error:
        return Outcome(task, error=str(error))
    except Exception as error:  # the others go on
        lacks_memory = isinstance(error, MemoryError) or is_out_of_memory(error)
        return Outcome(task, error=f"{type(error).__name__}: {_one_line(error)}", lacks_memory=lacks_memory)


class Job:
    """A function in a process of its own: its argument ``tell`` says what it comes to, and it can be stopped."""

    def __init__(self, function: Callable[..., object], *arguments: object) -> None:
        """Start it; function and arguments have to be picklable."""
        context = multiprocessing.get_context("spawn")  # a forked child could not use Warp
        self._told, theirs = context.Pipe(duplex=False)
        self._process = context.Process(target=_tell, args=(theirs, function, arguments), daemon=True)
        with _main_module_hidden():
            self._process.start()
        theirs.close()

    def news(self) -> list[Any]:
        """What it has said since it was asked last; the last of all is its `Outcome`, whose task is None."""
        found = []
        try:
            while self._told.poll():
                found.append(self._told.recv())
        except (EOFError, OSError):
            found.append(Outcome(None, error="the process was ended from outside"))
        return found

    def stop(self) -> None:
        """End it."""
        self._process.terminate()
        self._process.join()
        self._told.close()


def _tell(pipe: Connection, function: Callable[..., object], arguments: Sequence[Any]) -> None:
    """What the process of a job does; Ctrl-C is for the one that started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with_parent()
    pipe.send(outcome_of(lambda _: function(*arguments, tell=lambda *said: pipe.send(said)), None))


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _package(name: str) -> Any:  # noqa: ANN401 (a module that the type checker may not find)
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise OptionError(
            "executor.name",
            f"expected the package {name} to be installed, got: {error}; {install_text(_EXTRA[name])}",
        ) from None


class Processes:
    """A pool of processes; one that is killed ends the pool, and the next task opens another."""

    def __init__(self, function: Callable[[Any], Any], worker_count: int, gpu_count: int = 1) -> None:
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
        return concurrent.futures.wait(handles, return_when=concurrent.futures.FIRST_COMPLETED).done

    def outcome(self, handle: Future[Outcome[Any, Any]]) -> Outcome[Any, Any]:
        try:
            return handle.result()
        except BrokenProcessPool:
            raise _WorkerKilledError from None

    def close(self, handles: Collection[Future[Outcome[Any, Any]]]) -> None:
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
    """In which order processes see the GPUs, as CUDA_VISIBLE_DEVICES; empty where all see them as this one does."""
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
    """Processes that start now do not run the program that started them once more."""
    main = vars(sys.modules["__main__"])
    hidden = {name: main.pop(name) for name in ("__spec__", "__file__") if name in main}
    main["__spec__"] = None
    try:
        yield
    finally:
        main.update(hidden)


class _RayCluster:
    """Ray workers; each takes one task at a time, and one that is killed takes only its own task along."""

    def __init__(
        self, function: Callable[[Any], Any], address: str | None, options: Mapping[str, Any], worker_count: int | None
    ) -> None:
        self._ray = ray = _package("ray")
        try:
            self._remote = ray.remote(**{"max_retries": 0, **options})(_outcome_of)
        except (TypeError, ValueError) as error:
            raise OptionError("executor.options", f"expected options of ray.remote, got: {_one_line(error)}") from None
        self._function = function
        gpus = options.get("num_gpus") or 0
        gpu_processes = max(1, round(1 / gpus)) if gpus else worker_count or 1  # without, all see the GPU
        self._share = Share(max(1, int(options.get("num_cpus") or 1)), gpu_processes)
        self._is_gone = False
        self._is_own = not ray.is_initialized()  # a notebook's own stays
        if not self._is_own:
            here = ray.get_runtime_context().gcs_address
            if address not in (None, "auto", here):
                raise OptionError(
                    "executor.address",
                    f"expected {here}, where this process is connected already, got {address!r}; leave it out, or call "
                    "ray.shutdown() before",
                )
            self._head = here
            return
        address = address or os.environ.get("RAY_ADDRESS") or "local"
        if address == "local":
            self._start_local(options, worker_count)
        else:
            _check_answers(address)
            ray.init(address, log_to_driver=False, logging_level="ERROR")
        is_named = address not in ("auto", "local")
        self._head = address.removeprefix("ray://") if is_named else ray.get_runtime_context().gcs_address

    def _start_local(self, options: Mapping[str, Any], worker_count: int | None) -> None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent to Ray's makers
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # tasks without num_gpus see the GPU as well
        self._ray.init(
            "local", num_cpus=worker_count, include_dashboard=False, log_to_driver=False, logging_level="ERROR"
        )
        offered = self._ray.cluster_resources()
        for option, resource in (("num_cpus", "CPU"), ("num_gpus", "GPU")):
            wanted, there = options.get(option) or 0, offered.get(resource, 0)
            if wanted > there:  # Ray would wait for ever
                self._ray.shutdown()
                raise OptionError(
                    "executor.options",
                    f"expected {option} of at most {there:g}, as the Ray of this machine has no more, got {wanted:g}; "
                    "lower it, or let executor.address be a cluster that has as many",
                )

    def start(self, tasks: Sequence[Any]) -> Sequence[Any]:
        return [self._remote.remote(self._function, task, self._share) for task in tasks]

    def wait(self, handles: Collection[Any]) -> Collection[Any]:
        problem, last_seen = None, time.monotonic()
        while problem is None or time.monotonic() - last_seen < _GONE_S:
            try:
                ended = self._ray.wait(list(handles), timeout=_KNOCK_S)[0]
            except ConnectionError as error:  # by ray://, Ray itself has waited
                problem = _one_line(error)
                break
            if ended:
                return ended
            problem = _why_closed(self._head)
            if problem is None:
                last_seen = time.monotonic()
        self._is_gone = True
        raise OptionError(
            "executor.address",
            f"expected the Ray cluster at {self._head} to be there until all tasks have ended, got: {problem}; start "
            "it again; the same command then goes on with what it has not finished",
        )

    def outcome(self, handle: Any) -> Outcome[Any, Any]:  # noqa: ANN401
        errors = self._ray.exceptions
        try:
            return self._ray.get(handle)
        except (errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError):
            raise _WorkerKilledError from None
        except errors.RayError as error:  # it never began: warpav is not installed there, say
            return Outcome(None, error=f"Ray: {_one_line(error)}")

    def close(self, handles: Collection[Any]) -> None:
        if not self._is_gone:  # with a client that has lost its cluster, Ray would start another
            for handle in handles:
                self._ray.cancel(handle, force=True)
        if self._is_own or self._is_gone:  # Ray ends a process that stays with a cluster that is gone
            self._ray.shutdown()


def _outcome_of(function: Callable[[Any], Any], task: Any, share: Share) -> Outcome[Any, Any]:  # noqa: ANN401
    """`outcome_of` on the cores that Ray counts for a task."""
    take_share(share)
    return outcome_of(function, task)


def _check_answers(address: str) -> None:
    """Knock at a cluster from a process of its own: Ray waits for minutes, and then ends the process that waits."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    is_auto = address == "auto"
    if not is_auto and not (host and port.isdecimal() and 0 < int(port) < 2**16):
        raise OptionError(
            "executor.address",
            f"expected host:port, ray://host:port, auto or local, got {address!r}, as in 10.0.0.1:6379",
        )
    problem = None if is_auto else _why_closed(address.removeprefix("ray://"))
    if problem is None:
        knock = [sys.executable, "-c", _KNOCK, address]
        try:
            found = subprocess.run(
                knock, capture_output=True, text=True, errors="replace", timeout=_ANSWER_S, check=False
            )
        except subprocess.TimeoutExpired:
            problem = f"no answer within {_ANSWER_S:g} s"
        else:
            if found.returncode:
                said = [line for line in found.stderr.splitlines() if line.strip()]
                problem = said[-1] if said else f"exit status {found.returncode}"
    if problem is not None:
        raise OptionError(
            "executor.address",
            f"expected a Ray cluster that answers, got {address!r}: {problem}; start one with 'ray start --head', set "
            "RAY_AUTH_MODE=token if it asks for a token, or leave the address out for a Ray of this machine",
        )


def _why_closed(address: str) -> str | None:
    """Why ``host:port`` refuses a connection; None where it accepts one."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT_S).close()
    except OSError as error:
        return error.strerror or str(error)
    return None


class _SlurmJobs:
    """One job a task; those that start together make one job array."""

    def __init__(
        self, function: Callable[[Any], Any], cluster: str | None, options: Mapping[str, Any], folder: Path | str
    ) -> None:
        submitit = _package("submitit")
        self._errors = submitit.core.utils
        if cluster not in (None, "slurm", "local"):
            raise OptionError(
                "executor.address", f"expected local, or nothing for Slurm itself, with executor slurm, got {cluster!r}"
            )
        try:
            jobs = submitit.AutoExecutor(folder, cluster=cluster or "slurm")
        except RuntimeError:
            raise OptionError(
                "executor.name",
                "expected Slurm's commands on this machine, found none; run on one of its login nodes, or set "
                "executor.address=local",
            ) from None
        except OSError as error:
            raise InputError(f"{folder}: expected a folder to write jobs to, got: {error.strerror}") from None
        try:
            jobs.update_parameters(**{"name": "warpav", "timeout_min": _JOB_MIN, **options})
        except (AssertionError, NameError, TypeError, ValueError) as error:
            raise OptionError("executor.options", f"expected parameters of submitit, got: {_one_line(error)}") from None
        self._jobs, self._call = jobs, partial(outcome_of, function)

    def start(self, tasks: Sequence[Any]) -> Sequence[Any]:
        try:
            return self._jobs.map_array(self._call, tasks)
        except self._errors.FailedSubmissionError as error:
            raise OptionError("executor.options", f"expected what Slurm accepts, got: {_one_line(error)}") from None

    def wait(self, handles: Collection[Any]) -> Collection[Any]:
        while not (ended := [job for job in handles if job.done()]):
            time.sleep(_POLL_S)
        return ended

    def outcome(self, handle: Any) -> Outcome[Any, Any]:  # noqa: ANN401
        try:
            return handle.result()
        except self._errors.FailedJobError as error:  # it never began: warpav is not installed there, say
            return Outcome(None, error=f"job {handle.job_id}: {_one_line(error)}")
        except self._errors.UncompletedJobError:
            raise _WorkerKilledError from None

    def close(self, handles: Collection[Any]) -> None:
        for job in handles:
            job.cancel(check=False)


@dataclass(frozen=True)
class Executor:
    """Where tasks run.

    Ray's workers and Slurm's jobs need the same warpav and the same paths as this process: an installation and a file
    system that they share.
    """

    name: Literal["serial", "process", "ray", "slurm"] = "serial"
    # Tasks at a time, from 1. None: one for each core with ``process`` and a Ray of this machine, as many as there
    # is room for on a Ray cluster, and one job array with ``slurm``
    worker_count: int | None = None
    # Of a running Ray cluster, as ``ray.init`` understands it: ``host:port`` from one of its machines,
    # ``ray://host:port`` from elsewhere, ``auto``. None: that of ``RAY_ADDRESS``, else ``local``, a Ray of this
    # machine that ends with the tasks. With ``slurm``, ``local`` means processes of this machine
    address: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    folder: Path | str = "slurm_jobs"
    gpu_count: int = 1

    def map(self, function: Callable[[_Task], _Result], tasks: Sequence[_Task]) -> Iterator[Outcome[_Task, _Result]]:
        """Call a function with every task; one that fails keeps no other from running. All executors agree."""
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
        count = available_processes() if self.name == "process" and self.worker_count is None else self.worker_count
        failed = (yield from _run_once(self._workers(function, count), tasks, count)) if tasks else []
        is_alone = False
        while failed and not is_alone:
            count = max(1, (count or len(failed)) // 4)
            is_alone = count == 1
            again = [outcome.task for outcome in failed]
            failed = yield from _run_once(self._workers(function, count), again, count)
        yield from failed

    def _workers(self, function: Callable[[Any], Any], count: int | None) -> _Workers:
        if self.name == "ray":
            return _RayCluster(function, self.address, self.options, count)
        if self.name == "slurm":
            return _SlurmJobs(function, self.address, self.options, self.folder)
        return Processes(function, count or 1, self.gpu_count)


def _run_once(
    workers: _Workers, tasks: Sequence[_Task], worker_count: int | None
) -> Generator[Outcome[_Task, Any], None, list[Outcome[_Task, Any]]]:
    """Yield the outcomes of tasks; returns those of tasks whose workers were killed or had not the memory."""
    waiting = deque(tasks)
    running: dict[Any, _Task] = {}
    failed: list[Outcome[_Task, Any]] = []
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
                except _WorkerKilledError:
                    failed.append(Outcome(task, error="its process was killed; is there enough memory?"))
                    continue
                if outcome.lacks_memory:
                    failed.append(outcome)
                else:
                    yield outcome
    finally:
        workers.close(running)
    return failed
