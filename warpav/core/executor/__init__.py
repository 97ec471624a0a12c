"""Independent tasks: one after the other in this process, in several, on a Ray cluster, or as Slurm jobs."""

from warpav.core.executor.tasks import ExecutorName, Outcome, Result, Task, run_tasks

__all__ = ["ExecutorName", "Outcome", "Result", "Task", "run_tasks"]
