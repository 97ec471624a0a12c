"""The best rig out of a pool of single cameras, with a proof of how much better any other could be."""

from __future__ import annotations

import heapq
import itertools
import math
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from warpav.core.cores import available_cores
from warpav.core.errors import ArgumentError
from warpav.optimisation.selection._problem import SelectionProblem, exchange, feasible_rig, raise_conflict, random_rig
from warpav.optimisation.selection._relaxation import Node, Price, Relaxation, Relaxed

TOLERANCE = 1e-9  # expected miss rates that differ by less count as equal

_TRIALS = 8  # groups that are tried before one is branched on
_LEAST_FRACTION = 0.02
"""How far the cameras that the relaxation takes from a group must be from a whole number, for it to be tried."""
_ROUNDED_RIGS, _ROUNDING_EVERY = 16, 8
"""Rigs that are drawn from a fractional choice and exchanged, and nodes from one such draw to the next."""
STARTS, _DRAWS, _VAIN_DRAWS = 64, 256, 32
"""Random rigs that are exchanged first, draws for them, and draws in vain after which none more is made."""

_FEWEST_STARTS, _FURTHER_STARTS_TIME = 4, 0.1
"""Rigs that an integer programme finds where too few random ones satisfy the constraints, and the share of the time
left that it may take for each but the first."""


class BranchAndBound:
    """The state of a search: the best rig, and the bound.

    At the root the relaxation holds all cameras; those whose choice would raise its bound above the best rig go out for
    good. Then the node of the lowest bound is relaxed and split: of some group of cameras a rig has at most k, or at
    least k + 1. Groups are the clusters of a tree over the detection probabilities, single cameras its leaves: to
    forbid one camera hardly matters as long as there are others like it, to forbid a whole sector does. Trial
    relaxations of few iterations choose the group.
    """

    def __init__(
        self, problem: SelectionProblem, rigs: np.ndarray, *, gap: float, deadline_s: float, rng: np.random.Generator
    ) -> None:
        """Begin with rigs that satisfy the constraints, the required cameras first, int [rig, camera]."""
        self.rig, self.objective = np.sort(rigs[0]), problem.miss_rate(rigs[0])  # the best rig, its miss rate
        self.bound = problem.lowest  # no rig of the pool is below it
        self.price: Price | None = None  # duals of the root's bound; None before there is one
        self.nodes = 0  # number of nodes relaxed
        self._problem, self._kept = problem, np.arange(problem.camera_count)
        self._starts = rigs
        self._gap, self._deadline_s, self._rng = max(gap, TOLERANCE), deadline_s, rng

    def run(self) -> None:
        """Search until the gap is closed or the time is over; the attributes are valid at any time."""
        relaxation, root = self._root()
        if self._is_over:
            return
        tree = _GroupTree(self._problem)
        ties = itertools.count()
        open_nodes = [(root.bound, next(ties), root)]
        closed = math.inf  # least bound of the nodes that are not looked into
        while open_nodes and not self._is_over:
            _, _, node = open_nodes[0]  # it stays there, so that its bound counts if this is interrupted
            children, left = self._split(node, relaxation, tree)
            heapq.heappop(open_nodes)
            closed = min(closed, left)
            for child in children:
                heapq.heappush(open_nodes, (child.bound, next(ties), child))
            lowest = min(closed, self.objective, open_nodes[0][0] if open_nodes else math.inf)
            self.bound = max(self.bound, lowest)

    @property
    def _is_over(self) -> bool:
        return self.objective - self.bound <= self._gap or time.perf_counter() >= self._deadline_s

    def _root(self) -> tuple[Relaxation, Node]:
        """Relax the whole pool, and restrict it to the cameras that a better rig may have."""
        problem = self._problem
        every = np.ones(problem.camera_count, bool)
        required = np.zeros(problem.camera_count, bool)
        required[problem.required] = True
        root = Node(every, required, {}, self.bound)
        relaxation = Relaxation(problem, self._deadline_s)
        starts = self._starts[:_ROUNDED_RIGS]
        relaxation.add_cameras(np.unique(starts))
        fraction = np.bincount(starts.ravel(), minlength=problem.camera_count) / len(starts)
        level, _ = relaxation.most_violated(fraction, np.flatnonzero(fraction))
        cut = np.setdiff1d(np.arange(problem.object_count), problem.both[:, 0])
        relaxation.add_cuts(cut, level[cut])
        relaxed = relaxation.relax(root, self.objective)
        self.price = relaxed.price
        if relaxed.price is None:
            return relaxation, root
        self._round(relaxed.fraction)
        root, kept = _without_useless(root, relaxed, self.objective)
        self.bound = max(self.bound, min(relaxed.bound, self.objective))
        if self._is_over:
            return relaxation, root
        camera = np.flatnonzero(kept)
        self._problem, self._kept = problem.restricted(camera), camera
        smaller = Relaxation(self._problem, self._deadline_s)
        smaller.add_cameras(np.searchsorted(camera, np.intersect1d(relaxation.cameras, camera)))
        smaller.add_cuts(*relaxation.cuts)
        return smaller, replace(root, allowed=root.allowed[camera], required=root.required[camera])

    def _split(self, node: Node, relaxation: Relaxation, tree: _GroupTree) -> tuple[list[Node], float]:
        """Relax a node; its children, and the least bound of what of it is in none of them."""
        problem = self._problem
        if node.bound >= self.objective - TOLERANCE:
            return [], node.bound
        if np.count_nonzero(node.required) == problem.count:
            rig = np.flatnonzero(node.required)
            self._offer(rig)
            return [], problem.miss_rate(rig) if problem.is_feasible(rig) else math.inf
        enough = self.objective - self._gap
        relaxed = relaxation.relax(node, enough)
        if relaxed.price is None and not math.isinf(relaxed.bound):  # out of time
            return [node], math.inf
        self.nodes += 1
        if relaxed.bound >= self.objective - TOLERANCE:
            return [], relaxed.bound
        if relaxed.bound >= enough:  # it waits, in case a better rig asks for more
            return [replace(node, bound=relaxed.bound)], math.inf
        if self.nodes % _ROUNDING_EVERY == 0:
            self._round(relaxed.fraction)
        self._offer(np.argsort(-(relaxed.fraction + node.required), kind="stable")[: problem.count])
        node, _ = _without_useless(node, relaxed, self.objective)
        closed = self.objective  # of what went out
        if node.is_empty(problem.count):
            return [], closed
        branches = tree.branches(node, relaxed.fraction, relaxation, enough)
        return [tree.child(node, branch, problem.count) for branch in branches], closed

    def _round(self, fraction: np.ndarray) -> None:
        drawn = [random_rig(self._problem, self._rng, fraction) for _ in range(_ROUNDED_RIGS)]
        drawn = [rig for rig in drawn if rig is not None]
        if drawn:
            rigs, _ = exchange(self._problem, np.array(drawn))
            self._offer(rigs[0])

    def _offer(self, rig: np.ndarray) -> None:
        """Keep a rig of the restricted pool if it satisfies the constraints and is better."""
        value = self._problem.miss_rate(rig)
        if value < self.objective and self._problem.is_feasible(rig):
            self.rig, self.objective = np.sort(self._kept[rig]), value


class _GroupTree:
    """Nested groups of cameras that see alike: single cameras, and the clusters that Ward's method merges them into."""

    def __init__(self, problem: SelectionProblem) -> None:
        """Cluster the cameras of a pool."""
        from scipy.cluster.hierarchy import ward

        cameras = problem.camera_count
        member = np.zeros((max(2 * cameras - 1, 1), cameras), bool)
        member[:cameras] = np.eye(cameras, dtype=bool)
        if cameras > 1:
            seen = np.sqrt(np.abs(problem.weight))[:, None] * (1.0 - problem.missed)
            square = seen.T @ seen
            length = np.diag(square)
            distance = np.sqrt(np.maximum(length[:, None] + length - 2.0 * square, 0.0))
            merged = ward(distance[np.triu_indices(cameras, 1)])[:, :2].astype(int)
            for k, (one, other) in enumerate(merged):
                member[cameras + k] = member[one] | member[other]
        self.member = member  # cameras of the groups, the single ones first, bool [group, camera]
        self._row: dict[int, int] = {}
        self._group: dict[int, int] = {}

    def child(self, node: Node, branch: dict[int, tuple[float, float]], count: int) -> Node:
        """The part of a node that is in a branch, of rigs of so many cameras."""
        ((row, (low, high)),) = branch.items()
        member = self.member[self._group[row]]
        allowed, required = node.allowed, node.required
        if high <= 0.0:
            allowed = allowed & ~member
        if low >= min(np.count_nonzero(member & allowed), count):
            required = required | (member & allowed)
        return Node(allowed, required, {**node.branch, **branch}, node.bound)

    def branches(
        self, node: Node, fraction: np.ndarray, relaxation: Relaxation, enough: float
    ) -> list[dict[int, tuple[float, float]]]:
        """The two branches of the group whose trials rise most, by the product of both, each up to ``enough``."""
        taken = np.round(self.member @ fraction, 9)
        away = np.abs(taken - np.round(taken))
        group = np.flatnonzero(away > _LEAST_FRACTION)
        _, first = np.unique(taken[group], return_index=True)  # nested groups with the same share of the choice
        group = group[first]
        inside = np.count_nonzero(self.member[group] & node.allowed, axis=1)
        size = np.minimum(inside, np.count_nonzero(node.allowed) - inside) + 1.0
        group = group[np.argsort(-away[group] * np.sqrt(size))[:_TRIALS]]
        if not len(group):  # a whole choice, or nearly: take one camera that it does not agree on, or has not proved
            away[len(fraction) :] = 0.0
            single = int(np.argmax(away)) if away.any() else int(np.argmax(fraction * ~node.required))
            return self._two_branches(single, node, taken[single], relaxation)
        pairs = [self._two_branches(int(k), node, float(taken[k]), relaxation) for k in group]
        if len(pairs) == 1:
            return pairs[0]
        value = np.array(relaxation.try_branches(node, [branch for pair in pairs for branch in pair]))
        rise = np.clip(np.minimum(value.reshape(-1, 2), enough) - node.bound, 1e-7, None)
        return pairs[int(np.argmax(np.prod(rise, axis=1)))]

    def _two_branches(
        self, group: int, node: Node, taken: float, relaxation: Relaxation
    ) -> list[dict[int, tuple[float, float]]]:
        if group not in self._row:
            self._row[group] = relaxation.add_row(self.member[group].astype(float))
            self._group[self._row[group]] = group
        row = self._row[group]
        low, high = node.branch.get(row, (-math.inf, math.inf))
        split = max(math.ceil(taken - 1e-9) - 1, 0)
        return [{row: (low, float(split))}, {row: (split + 1.0, high)}]


def _without_useless(node: Node, relaxed: Relaxed, objective: float) -> tuple[Node, np.ndarray]:
    """A node of the cameras that a rig better than the objective may have; those that it must have are required."""
    allowed = node.allowed & ((relaxed.bound + relaxed.rise_in < objective) | node.required)
    required = node.required | (allowed & (relaxed.bound + relaxed.rise_out >= objective))
    return Node(allowed, required, node.branch, relaxed.bound), allowed


Ended = Literal["optimal", "gap", "time", "interrupted", "exchange"]  # why a selection ended, see `Selection`


@dataclass(frozen=True, eq=False)
class Selection:
    """A rig, and what is proven of it."""

    cameras: np.ndarray  # the cameras of the pool that it consists of, ascending, int [camera]
    objective: float  # its expected miss rate, 0..1
    bound: float  # no rig of the pool that satisfies the constraints is below it
    ended: Ended  # ``optimal``: no other is better by more than 1e-9
    seconds: float  # wall time [s]
    nodes: int  # nodes of the branch and bound beyond the root
    price: Price | None  # what further cameras would bring; None where the time did not suffice for a relaxation
    others: tuple[np.ndarray, ...] = ()  # of a selection without a proof further good rigs

    @property
    def gap(self) -> float:
        """By how much another rig of the pool could be better at most, >= 0."""
        return self.objective - self.bound


def select(
    problem: SelectionProblem,
    *,
    start: Sequence[int] | np.ndarray | None = None,
    gap: float = 1e-3,
    time_limit_s: float = 60.0,
    seed: int = 0,
) -> Selection:
    """Choose the rig of the lowest expected miss rate, the weighted mean over objects of the product of 1 - p.

    Exchanges of single cameras find good rigs, a linear relaxation bounds all rigs from below (`relaxation`), and a
    branch and bound closes the gap between them. Deterministic but for the time limit.
    """
    began_s = time.perf_counter()
    if not time_limit_s > 0.0:
        raise ArgumentError("time_limit_s", f"expected more than 0 s, got {time_limit_s:g}")
    if not gap >= 0.0:
        raise ArgumentError("gap", f"expected an expected miss rate of 0 or more, got {gap:g}")
    rng = np.random.default_rng(seed)
    deadline_s = began_s + time_limit_s
    rigs = _first_rigs(problem, start, rng, deadline_s)
    search = BranchAndBound(problem, rigs, gap=gap, deadline_s=deadline_s, rng=rng)
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


def _first_rigs(
    problem: SelectionProblem, start: Sequence[int] | np.ndarray | None, rng: np.random.Generator, deadline_s: float
) -> np.ndarray:
    """Rigs that no exchange of a single camera makes better, from random ones or a programme, the best first."""
    rigs = [] if start is None else [_checked_start(problem, start)]
    first = len(rigs)
    for draw in range(_DRAWS):
        if len(rigs) == first + STARTS or draw >= _VAIN_DRAWS * (1 + len(rigs) - first):
            break
        rig = random_rig(problem, rng)
        rigs += [] if rig is None else [rig]
    missing, left_s = max(_FEWEST_STARTS - len(rigs), 0), deadline_s - time.perf_counter()
    cost = [np.zeros(problem.camera_count), *rng.uniform(size=(missing, problem.camera_count))]
    limit_s = [max(left_s if k == len(rigs) == 0 else _FURTHER_STARTS_TIME * left_s, 1e-3) for k in range(missing)]
    with ThreadPoolExecutor(available_cores()) as threads:
        tried = [threads.submit(feasible_rig, problem, time_limit_s=limit_s[k], cost=cost[k]) for k in range(missing)]
    for each in tried:
        try:
            rig = each.result()
        except TimeoutError:
            if rigs:
                break
            raise ArgumentError(
                "time_limit_s", "expected enough to find a rig that satisfies the constraints; raise it or give a start"
            ) from None
        if rig is None:
            raise_conflict(problem, time_limit_s=max(left_s, 1.0))
        else:
            rigs.append(rig)
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
        cut_dual=np.concatenate([price.cut_dual, np.maximum(problem.every_weight[unseen], 0.0)]),
        row_dual=price.row_dual / problem.row_scale,
    )
