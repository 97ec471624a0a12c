"""Good rigs, without a proof: cameras of many rigs are exchanged one at a time, all rigs at once."""

from __future__ import annotations

import numpy as np

from warpav.optimisation.selection.problem import ROW_TOLERANCE, SelectionProblem


def random_rig(
    problem: SelectionProblem, rng: np.random.Generator, fraction: np.ndarray | None = None
) -> np.ndarray | None:
    """A rig that satisfies the constraints, its required cameras first, int [camera]; None where the draw got stuck.

    Args:
        problem: What is drawn from.
        rng: Draws.
        fraction: How a camera is favoured, >= 0, float64 [camera]; None: all alike.
    """
    rig = list(problem.required)
    favour = np.ones(problem.camera_count) if fraction is None else fraction + 1e-6
    can_be = np.ones(problem.camera_count, bool)
    can_be[rig] = False
    can_be &= ~problem.excluded_by(rig)
    while len(rig) < problem.count:
        total = problem.coefficient[:, rig].sum(axis=1)
        wanted = can_be.copy()
        for coefficient, now, low, high in zip(problem.coefficient, total, problem.low, problem.high, strict=True):
            if (coefficient >= 0.0).all():
                wanted &= now + coefficient <= high + ROW_TOLERANCE
                if now < low - ROW_TOLERANCE and (wanted & (coefficient > 0.0)).any():
                    wanted &= coefficient > 0.0
        choice = np.flatnonzero(wanted)
        if not len(choice):
            return None
        camera = int(rng.choice(choice, p=favour[choice] / favour[choice].sum()))
        rig.append(camera)
        can_be[camera] = False
        can_be &= ~problem.excluded_by([camera])
    return np.array(rig) if problem.is_feasible(np.array(rig)) else None


def exchange(problem: SelectionProblem, rigs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exchange one camera of each rig after the other for the best of the pool, until nothing helps any of them.

    Args:
        problem: What is chosen from.
        rigs: Rigs that satisfy the constraints, the required cameras first, int [rig, camera].

    Returns:
        The rigs, likewise, the best first, and their expected miss rates, float64 [rig].
    """
    rigs = np.array(rigs)
    every = np.arange(len(rigs))
    first = len(problem.required)
    slot, unchanged = first, 0
    while unchanged < problem.count - first:
        others = np.delete(rigs, slot, axis=1)
        left = np.prod(problem.missed[:, others], axis=2) * problem.weight[:, None]
        value = problem.missed.T @ left
        before = value[rigs[:, slot], every]
        value[~fits(problem, others)] = np.inf
        best = np.argmin(value, axis=0)
        # what only rounding tells apart would be exchanged for ever
        is_better = value[best, every] < before * (1.0 - 1e-9)
        rigs[is_better, slot] = best[is_better]
        unchanged = 0 if is_better.any() else unchanged + 1
        slot = slot + 1 if slot + 1 < problem.count else first
    value = np.array([problem.miss_rate(rig) for rig in rigs])
    order = np.argsort(value, kind="stable")
    return rigs[order], value[order]


def fits(problem: SelectionProblem, others: np.ndarray) -> np.ndarray:
    """Which cameras complete the rigs of which others, bool [camera, rig]; others are int [rig, camera]."""
    chosen = np.zeros((problem.camera_count, len(others)), bool)
    chosen[others.T, np.arange(len(others))] = True
    fits = ~chosen
    if problem.conflict.nnz:
        fits &= (problem.conflict @ chosen.astype(np.int32)) == 0
    total = problem.coefficient @ chosen
    for coefficient, now, low, high in zip(problem.coefficient, total, problem.low, problem.high, strict=True):
        then = coefficient[:, None] + now
        fits &= (then >= low - ROW_TOLERANCE) & (then <= high + ROW_TOLERANCE)
    return fits
