"""Searches, polishes and selections by keyword, for tests that vary one thing at a time."""

from warpav.optimisation import CameraPool, Drawing, PoolTask
from warpav.optimisation._camera_loss import select_robust as robust
from warpav.optimisation._polish import PolishSteps, PolishTask
from warpav.optimisation._polish import polish as polished
from warpav.optimisation._pool_search import PoolSearch
from warpav.optimisation.selection._problem import SelectionProblem
from warpav.optimisation.selection._select import select as selected


def draw(mount_pose, *, executor=None, cache=None, chunk_cameras=512, **options):
    empty = CameraPool.empty(options.pop("scenes"), options.pop("cameras"), Drawing(executor, cache, chunk_cameras))
    return empty.extended(mount_pose, **options)


def pool_search(
    cameras, scenes, constraints, count, *, settings=None, executor=None, cache=None, seed=0, pool=None, **task
):
    drawing = Drawing(executor, cache)
    return PoolSearch(
        PoolTask(cameras, scenes, constraints, count, **task), settings, seed=seed, drawing=drawing, pool=pool
    )


def polish(
    mount_pose, detect, *, mount, constraints, scene_count, step_count=20, radius=0.4, camera_renders_max=None, **task
):
    steps = PolishSteps(step_count, radius, camera_renders_max=camera_renders_max)
    return polished(mount_pose, detect, PolishTask(mount, constraints, scene_count, **task), steps)


def _problem(probability, count, options):
    names = ("conflict", "required", "rows", "weight", "triple", "cost")
    return SelectionProblem.create(probability, count, **{name: options.pop(name) for name in names if name in options})


def select(probability, count, **options):
    return selected(_problem(probability, count, options), **options)


def select_robust(probability, count, *, objective, size, **options):
    return robust(_problem(probability, count, options), objective, size, **options)
