"""Independent tasks: one after the other in this process, in several, on a Ray cluster, or as Slurm jobs."""

from warpav.core.executor.tasks import ExecutorName, Outcome, Result, Task, run_tasks
from warpav.core.executor.workers import available_cores

__all__ = ["ExecutorName", "Outcome", "Result", "Task", "available_cores", "run_tasks"]
