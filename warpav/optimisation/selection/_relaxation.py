"""The linear relaxation of the choice: a live model of few cameras and few cuts, and bounds made of its duals.

Lower bounds on an object's miss probability that are linear in the choice: lifted tangents.

A rig S misses an object with probability ``u = exp(-sum of L)``, the sum over its cameras of ``L = -log(1 - p)``, which
is 0 for a camera that does not see the object and inf for one that never misses it. For any level z >= 0

    u >= (1 + z) exp(-z) - sum over S of phi(L),   phi(L) = exp(-z) L                    where L <= z,
                                                   phi(L) = (1 + z) exp(-z) - exp(-L)    where L > z.

Proof: where all L <= z this is the tangent of the exponential at z. Otherwise take one camera with L' > z: the right
side is ``exp(-L')`` less phi of the others. As ``phi(L) >= exp(-z) (1 - exp(-L))`` on both branches, and
``exp(-z) > exp(-L')``, it is at most ``exp(-L') (1 - sum over the others of (1 - exp(-L)))``, and so at most u.

At z = 0 it is ``u >= 1 - sum of p``, the submodular cut of the empty rig; for larger z it takes off a tangent what no
single camera can bring, so it is finite where p = 1. One condition gives the level that a fractional choice violates
most (`cut_level`), and for a whole rig that cut is tight.

Of an object that a camera and a LiDAR have to find, the miss probability is ``u = 1 - (1 - a)(1 - b)``, with a what all
cameras miss and b what all LiDARs miss. With p and q the most that cameras and that LiDARs of a rig find of it,

    u >= 1 - q (1 - a)   and   u >= 1 - p (1 - b),

the best such bounds, as the convex hull of a product has it (McCormick 1976); a and b have cuts as above. p and q are
those of a node, so with its LiDARs chosen the first is exact.

Sources: Nemhauser and Wolsey (1981), Maximizing submodular set functions: formulations and analysis of algorithms, for
z = 0; Ahmed and Atamtürk (2011), Maximizing a class of submodular utility functions, for the lifting of such cuts where
the function is a concave one of a sum.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import ArgumentError
from warpav.optimisation.selection._problem import SelectionProblem

if TYPE_CHECKING:
    import highspy


_MOST_LEVEL = 30.0  # greatest level [log of a miss probability]: such a cut asks for no more than 3e-12


def _cut_constant(level: np.ndarray) -> np.ndarray:
    """The right side for an empty rig, ``(1 + z) exp(-z)``, in the shape of the levels."""
    return (1.0 + level) * np.exp(-level)


def _cut_coefficient(missed: np.ndarray, log_missed: np.ndarray, level: np.ndarray) -> np.ndarray:
    """What a camera takes off the right side, phi(L), 0..1; concave and increasing in L."""
    decay = np.exp(-level)
    return np.where(log_missed <= level, decay * log_missed, decay * (1.0 + level) - missed)


def _cut_slope(missed: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Derivative of `_cut_coefficient` by the detection probability p = 1 - missed, exp(-z)..1; continuous."""
    decay = np.exp(-level)
    return np.where(missed >= decay, decay / np.maximum(missed, decay), 1.0)


def cut_level(fraction: np.ndarray, log_missed: np.ndarray) -> np.ndarray:
    """The level of the cut that a fractional choice violates most, for every object, 0..30, float64 [object].

    The derivative of the right side by z is ``exp(-z) (sum of x min(L, z) - z)``. Its bracket is concave in z and 0 at
    z = 0, so it is positive up to one root and negative beyond, or nowhere positive. Newton's steps from the right
    reach that root.
    """
    level = np.minimum(fraction @ np.minimum(log_missed, _MOST_LEVEL), _MOST_LEVEL)
    while True:
        is_above = log_missed > level
        share_above = fraction @ is_above
        sum_below = fraction @ np.where(is_above, 0.0, log_missed)
        root = np.where(share_above < 1.0, sum_below / np.maximum(1.0 - share_above, 1e-12), level)
        lower = np.minimum(root, level)
        if (lower >= level - 1e-9).all():
            return lower
        level = lower


@dataclass(frozen=True, eq=False)
class Price:
    """Duals of a bound on all rigs of a pool."""

    bound: float  # the bound, an expected miss rate
    object_count: int  # number of objects of the pool
    cut_object: np.ndarray  # objects of the cuts that hold it up, int [cut]
    cut_level: np.ndarray  # their levels, float64 [cut]
    cut_dual: np.ndarray  # their duals, > 0; an object's sum to its weight at most, float64 [cut]
    row_dual: np.ndarray  # what the bound rises by for a unit more of a row's limit, float64 [row]
    dearest: float  # cost of the dearest camera that the bound takes: who costs less would replace it

    def reduced_cost(self, detection_probability: np.ndarray, coefficient: np.ndarray | None = None) -> np.ndarray:
        """How much lower the bound would be with one more camera in the pool, if negative; float64 [camera].

        No rig of the pool and one such camera is below ``bound + min(0, reduced cost)``; the camera is taken to be free
        of conflicts, and to find what a camera and a LiDAR must find no surer than its kind in the pool.
        """
        missed = self._missed(detection_probability)
        with np.errstate(divide="ignore"):
            gain = _cut_coefficient(missed, -np.log(missed), self.cut_level) @ self.cut_dual
        return -gain - self.dearest - (0.0 if coefficient is None else np.asarray(coefficient) @ self.row_dual)

    def reduced_cost_slope(self, detection_probability: np.ndarray) -> np.ndarray:
        """Derivative of the reduced cost by each probability, <= 0 and continuous, float64 [camera, object]."""
        missed = self._missed(detection_probability)
        slope = np.zeros((len(missed), self.object_count))
        share = -self.cut_dual * _cut_slope(missed, self.cut_level)
        np.add.at(slope.T, self.cut_object, share.T)
        return slope

    def _missed(self, detection_probability: np.ndarray) -> np.ndarray:
        """1 - p for every cut, float64 [camera, cut]."""
        probability = np.asarray(detection_probability, np.float64)
        if probability.ndim != 2 or probability.shape[1] != self.object_count:
            raise ArgumentError(
                "detection_probability", f"expected [camera, {self.object_count}], got {list(probability.shape)}"
            )
        if not ((probability >= 0.0) & (probability <= 1.0)).all():
            raise ArgumentError("detection_probability", "expected probabilities 0..1, got others or NaN")
        return 1.0 - probability[:, self.cut_object]


ROUNDING = 1e-11  # what bounds are lowered by: more than some thousand sums of numbers up to 1 lose in double precision
_NEAR = 0.15  # part of what a node's bound lacks to the best rig that further rounds are not worth
_MOST_NEW_CAMERAS = 60  # cameras that enter the model in a round, those of the lowest reduced cost
_SOLVER_OPTIONS = {
    "threads": 1,
    "presolve": "off",
    "solver": "simplex",
    "simplex_scale_strategy": 0,
    "primal_feasibility_tolerance": 1e-9,
    "dual_feasibility_tolerance": 1e-9,
}
"""Of HiGHS."""
_TROUBLED_OPTIONS = {
    **_SOLVER_OPTIONS,
    "presolve": "on",
    "simplex_scale_strategy": 4,
    "primal_feasibility_tolerance": 1e-7,
    "dual_feasibility_tolerance": 1e-7,
}
"""Of HiGHS, where these fail: bounds do not rest on its tolerances."""
_LEAST_VIOLATION = 1e-8  # by how much a cut must be violated to be added: more than the solver allows itself
_MOST_IDLE_ROUNDS = 8  # rounds after which a cut without a dual leaves the model
_STRONG_ITERATIONS = 60  # simplex iterations that a trial of a branch may take


@dataclass(frozen=True, eq=False)
class Node:
    """A part of all rigs."""

    allowed: np.ndarray  # cameras that its rigs may have, bool [camera]
    required: np.ndarray  # cameras that all its rigs have, bool [camera]; allowed ones
    branch: Mapping[int, tuple[float, float]]  # bounds of groups of cameras
    bound: float  # no rig in it is known to have a lower expected miss rate

    def is_empty(self, count: int) -> bool:
        """Whether it has no rig of so many cameras, whatever the other constraints; branches can ask for too many."""
        required, allowed = np.count_nonzero(self.required), np.count_nonzero(self.allowed)
        return bool(required > count or allowed < count or (self.required & ~self.allowed).any())


@dataclass(frozen=True, eq=False)
class Relaxed:
    bound: float  # lower bound on the expected miss rate of the node's rigs; inf where it has none
    value: float = math.inf  # relaxed expected miss rate of the fractional choice
    fraction: np.ndarray = field(default_factory=lambda: np.zeros(0))  # the fractional choice, float64 [camera]
    rise_in: np.ndarray = field(default_factory=lambda: np.zeros(0))  # by how much the bound rises if a camera is taken
    rise_out: np.ndarray = field(default_factory=lambda: np.zeros(0))  # by how much it rises if a camera is left out
    price: Price | None = None  # the duals of the bound


class Relaxation:
    """Minimise the weighted sum of u, and the cameras' cost, under cuts, over shares 0..1 that keep count and rows.

    The model begins empty. Rounds add the cameras that its duals ask for and the cuts that its choice violates, those
    of cliques of conflicts among them. All of it serves every node, and the simplex goes on where it stopped.

    Bounds are not the solver's. For any duals >= 0 of the cuts, of which an object's sum to its weight at most, and any
    duals of the rows, the Lagrangian is a lower bound on every rig, and its minimum over choices of ``count`` cameras
    is a sort. So tolerances of the solver cost tightness and not validity.
    """

    def __init__(self, problem: SelectionProblem, deadline_s: float) -> None:
        import highspy

        class Silent(highspy.Highs):
            """A model that prints nothing: from HiGHS 1.16 on its first call, inside `Highs`, prints a banner."""

            def enableCallbacks(self) -> None:  # noqa: N802
                self.silent()
                super().enableCallbacks()

        self.problem = problem
        self._deadline_s = deadline_s
        with np.errstate(divide="ignore"):
            self._log_missed = -np.log(problem.missed)
        self._status = highspy.HighsModelStatus
        self._model = Silent()
        self._set_options(_SOLVER_OPTIONS)
        objects = problem.object_count
        self._model.addVars(objects, np.zeros(objects), np.full(objects, math.inf))
        cost = np.abs(problem.weight)
        cost[problem.both[:, 1:]] = 0.0  # they count by the first of the three, whose variable is u
        self._model.changeColsCost(objects, np.arange(objects, dtype=np.int32), cost)
        self.cameras = np.zeros(0, np.int64)  # of the model's columns behind those of the objects
        self._row = np.vstack([np.ones(problem.camera_count), problem.coefficient])  # the first is the count
        self._low = np.concatenate([[problem.count], problem.low])
        self._high = np.concatenate([[problem.count], problem.high])
        # rows of the model: cuts have an object and a level, others the index of their row
        self._cut_object = np.zeros(0, np.int64)
        self._cut_level = np.zeros(0)
        self._row_index = np.zeros(0, np.int64)
        self._idle = np.zeros(0, np.int64)
        self._in_force: set[int] = set()
        self._place_rows(range(len(self._row)))
        self._found = np.ones((len(problem.both), 2))  # p and q of the node
        self._links = self._link_rows()

    def _link_rows(self) -> np.ndarray:
        """Rows of the model that hold u to what cameras miss, and to what LiDARs miss, int [both, 2]."""
        both, first = self.problem.both, len(self._cut_object)
        no_camera = self.add_row(np.zeros(self.problem.camera_count), 0.0, 0.0) if len(both) else 0
        for every, *sides in both:
            for side in sides:
                self._model.addRow(0.0, math.inf, 2, np.array([every, side], np.int32), np.array([1.0, -1.0]))
        self._note_rows(np.full(2 * len(both), -1), np.zeros(2 * len(both)), np.full(2 * len(both), no_camera))
        return first + np.arange(2 * len(both)).reshape(-1, 2)

    def _set_links(self, node: Node) -> None:
        found = self.problem.most_found(node.allowed, node.required)
        for k, side in np.argwhere(found != self._found):
            of_other, row, column = float(found[k, side]), int(self._links[k, 1 - side]), self.problem.both[k, 2 - side]
            self._model.changeCoeff(row, int(column), -of_other)
            self._model.changeRowBounds(row, 1.0 - of_other, math.inf)
        self._found = found

    def add_cameras(self, camera: np.ndarray) -> None:
        """Add columns of cameras, int [added], that the model does not have."""
        coefficient = np.empty((len(self._cut_object), len(camera)))
        is_cut = self._cut_object >= 0
        coefficient[is_cut] = self._coefficient(self._cut_object[is_cut], camera, self._cut_level[is_cut])
        coefficient[~is_cut] = self._row[self._row_index[~is_cut]][:, camera]
        start, index, value = _sparse(coefficient.T, np.arange(len(coefficient)))
        zeros = np.zeros(len(camera))
        self._model.addCols(len(camera), self.problem.cost[camera], zeros, zeros + 1.0, len(value), start, index, value)
        self.cameras = np.concatenate([self.cameras, camera])

    def add_cuts(self, cut_object: np.ndarray, level: np.ndarray) -> None:
        """Add cuts of objects, int [added], at their levels, float64 [added]."""
        columns = np.concatenate([[0], self.problem.object_count + np.arange(len(self.cameras))])
        coefficient = np.hstack([np.ones((len(level), 1)), self._coefficient(cut_object, self.cameras, level)])
        start, index, value = _sparse(coefficient, columns)
        index[start] = cut_object
        high = np.full(len(level), math.inf)
        self._model.addRows(len(level), _cut_constant(level), high, len(value), start, index, value)
        self._note_rows(cut_object, level, np.full(len(level), -1))

    def add_row(self, coefficient: np.ndarray, low: float = -math.inf, high: float = math.inf) -> int:
        """Add a linear row over all cameras, [camera]; returns the index that branches know it by."""
        self._row = np.vstack([self._row, coefficient])
        self._low, self._high = np.append(self._low, low), np.append(self._high, high)
        return len(self._row) - 1

    @property
    def cuts(self) -> tuple[np.ndarray, np.ndarray]:
        """Objects and levels of the cuts that had a dual lately, int and float64 [cut]."""
        is_kept = (self._cut_object >= 0) & (self._idle < 2)
        return self._cut_object[is_kept], self._cut_level[is_kept]

    def relax(self, node: Node, enough: float) -> Relaxed:
        if node.is_empty(self.problem.count):  # the model may lack the cameras that would show it
            return Relaxed(math.inf)
        self._drop_idle_cuts()
        self._enter(node)
        best = Relaxed(node.bound)
        in_model = np.zeros(self.problem.camera_count, bool)
        while True:
            in_model[self.cameras] = True
            status = self._solve()
            if status == self._status.kInfeasible:
                missing = np.flatnonzero(node.allowed & ~in_model)
                if not len(missing):
                    return Relaxed(math.inf)
                self.add_cameras(missing)
                self._enter(node)
                continue
            if status in (self._status.kTimeLimit, self._status.kUnknown, self._status.kSolveError):
                return best  # what earlier duals have proven
            if status != self._status.kOptimal:
                raise RuntimeError(f"HiGHS ended with {self._model.modelStatusToString(status)}")
            solution = self._model.getSolution()
            dual, value = np.array(solution.row_dual), np.array(solution.col_value)
            self._idle = np.where(np.abs(dual) > 1e-12, 0, self._idle + 1)
            fraction = np.zeros(self.problem.camera_count)
            fraction[self.cameras] = np.clip(value[self.problem.object_count :], 0.0, 1.0)
            support = np.flatnonzero(fraction > 1e-9)
            level, missed = self.most_violated(fraction, support)
            relaxed_value = self._missed_by(missed) + float(self.problem.cost @ fraction)
            relaxed, cost = self._bound(node, dual, fraction, relaxed_value)
            if relaxed.bound >= best.bound or best.price is None:
                best = relaxed
            else:  # the choice is newer, the duals are better
                best = Relaxed(best.bound, relaxed.value, fraction, best.rise_in, best.rise_out, best.price)
            cliques = self._violated_cliques(fraction, support, node)
            near = max(_NEAR * (enough - best.bound), _LEAST_VIOLATION)
            if best.bound >= enough or (best.value - best.bound < near and not cliques):
                return best
            wanted = np.flatnonzero(node.allowed & ~in_model & (cost < dual[0] - 1e-9))
            wanted = wanted[np.argsort(cost[wanted])[:_MOST_NEW_CAMERAS]]
            violated = np.flatnonzero(self._lacking(missed, value) > min(near, 1e-4))
            if not (len(wanted) or len(violated) or cliques):
                return best
            if len(wanted):
                self.add_cameras(wanted)
                self._enter(node)
            if len(violated):
                self.add_cuts(violated, level[violated])
            self._place_rows([self.add_row(clique, high=1.0) for clique in cliques])

    def try_branches(self, node: Node, branches: Iterable[Mapping[int, tuple[float, float]]]) -> list[float]:
        """About the relaxed objective of a node with one more branch each, after a few iterations; inf: no choice."""
        branches = list(branches)
        self._place_rows({k for branch in branches for k in branch} - set(self._row_index))
        self._enter(node)
        self._solve()
        basis = self._model.getBasis()
        self._model.setOptionValue("simplex_iteration_limit", _STRONG_ITERATIONS)
        found = []
        for branch in branches:
            self._set_branches({**node.branch, **branch})
            self._model.setBasis(basis)
            is_infeasible = self._solve() == self._status.kInfeasible
            found.append(math.inf if is_infeasible else self.problem.unseen + self._model.getObjectiveValue())
        self._model.setOptionValue("simplex_iteration_limit", 2**31 - 1)
        self._set_branches(node.branch)
        return found

    def _solve(self) -> highspy.HighsModelStatus:
        left_s = self._deadline_s - time.perf_counter()
        if left_s <= 0.0:
            return self._status.kTimeLimit
        self._model.setOptionValue("time_limit", self._model.getRunTime() + left_s)
        self._model.run()
        status = self._model.getModelStatus()
        for options in (_SOLVER_OPTIONS, _TROUBLED_OPTIONS):  # numerical trouble: from a basis of its own
            if status not in (self._status.kUnknown, self._status.kSolveError):
                break
            self._model.clearSolver()
            self._set_options(options)
            self._model.run()
            status = self._model.getModelStatus()
            self._set_options(_SOLVER_OPTIONS)
        return status

    def _set_options(self, options: Mapping[str, Any]) -> None:
        for option, value in options.items():
            self._model.setOptionValue(option, value)

    def _coefficient(self, cut_object: np.ndarray, camera: np.ndarray, level: np.ndarray) -> np.ndarray:
        """Of cuts, float64 [cut, camera]."""
        part = np.ix_(cut_object, camera)
        return _cut_coefficient(self.problem.missed[part], self._log_missed[part], level[:, None])

    def most_violated(self, fraction: np.ndarray, support: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Levels of the most violated cuts, and what they ask of u, float64 [object] each."""
        log_missed, missed = self._log_missed[:, support].T, self.problem.missed[:, support].T
        level = cut_level(fraction[support], log_missed)
        least = _cut_constant(level) - fraction[support] @ _cut_coefficient(missed, log_missed, level)
        return level, np.maximum(least, 0.0)

    def _linked(self, missed: np.ndarray) -> np.ndarray:
        """What links ask of u where sides miss so much, [object]; float64 [both, 2]."""
        return 1.0 - self._found[:, ::-1] * (1.0 - missed[self.problem.both[:, 1:]])

    def _missed_by(self, missed: np.ndarray) -> float:
        """The relaxed expected miss rate of what each object is missed with, float64 [object]."""
        problem, value = self.problem, missed.copy()
        value[problem.both[:, 0]] = self._linked(missed).max(axis=1, initial=0.0)
        weight = np.abs(problem.weight)
        weight[problem.both[:, 1:]] = 0.0
        return problem.unseen + float(weight @ value)

    def _lacking(self, missed: np.ndarray, value: np.ndarray) -> np.ndarray:
        """By how much the model's variables violate what they are missed with, both float64 [object]."""
        both, lacking = self.problem.both, missed - value[: self.problem.object_count]
        lacking[both[:, 1:]] = self._linked(missed) - value[both[:, :1]]
        lacking[both[:, 0]] = 0.0
        return lacking

    def _bound(self, node: Node, dual: np.ndarray, fraction: np.ndarray, value: float) -> tuple[Relaxed, np.ndarray]:
        """The Lagrangian bound of duals, and every camera's cost in it, float64 [camera]."""
        problem = self.problem
        cut = np.flatnonzero((self._cut_object >= 0) & (dual > 0.0))
        cut_object, level, cut_dual = self._cut_object[cut], self._cut_level[cut], dual[cut]
        total = np.bincount(cut_object, cut_dual, problem.object_count)
        weight, both = problem.weight.copy(), problem.both
        link_dual = np.maximum(dual[self._links], 0.0)
        link_dual *= np.minimum(1.0, -weight[both[:, :1]] / np.maximum(link_dual.sum(axis=1, keepdims=True), 1e-300))
        weight[both[:, 0]] = 0.0
        weight[both[:, 1:]] = link_dual * self._found[:, ::-1]
        cut_dual *= np.minimum(1.0, weight / np.maximum(total, 1e-300))[cut_object]
        allowed = np.flatnonzero(node.allowed)
        gain = cut_dual @ self._coefficient(cut_object, allowed, level)

        is_row = self._row_index > 0  # the count is kept exactly, below
        row, row_dual = self._row_index[is_row], dual[is_row]
        low, high = self._low.copy(), self._high.copy()
        for k, (least, most) in node.branch.items():
            low[k], high[k] = least, most
        limit = np.where(row_dual > 0.0, low[row], high[row])
        row, row_dual, limit = (each[np.isfinite(limit)] for each in (row, row_dual, limit))

        cost = np.full(problem.camera_count, math.inf)
        cost[allowed] = problem.cost[allowed] - gain - row_dual @ self._row[np.ix_(row, allowed)]
        free = np.where(node.required, math.inf, cost)
        order = np.argsort(free, kind="stable")
        left = problem.count - int(np.count_nonzero(node.required))
        taken = order[:left]
        bound = problem.unseen + float(cut_dual @ _cut_constant(level) + row_dual @ limit)
        bound += float((link_dual * (1.0 - self._found[:, ::-1])).sum())
        bound += float(cost[node.required].sum() + free[taken].sum()) - ROUNDING
        dearest = free[order[left - 1]] if left else -math.inf
        next_cost = free[order[left]] if left < len(order) else math.inf
        rise_in = np.maximum(free - dearest, 0.0)
        rise_in[node.required] = 0.0
        rise_out = np.zeros(problem.camera_count)
        rise_out[taken] = next_cost - free[taken]
        rise_out[node.required] = math.inf
        behind = max(node.bound - bound, 0.0)  # the rises count from the Lagrangian, not from the node's bound
        rise_in, rise_out = np.maximum(rise_in - behind, 0.0), np.maximum(rise_out - behind, 0.0)
        whole_row_dual = np.zeros(len(problem.coefficient))
        is_named = row <= len(whole_row_dual)
        whole_row_dual[row[is_named] - 1] = row_dual[is_named]
        price = Price(bound, problem.object_count, cut_object, level, cut_dual, whole_row_dual, float(dearest))
        return Relaxed(max(bound, node.bound), value, fraction, rise_in, rise_out, price), cost

    def _violated_cliques(self, fraction: np.ndarray, support: np.ndarray, node: Node) -> list[np.ndarray]:
        """Sets of cameras that exclude each other and of which the choice has more than one, grown greedily."""
        if not self.problem.conflict.nnz:
            return []
        order = support[np.argsort(-fraction[support])]
        excludes = self.problem.conflict[order][:, order].toarray()
        found = set()
        for first in range(len(order)):
            clique, common = [first], excludes[first].copy()
            while common.any():
                clique.append(int(np.argmax(common)))  # the largest share comes first
                common &= excludes[clique[-1]]
            if fraction[order[clique]].sum() > 1.0 + 1e-6:
                found.add(tuple(sorted(clique)))
        return [self.problem.whole_clique(order[list(clique)], node.allowed) for clique in sorted(found)]

    def _enter(self, node: Node) -> None:
        columns = (self.problem.object_count + np.arange(len(self.cameras))).astype(np.int32)
        low, high = node.required[self.cameras].astype(float), node.allowed[self.cameras].astype(float)
        self._model.changeColsBounds(len(columns), columns, low, high)
        self._set_branches(node.branch)
        self._set_links(node)

    def _set_branches(self, branch: Mapping[int, tuple[float, float]]) -> None:
        missing = [k for k in branch if k not in self._row_index]
        self._place_rows(missing)
        for k in self._in_force | set(branch):
            place = np.flatnonzero(self._row_index == k)
            if len(place):
                low, high = branch.get(k, (self._low[k], self._high[k]))
                self._model.changeRowBounds(int(place[0]), float(low), float(high))
        self._in_force = set(branch)

    def _place_rows(self, rows: Iterable[int]) -> None:
        for k in rows:
            columns = self.problem.object_count + np.arange(len(self.cameras))
            _, index, value = _sparse(self._row[k, self.cameras][None], columns)
            self._model.addRow(self._low[k], self._high[k], len(value), index, value)
            self._note_rows(np.array([-1]), np.zeros(1), np.array([k]))

    def _note_rows(self, cut_object: np.ndarray, level: np.ndarray, row: np.ndarray) -> None:
        self._cut_object = np.concatenate([self._cut_object, cut_object])
        self._cut_level = np.concatenate([self._cut_level, level])
        self._row_index = np.concatenate([self._row_index, row])
        self._idle = np.concatenate([self._idle, np.zeros(len(level), np.int64)])

    def _drop_idle_cuts(self) -> None:
        is_group = np.isinf(self._low[self._row_index]) & np.isinf(self._high[self._row_index])
        is_idle = (self._idle > _MOST_IDLE_ROUNDS) & ((self._cut_object >= 0) | is_group)
        if np.count_nonzero(is_idle) < 0.15 * len(is_idle):
            return
        dropped = np.flatnonzero(is_idle).astype(np.int32)
        self._model.deleteRows(len(dropped), dropped)
        for name in ("_cut_object", "_cut_level", "_row_index", "_idle"):
            setattr(self, name, getattr(self, name)[~is_idle])


def _sparse(dense: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Starts, indices and values of the rows of a matrix, [row, column]; columns are renamed."""
    is_kept = dense != 0.0
    start = np.concatenate([[0], np.cumsum(np.count_nonzero(is_kept, axis=1))[:-1]]).astype(np.int32)
    return start, np.broadcast_to(column, dense.shape)[is_kept].astype(np.int32), dense[is_kept]
