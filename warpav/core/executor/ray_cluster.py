"""Workers of a Ray cluster, or of a Ray of this machine that ends with the tasks; needs the extra ``ray``."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

from warpav.core.errors import OptionError
from warpav.core.executor.workers import (
    Outcome,
    Share,
    WorkerKilledError,
    executor_package,
    one_line,
    outcome_of,
    take_share,
)

CONNECT_S = 5.0
"""How long a Ray cluster may take to accept a connection [s]."""
ANSWER_S = 20.0
"""How long a Ray cluster may take to let this program in, the import of ray included [s]; two are usual."""
KNOCK_S = 2.0
"""How often the head is knocked at while tasks run [s]."""
GONE_S = 20.0
"""A head that has not opened for so long is gone [s]; Ray would end this process after 60 s, without a word to it."""

_KNOCK = "import ray, sys; ray.init(sys.argv[1], log_to_driver=False, logging_level='ERROR'); ray.cluster_resources()"


class RayCluster:
    """Ray workers; each takes one task at a time, and one that is killed takes only its own task along."""

    def __init__(
        self, function: Callable[[Any], Any], address: str | None, options: Mapping[str, Any], worker_count: int | None
    ) -> None:
        """Connect, or start a Ray of this machine.

        Args:
            function: What is called with every task.
            address: Of the cluster, as ``ray.init`` understands it; None: that of ``RAY_ADDRESS``, else ``local``.
            options: Of ``ray.remote``.
            worker_count: CPUs of a Ray of this machine; None: all that there are.

        Raises:
            OptionError: Ray is not installed, no cluster answers, or an option is wrong.
        """
        self._ray = ray = executor_package("ray")
        try:
            self._remote = ray.remote(**{"max_retries": 0, **options})(_outcome_of)
        except (TypeError, ValueError) as error:
            raise OptionError("executor.options", f"expected options of ray.remote, got: {one_line(error)}") from None
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
        """Hand tasks to Ray, which queues what there is no room for."""
        return [self._remote.remote(self._function, task, self._share) for task in tasks]

    def wait(self, handles: Collection[Any]) -> Collection[Any]:
        """Wait until a task has ended.

        Raises:
            OptionError: The cluster's head is gone; it is left.
        """
        problem, last_seen = None, time.monotonic()
        while problem is None or time.monotonic() - last_seen < GONE_S:
            try:
                ended = self._ray.wait(list(handles), timeout=KNOCK_S)[0]
            except ConnectionError as error:  # by ray://, Ray itself has waited
                problem = one_line(error)
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
        """The outcome of a task; `WorkerKilledError` where its worker or its machine died."""
        errors = self._ray.exceptions
        try:
            return self._ray.get(handle)
        except (errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError):
            raise WorkerKilledError from None
        except errors.RayError as error:  # it never began: warpav is not installed there, say
            return Outcome(None, error=f"Ray: {one_line(error)}")

    def close(self, handles: Collection[Any]) -> None:
        """Cancel what is under way, and leave the cluster; a Ray of this machine that was started here ends."""
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
                knock, capture_output=True, text=True, errors="replace", timeout=ANSWER_S, check=False
            )
        except subprocess.TimeoutExpired:
            problem = f"no answer within {ANSWER_S:g} s"
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
    """Why nobody opens at ``host:port``; None where somebody does."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_S).close()
    except OSError as error:
        return error.strerror or str(error)
    return None
