"""Independent tasks: one after the other, in processes, on a Ray cluster, as Slurm jobs, or one in the background."""

from warpav.core.executor.background import in_background
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
    "in_background",
    "run_tasks",
]
