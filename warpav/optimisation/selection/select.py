"""The best rig out of a pool of single cameras, with a proof of how much better any other could be."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy import sparse

from warpav.core.errors import ArgumentError
from warpav.optimisation.selection.branching import TOLERANCE, Improvement, Search
from warpav.optimisation.selection.exchange import exchange, random_rig
from warpav.optimisation.selection.feasibility import feasible_rig, raise_conflict
from warpav.optimisation.selection.price import Price
from warpav.optimisation.selection.problem import Row, SelectionProblem

STARTS = 64
"""Random rigs that are exchanged first."""

DRAWS = 4 * STARTS
"""Draws that may be made for them: with tight constraints most get stuck."""

FEWEST_STARTS = 8
"""Rigs that an integer programme looks for where random ones do not satisfy the constraints."""

FURTHER_STARTS_TIME = 0.1
"""Share of the time left that it may take for each but the first."""


Ended = Literal["optimal", "gap", "time", "interrupted", "exchange"]
"""Why a selection ended, see `Selection`."""


@dataclass(frozen=True, eq=False)
class Selection:
    """A rig, and what is proven of it.

    Attributes:
        cameras: The cameras of the pool that it consists of, ascending, int [camera].
        objective: Its expected miss rate, 0..1.
        bound: No rig of the pool that satisfies the constraints is below it.
        ended: ``optimal``: no other is better by more than 1e-9; ``gap``: none by more than the gap that was asked for;
            ``time``: it was over; ``interrupted``: by Ctrl-C; ``exchange``: no exchange of a camera helps, and no more
            is proven than the bound.
        seconds: Wall time [s].
        nodes: Nodes of the branch and bound beyond the root.
        price: What further cameras would bring; None where the time did not suffice for a relaxation.
        others: Of a selection without a proof further good rigs, no two of which share all cameras but one.
    """

    cameras: np.ndarray
    objective: float
    bound: float
    ended: Ended
    seconds: float
    nodes: int
    price: Price | None
    others: tuple[np.ndarray, ...] = ()

    @property
    def gap(self) -> float:
        """Objective less bound: by how much another rig of the pool could be better at most, >= 0."""
        return self.objective - self.bound


def select(
    detection_probability: np.ndarray,
    count: int,
    *,
    conflict: np.ndarray | sparse.sparray | sparse.spmatrix | None = None,
    required: Sequence[int] | np.ndarray = (),
    rows: Sequence[Row] = (),
    weight: np.ndarray | None = None,
    start: Sequence[int] | np.ndarray | None = None,
    gap: float = 1e-3,
    time_limit_s: float = 60.0,
    seed: int = 0,
    on_improvement: Callable[[Improvement], None] | None = None,
) -> Selection:
    """Choose the rig of the lowest expected miss rate, the weighted mean over objects of the product of 1 - p.

    Exchanges of single cameras find good rigs, a linear relaxation bounds all rigs from below (`relaxation`, `cut`),
    and a branch and bound closes the gap between them (`branching`). Deterministic but for the time limit.

    Args:
        detection_probability: Probability p that each camera detects each object, 0..1, float [camera, object].
        count: Number of cameras of the rig.
        conflict: Pairs of which a rig has one at most, such as cameras too near to each other, bool [camera, camera];
            dense or sparse, one triangle or both.
        required: Cameras that the rig must have, such as frozen ones.
        rows: Further linear constraints: costs, numbers of a zone or module, objects that several must see.
        weight: Of the objects, >= 0, float [object]; None: all alike.
        start: A rig that satisfies the constraints, which the result is not worse than; None: none is known.
        gap: Objective less bound at which the search ends, an expected miss rate, >= 0; 0: only the optimum will do.
        time_limit_s: When it ends at the latest [s], > 0; single steps are not cut short. The best rig and the bound
            are kept, and on Ctrl-C as well.
        seed: Of the rigs that exchanges begin with.
        on_improvement: Called with every better rig or bound.

    Raises:
        InputError: Arguments that cannot be used; a pool in which no camera sees anything; constraints that no rig
            satisfies, of which it names some that exclude each other, none of them dispensable.
    """
    began_s = time.perf_counter()
    if not time_limit_s > 0.0:
        raise ArgumentError("time_limit_s", f"expected more than 0 s, got {time_limit_s:g}")
    if not gap >= 0.0:
        raise ArgumentError("gap", f"expected an expected miss rate of 0 or more, got {gap:g}")
    problem = SelectionProblem.create(
        detection_probability, count, conflict=conflict, required=required, rows=rows, weight=weight
    )
    rng = np.random.default_rng(seed)
    deadline_s = began_s + time_limit_s
    rigs = first_rigs(problem, start, rng, deadline_s)
    search = Search(problem, rigs, gap=gap, deadline_s=deadline_s, rng=rng, on_improvement=on_improvement)
    ended = "time"
    try:
        search.run()
    except KeyboardInterrupt:
        ended = "interrupted"
    if search.objective - search.bound <= TOLERANCE:
        ended = "optimal"
    elif search.objective - search.bound <= gap:
        ended = "gap"
    price = None if search.price is None else _for_all_objects(search.price, problem)
    return Selection(
        search.rig, search.objective, search.bound, ended, time.perf_counter() - began_s, search.nodes, price
    )


def first_rigs(
    problem: SelectionProblem, start: Sequence[int] | np.ndarray | None, rng: np.random.Generator, deadline_s: float
) -> np.ndarray:
    """Rigs that no exchange of a single camera makes better, the best first, int [rig, camera].

    They come from random ones; where the constraints are so tight that those break them, from an integer programme.

    Raises:
        InputError: The start cannot be used, or no rig satisfies the constraints.
    """
    rigs = [] if start is None else [_checked_start(problem, start)]
    drawn = (random_rig(problem, rng) for _ in range(DRAWS))
    rigs += itertools.islice((rig for rig in drawn if rig is not None), STARTS)
    cost = np.zeros(problem.camera_count)
    while len(rigs) < FEWEST_STARTS:
        left_s = deadline_s - time.perf_counter()
        if rigs and left_s <= 0.0:
            break
        try:
            rig = feasible_rig(
                problem, time_limit_s=max(FURTHER_STARTS_TIME * left_s if rigs else left_s, 1e-3), cost=cost
            )
        except TimeoutError:
            if rigs:
                break
            raise ArgumentError(
                "time_limit_s",
                "expected enough to find a rig that satisfies the constraints; raise it or give a start",
            ) from None
        if rig is None:
            raise_conflict(problem, time_limit_s=max(left_s, 1.0))
        else:
            rigs.append(rig)
        cost = rng.uniform(size=problem.camera_count)
    return exchange(problem, np.array(rigs))[0]


def _checked_start(problem: SelectionProblem, start: Sequence[int] | np.ndarray) -> np.ndarray:
    rig = np.unique(np.asarray(start, np.int64))
    is_within = len(rig) > 0 and 0 <= rig[0] <= rig[-1] < problem.camera_count
    if not is_within or not problem.is_feasible(rig):
        raise ArgumentError(
            "start", f"expected {problem.count} cameras of the pool that satisfy the constraints, got {list(start)}"
        )
    return np.concatenate([problem.required, np.setdiff1d(rig, problem.required)])


def _for_all_objects(price: Price, problem: SelectionProblem) -> Price:
    """A price of the pool's objects, and of those that none of its cameras sees, of which each would count in full."""
    unseen = np.setdiff1d(np.arange(len(problem.every_weight)), problem.seen)
    return replace(
        price,
        object_count=len(problem.every_weight),
        cut_object=np.concatenate([problem.seen[price.cut_object], unseen]),
        cut_level=np.concatenate([price.cut_level, np.zeros(len(unseen))]),
        cut_dual=np.concatenate([price.cut_dual, problem.every_weight[unseen]]),
        row_dual=price.row_dual / problem.row_scale,
    )
