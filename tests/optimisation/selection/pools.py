"""Pools of cameras for tests: random ones, and what is the best of all their rigs."""

import itertools

import numpy as np


def random_pool(rng, cameras, objects):
    """Cameras on a circle that see objects before them and near, some for certain, float64 [camera, object]."""
    bearing = rng.uniform(-np.pi, np.pi, objects)
    away_m = rng.uniform(5.0, 60.0, objects)
    yaw = rng.uniform(-np.pi, np.pi, cameras)
    off = np.abs(np.angle(np.exp(1j * (bearing - yaw[:, None]))))
    sure = 1.0 / (1.0 + np.exp((away_m - rng.uniform(20.0, 50.0, (cameras, 1))) / 4.0))
    probability = np.where(off < 0.8, sure, 0.0) * (rng.uniform(size=off.shape) < 0.8)
    return np.where(probability > 0.97, 1.0, probability)


def every_rig(cameras, count, *, conflict=None, required=(), rows=()):
    """All rigs that satisfy the constraints, as tuples."""
    for rig in itertools.combinations(range(cameras), count):
        chosen = list(rig)
        if not set(required) <= set(rig):
            continue
        if conflict is not None and (conflict | conflict.T)[np.ix_(chosen, chosen)][~np.eye(count, dtype=bool)].any():
            continue
        total = [np.sum(np.asarray(row.coefficient)[chosen]) for row in rows]
        if all(row.low - 1e-9 <= each <= row.high + 1e-9 for row, each in zip(rows, total, strict=True)):
            yield rig


def miss_rate(probability, rig, weight=None, cost=None):
    """Expected miss rate of a rig, and the cost of its cameras."""
    missed = np.average(np.prod(1.0 - np.asarray(probability, float)[list(rig)], axis=0), weights=weight)
    return missed + (0.0 if cost is None else cost[list(rig)].sum())


def best_by_brute_force(probability, count, *, weight=None, cost=None, **constraints):
    """The lowest expected miss rate of all rigs; None where none satisfies the constraints."""
    rigs = every_rig(len(probability), count, **constraints)
    return min((miss_rate(probability, rig, weight, cost) for rig in rigs), default=None)
