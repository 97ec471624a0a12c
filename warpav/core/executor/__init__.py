"""Independent tasks: one after the other, in processes, on a Ray cluster, or as Slurm jobs."""

from warpav.core.executor.tasks import Executor, ExecutorName, Outcome, Result, Task, run_tasks
from warpav.core.executor.workers import available_cores, gpu_processes, gpu_share

__all__ = [
    "Executor",
    "ExecutorName",
    "Outcome",
    "Result",
    "Task",
    "available_cores",
    "gpu_processes",
    "gpu_share",
    "run_tasks",
]
