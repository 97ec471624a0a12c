"""Rival searches: they need nothing of an objective but its value, and all get the same budget of camera renders.

Each is a `Search`, which evaluates rigs through a `BudgetedValue` until the budget is spent; `functools.partial` binds
what options it takes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from warpav.core.errors import OptionError, install_text
from warpav.detection import SUREST, false_alarm_cost
from warpav.optimisation._budget import BudgetedValue, SingleCameraValues
from warpav.optimisation._constraints import Constraints, too_near
from warpav.optimisation._mount import X_M, Y_M, YAW_RAD
from warpav.optimisation._objective import RigObjective, single_cameras_of
from warpav.optimisation._pool_cache import rows_of
from warpav.optimisation._space import SearchSpace
from warpav.optimisation.losses._scene_on_tape import AssignedScene
from warpav.optimisation.selection._problem import SelectionProblem
from warpav.optimisation.selection._select import Selection, select

_FIRST_STEP = 0.2  # first standard deviation of CMA-ES, in widths of the mount surface and turns of the yaw

_NEAR_STEP, _SCENES_AT_ONCE, _MEAN_EVERY = 0.05, 5, 10
"""First standard deviation of CMA-ES around a rig, scenes a generation, generations between looks at all scenes."""

_SEEN_SHARE = 0.9  # assumed probability that a camera detects an object that the detector once found in its image


Draw = Callable[[SearchSpace, int, np.random.Generator], np.ndarray]
"""So many feasible rigs of a space that know nothing of each other's values, float [rig, camera, 7]."""


def random_rigs(space: SearchSpace, count: int, rng: np.random.Generator) -> np.ndarray:
    """Random rigs, see `Draw`."""
    return np.array([space.random(rng) for _ in range(count)]).reshape(count, space.camera_count, -1)


def sobol_rigs(space: SearchSpace, count: int, rng: np.random.Generator) -> np.ndarray:
    """Rigs of a scrambled Sobol sequence, each moved to the nearest feasible one, see `Draw`."""
    from scipy.stats import qmc

    sequence = qmc.Sobol(space.size, scramble=True, rng=rng) if space.size and count else None
    points = sequence.random_base2(math.ceil(math.log2(count))) if sequence else np.zeros((count, 0))
    return np.array([space.pose_of(unit) for unit in points[:count]]).reshape(count, space.camera_count, -1)


def random_search(value: BudgetedValue, rng: np.random.Generator) -> None:
    """The best of as many random rigs as the budget allows."""
    value.of_rigs(random_rigs(value.space, value.rigs_left, rng))


def sobol_search(value: BudgetedValue, rng: np.random.Generator) -> None:
    """The best of as many rigs of a scrambled Sobol sequence, each moved to the nearest feasible one."""
    value.of_rigs(sobol_rigs(value.space, value.rigs_left, rng))


def selected_search(
    value: BudgetedValue,
    rng: np.random.Generator,
    *,
    draw: Draw,
    single: SingleCameraValues,
    gap: float,
    time_limit_s: float,
    seed: int,
    on_selection: Callable[[Selection], None],
) -> None:
    """The best rig of the cameras of as many drawn rigs as the budget allows, chosen by `select` without a render."""
    space = value.space
    value.of_rigs(draw(space, value.rigs_left, rng))
    pose, found = single.looked_at
    held = int(space.is_frozen.sum())
    # the frozen cameras first, once; every rig has them
    is_further = np.tile(~space.is_frozen, len(pose) // space.camera_count)
    row = np.concatenate([np.flatnonzero(space.is_frozen), np.flatnonzero(is_further)])
    best = value.best_pose
    start = None
    if best is not None:
        start = np.concatenate([np.arange(held), held + rows_of(best[~space.is_frozen], pose[row[held:]])])
    problem = SelectionProblem.create(
        np.minimum(found[row], SUREST),
        space.camera_count,
        conflict=too_near(pose[row], space.constraints),
        required=np.arange(held),
        weight=single.object_weight,
        cost=false_alarm_cost(found[row], single.charge),
        triple=single.cameras.triples(single.scenes),
    )
    selection = select(problem, start=start, gap=gap, time_limit_s=time_limit_s, seed=seed)
    rig = pose[: space.camera_count].copy()
    rig[~space.is_frozen] = pose[row][np.setdiff1d(selection.cameras, np.arange(held))]
    value.record(rig, single.weight * selection.objective)
    on_selection(selection)


def cma_es(
    value: BudgetedValue,
    rng: np.random.Generator,
    *,
    start: np.ndarray | None = None,
    values_on: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> None:
    """CMA-ES with restarts, each with twice the population of the one before, until the budget is spent.

    A sample has the value of the nearest feasible rig. What CMA-ES learns from has a penalty on top, so that samples do
    not drift away from the rigs: the spread of the generation's values (its interquartile range), times the squared
    distance that the projection moved the sample, in standard deviations, mean over the numbers.

    Around a ``start`` [camera, 7] each generation sees a few scenes of its own, so that a budget buys many rigs; the
    mean is looked at on all scenes now and then, and the best of these looks is the result. ``values_on`` gives values
    of rigs, float32 [rig, camera, 7], on some scenes, int [scene].
    """
    space, count = value.space, min(_SCENES_AT_ONCE, value.scene_count)
    if space.size < 2:
        raise ValueError(f"CMA-ES needs at least 2 free numbers, got {space.size}")

    def on_some(poses: Sequence[np.ndarray]) -> np.ndarray:
        assert values_on is not None
        value.spend(len(poses) * space.camera_count * count)
        return values_on(np.array(poses, np.float32), rng.choice(value.scene_count, count, replace=False))

    population = 4 + int(3.0 * math.log(space.size))
    while value.rigs_left:
        if start is None:
            poses = random_rigs(space, population, rng)
            first, step = poses[int(np.argmin(value.of_rigs(poses)))], _FIRST_STEP
        else:
            value(start)
            first, step = start, _NEAR_STEP
        evolution = _evolution(space.unit_of(first), step, population, rng)
        while not evolution.stop():
            _generation(evolution, space, value.of_rigs if values_on is None else on_some)
            if values_on is not None and evolution.countiter % _MEAN_EVERY == 0:
                value(space.pose_of(np.asarray(evolution.mean)))
        population *= 2


def _evolution(first: np.ndarray, step: float, population: int, rng: np.random.Generator) -> Any:  # noqa: ANN401
    try:
        import cma
    except ImportError:
        raise OptionError("arm cma", f"expected the package cma, got none; {install_text('rivals')}") from None
    options = {
        "popsize": population,
        "seed": math.nan,  # leaves NumPy's global numbers alone
        "randn": lambda *shape: rng.standard_normal(shape),
        "verbose": -9,
        "verb_log": 0,
    }
    return cma.CMAEvolutionStrategy(first, step, options)


def _generation(evolution: Any, space: SearchSpace, values_of: Callable[[list[np.ndarray]], np.ndarray]) -> None:  # noqa: ANN401
    samples = evolution.ask()
    deviation = np.asarray(evolution.stds)
    poses = [space.pose_of(unit) for unit in samples]
    found = values_of(poses)
    moved = []
    for unit, pose in zip(samples, poses, strict=True):
        step = np.where(space.goes_round, 0.0, space.unit_of(pose) - unit) / deviation
        moved.append(float(np.mean(step**2)))
    evolution.tell(samples, _with_penalty(found, np.array(moved)).tolist())


def _with_penalty(value: np.ndarray, squared_distance: np.ndarray) -> np.ndarray:
    """The values of a generation with what their samples pay for lying beyond the constraints."""
    is_finite = np.isfinite(value)
    if not is_finite.any():
        return np.zeros_like(value) + squared_distance
    worst = value[is_finite].max()
    low, high = np.percentile(value[is_finite], [25.0, 75.0])
    return np.where(is_finite, value, worst + (high - low)) + (high - low) * squared_distance


_Detections = Callable[[np.ndarray], np.ndarray]
"""The probability that each camera detects each object of all scenes: mount poses [camera, 7] to [camera, object]."""


def detections_of(objective: RigObjective, scenes: Sequence[AssignedScene]) -> _Detections:
    """What single cameras detect: by the model of an objective that is made of it, else by the detector itself."""
    cameras = single_cameras_of(objective)
    if cameras is not None:
        return SingleCameraValues(cameras, [each.scene for each in scenes]).detection_probability

    def detections(mount_pose: np.ndarray) -> np.ndarray:
        found = []
        for first in range(0, len(mount_pose), objective.camera_count):
            asked = mount_pose[first : first + objective.camera_count]
            filled = np.concatenate([asked, np.repeat(asked[-1:], objective.camera_count - len(asked), axis=0)])
            rig = objective.mount.rig(filled)
            seen = np.concatenate([objective.observe_rig(rig, scene)[0].match >= 0 for scene in scenes], axis=1)
            found.append(_SEEN_SHARE * seen[: len(asked)])
        return np.concatenate(found)

    return detections


def greedy_cover(
    value: BudgetedValue,
    rng: np.random.Generator,
    *,
    detections: _Detections,
    yaw_count: int = 8,
    object_weight: np.ndarray | None = None,
) -> None:
    """Greedy set cover on a discretised mount surface.

    Single cameras on a grid of places, as fine as the budget allows, looking in ``yaw_count`` directions, are asked
    what they detect. Then one after the other is chosen, the one that lowers the expected number of missed objects
    most; the nearest feasible rig is evaluated.
    """
    space = value.space
    round_the_circle = space.high[:, YAW_RAD] - space.low[:, YAW_RAD]
    if not (round_the_circle >= 2.0 * math.pi - 1e-9).all():
        raise ValueError("greedy_cover needs yaws that are free over the whole circle")
    candidate_count = (value.camera_renders_left - value.camera_renders_per_rig) // value.scene_count
    if candidate_count < yaw_count:
        least = (yaw_count + space.camera_count) * value.scene_count
        raise ValueError(f"greedy_cover needs at least {least} camera renders, got {value.camera_renders_left}")
    place_m = _grid(space.constraints, candidate_count // yaw_count)
    candidate = np.tile(0.5 * (space.low + space.high)[0], (len(place_m) * yaw_count, 1))
    candidate[:, [X_M, Y_M]] = np.repeat(place_m, yaw_count, axis=0)
    candidate[:, YAW_RAD] = np.tile(2.0 * math.pi * np.arange(yaw_count) / yaw_count, len(place_m))
    value.spend(len(candidate) * value.scene_count)
    detected = np.asarray(detections(candidate), np.float64)
    missed = np.ones(detected.shape[1]) if object_weight is None else object_weight / np.mean(object_weight)
    chosen = []
    order = rng.permutation(len(detected))
    for _ in range(space.camera_count):
        gain = detected @ missed
        best = order[np.argmax(np.round(gain[order], 9))]
        chosen.append(best)
        missed *= 1.0 - detected[best]
    value(space.in_order(candidate[chosen]))


def _grid(constraints: Constraints, place_count: int) -> np.ndarray:
    """The allowed places of the finest grid of nearly square cells that has at most so many, float64 [place, 2]."""
    low_m, high_m = constraints.surface.bounds_m
    length_m, width_m = high_m - low_m

    def middles(rows: int, columns: int) -> np.ndarray:
        x_m = low_m[0] + (np.arange(rows) + 0.5) / rows * length_m
        y_m = low_m[1] + (np.arange(columns) + 0.5) / columns * width_m
        return np.stack(np.meshgrid(x_m, y_m, indexing="ij"), axis=-1).reshape(-1, 2)

    finest = None
    for rows in itertools.count(1):
        place_m = middles(rows, max(1, round(rows * width_m / length_m)))
        place_m = place_m[constraints.contains(place_m)]
        if len(place_m) > place_count:
            break
        if len(place_m):
            finest = place_m
    if finest is None:  # even the coarsest has more
        finest = np.concatenate([constraints.project(place_m[None]) for place_m in middles(1, place_count)])
    return finest
