"""What a rig is chosen from, what the choice must satisfy, and good rigs without a proof."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse
from scipy.optimize import Bounds, LinearConstraint, linprog, milp

from warpav.core.errors import ArgumentError, InputError

_ROW_TOLERANCE = 1e-6  # how far a row may be missed, per unit of its largest coefficient: what HiGHS allows itself


@dataclass(frozen=True, eq=False)
class Row:
    """A linear constraint on a rig: ``low <= sum of coefficient over its cameras <= high``."""

    name: str  # what an error calls it
    coefficient: np.ndarray  # of every camera of the pool, float [camera]
    low: float = -math.inf  # least sum; -inf: none
    high: float = math.inf  # greatest sum; inf: none


@dataclass(frozen=True, eq=False)
class SelectionProblem:
    """Single cameras, and the rigs that may be made of them. Its objects are those that some camera sees."""

    missed: np.ndarray  # probability that a camera does not detect an object, float64 [object, camera]
    weight: np.ndarray  # of the objects, float64 [object]; below 0 of what all sensors miss of those that need both
    unseen: float  # weight of the objects that no camera of the pool sees, 0..1
    seen: np.ndarray  # which of the objects some camera sees, as they were counted at first, int [object]
    every_weight: np.ndarray  # of all objects, those that no camera sees among them, 1 in sum, float64 [every object]
    count: int  # number of cameras of a rig
    required: np.ndarray  # cameras that every rig has, int [required]
    conflict: sparse.csr_array  # pairs that exclude each other, symmetric bool CSR [camera, camera]
    coefficient: np.ndarray  # of the rows, divided by the largest of each, float64 [row, camera]
    low: np.ndarray  # least sums of the rows, likewise, float64 [row]
    high: np.ndarray  # greatest sums of the rows, likewise, float64 [row]
    row_scale: np.ndarray  # what the rows were divided by, > 0, float64 [row]
    rows: tuple[Row, ...]  # they as they were given
    cost: np.ndarray  # what each camera costs, in misses, float64 [camera]
    both: np.ndarray  # objects as all sensors, as cameras, and as LiDARs miss them, of which both count, int [both, 3]

    @classmethod
    def create(
        cls,
        detection_probability: np.ndarray,
        count: int,
        *,
        conflict: np.ndarray | sparse.sparray | sparse.spmatrix | None = None,
        required: Sequence[int] | np.ndarray = (),
        rows: Sequence[Row] = (),
        weight: np.ndarray | None = None,
        triple: np.ndarray | None = None,
        cost: np.ndarray | None = None,
    ) -> SelectionProblem:
        """What a rig is chosen from. ``conflict`` bool [camera, camera]; ``triple`` as of `Fusion`, int [object, 3].

        ``cost`` float [camera], of each camera in its rig, beside the misses.
        """
        probability = np.asarray(detection_probability, np.float64)
        if probability.ndim != 2 or 0 in probability.shape:
            raise ArgumentError(
                "detection_probability", f"expected [camera, object], at least one of each, got {probability.shape}"
            )
        cameras, objects = probability.shape
        wrong = ~((probability >= 0.0) & (probability <= 1.0))  # NaN compares with nothing
        if wrong.any():
            camera, seen = np.argwhere(wrong)[0]
            raise ArgumentError(
                "detection_probability",
                f"expected probabilities 0..1, got {probability[camera, seen]:g} at camera {camera}, object {seen}",
            )
        if not probability.any():
            raise ArgumentError(
                "detection_probability",
                f"none of the {cameras} cameras sees any of the {objects} objects; check scenes, targets and poses",
            )
        if not 1 <= count <= cameras:
            raise ArgumentError("count", f"expected 1 to {cameras}, the cameras of the pool, got {count}")
        fixed = np.unique(np.asarray(required, np.int64))
        if len(fixed) != np.size(required) or (len(fixed) and not 0 <= fixed[0] <= fixed[-1] < cameras):
            raise ArgumentError("required", f"expected different cameras, 0..{cameras - 1}, got {list(required)}")
        if len(fixed) > count:
            raise ArgumentError("required", f"expected at most `count` = {count} cameras, got {len(fixed)}")
        share = _checked_weight(weight, objects, triple)
        is_seen = probability.any(axis=0)
        both = np.zeros((0, 3), int) if triple is None else triple[share[triple[:, 0]] < 0.0]
        if triple is not None:
            is_seen &= share != 0.0
            is_seen[both] = is_seen[both[:, 1:]].all(axis=1, keepdims=True)  # nobody finds it where one side is blind
            both = both[is_seen[both[:, 0]]]
        return cls(
            missed=np.ascontiguousarray(1.0 - probability[:, is_seen].T),
            weight=share[is_seen],
            unseen=float(share[~is_seen].sum()),
            seen=np.flatnonzero(is_seen),
            every_weight=share,
            count=int(count),
            required=fixed,
            conflict=_checked_conflict(conflict, cameras),
            **_checked_rows(rows, cameras),
            cost=np.zeros(cameras) if cost is None else np.asarray(cost, np.float64),
            both=np.cumsum(is_seen)[both] - 1,
        )

    def under(self, rows: Sequence[Row], **others: Any) -> SelectionProblem:  # noqa: ANN401
        """The same under other rows, and with other attributes."""
        return replace(self, **_checked_rows(rows, self.camera_count), **others)

    @property
    def camera_count(self) -> int:
        return self.missed.shape[1]

    @property
    def object_count(self) -> int:
        return self.missed.shape[0]

    @cached_property
    def counting_rows(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Of the rows that no camera lowers those with a least sum and those with a greatest: coefficients, limits."""
        counts = (self.coefficient >= 0.0).all(axis=1)
        limited = (counts & np.isfinite(limit) for limit in (self.low, self.high))
        return [(self.coefficient[row], limit[row]) for row, limit in zip(limited, (self.low, self.high), strict=True)]

    def excluded_by(self, camera: Sequence[int] | np.ndarray) -> np.ndarray:
        """Which cameras conflict with one of these, bool [camera]."""
        excluded = np.zeros(self.camera_count, bool)
        for each in camera:  # a slice of a sparse matrix would take many times as long
            excluded[self.conflict.indices[self.conflict.indptr[each] : self.conflict.indptr[each + 1]]] = True
        return excluded

    def whole_clique(self, clique: Sequence[int] | np.ndarray, allowed: np.ndarray) -> np.ndarray:
        """A clique of conflicting cameras with all allowed ones that fit into it one after the other, bool [camera]."""
        member = np.zeros(self.camera_count, bool)
        member[clique] = True
        common = allowed & (np.asarray(self.conflict[clique].sum(axis=0)).ravel() == len(clique))
        while common.any():
            camera = int(np.argmax(common))
            member[camera] = True
            neighbour = np.zeros(self.camera_count, bool)
            neighbour[self.conflict.indices[self.conflict.indptr[camera] : self.conflict.indptr[camera + 1]]] = True
            common &= neighbour
        return member

    def restricted(self, camera: np.ndarray) -> SelectionProblem:
        """The same problem without the other cameras; ``camera`` holds those required, int [kept], ascending."""
        return replace(
            self,
            missed=np.ascontiguousarray(self.missed[:, camera]),
            cost=self.cost[camera],
            required=np.searchsorted(camera, self.required),
            conflict=self.conflict[camera][:, camera],
            coefficient=self.coefficient[:, camera],
        )

    @cached_property
    def _most_of_side(self) -> list[int]:
        """How many cameras, and how many LiDARs, a rig has at most."""
        most = []
        for column in self.both[:, 1:].T:
            cost = -(self.missed[column] < 1.0).any(axis=0).astype(float)
            limits = {"A_ub": np.vstack([self.coefficient, -self.coefficient]), "b_ub": np.append(self.high, -self.low)}
            limits = {name: value[np.isfinite(limits["b_ub"])] for name, value in limits.items()}
            found = linprog(cost, A_eq=np.ones((1, len(cost))), b_eq=[self.count], bounds=(0.0, 1.0), **limits)
            most.append(math.floor(-found.fun + _ROW_TOLERANCE) if found.status == 0 else self.count)
        return most

    def most_found(self, allowed: np.ndarray, required: np.ndarray) -> np.ndarray:
        """How surely the cameras, and the LiDARs, of a rig find each object of `both` at most, float64 [both, 2].

        Of rigs of the sensors ``allowed``, all those ``required`` among them, bool [camera].
        """
        least, free = np.ones((len(self.both), 2)), np.flatnonzero(allowed & ~required)
        if not len(least):
            return least
        for side, (column, most) in enumerate(zip(self.both[:, 1:].T, self._most_of_side, strict=True)):
            missed = self.missed[column]
            is_own = (missed < 1.0).any(axis=0)
            left = min(max(most - np.count_nonzero(required & is_own), 0), len(free))
            least[:, side] = np.prod(missed[:, required], axis=1)
            least[:, side] *= np.prod(np.sort(missed[:, free], axis=1)[:, :left], axis=1)
        return np.minimum(1.0 - least + 1e-12, 1.0)

    @property
    def lowest(self) -> float:
        """No rig is below it: every object is missed as by the cameras that see it best, by a side each of `both`."""
        best = np.partition(self.missed, self.count - 1, axis=1)[:, : self.count]
        missed, every = np.prod(best, axis=1), np.ones(self.camera_count, bool)
        weight = self.weight.copy()
        weight[self.both[:, 1:]] = 0.0
        missed[self.both[:, 0]] = 1.0 - np.prod(self.most_found(every, ~every), axis=1)
        weight[self.both[:, 0]] *= -1.0
        least_cost = np.partition(self.cost, self.count - 1)[: self.count].sum()
        return self.unseen + (float(weight @ missed) + float(least_cost)) * (1.0 - 1e-12)

    def miss_rate(self, rig: np.ndarray) -> float:
        """Expected miss rate of a rig and the cost of its cameras, which are int [camera]."""
        return self.unseen + float(self.weight @ np.prod(self.missed[:, rig], axis=1)) + float(self.cost[rig].sum())

    def is_feasible(self, rig: np.ndarray) -> bool:
        """Whether a rig, int [camera], satisfies all constraints."""
        chosen = np.zeros(self.camera_count, bool)
        chosen[rig] = True
        if len(rig) != self.count or chosen.sum() != self.count or not chosen[self.required].all():
            return False
        total = self.coefficient @ chosen
        return bool(
            not self.conflict[rig][:, rig].nnz
            and (total >= self.low - _ROW_TOLERANCE).all()
            and (total <= self.high + _ROW_TOLERANCE).all()
        )


def _checked_weight(weight: np.ndarray | None, objects: int, triple: np.ndarray | None) -> np.ndarray:
    share = np.ones(objects) if weight is None else np.asarray(weight, np.float64)
    is_free = np.zeros(objects, bool) if triple is None else np.isin(np.arange(objects), triple[:, 0])
    if share.shape != (objects,) or not (np.isfinite(share) & (is_free | (share >= 0.0))).all() or not share.any():
        raise ArgumentError("weight", f"expected [{objects}] finite numbers >= 0, not all 0, got {share}")
    return share / share.sum()


def _checked_conflict(conflict: np.ndarray | sparse.sparray | sparse.spmatrix | None, cameras: int) -> sparse.csr_array:
    if conflict is None:
        return sparse.csr_array((cameras, cameras), dtype=bool)
    pairs = sparse.csr_array(conflict, dtype=bool)
    if pairs.shape != (cameras, cameras):
        raise ArgumentError("conflict", f"expected [{cameras}, {cameras}], got {pairs.shape}")
    pairs = sparse.csr_array(pairs + pairs.T)
    pairs.setdiag(False)  # no camera excludes itself
    pairs.eliminate_zeros()
    return pairs


def _checked_rows(rows: Sequence[Row], cameras: int) -> dict[str, Any]:
    """The attributes of a problem that rows make."""
    coefficient = np.zeros((len(rows), cameras))
    for k, row in enumerate(rows):
        values = np.asarray(row.coefficient, np.float64)
        if values.shape != (cameras,) or not np.isfinite(values).all():
            raise ArgumentError("rows", f"{row.name}: expected [{cameras}] finite coefficients, got {values}")
        if math.isnan(row.low) or math.isnan(row.high):
            raise ArgumentError("rows", f"{row.name}: expected numbers as bounds, got {row.low} and {row.high}")
        coefficient[k] = values
    scale = np.abs(coefficient).max(axis=1, initial=0.0)
    scale[scale == 0.0] = 1.0
    low, high = (np.array([getattr(row, name) for row in rows], float) / scale for name in ("low", "high"))
    coefficient /= scale[:, None]
    return {"coefficient": coefficient, "low": low, "high": high, "row_scale": scale, "rows": tuple(rows)}


_INFEASIBLE = 2  # status of `scipy.optimize.milp`


def feasible_rig(
    problem: SelectionProblem, *, time_limit_s: float, cost: np.ndarray | None = None
) -> np.ndarray | None:
    """A rig that satisfies all constraints, its required cameras first, int [camera]; None where there is none."""
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
        if found.status == _INFEASIBLE:
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
    """Name constraints that exclude each other, of which each is needed for that, `count` always among them.

    They are found by deletion: what can go while there still is no rig, goes (Chinneck and Dravnieks 1991, Locating
    minimal infeasible constraint sets in linear programs).
    """
    kept = [
        *(["required"] if len(problem.required) else []),
        *(["conflict"] if problem.conflict.nnz else []),
        *(row.name for row in problem.rows),
    ]
    for name in list(kept):
        fewer = [each for each in kept if each != name]
        loosened = problem.under(
            [row for row in problem.rows if row.name in fewer],
            required=problem.required if "required" in fewer else problem.required[:0],
            conflict=problem.conflict if "conflict" in fewer else sparse.csr_array(problem.conflict.shape, dtype=bool),
        )
        try:
            if feasible_rig(loosened, time_limit_s=time_limit_s) is None:
                kept = fewer
        except TimeoutError:
            continue  # it stays: not known to be dispensable
    names = " and ".join([f"count = {problem.count}", *kept])
    raise InputError(f"no rig of the pool satisfies {names}; loosen one of them, or add cameras to the pool")


def random_rig(
    problem: SelectionProblem, rng: np.random.Generator, fraction: np.ndarray | None = None
) -> np.ndarray | None:
    """A rig that satisfies the constraints, its required cameras first, int [camera]; None where the draw got stuck."""
    rig = list(problem.required)
    favour = np.ones(problem.camera_count) if fraction is None else fraction + 1e-6
    can_be = np.ones(problem.camera_count, bool)
    can_be[rig] = False
    can_be &= ~problem.excluded_by(rig)
    (asked, low), (limited, high) = problem.counting_rows
    while len(rig) < problem.count:
        left = high + _ROW_TOLERANCE - limited[:, rig].sum(axis=1)
        wanted = can_be & (limited <= left[:, None]).all(axis=0)
        for row in np.flatnonzero(asked[:, rig].sum(axis=1) < low - _ROW_TOLERANCE):
            fewer = wanted & (asked[row] > 0.0)
            wanted = fewer if fewer.any() else wanted
        choice = np.flatnonzero(wanted)
        if not len(choice):
            return None
        camera = int(rng.choice(choice, p=favour[choice] / favour[choice].sum()))
        rig.append(camera)
        can_be[camera] = False
        can_be &= ~problem.excluded_by([camera])
    return np.array(rig) if problem.is_feasible(np.array(rig)) else None


def exchange(
    problem: SelectionProblem,
    rigs: np.ndarray,
    *,
    completed: Callable[[np.ndarray], np.ndarray] | None = None,
    value_of: Callable[[np.ndarray], float] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Exchange one camera of each rig after the other for the best of the pool, until nothing helps any of them.

    Returns the rigs, likewise, the best first, and their expected miss rates, float64 [rig]. ``rigs`` int [rig,
    camera]. Of another value ``value_of`` is that of a rig, ``completed`` those of the rigs, [camera, rig], that each
    camera of the pool makes of others, int [rig, camera].
    """

    def miss_rates(others: np.ndarray) -> np.ndarray:
        left = np.prod(problem.missed[:, others], axis=2) * problem.weight[:, None]
        return problem.missed.T @ left + problem.cost[:, None]

    rigs = np.array(rigs)
    every = np.arange(len(rigs))
    first = len(problem.required)
    slot, unchanged = first, 0
    while unchanged < problem.count - first:
        others = np.delete(rigs, slot, axis=1)
        value = (completed or miss_rates)(others)
        before = value[rigs[:, slot], every]
        value[~_fits(problem, others)] = np.inf
        best = np.argmin(value, axis=0)
        # what only rounding tells apart would be exchanged for ever
        is_better = value[best, every] < before * (1.0 - 1e-9)
        rigs[is_better, slot] = best[is_better]
        unchanged = 0 if is_better.any() else unchanged + 1
        slot = slot + 1 if slot + 1 < problem.count else first
    value = np.array([(value_of or problem.miss_rate)(rig) for rig in rigs])
    order = np.argsort(value, kind="stable")
    return rigs[order], value[order]


def _fits(problem: SelectionProblem, others: np.ndarray) -> np.ndarray:
    """Which cameras complete the rigs of which others, bool [camera, rig]; others are int [rig, camera]."""
    chosen = np.zeros((problem.camera_count, len(others)), bool)
    chosen[others.T, np.arange(len(others))] = True
    fits = ~chosen
    if problem.conflict.nnz:
        fits &= (problem.conflict @ chosen.astype(np.int32)) == 0
    total = problem.coefficient @ chosen
    for coefficient, now, low, high in zip(problem.coefficient, total, problem.low, problem.high, strict=True):
        then = coefficient[:, None] + now
        fits &= (then >= low - _ROW_TOLERANCE) & (then <= high + _ROW_TOLERANCE)
    return fits
