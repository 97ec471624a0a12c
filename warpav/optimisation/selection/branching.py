"""Branch and bound on groups of cameras that see alike."""

from __future__ import annotations

import heapq
import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from warpav.optimisation.selection.exchange import exchange, random_rig
from warpav.optimisation.selection.price import Price
from warpav.optimisation.selection.problem import SelectionProblem
from warpav.optimisation.selection.relaxation import Node, Relaxation, Relaxed

TOLERANCE = 1e-9
"""Expected miss rates that differ by less count as equal."""

TRIALS = 8
"""Groups that are tried before one is branched on."""

LEAST_FRACTION = 0.02
"""How far the cameras that the relaxation takes from a group must be from a whole number, for it to be tried."""

ROUNDED_RIGS = 16
"""Rigs that are drawn from a fractional choice and exchanged."""

ROUNDING_EVERY = 8
"""Nodes from one such draw to the next."""


@dataclass(frozen=True)
class Improvement:
    """A better rig or a better bound.

    Attributes:
        cameras: The best rig so far, ascending, int [camera].
        objective: Its expected miss rate, 0..1.
        bound: No rig of the pool is below it.
        seconds: Wall time so far [s].
    """

    cameras: np.ndarray
    objective: float
    bound: float
    seconds: float


class Search:
    """The state of a search: the best rig, the bound, and the nodes that are open.

    At the root the relaxation holds all cameras; those whose choice would raise its bound above the best rig go out
    for good. Then the node of the lowest bound is relaxed and split: of some group of cameras a rig has at most k, or
    at least k + 1. Groups are the clusters of a tree over the detection probabilities, single cameras its leaves: to
    forbid one camera hardly matters as long as there are others like it, to forbid a whole sector does. Trial
    relaxations of few iterations choose the group.

    Attributes:
        rig: The best rig, int [camera].
        objective: Its expected miss rate.
        bound: No rig of the pool is below it.
        price: Duals of the root's bound; None before there is one.
        nodes: Number of nodes relaxed.
    """

    def __init__(
        self,
        problem: SelectionProblem,
        rigs: np.ndarray,
        *,
        gap: float,
        deadline_s: float,
        rng: np.random.Generator,
        on_improvement: Callable[[Improvement], None] | None,
    ) -> None:
        """Begin with rigs that satisfy the constraints, the required cameras first, int [rig, camera].

        Args:
            problem: What is chosen from.
            rigs: At least one.
            gap: Objective less bound at which the search ends, >= 0.
            deadline_s: When it ends, on the clock of `time.perf_counter`.
            rng: Draws rigs from fractional choices.
            on_improvement: Called with every better rig or bound.
        """
        self.rig, self.objective = np.sort(rigs[0]), problem.miss_rate(rigs[0])
        self.bound = _each_object_alone(problem)
        self.price: Price | None = None
        self.nodes = 0
        self._problem, self._kept = problem, np.arange(problem.camera_count)
        self._starts = rigs
        self._gap, self._deadline_s, self._rng = max(gap, TOLERANCE), deadline_s, rng
        self._on_improvement, self._began_s = on_improvement, time.perf_counter()

    def run(self) -> None:
        """Search until the gap is closed or the time is over; the attributes are valid at any time."""
        self._report()
        relaxation, root = self._root()
        if self._is_over:
            return
        tree = GroupTree(self._problem)
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
            self._raise_bound(min(closed, self.objective, open_nodes[0][0] if open_nodes else math.inf))

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
        starts = self._starts[:ROUNDED_RIGS]
        relaxation.add_cameras(np.unique(starts))
        relaxation.add_first_cuts(np.bincount(starts.ravel(), minlength=problem.camera_count) / len(starts))
        relaxed = relaxation.relax(root, self.objective)
        self.price = relaxed.price
        if relaxed.price is None:
            return relaxation, root
        self._round(relaxed.fraction)
        root, kept = _without_useless(root, relaxed, self.objective)
        self._raise_bound(min(relaxed.bound, self.objective))
        if self._is_over:
            return relaxation, root
        camera = np.flatnonzero(kept)
        self._problem, self._kept = problem.restricted(camera), camera
        smaller = Relaxation(self._problem, self._deadline_s)
        smaller.add_cameras(np.searchsorted(camera, np.intersect1d(relaxation.cameras, camera)))
        smaller.add_cuts(*relaxation.cuts)
        return smaller, replace(root, allowed=root.allowed[camera], required=root.required[camera])

    def _split(self, node: Node, relaxation: Relaxation, tree: GroupTree) -> tuple[list[Node], float]:
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
        if self.nodes % ROUNDING_EVERY == 0:
            self._round(relaxed.fraction)
        self._offer(np.argsort(-(relaxed.fraction + node.required), kind="stable")[: problem.count])
        node, _ = _without_useless(node, relaxed, self.objective)
        closed = self.objective  # of what went out
        if node.is_empty(problem.count):
            return [], closed
        branches = tree.branches(node, relaxed.fraction, relaxation, enough)
        return [_child(node, branch, tree, self._problem.count) for branch in branches], closed

    def _round(self, fraction: np.ndarray) -> None:
        drawn = [random_rig(self._problem, self._rng, fraction) for _ in range(ROUNDED_RIGS)]
        drawn = [rig for rig in drawn if rig is not None]
        if drawn:
            rigs, _ = exchange(self._problem, np.array(drawn))
            self._offer(rigs[0])

    def _offer(self, rig: np.ndarray) -> None:
        """Keep a rig of the restricted pool if it satisfies the constraints and is better."""
        value = self._problem.miss_rate(rig)
        if value < self.objective and self._problem.is_feasible(rig):
            self.rig, self.objective = np.sort(self._kept[rig]), value
            self._report()

    def _raise_bound(self, bound: float) -> None:
        if bound > self.bound:
            self.bound = bound
            self._report()

    def _report(self) -> None:
        if self._on_improvement is not None:
            seconds = time.perf_counter() - self._began_s
            self._on_improvement(Improvement(self.rig, self.objective, self.bound, seconds))


class GroupTree:
    """Nested groups of cameras that see alike: single cameras, and the clusters that Ward's method merges them into.

    Attributes:
        member: Cameras of the groups, the single ones first, bool [group, camera].
    """

    def __init__(self, problem: SelectionProblem) -> None:
        """Cluster the cameras of a pool."""
        from scipy.cluster.hierarchy import ward

        cameras = problem.camera_count
        member = np.zeros((max(2 * cameras - 1, 1), cameras), bool)
        member[:cameras] = np.eye(cameras, dtype=bool)
        if cameras > 1:
            seen = np.sqrt(problem.weight)[:, None] * (1.0 - problem.missed)
            square = seen.T @ seen
            length = np.diag(square)
            distance = np.sqrt(np.maximum(length[:, None] + length - 2.0 * square, 0.0))
            merged = ward(distance[np.triu_indices(cameras, 1)])[:, :2].astype(int)
            for k, (one, other) in enumerate(merged):
                member[cameras + k] = member[one] | member[other]
        self.member = member
        self._row: dict[int, int] = {}
        self._group: dict[int, int] = {}

    def members_of_row(self, row: int) -> np.ndarray:
        """Cameras of the group whose row of the relaxation this is, bool [camera]."""
        return self.member[self._group[row]]

    def branches(
        self, node: Node, fraction: np.ndarray, relaxation: Relaxation, enough: float
    ) -> list[dict[int, tuple[float, float]]]:
        """The two branches of the group whose trials rise most, by the product of both, each up to ``enough``."""
        taken = np.round(self.member @ fraction, 9)
        away = np.abs(taken - np.round(taken))
        group = np.flatnonzero(away > LEAST_FRACTION)
        _, first = np.unique(taken[group], return_index=True)  # nested groups with the same share of the choice
        group = group[first]
        inside = np.count_nonzero(self.member[group] & node.allowed, axis=1)
        size = np.minimum(inside, np.count_nonzero(node.allowed) - inside) + 1.0
        group = group[np.argsort(-away[group] * np.sqrt(size))[:TRIALS]]
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


def _child(node: Node, branch: dict[int, tuple[float, float]], tree: GroupTree, count: int) -> Node:
    ((row, (low, high)),) = branch.items()
    member = tree.members_of_row(row)
    allowed, required = node.allowed, node.required
    if high <= 0.0:
        allowed = allowed & ~member
    if low >= min(np.count_nonzero(member & allowed), count):
        required = required | (member & allowed)
    return Node(allowed, required, {**node.branch, **branch}, node.bound)


def _without_useless(node: Node, relaxed: Relaxed, objective: float) -> tuple[Node, np.ndarray]:
    """A node of the cameras that a rig better than the objective may have; those that it must have are required."""
    allowed = node.allowed & ((relaxed.bound + relaxed.rise_in < objective) | node.required)
    required = node.required | (allowed & (relaxed.bound + relaxed.rise_out >= objective))
    return Node(allowed, required, node.branch, relaxed.bound), allowed


def _each_object_alone(problem: SelectionProblem) -> float:
    """The bound where every object has the cameras that see it best."""
    best = np.partition(problem.missed, problem.count - 1, axis=1)[:, : problem.count]
    return problem.unseen + float(problem.weight @ np.prod(best, axis=1)) * (1.0 - 1e-12)
