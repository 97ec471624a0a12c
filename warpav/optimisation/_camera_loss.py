"""A rig that still finds most when any one of its cameras fails: the objective, its selection and its bound.

The objective is ``(1 - w) m + w L``: m is the expected miss rate of the whole rig, L that without one of its cameras,
in the mean over the cameras or without the one that is worst to lose. Cameras err independently, so all of it follows
in closed form from what single cameras detect, and so does its slope.

The bound. A loss only adds misses, and a rig of n cameras without one is a rig of n - 1. So no rig is below
``(1 - w) B_n + w B_(n-1)``, where B_k is the proven bound of all rigs of k cameras of the pool. It is not tight: the
best rig of n - 1 cameras is not what is left of the best of n.

Pairs. Of a symmetric rig one row of a pool stands for a camera and its mirror image, whose probabilities are merged.
The loss of one of the two then counts as that of both, twice in the mean: more than is really missed, never less. The
bound is one of this objective.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from warpav.core.errors import ArgumentError
from warpav.detection import SUREST
from warpav.optimisation.selection._problem import Row, SelectionProblem, exchange, random_rig
from warpav.optimisation.selection._relaxation import Price
from warpav.optimisation.selection._select import STARTS, TOLERANCE, Ended, Selection, select

_MOST_EXCHANGES, _EXCHANGE_TIME = 8, 0.25
"""Times `STARTS` random rigs that are exchanged, and the share of a selection's time after which no more are."""
OTHERS = 2  # further rigs that are handed out for a polish: the best of a pool often ends higher than they
SOFTNESS = 0.02  # expected miss rate within which the worst loss is rounded where a polish looks for a better rig


@dataclass(frozen=True)
class RobustValue:
    """What a rig misses with all of its cameras and without one."""

    objective: float  # of these two, as a `RobustObjective` weights them
    expected_miss_rate: float  # of the whole rig
    without_camera: float  # of the rig without one camera: the mean over the cameras, or the worst


@dataclass(frozen=True)
class RobustObjective:
    """How much the loss of a camera counts.

    In all methods ``missed`` is the probability that a camera misses an object, at least 1 - `SUREST`, and ``size`` how
    many cameras a row stands for: 1; 2 for a pair; 0 for one that is not there.
    """

    camera_loss: Literal["mean", "worst"]  # ``mean`` over the loss of any one camera, or the ``worst`` one
    weight: float = 0.5  # of that loss, in (0, 1]; the whole rig has the rest

    def __post_init__(self) -> None:
        if self.camera_loss not in ("mean", "worst"):
            raise ArgumentError("camera_loss", f"expected mean or worst, got {self.camera_loss!r}")
        if not 0.0 < self.weight <= 1.0:
            raise ArgumentError("weight", f"expected more than 0, at most 1, got {self.weight:g}")

    def of_rig(
        self, detection_probability: np.ndarray, share: np.ndarray | None = None, size: np.ndarray | None = None
    ) -> RobustValue:
        """The value of a rig. ``share`` float [object]; ``size`` int [camera]."""
        missed = 1.0 - np.minimum(np.asarray(detection_probability, np.float64), SUREST)
        if share is None:
            share = np.full(missed.shape[1], 1.0 / max(missed.shape[1], 1))
        whole = missed.prod(axis=0)
        without = (whole / missed) @ share
        nominal, lost = float(whole @ share), float(self._of_cameras(without, size) @ without)
        return RobustValue((1.0 - self.weight) * nominal + self.weight * lost, nominal, lost)

    def value_and_slope(
        self, missed: np.ndarray, share: np.ndarray, size: np.ndarray | None = None, *, softness: float = 0.0
    ) -> tuple[float, np.ndarray]:
        """The objective of a rig and its derivatives to what each camera misses, both [camera, object]."""
        whole = missed.prod(axis=0)
        without = (whole / missed) @ share
        of_camera = self._of_cameras(without, size, softness)
        lost = float(of_camera @ without)
        if softness > 0.0 and self.camera_loss == "worst":  # the log-sum-exp is that mean and its entropy
            lost -= softness * float(of_camera @ np.log(np.maximum(of_camera, 1e-300)))
        by_loss = of_camera[:, None] / missed
        by_product = (1.0 - self.weight) + self.weight * (by_loss.sum(axis=0) - by_loss)
        value = (1.0 - self.weight) * float(whole @ share) + self.weight * lost
        return value, share * whole / missed * by_product

    def of_completed(self, missed: np.ndarray, weight: np.ndarray, others: np.ndarray, size: np.ndarray) -> np.ndarray:
        """The objective, [camera, rig], of rigs of others, int [rig, other], that each camera would complete.

        ``missed`` float64 [object, camera].
        """
        left = np.prod(missed[:, others], axis=2) * weight[:, None]
        nominal, lost_itself = missed.T @ left, left.sum(axis=0)[None]
        is_mean = self.camera_loss == "mean"
        itself = size[:, None].astype(float)
        lost = itself * lost_itself if is_mean else np.where(itself > 0.0, lost_itself, -np.inf)
        for slot in others.T:
            without = missed.T @ (left / missed[:, slot])
            lost = lost + size[slot] * without if is_mean else np.maximum(lost, np.where(size[slot] > 0, without, lost))
        if is_mean:
            lost = lost / np.maximum(itself + size[others].sum(axis=1), 1.0)
        return (1.0 - self.weight) * nominal + self.weight * lost

    def _of_cameras(self, without: np.ndarray, size: np.ndarray | None, softness: float = 0.0) -> np.ndarray:
        """How much the loss of each camera counts among all, 1 in sum, float64 [camera]."""
        size = np.ones(len(without)) if size is None else np.asarray(size, np.float64)
        if self.camera_loss == "mean":
            return size / size.sum()
        without = np.where(size > 0.0, without, -np.inf)
        if softness > 0.0:
            share = np.exp((without - without.max()) / softness)
            return share / share.sum()
        return np.eye(len(without))[int(np.argmax(without))]


def select_robust(
    problem: SelectionProblem,
    objective: RobustObjective,
    size: np.ndarray,
    *,
    start: Sequence[int] | np.ndarray | None = None,
    gap: float = 1e-3,
    time_limit_s: float = 60.0,
    seed: int = 0,
) -> Selection:
    """A rig of a low robust objective, and a bound that no rig of the pool is below; options as of `select`.

    The rig comes from exchanges of single cameras under the robust objective, from the best rig of the expected miss
    rate alone, the start, and random ones; it is not proven to be the best. The bound, and the price, come from two
    selections of the expected miss rate, with all cameras and with one less, which share the time.
    """
    count, required = problem.count, problem.required
    whole = select(problem, start=start, time_limit_s=0.5 * time_limit_s, gap=gap, seed=seed)
    fewer = None
    if count > 1 and whole.ended != "interrupted":
        kept = [np.delete(whole.cameras, k) for k in range(count)]
        rows = _without_one(problem.rows, required, problem.camera_count)
        fewer = select(
            problem.under(rows, count=count - 1, required=required[:0]),
            start=min(kept, key=problem.miss_rate),
            time_limit_s=0.5 * time_limit_s,
            gap=gap,
            seed=seed,
        )
    # B_0 is 1; where the second selection was not made, B_(n-1) is not below B_n
    bound_of_fewer = 1.0 if count == 1 else whole.bound if fewer is None else max(fewer.bound, whole.bound)
    bound = (1.0 - objective.weight) * whole.bound + objective.weight * bound_of_fewer
    known = [whole.cameras] if start is None else [np.asarray(start, np.int64), whole.cameras]
    rigs, value = _exchanged(problem, known, objective, size, _EXCHANGE_TIME * time_limit_s, seed)
    ended: Ended = "exchange"
    if value[0] - bound <= max(TOLERANCE, gap):
        ended = "optimal" if value[0] - bound <= TOLERANCE else "gap"
    if "interrupted" in (whole.ended, fewer.ended if fewer else None):
        ended = "interrupted"
    return Selection(
        np.sort(rigs[0]),
        float(value[0]),
        bound,
        ended,
        whole.seconds + (fewer.seconds if fewer else 0.0),
        whole.nodes + (fewer.nodes if fewer else 0),
        _mixed(whole.price, None if fewer is None else fewer.price, objective.weight, len(problem.rows)),
        _apart(rigs)[1 : 1 + OTHERS],
    )


def _exchanged(
    problem: SelectionProblem,
    known: Sequence[np.ndarray],
    objective: RobustObjective,
    size: np.ndarray,
    time_limit_s: float,
    seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    """What `exchange_robust` makes of known rigs and of random ones, as many as there is time for, the best first."""
    rng = np.random.default_rng([seed, 2])
    required, deadline_s = problem.required, time.perf_counter() + time_limit_s
    rigs = [np.concatenate([required, np.setdiff1d(rig, required)]) for rig in known]
    found: list[tuple[np.ndarray, np.ndarray]] = []
    for _ in range(_MOST_EXCHANGES):
        rigs += [rig for rig in (random_rig(problem, rng) for _ in range(STARTS)) if rig is not None]
        if rigs:
            found.append(exchange_robust(problem, np.array(rigs), objective, size))
        if time.perf_counter() > deadline_s:
            break
        rigs = []
    rigs, value = (np.concatenate(each) for each in zip(*found, strict=True))
    order = np.argsort(value, kind="stable")
    return rigs[order], value[order]


def _apart(rigs: np.ndarray) -> tuple[np.ndarray, ...]:
    """The first of some rigs that differ in more than one camera from each other, one more than `OTHERS` at most."""
    kept: list[np.ndarray] = []
    for rig in rigs:
        if len(kept) <= OTHERS and all(len(np.setdiff1d(rig, other)) > 1 for other in kept):
            kept.append(rig)
    return tuple(kept)


def exchange_robust(
    problem: SelectionProblem, rigs: np.ndarray, objective: RobustObjective, size: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """As `exchange`, under a robust objective. ``rigs`` int [rig, camera]; ``size`` int [camera]."""

    def value_of(rig: np.ndarray) -> float:
        seen = problem.missed[:, rig].T
        return problem.unseen + objective.value_and_slope(seen, problem.weight, size[rig])[0]

    return exchange(
        problem,
        rigs,
        completed=lambda others: objective.of_completed(problem.missed, problem.weight, others, size),
        value_of=value_of,
    )


def _without_one(rows: Sequence[Row], required: np.ndarray, cameras: int) -> list[Row]:
    """Rows that every rig keeps that has lost one camera, for a pool of so many."""
    kept = []
    for row in rows:
        most, least = float(np.max(row.coefficient)), float(np.min(row.coefficient))
        kept.append(Row(row.name, row.coefficient, row.low - max(most, 0.0), row.high - min(least, 0.0)))
    if len(required) > 1:
        is_required = np.bincount(required, minlength=cameras).astype(float)
        kept.append(Row("required cameras but one", is_required, low=len(required) - 1.0))
    return kept


def _mixed(whole: Price | None, fewer: Price | None, weight: float, row_count: int) -> Price | None:
    """What a further camera would bring to the robust bound: the weighted sum of what it brings to the two."""
    if whole is None or fewer is None:
        return whole
    parts = ((1.0 - weight, whole), (weight, fewer))
    return replace(
        whole,
        bound=sum(share * price.bound for share, price in parts),
        cut_object=np.concatenate([price.cut_object for _, price in parts]),
        cut_level=np.concatenate([price.cut_level for _, price in parts]),
        cut_dual=np.concatenate([share * price.cut_dual for share, price in parts]),
        row_dual=sum(share * price.row_dual[:row_count] for share, price in parts),
        dearest=sum(share * price.dearest for share, price in parts),
    )
