"""The search for a rig: render a pool of cameras, select a rig with a proven bound, polish it, price further cameras.

The cameras of the start are the pool's first, and rendered before the others: so there is a rig from the beginning.
The pool makes the choice global: a few hundred single cameras stand for every rig that can be made of them, and an
integer programme finds the best one and proves how far off it can be. The gradient makes it exact: `polish` moves all
cameras of the chosen rig at once, on all scenes, below what the pool itself can reach. Then the duals of the selection
price cameras that the pool does not have: gradient ascent looks for those that would lower the bound most, they and the
polished ones join the pool, and the selection has the next word. Where more may be spent, single cameras are polished
from other places, and the pool is refined around the rig, as the objective is rougher than the steps of a gradient.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from scipy import sparse

from warpav.core.errors import ArgumentError, InputError, OptionError
from warpav.core.progress import Progress
from warpav.detection import SUREST, expected_miss_rate, false_alarm_cost, shares_of
from warpav.optimisation._camera_loss import OTHERS, RobustObjective, RobustValue, exchange_robust, select_robust
from warpav.optimisation._constraints import Constraints, too_near
from warpav.optimisation._hand_rigs import HandRig, by_hand
from warpav.optimisation._mount import MOUNT_POSE_SIZE, X_M, Y_M
from warpav.optimisation._mount_errors import MountErrors
from warpav.optimisation._objective import RigObjective, single_cameras_of
from warpav.optimisation._polish import Detected, PolishSteps, PolishTask, nearest_rig, polish, step_unit
from warpav.optimisation._pool import SLOPE_COST, CameraPool, Drawing, Pace, spread_mount_poses
from warpav.optimisation._pool_cache import rows_of
from warpav.optimisation._pool_rules import PoolRules
from warpav.optimisation._replacements import Assembly, Replacements, apart
from warpav.optimisation._required_points import RequiredPoints
from warpav.optimisation._rig_limits import RigLimits
from warpav.optimisation._single_cameras import MisplacedCameras, SingleCameras, hard_points
from warpav.optimisation._tangent_model import HardPoints
from warpav.optimisation.losses._scene_on_tape import AssignedScene
from warpav.optimisation.selection._problem import Row, SelectionProblem, exchange, feasible_rig
from warpav.optimisation.selection._relaxation import Price
from warpav.optimisation.selection._select import Selection, select
from warpav.scene import DeviceScene
from warpav.sight import AZIMUTH_STEP_RAD, NEAR_M

_Known = tuple[np.ndarray, float]  # cameras of a rig of the pool, int [camera], and its objective
_Stage = Literal["start", "selection", "polish", "pricing", "settled"]
_START_NAME = "scenes seen by the start"  # what progress calls them
_POOL_SHARE = 0.45
"""Of a budget, the share of the first pool; more where less than the rest is enough for a round with its polishes."""
_PRICED_STEPS = 3  # steps of the ascent of the prices
_FIRST_POLISH, _FURTHER_POLISH, _LAST_POLISH = (10, 1.0), (10, 0.4), (6, 0.2)
"""Steps and first radius of a polish: of the first selected rig, in a round of pricing, and at the end."""
WHOLE_POLISH = (40, 1.0)  # of a rig by hand where there is no pool
_BEHIND_MAX = 0.01  # how far behind the best a polish may be, relatively, after half of its steps
_GAP_ON_THE_WAY = 3e-3
"""Objective less bound at which a selection ends whose rig is polished next: about what the relaxation alone proves."""
_REPLACEMENTS, _REPLACEMENT_POLISH, _VAIN_REPLACEMENTS = 4, (12, 0.4), 2
"""Single cameras that are polished from elsewhere at a time, their steps and first radius, and how often in vain."""
_NEAR_CAMERAS = 16  # cameras that are drawn around each of the rig's at a time
_REFINED_FROM, _REFINED_TO = 0.4, 0.01
"""Radii of these, in units of the polish: halved whenever nothing better is found."""
_PRICE, _LOOSER_GAP_PRICE = 0.01, 0.0025
"""Shares of the objective that the rules of gap and near ground together may cost; and a gap wider than asked for."""
_POLISHED_BY_HAND = 3  # rigs by hand that are polished
_SAME = 1e-6  # the polish and the pool round differently
_TOLD = {
    "select": "selecting",
    "select_and_polish": "selecting",
    "polish": "polishing",
    "price": "pricing",
    "replaced": "replacing cameras",
    "nearby": "looking nearby",
}
"""What progress calls the stages that take long."""
_HAND_CAMERAS, _ROUNDED_TIMES = 40, 8
"""Cameras that rigs by hand draw, and how often each camera of the rig is drawn to be rounded, about."""
_KEPT = ("pool", "rig", "objective", "bound", "price", "round", "_under", "_row_points")
"""What a search knows between two stages, besides these, places and random numbers."""


@dataclass(frozen=True)
class PoolSearchSettings:
    """How much the search looks at."""

    pool_cameras: int = 128  # single cameras of the first pool, at least as many as the rig has
    rounds: int = 4  # how often further cameras are priced, at most
    priced_cameras: int = 8  # cameras that a round follows along their prices, each for a few steps
    gap: float = 5e-4  # objective less bound at which the last selection ends, an expected miss rate
    # how often other places for single cameras and places near the best rig's are looked at when rounds bring nothing
    # more, at most
    refinements: int = 0
    selection_time_s: float = 20.0  # when a selection ends at the latest [s]
    camera_renders_max: int | None = None  # camera renders (one camera, one scene) that may be spent
    polishes: bool = True  # whether selected rigs are polished
    selects: bool = True  # whether there is a pool to select from; else rigs by hand are polished, one after the other


@dataclass(frozen=True, eq=False)
class PoolTask:
    """What a search looks for."""

    cameras: SingleCameras  # what the cameras are, and how likely one is to detect
    scenes: Sequence[DeviceScene]  # the scenes, on the device of the mount
    constraints: Constraints  # where cameras may stand; frozen cameras are part of every rig
    camera_count: int  # cameras of the rig, frozen ones among them
    start: np.ndarray | None = None  # a rig whose cameras join the pool, so that the result is not worse
    object_weight: np.ndarray | None = None  # of the objects of all scenes, or their columns, of a sum above 0
    charge: np.ndarray | None = None  # for false alarms at these, see `false_alarm_cost`; None: nothing
    limits: RigLimits | None = None  # how many cameras of each of the mount's modules a rig may have
    requirements: RequiredPoints | None = None  # points that have to be seen near the vehicle besides
    robust: RobustObjective | None = None  # what is minimised instead of the expected miss rate, see `camera_loss`
    rules: PoolRules | None = None  # design rules that every rig keeps
    starts_by_hand: bool = False  # whether rigs by hand are tried first, and the best of them polished
    mount_errors: MountErrors | None = None  # over which every camera's probabilities are averaged, see `mount_errors`

    @classmethod
    def of(cls, objective: RigObjective, scenes: Sequence[AssignedScene], **others: Any) -> PoolTask:  # noqa: ANN401
        """The task of an objective on some scenes; ``others`` are further attributes."""
        cameras = single_cameras_of(objective)
        if cameras is None:
            raise OptionError(
                "optimiser.search",
                "expected descent, as a pool knows the loss expected_miss_rate alone, with combine=any and "
                f"detector_share=0, got {', '.join(loss.name for _, loss in objective.losses)}; set "
                "optimiser.search=descent",
            )
        limits = others.get("limits")
        count = objective.camera_count if limits is None else limits.count[1]
        weight = objective.object_weight(scenes)
        packed = [each.scene for each in scenes]
        charge = None if others.get("robust") else objective.charge_of(packed)
        return cls(cameras, packed, objective.constraints, count, object_weight=weight, charge=charge, **others)

    @property
    def object_count(self) -> int:
        """Objects of the scenes, or their columns, without the requirements' points."""
        return sum(map(self.cameras.column_count, self.scenes))

    @property
    def whole_weight(self) -> np.ndarray | None:
        """Weights of the objects and of the requirements' points behind them, float64 [object]; None: all alike."""
        if self.requirements is None:
            return self.object_weight
        alike = np.full(self.object_count, 1.0 / max(self.object_count, 1))
        share = alike if self.object_weight is None else self.object_weight / self.object_weight.sum()
        return np.concatenate([share, self.requirements.weight])

    @property
    def whole_charge(self) -> np.ndarray | None:
        """The charge beside `whole_weight`, and nothing for the requirements' points, float64 [object]."""
        points, weight = self.requirements, self.whole_weight
        if self.charge is None or points is None or weight is None:
            return self.charge
        return np.pad(self.charge, (0, points.vehicle_count)) / weight.sum()


@dataclass(frozen=True, eq=False)
class Found:
    """The state of a search: at every moment the best rig, and what is proven."""

    mount_pose: np.ndarray  # the best rig so far, which satisfies all constraints, float32 [camera, 7]
    objective: float  # its expected miss rate on the scenes of the search, or its robust objective
    bound: float  # no rig of cameras of the pool is below it; 0 before the first selection
    stage: _Stage  # what has just been done; ``settled`` where nothing is left to do
    camera_renders: int  # camera renders so far, those that the cache has spared among them
    pool_cameras: int  # cameras of the pool; at the start those of the start alone, where the others are drawn next
    seconds: float  # wall time so far [s]
    pool: CameraPool = field(repr=False)  # the cameras that the search knows, those of the best rig among them
    round: int = 0  # of pricing, from 0
    robust: RobustValue | None = None  # what the objective is made of where it is a robust one, else None
    # whether the same search always comes to this state: not after a selection that Ctrl-C has ended
    is_final: bool = True

    @property
    def gap(self) -> float:
        """Objective less bound; negative where the polish has gone below what the pool can reach."""
        return self.objective - self.bound


class PoolSearch:
    """A search for the rig with the lowest expected miss rate: an iterator of `Found`, whose objectives never rise.

    Stop any time: the last value is the best. Whatever was rendered joins the pool, so that each selection chooses
    among all that is known.

    A search is a list of short stages (``_todo``), each of which may put others in front. Between two stages all that
    it knows is the pool and a few numbers (`position`). Within a stage nothing is random, so that a search that is
    stopped goes on from the stage's beginning to the same rigs, to the bit.
    """

    def __init__(
        self,
        task: PoolTask,
        settings: PoolSearchSettings | None = None,
        *,
        seed: int = 0,
        drawing: Drawing | None = None,
        progress: Progress | None = None,
        pool: CameraPool | None = None,
    ) -> None:
        settings = settings or PoolSearchSettings()
        if settings.selects and settings.pool_cameras < task.camera_count:
            expected = f"expected at least the rig's {task.camera_count}, got {settings.pool_cameras}"
            raise ArgumentError("pool_cameras", expected)
        if not settings.selection_time_s > 0.0:  # before anything is drawn
            raise ArgumentError("selection_time_s", f"expected more than 0 s, got {settings.selection_time_s:g}")
        self.task, self.settings, self.seed = task, settings, seed
        self.designed = task.cameras if pool is None or task.mount_errors else pool.cameras
        self.cameras = (
            self.designed if task.mount_errors is None else MisplacedCameras.of(self.designed, task.mount_errors)
        )
        self.constraints, self.points = task.constraints.of_any_modules, task.requirements
        # the scenes, and the requirements' points behind them
        self.scenes = (*task.scenes, *([] if self.points is None else [self.points]))
        self.camera_count, self.limits = task.camera_count, task.limits
        self.rules, self._rule_rows = task.rules, list[str]()
        self.hand_rigs = list[HandRig]()
        self.object_weight, self.charge, self.robust = task.whole_weight, task.whole_charge, task.robust
        self.assembly = Assembly(self.cameras.mount)
        # the cameras that it knows
        self.pool = CameraPool.empty(self.scenes, self.cameras, drawing) if pool is None else pool
        self.rig: np.ndarray | None = None
        self.objective = np.inf
        self.bound: float | None = None
        self.price: Price | None = None
        self.round = 0
        self._progress = progress
        self._row_points = np.zeros(0, int)
        self._began = time.perf_counter()
        self._pace = Pace()
        self._under: PoolSearchSettings | None = None  # those under which pricing brought nothing more
        self._rng, self._places = np.random.default_rng([seed, 1]), list[np.ndarray]()
        self._todo: list[tuple[Any, ...]] = [("begin",)]
        self._states = self._run()
        self._boundary = self.position()  # where the present stage began

    def __iter__(self) -> PoolSearch:
        return self

    def __next__(self) -> Found:
        return next(self._states)

    def _run(self) -> Iterator[Found]:
        while self._todo:
            self._boundary = self.position()
            stage, *given = self._todo.pop(0)
            if self._progress is not None and stage in _TOLD:
                self._progress.stage(_TOLD[stage] + self._pace.left_text(self.pool, sum(self._planned())))
            yield from getattr(self, f"_{stage}")(*given) or ()

    def position(self) -> dict[str, Any]:
        """All that it knows between two stages."""
        known: dict[str, Any] = {name: getattr(self, name) for name in _KEPT}
        rules = self.rules
        levels = rules and [rules.gap_steps, rules.near_level, list(self._rule_rows), rules.price_of_gap]
        known |= {"todo": list(self._todo), "places": list(self._places), "rules": levels}
        return known | {"rng": self._rng.bit_generator.state}

    def _found(self, stage: _Stage, *, is_final: bool = True) -> Found:
        assert self.rig is not None
        return Found(
            self.rig,
            self.objective,
            self.bound or 0.0,
            stage,
            self.camera_renders,
            len(self.pool.mount_pose),
            time.perf_counter() - self._began,
            self.pool,
            self.round,
            self._robust_value(self._rows_of_best()),
            is_final,
        )

    def _robust_value(self, row: np.ndarray) -> RobustValue | None:
        """Of a rig of the pool, int [camera]; None where the objective is the expected miss rate alone."""
        if self.robust is None:
            return None
        share, size = shares_of(self.object_weight), self._sizes(self.pool.mount_pose[row])
        return self.robust.of_rig(self.pool.detection_probability[row], share, size)

    def _sizes(self, mount_pose: np.ndarray, absent: int = 0) -> np.ndarray:
        """How many cameras rows of the pool stand for, int [camera]; see `_limit_rows`."""
        return np.append(1 + self.cameras.mount.is_pair(mount_pose).astype(int), np.zeros(absent, int))

    def _begin(self) -> Iterator[Found]:
        mount, start = self.cameras.mount, self.task.start
        spread_count = self.settings.pool_cameras if self.settings.selects else 0
        first = self.assembly.frozen
        if start is not None:
            start = nearest_rig(start, mount, self.constraints)
            first = self.assembly.in_order(start)
        limit = self.settings.camera_renders_max
        if limit is not None:
            most = max(self._first_share(limit) // len(self.scenes), self.camera_count)
            spread_count = min(spread_count, most - len(first))
        if len(first) + spread_count < self.camera_count:
            expected = f"expected enough for a pool of {self.camera_count} cameras in {len(self.scenes)} scenes"
            raise ArgumentError("camera_renders_max", f"{expected}, got {limit}")
        spread, pool = np.zeros((0, MOUNT_POSE_SIZE), np.float32), self.pool
        if len(pool.mount_pose):
            new = first[rows_of(first, pool.mount_pose) < 0]
            self.pool = pool.extended(new, progress=self._progress) if len(new) else pool
        else:
            if spread_count > 0:
                allowed = None if self.rules is None else self.rules.allowed
                spread = spread_mount_poses(mount, self.constraints, spread_count, seed=self.seed, allowed=allowed)
                if self.rules is not None and len(spread) < self.camera_count - len(self.assembly.frozen):
                    self.rules.refuse(spread_mount_poses(mount, self.constraints, 64, seed=self.seed), len(spread))
            if start is None:
                self.pool = pool.extended(np.concatenate([first, spread]), progress=self._progress)
            else:
                self._pace.begin(pool.drawn_count)
                told = {"progress": self._progress, "name": _START_NAME}
                self.pool = pool.extended(first, may_see_nothing=len(spread) > 0, **told)
            if self._progress is not None and len(spread):
                with_points = self.points is not None
                forecast = self._pace.forecast(self.pool, *self._planned(), with_points=with_points)
                self._progress.say(f"{'forecast':<12} {forecast}")
        if start is not None:
            if self.rules is None and not self.task.starts_by_hand:  # levels of rules follow from the pool
                yield from self._offered(start, first)
            if len(spread):
                self.pool = self.pool.extended(spread, progress=self._progress)
        if self.points is not None:
            found = self.pool.detection_probability[:, -self.points.vehicle_count :]
            seen = partial(self.cameras.visibility, self.pool.mount_pose, self.points)
            self.points.check(found, seen, self.camera_count)
        if self.task.starts_by_hand:
            self.try_by_hand()
        if self.rules is not None:
            self._settle_rules(self.rules)
        by_hand = self._best_by_hand()
        self._pace.learn(self.pool, cost=SLOPE_COST)
        if start is not None and (self.rules is not None or self.task.starts_by_hand):
            yield from self._offered(start, first)
        self._todo = [("improve", by_hand[:_POLISHED_BY_HAND])]
        if not self.settings.selects:
            self._todo = [*(("polish", rig, *WHOLE_POLISH) for rig in by_hand), ("note",), ("settle",)]

    def _offered(self, start: np.ndarray, rows: np.ndarray) -> Iterator[Found]:
        """The start as the first rig, where it keeps what rigs must keep, unless there is one already."""
        if self.rig is None:
            self._is_better(start, self._value_of(rows))
        if self.rig is not None:
            yield self._found("start")

    def try_by_hand(self) -> None:

        def values_of(rigs: Sequence[np.ndarray]) -> list[float]:
            new = np.unique(np.concatenate(rigs), axis=0)
            if self._affordable(len(new)) < len(new):
                return [np.inf] * len(rigs)
            self.pool = self.pool.extended(np.concatenate(rigs))
            return [self._value_of(rig) for rig in rigs]

        if self._progress is not None:
            self._progress.stage("rigs by hand")
        found = by_hand(self.cameras.mount, self.task.constraints, self.camera_count, values_of)
        if self._progress is not None and found:
            self._progress.say(f"{'by hand':<12} objective {found[0].value:.4f}  {found[0]}")
        self.hand_rigs = [replace(each, mount_pose=self.assembly.rig(each.mount_pose)) for each in found]

    def _best_by_hand(self) -> list[list[list[float]]]:
        """Of every kind the best of those rigs that keeps the rules, and whose cameras stand apart."""
        kept = dict[str, list[list[float]]]()
        for each in self.hand_rigs:
            rig, is_known = each.mount_pose, each.name in kept
            if is_known or each.value == np.inf or too_near(rig, self.constraints).nnz or not self._keeps_rules(rig):
                continue
            kept[each.name] = rig.tolist()
            self._is_better(rig, each.value)
        return list(kept.values())

    def _value_of(self, rig: np.ndarray) -> float:
        """The objective of a rig of the pool, float32 [camera, 7]."""
        row = rows_of(rig, self.pool.mount_pose)
        robust = self._robust_value(row)
        if robust is not None:
            return robust.objective
        found = self.pool.detection_probability[row]
        return expected_miss_rate(found, shares_of(self.object_weight)) + float(self._cost(found).sum())

    def _cost(self, detection_probability: np.ndarray) -> np.ndarray:
        """What cameras cost by their false alarms, float64 [camera]."""
        return false_alarm_cost(detection_probability, self.charge)

    def _settle_rules(self, rules: PoolRules) -> None:
        """The strictest levels of what a rig must see together that the cameras of the pool can keep."""
        most = self.camera_count if self.limits is None else self.limits.count[1]
        widest_rad = max(model.fov_rad for model in self.cameras.mount.cameras)
        free = self._selection(_GAP_ON_THE_WAY)
        known = [(free.cameras, free.objective)]
        if rules.rules.azimuth_gap_rad is not None and most * widest_rad >= 2.0 * np.pi - 1e-6:
            first = round(rules.rules.azimuth_gap_rad / AZIMUTH_STEP_RAD)
            levels = [first + k for k in range(20)]
            rules.gap_steps, rules.price_of_gap = self._kept_level("gap_steps", levels, known)
        if rules.rules.near_ground:
            rules.near_level, _ = self._kept_level("near_level", list(range(len(NEAR_M))), known)

    def _kept_level(self, name: str, levels: list[int], known: list[_Known]) -> tuple[int | None, float]:
        """The strictest level of a rule, of ever looser ones, that costs at most a share of the objective.

        Nor more than the lead over the best rig by hand. None: no rule. And the share that the first would cost,
        infinite where no rig keeps it. ``known``: rigs that were selected, the first without such rules; others join.
        """
        free, first = known[0][1], self._selected_at(name, levels[0], known)
        lead = max(self.hand_rigs[0].value - free, 0.0) if self.hand_rigs else np.inf
        low, high = (0, 0) if first <= free + min(_PRICE * free, lead) else (1, len(levels))
        most = free + min((_LOOSER_GAP_PRICE if name == "gap_steps" else _PRICE) * free, lead)
        while low < high:
            middle = (low + high) // 2
            is_kept = self._selected_at(name, levels[middle], known, enough=most) <= most
            low, high = (low, middle) if is_kept else (middle + 1, high)
        return levels[low] if low < len(levels) else None, first / max(free, _SAME) - 1.0

    def _selected_at(self, name: str, level: int | None, known: list[_Known], enough: float = -np.inf) -> float:
        """The objective of the rig that would be selected at a level of a rule; inf where none keeps it.

        Of a known rig that keeps the level and is good ``enough`` it is that rig's.
        """
        setattr(self.rules, name, level)
        try:
            problem = self._problem()
            kept = [(rig, value) for rig, value in known if problem.is_feasible(rig)]
            rig, value = min(kept, key=lambda each: each[1], default=(None, np.inf))
            if value <= enough:
                return value
            if rig is None and (rig := feasible_rig(problem, time_limit_s=self.settings.selection_time_s)) is None:
                return np.inf
            found = self._selection(_GAP_ON_THE_WAY, problem, rig)
            known.append((found.cameras, found.objective))
            return found.objective
        except (InputError, TimeoutError):
            return np.inf
        finally:
            setattr(self.rules, name, None)

    def _of_a_round(self, camera_count: int) -> int:
        """Cameras that a round and the polishes around it draw in each scene, of rigs of so many."""
        if not self.settings.polishes:
            return 0
        polishes = (_FURTHER_POLISH, _LAST_POLISH, *(_FIRST_POLISH,) * (2 + 2 * (OTHERS if self.robust else 0)))
        return sum(1 + count for count, _ in polishes) * camera_count + _PRICED_STEPS * self.settings.priced_cameras

    def _planned(self) -> tuple[int, int]:
        """Cameras that the pool draws in each scene, and that are drawn after it, about."""
        settings, count = self.settings, self.camera_count if self.task.start is None else len(self.task.start)
        of_pool = count + settings.pool_cameras + _HAND_CAMERAS * self.task.starts_by_hand
        further = (1 + _FURTHER_POLISH[0]) * count + _PRICED_STEPS * settings.priced_cameras
        later = self._of_a_round(count) + max(settings.rounds - 1, 0) * further + _ROUNDED_TIMES * count
        return of_pool, later + settings.refinements * 4 * _NEAR_CAMERAS * count

    def _first_share(self, limit: int) -> int:
        """Camera renders that the first pool may take of so many."""
        if not self.settings.polishes:
            return limit
        rest = limit - self._of_a_round(self.camera_count) * len(self.scenes)
        return int(_POOL_SHARE * limit) if self.settings.refinements else max(int(_POOL_SHARE * limit), rest)

    def _improve(self, by_hand: Sequence[list[list[float]]] = ()) -> None:
        """Improve the best rig, and those by hand, and prove how good the best is."""
        self._todo = [("note",), ("select",), ("settle",)]
        if self.settings.polishes:
            first = [] if self.bound is not None else [("select_and_polish", *_FIRST_POLISH)]
            first += [("polish", rig, *_FIRST_POLISH) for rig in by_hand]
            self._todo[:1] = [*first, ("priced",), ("note",), ("select_and_polish", *_LAST_POLISH), ("refined", 0, -1)]

    def _note(self) -> None:
        """The settings under which pricing has come to its end."""
        self._under = self.settings

    def _settle(self) -> Iterator[Found]:
        yield self._found("settled")
        if self.settings != self._under:
            self._todo = [("improve",)]

    def _priced(self, before: float = np.inf) -> None:
        """Price, select and polish until a round brings nothing; ``before`` is the objective before the last."""
        is_first, can_pay = before == np.inf, self._affordable(_PRICED_STEPS) == _PRICED_STEPS
        if (is_first or self.objective <= before - _SAME) and self.round < self.settings.rounds and can_pay:
            self.round += 1
            self._todo[:0] = [("price",), ("select_and_polish", *_FURTHER_POLISH), ("priced", self.objective)]

    def _refined(self, times: int, spent: int) -> None:
        """Look for what steps along gradients have missed: other places for single cameras, and near the rig's.

        One time after the other, while they look at something new; ``spent`` are renders before the last.
        """
        if not times:
            self._rng, self._places = np.random.default_rng([self.seed, 1]), []
        if times < self.settings.refinements and self.camera_renders != spent:
            further = ("refined", times + 1, self.camera_renders)
            self._todo[:0] = [("replaced", -1, np.inf), ("nearby", 2.0 * _REFINED_FROM, 0.0), further]

    def _replaced(self, vain: int, before: float) -> Iterator[Found]:
        """Replace single cameras until that was in vain too often."""
        vain = 0 if vain < 0 or self.objective < before - _SAME else vain + 1
        if vain < _VAIN_REPLACEMENTS and self._affordable(2) == 2:
            before, renders = self.objective, self.camera_renders
            yield from self._replace()
            if self.camera_renders != renders:
                self._todo[:0] = [("select_and_polish", *_FURTHER_POLISH), ("replaced", vain, before)]

    def _nearby(self, radius: float, before: float) -> Iterator[Found]:
        """Look around the best rig's cameras, ever nearer when nothing better is found."""
        assert self.rig is not None
        radius = radius * 0.5 if self.objective > before - _SAME else radius
        count = _NEAR_CAMERAS * (len(self.rig) - len(self.assembly.frozen))
        if radius > _REFINED_TO and self._affordable(count) == count:
            before = self.objective
            yield from self._look_nearby(radius)
            self._todo.insert(0, ("nearby", radius, before))

    @property
    def camera_renders(self) -> int:
        return self.pool.drawn_count + self.pool.cached_count

    @property
    def _left(self) -> int | None:
        """Camera renders that may still be spent; None: as many as it takes."""
        limit = self.settings.camera_renders_max
        return None if limit is None else max(limit - self.camera_renders, 0)

    def _affordable(self, camera_count: int) -> int:
        """Of so many cameras, those that may still be rendered in all scenes."""
        return camera_count if self._left is None else min(camera_count, self._left // len(self.scenes))

    def _is_better(self, rig: np.ndarray, objective: float, probability: np.ndarray | None = None) -> bool:
        """Whether a rig is better than the best so far, which it then is; not if it breaks a hard requirement."""
        if self.points is not None:
            if probability is None:
                probability = self.pool.detection_probability[rows_of(rig, self.pool.mount_pose)]
            if not self._meets_requirements(probability):
                return False
        if not self._keeps_rules(rig) or objective >= self.objective - (_SAME if self.rig is not None else 0.0):
            return False
        self.rig, self.objective = rig, objective
        return True

    def _keeps_rules(self, rig: np.ndarray) -> bool:
        return self.rules is None or self.rules.keeps(rig, frozen=self.assembly.is_held(len(rig)))

    def _select(self, least_gap: float = 0.0) -> Generator[Found, None, tuple[np.ndarray, bool]]:
        """The best rig of the pool, and whether it is better than what was known."""
        cameras = len(self.pool.mount_pose)
        selection = self._selection(least_gap)
        self.bound, self.price, self._others = selection.bound, selection.price, selection.others
        chosen = selection.cameras[selection.cameras < cameras]
        chosen = self.assembly.rig(self.pool.mount_pose[chosen], like=self.rig)
        is_better = self._is_better(chosen, selection.objective)
        is_interrupted = selection.ended == "interrupted"
        yield self._found("selection", is_final=not is_interrupted)
        if is_interrupted:  # what it has found is kept, the search ends
            raise KeyboardInterrupt
        return chosen, is_better

    def _problem(self) -> SelectionProblem:
        absent = 0 if self.limits is None else self.limits.absent
        rows, self._row_points = self._rows_for(self.pool.mount_pose, absent)
        found = _with_absent(np.minimum(self.pool.detection_probability, SUREST), absent)
        return SelectionProblem.create(
            found,
            self.camera_count,
            conflict=self._conflict(self.pool.mount_pose, absent),
            required=np.arange(len(self.assembly.frozen)),
            rows=rows,
            weight=self.object_weight,
            cost=self._cost(found),
            triple=self.cameras.triples(self.scenes),
        )

    def _conflict(self, mount_pose: np.ndarray, absent: int = 0) -> sparse.csr_array:
        near = too_near(mount_pose, self.constraints, absent=absent)
        if self.rules is None:
            return near
        housing = self.rules.conflict(mount_pose, absent=absent).tocoo()
        held = len(self.assembly.frozen)
        kept = (housing.row >= held) | (housing.col >= held)
        index = housing.row[kept], housing.col[kept]
        return sparse.csr_array(near + sparse.csr_array((np.ones(kept.sum(), bool), index), shape=near.shape))

    def _selection(
        self, least_gap: float, problem: SelectionProblem | None = None, known: np.ndarray | None = None
    ) -> Selection:
        """Choose the best rig of the pool, or of a problem of its cameras of which a rig is known, int [camera]."""
        pool = self.pool
        absent = 0 if self.limits is None else self.limits.absent
        if self.rig is not None and known is None:
            missing = np.arange(self.camera_count - len(self.rig))
            known = np.concatenate([self._rows_of_best(), len(pool.mount_pose) + missing])
        problem = problem or self._problem()
        gap = max(self.settings.gap, least_gap)
        options = {"gap": gap, "time_limit_s": self.settings.selection_time_s, "seed": self.seed}
        if self.robust is None:
            return select(problem, start=known, **options)
        return select_robust(problem, self.robust, self._sizes(pool.mount_pose, absent), start=known, **options)

    def _limit_rows(self, mount_pose: np.ndarray, absent: int = 0) -> list[Row]:
        """The limits for cameras [camera, 7], behind which some that are not there stand."""
        if self.limits is None:
            return []
        return self.limits.rows(np.append(self.cameras.mount.module_of(mount_pose), np.full(absent, -1)))

    def _points_of(self, mount_pose: np.ndarray, absent: int = 0) -> np.ndarray:
        """How surely cameras of the pool see the requirements' points, [camera, point]; see `_limit_rows`."""
        assert self.points is not None
        found = self.pool.detection_probability[rows_of(mount_pose, self.pool.mount_pose)]
        return _with_absent(found[:, -self.points.vehicle_count :], absent)

    def _rows_for(self, mount_pose: np.ndarray, absent: int = 0) -> tuple[list[Row], np.ndarray]:
        """Limits and hard requirements for cameras of the pool, and the points that the latter are, int [row]."""
        rows = self._limit_rows(mount_pose, absent)
        if self.rules is not None:
            of_rules = self.rules.rows(mount_pose, absent=absent, free_from=len(self.assembly.frozen))
            self._rule_rows = [row.name for row in of_rules]
            rows += of_rules
        if self.points is None:
            return rows, np.zeros(0, int)
        asked, point = self.points.rows(self._points_of(mount_pose, absent))
        return [*rows, *asked], point

    def _coefficients_for(self, mount_pose: np.ndarray) -> np.ndarray | None:
        """Coefficients of cameras of the pool in the rows of the last selection, float [camera, row]; None: no rows."""
        rows = [row.coefficient for row in self._limit_rows(mount_pose)]
        if self.rules is not None:
            rows += self.rules.coefficients(mount_pose, self._rule_rows)
        if self.points is not None and len(self._row_points):
            rows += list(self.points.meets(self._points_of(mount_pose)[:, self._row_points]).T.astype(float))
        return np.stack(rows, axis=1) if rows else None

    def _select_and_polish(self, step_count: int, radius: float) -> Iterator[Found]:
        is_first = self.bound is None
        chosen, is_better = yield from self._select(_GAP_ON_THE_WAY)
        rigs = [chosen] if is_better or is_first else []
        if is_first:
            cameras = len(self.pool.mount_pose)
            rigs += [self.assembly.rig(self.pool.mount_pose[rig[rig < cameras]]) for rig in self._others]
        ways = ((step_count, radius), *(_FURTHER_POLISH,) * is_first)  # of two radii neither is better everywhere
        polishes = [("polish", rig.tolist(), *way) for rig in rigs for way in ways]
        self._todo = [*polishes, *(stage for stage in self._todo if stage not in polishes)]

    def _polish(self, rig: list[list[float]], step_count: int, radius: float) -> Iterator[Found]:
        if self._affordable(len(rig)) < len(rig):
            return
        asked = [] if self.points is None else [hard_points(self.cameras, self.points)]
        asked += [] if self.rules is None else [HardPoints(self.rules.margins, self.rules.needed)]
        task = PolishTask(
            self.cameras.mount,
            self.constraints,
            len(self.scenes),
            weight=self.object_weight,
            charge=self.charge,
            robust=self.robust,
            hard_points=HardPoints.of_all([each for each in asked if each is not None]),
            pair_edges=None if self.rules is None else self.rules.pair_edges,
            is_allowed=self._is_allowed,
        )
        steps = PolishSteps(step_count, radius, camera_renders_max=self._left)
        is_better = True
        for taken, step in enumerate(polish(np.array(rig, np.float32), self._detect, task, steps)):
            is_better = self._is_better(step.mount_pose, step.objective)
            if is_better:
                yield self._found("polish")
            elif 2 * taken >= step_count and step.objective > self.objective * (1.0 + _BEHIND_MAX):
                break
        if not is_better:  # what the last steps have cost is the polish's too
            yield self._found("polish")

    def _is_allowed(self, mount_pose: np.ndarray, probability: np.ndarray) -> bool:
        return self._meets_requirements(probability) and self._keeps_rules(mount_pose)

    def _detect(self, mount_pose: np.ndarray) -> Detected:
        probability, jacobian = self.cameras.with_jacobian(mount_pose, self.scenes)
        self.pool = self.pool.joined(mount_pose, probability)
        return probability, jacobian

    def _meets_requirements(self, probability: np.ndarray) -> bool:
        """Whether a rig whose cameras detect so much, [camera, object], meets all hard requirements."""
        return self.points is None or self.points.is_kept(probability[:, -self.points.vehicle_count :])

    def _price(self) -> Iterator[Found]:
        """Look for cameras that promise to lower the bound, by gradient ascent from the cheapest of the pool."""
        price, count = self.price, self._affordable(_PRICED_STEPS * self.settings.priced_cameras) // _PRICED_STEPS
        if price is None or count < 1:
            return
        self._ascend(price, count)
        yield self._found("pricing")

    def _ascend(self, price: Price, count: int) -> None:
        """Ascend from so many cameras; what is rendered on the way joins the pool."""
        found = np.minimum(np.asarray(self.pool.detection_probability, np.float64), SUREST)
        cost = price.reduced_cost(found, self._coefficients_for(self.pool.mount_pose)) + self._cost(found)
        mount, unit = self.cameras.mount, step_unit(self.cameras.mount)
        pose = apart(self.pool.mount_pose[np.argsort(cost, kind="stable")], count, unit)
        length = np.full(len(pose), 0.5)
        lowest, kept, slope = np.full(len(pose), np.inf), pose, np.zeros(pose.shape)
        tried = pose
        for _ in range(_PRICED_STEPS):
            probability, jacobian = self._detect(tried)
            probability = np.minimum(probability, SUREST)
            cost = price.reduced_cost(probability, self._coefficients_for(tried)) + self._cost(probability)
            is_lower = cost < lowest
            length = np.where(is_lower, length, 0.4 * length)
            kept = np.where(is_lower[:, None], tried, kept)
            by_found = price.reduced_cost_slope(probability)
            by_found += 0.0 if self.charge is None else self.charge * (1.0 - 2.0 * probability)
            downhill = -np.einsum("co,cok->ck", by_found, jacobian) * unit
            slope = np.where(is_lower[:, None], downhill, slope)
            lowest = np.minimum(cost, lowest)
            norm = np.maximum(np.abs(slope).max(axis=1, keepdims=True), 1e-12)
            tried = kept + length[:, None] * slope / norm * unit
            tried[:, [X_M, Y_M]] = self.constraints.nearest_place(tried[:, [X_M, Y_M]])
            tried = mount.clipped(tried).astype(np.float32)

    @property
    def _replacements(self) -> Replacements:
        pool, rig, held = self.pool, self._rows_of_best(), len(self.assembly.frozen)
        conflict = self._conflict(pool.mount_pose)
        module = self.cameras.mount.module_of(pool.mount_pose)
        can_replace = ~(conflict + conflict.T)[:, rig].toarray(), module[:, None] == module[rig]
        return Replacements(
            pool,
            rig[:held],
            rig[held:],
            *can_replace,
            unit=step_unit(self.cameras.mount),
            weight=self.object_weight,
            robust=None if self.robust is None else (self.robust, self._sizes(pool.mount_pose)),
            charge=self.charge,
        )

    def _rows_of_best(self) -> np.ndarray:
        """The cameras of the best rig in the pool, the frozen ones first, int [camera]."""
        assert self.rig is not None
        return rows_of(self.assembly.in_order(self.rig), self.pool.mount_pose)

    def _replace(self) -> Iterator[Found]:
        """Polish single cameras from other places than were tried, each with the rest of the rig as it is."""
        replacements, pose = self._replacements, self.pool.mount_pose
        mount, constraints = self.cameras.mount.of_single_cameras, self.constraints.of_single_cameras
        for camera, slot in replacements.starts(_REPLACEMENTS, np.concatenate([np.zeros((0, 7)), *self._places])):
            if self._affordable(2) < 2:
                break
            weight = replacements.missed_by_others[slot]
            charge = None if self.charge is None else self.charge * len(weight) / weight.sum()
            task = PolishTask(mount, constraints, len(self.scenes), weight=weight, charge=charge)
            steps = PolishSteps(*_REPLACEMENT_POLISH, camera_renders_max=self._left)
            *_, last = polish(pose[camera][None], self._detect, task, steps)
            self._places += [pose[camera][None], last.mount_pose]
        yield self._found("polish")

    def _look_nearby(self, radius: float) -> Iterator[Found]:
        """Draw cameras around those of the best rig, and exchange its own for them."""
        mount = self.cameras.mount
        near = np.asarray(self._replacements.near(radius, _NEAR_CAMERAS, self._rng), np.float64)
        near[:, [X_M, Y_M]] = self.constraints.nearest_place(near[:, [X_M, Y_M]])
        near = mount.clipped(near)
        before = len(self.pool.mount_pose)
        self.pool = pool = self.pool.extended(near.astype(np.float32))
        rig = self._rows_of_best()
        around = np.union1d(rig, np.arange(before, len(pool.mount_pose)))  # frozen cameras are the pool's first
        found = np.minimum(pool.detection_probability[around], SUREST)
        problem = SelectionProblem.create(
            found,
            len(rig),
            conflict=self._conflict(pool.mount_pose[around]),
            required=np.arange(len(self.assembly.frozen)),
            rows=self._rows_for(pool.mount_pose[around])[0],
            weight=self.object_weight,
            cost=self._cost(found),
            triple=self.cameras.triples(self.scenes),
        )
        first = np.searchsorted(around, rig)[None]
        if self.robust is None:
            rigs, value = exchange(problem, first)
        else:
            rigs, value = exchange_robust(problem, first, self.robust, self._sizes(pool.mount_pose[around]))
        self._is_better(self.assembly.rig(pool.mount_pose[around[rigs[0]]], like=self.rig), float(value[0]))
        yield self._found("polish")


def _with_absent(detection_probability: np.ndarray, absent: int) -> np.ndarray:
    """The cameras of a pool and behind them some that are not there and detect nothing, [camera, object]."""
    return np.pad(detection_probability, ((0, absent), (0, 0))) if absent else detection_probability
