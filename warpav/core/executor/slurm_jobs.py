"""Slurm jobs through submitit; needs the extra ``slurm``."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from warpav.core.errors import InputError, OptionError
from warpav.core.executor.workers import Outcome, WorkerKilledError, executor_package, one_line, outcome_of

JOB_MIN = 240
"""How long a job may take unless ``timeout_min`` says so [min]."""
POLL_S = 0.2
"""How often the folder is searched for results [s]; submitit asks Slurm itself far less often."""


class SlurmJobs:
    """One job a task; those that start together make one job array."""

    def __init__(
        self, function: Callable[[Any], Any], cluster: str | None, options: Mapping[str, Any], folder: Path | str
    ) -> None:
        """Find Slurm.

        Args:
            function: What is called with every task.
            cluster: ``slurm`` or None; ``local``: processes of this machine in the place of Slurm's.
            options: Parameters of submitit's ``AutoExecutor``.
            folder: For jobs, results and logs; all machines must see it.

        Raises:
            OptionError: submitit is not installed, Slurm is not there, or an option is wrong.
            InputError: The folder cannot be written to.
        """
        submitit = executor_package("submitit")
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
            jobs.update_parameters(**{"name": "warpav", "timeout_min": JOB_MIN, **options})
        except (AssertionError, NameError, TypeError, ValueError) as error:
            raise OptionError("executor.options", f"expected parameters of submitit, got: {one_line(error)}") from None
        self._jobs, self._call = jobs, partial(outcome_of, function)

    def start(self, tasks: Sequence[Any]) -> Sequence[Any]:
        """Submit tasks as one job array.

        Raises:
            OptionError: Slurm rejects it.
        """
        try:
            return self._jobs.map_array(self._call, tasks)
        except self._errors.FailedSubmissionError as error:
            raise OptionError("executor.options", f"expected what Slurm accepts, got: {one_line(error)}") from None

    def wait(self, handles: Collection[Any]) -> Collection[Any]:
        """Wait until some of the jobs have ended."""
        while not (ended := [job for job in handles if job.done()]):
            time.sleep(POLL_S)
        return ended

    def outcome(self, handle: Any) -> Outcome[Any, Any]:  # noqa: ANN401
        """The outcome of a job; `WorkerKilledError` where it was killed or ran out of time."""
        try:
            return handle.result()
        except self._errors.FailedJobError as error:  # it never began: warpav is not installed there, say
            return Outcome(None, error=f"job {handle.job_id}: {one_line(error)}")
        except self._errors.UncompletedJobError:
            raise WorkerKilledError from None

    def close(self, handles: Collection[Any]) -> None:
        """Cancel the jobs that are under way."""
        for job in handles:
            job.cancel(check=False)
