"""Whether any rig satisfies the constraints, and if none does, which of them exclude each other."""

from __future__ import annotations

import dataclasses
import math
import time

import numpy as np
from scipy import sparse
from scipy.optimize import Bounds, LinearConstraint, milp

from warpav.core.errors import InputError
from warpav.optimisation.selection.problem import SelectionProblem

INFEASIBLE = 2
"""Status of `scipy.optimize.milp`."""


def feasible_rig(
    problem: SelectionProblem, *, time_limit_s: float, cost: np.ndarray | None = None
) -> np.ndarray | None:
    """A rig that satisfies all constraints, its required cameras first, int [camera]; None where there is none.

    Args:
        problem: What is chosen from.
        time_limit_s: When to give up.
        cost: Of the cameras, float64 [camera], whose sum over the rig is to be low; None: any rig will do.

    Raises:
        TimeoutError: Neither a rig was found nor that there is none.
    """
    cameras = problem.camera_count
    deadline_s = time.perf_counter() + time_limit_s
    everything = np.ones(cameras, bool)
    low = np.zeros(cameras)
    low[problem.required] = 1.0
    # their annotations know numbers alone
    constraints = [LinearConstraint(np.ones((1, cameras)), problem.count, problem.count)]
    if len(problem.coefficient):
        constraints.append(LinearConstraint(problem.coefficient, problem.low, problem.high))  # pyright: ignore[reportArgumentType]
    while True:
        found = milp(
            np.zeros(cameras) if cost is None else cost,
            constraints=constraints,
            integrality=np.ones(cameras),
            bounds=Bounds(low, 1.0),  # pyright: ignore[reportArgumentType]
            options={"time_limit": max(deadline_s - time.perf_counter(), 1e-3), "mip_rel_gap": 0.1},
        )
        if found.status == INFEASIBLE:
            return None
        if found.x is None:
            raise TimeoutError
        rig = np.flatnonzero(found.x > 0.5)
        one, other = np.nonzero(np.triu(problem.conflict[rig][:, rig].toarray()))
        if not len(one):
            return np.concatenate([problem.required, np.setdiff1d(rig, problem.required)])
        # conflicts come in as they are broken: there are millions of pairs, and few cliques are needed
        clique = [problem.whole_clique(rig[list(pair)], everything) for pair in zip(one, other, strict=True)]
        constraints.append(LinearConstraint(np.unique(clique, axis=0).astype(float), -math.inf, 1.0))


def raise_conflict(problem: SelectionProblem, *, time_limit_s: float) -> None:
    """Name constraints that exclude each other, of which each is needed for that: leave one out, and there is a rig.

    They are found by deletion: what can go while there still is no rig, goes (Chinneck and Dravnieks 1991, Locating
    minimal infeasible constraint sets in linear programs). ``count`` is among them always.

    Raises:
        InputError: Always; it names them.
    """
    kept = [
        *(["required"] if len(problem.required) else []),
        *(["conflict"] if problem.conflict.nnz else []),
        *problem.row_name,
    ]
    for name in list(kept):
        fewer = [each for each in kept if each != name]
        try:
            if feasible_rig(_with(problem, fewer), time_limit_s=time_limit_s) is None:
                kept = fewer
        except TimeoutError:
            continue  # it stays: not known to be dispensable
    names = " and ".join([f"count = {problem.count}", *kept])
    raise InputError(f"no rig of the pool satisfies {names}; loosen one of them, or add cameras to the pool")


def _with(problem: SelectionProblem, names: list[str]) -> SelectionProblem:
    """The pool with these constraints alone."""
    is_kept = np.array([name in names for name in problem.row_name], bool)
    return dataclasses.replace(
        problem,
        required=problem.required if "required" in names else problem.required[:0],
        conflict=problem.conflict if "conflict" in names else sparse.csr_array(problem.conflict.shape, dtype=bool),
        coefficient=problem.coefficient[is_kept],
        low=problem.low[is_kept],
        high=problem.high[is_kept],
        row_scale=problem.row_scale[is_kept],
        row_name=tuple(name for name in problem.row_name if name in names),
    )
