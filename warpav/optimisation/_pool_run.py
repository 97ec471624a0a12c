"""The search by a pool as a run: state by state, with what a run records of each."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from warpav.core.errors import InputError
from warpav.core.progress import Progress
from warpav.detection import expected_miss_rate, shares_of
from warpav.optimisation._camera_loss import RobustValue
from warpav.optimisation._further_camera import FurtherCameras, further_cameras
from warpav.optimisation._hand_rigs import HandRig
from warpav.optimisation._mount import LOG_ZOOM, PITCH_RAD, X_M, Y_M, YAW_RAD, CameraMount, mirror_image
from warpav.optimisation._mount_errors import COLUMNS
from warpav.optimisation._polish import PolishSteps, PolishTask, nearest_rig, polish
from warpav.optimisation._pool import CameraPool, Drawing
from warpav.optimisation._pool_cache import rows_of
from warpav.optimisation._pool_search import WHOLE_POLISH, Found, PoolSearch, PoolSearchSettings, PoolTask
from warpav.optimisation._records import Candidate, IterationRecord, named_part, part_of, rig_fields
from warpav.optimisation._replacements import within_half_a_turn
from warpav.optimisation._tangent_model import HardPoints
from warpav.optimisation.selection._relaxation import Price
from warpav.rig import Rig, RigCamera

_WORDS = ("todo", "objective", "bound", "round", "rng", "rules", "iteration", "proven")
STEP_M, STEP_DEG = 0.005, 0.5
"""Steps of the numbers of poses as a workshop takes them."""
_ROUNDINGS_AT_ONCE = 4  # roundings of a camera of which the best is taken
_ROUNDED_BY = np.array([STEP_M, STEP_M, *3 * [math.radians(STEP_DEG)], STEP_M, 0.001])  # numbers of a mount pose
_NUMBERS = {column: name for name, column in COLUMNS.items()} | {LOG_ZOOM: "field of view"}
_SIMPLER = 0.002  # what the simpler rig may miss more


@dataclass(frozen=True)
class _SimplerRig:
    """A rig some of whose numbers are those of the rig by hand."""

    mount_pose: np.ndarray  # float32 [camera, 7]
    objective: float
    by_hand: dict[int, list[str]]  # the numbers that are by hand, by the camera of the mount pose
    differing: int  # numbers in which the rig that was found differs from the one by hand


def _with_number(rig: np.ndarray, other: np.ndarray, number: tuple[int, int]) -> np.ndarray:
    """A rig with one number of another."""
    changed = rig.copy()
    changed[number] = other[number]
    return changed


class PoolRun(PoolSearch):
    """A search from a start, with its records; call `step` while `stop_reason` is None, then `finish`."""

    def __init__(
        self,
        task: PoolTask,
        settings: PoolSearchSettings,
        *,
        seed: int,
        drawing: Drawing | None = None,
        progress: Progress | None = None,
        pool: CameraPool | None = None,
    ) -> None:
        assert task.start is not None
        self._start = task.cameras.mount.within(np.asarray(task.start, np.float32))
        self.candidates: list[Candidate] = []  # the rigs that were found, each better than those before
        self.iteration = 0  # steps so far
        self.found: Found | None = None  # the last state; None before the first step
        self._proven: tuple[float, int] | None = None  # the bound of the last selection, and the cameras of its pool
        self._final_states = 0
        self.rounding: Candidate | None = None  # the best rig, rounded
        self.unrounded = list[int]()  # its cameras that fit no rounded place
        super().__init__(task, settings, seed=seed, drawing=drawing, progress=progress, pool=pool)

    @property
    def start(self) -> np.ndarray:
        """Mount poses that the rig is compared with: the best by hand, else the given start, float32 [camera, 7]."""
        return self.hand_rigs[0].mount_pose if self.hand_rigs else self._start

    @property
    def start_objective(self) -> float:
        """The objective of `start`; infinite where it breaks a hard requirement, and was not drawn by hand."""
        return self.hand_rigs[0].value if self.hand_rigs else self.candidates[0].training_objective

    def robust_value(self, mount_pose: np.ndarray) -> RobustValue | None:
        """What the objective of a rig of the pool, float32 [camera, 7], is made of; None where it is no robust one."""
        row = rows_of(self.assembly.in_order(mount_pose), self.pool.mount_pose)
        return None if (row < 0).any() else self._robust_value(row)

    @property
    def mount_pose(self) -> np.ndarray:
        """Mount poses of the best rig so far, float32 [camera, 7]."""
        return (self.start if self.found is None else self.found.mount_pose).copy()

    @property
    def best(self) -> Candidate:
        return self.candidates[-1]

    @property
    def stop_reason(self) -> str | None:
        """Why the search has stopped; None while it goes on."""
        if self.found is None or self._todo or self.settings != self._under:
            return None
        return f"the search has converged, after {self.found.camera_renders} camera renders"

    def step(self) -> IterationRecord:
        """Go on until the search comes to another state."""
        began = time.perf_counter()
        self.found = found = next(self)
        if not self.candidates and found.stage != "start":  # it breaks a hard requirement or a rule
            self.candidates.append(Candidate(self.start, math.inf, self.iteration, 0))
        if not self.candidates or found.objective < self.best.training_objective:
            self.candidates.append(Candidate(found.mount_pose, found.objective, self.iteration, 0))
        record = self._record(found, time.perf_counter() - began)
        self.iteration += 1
        if found.is_final:
            self._final_states = self.iteration
        return record

    def finish(self) -> Candidate:
        """The best rig, with rules rounded as a workshop takes it; where no step was taken, the start."""
        if not self.candidates:
            self.step()
        if self.rules is not None and self.rounding is None and self.best.training_objective < math.inf:
            self._round(self.best)
        return self.best if self.rounding is None else self.rounding

    def _round(self, best: Candidate) -> None:
        """Round camera after camera, each as it costs least with the others as they are."""
        pose, held = best.mount_pose.copy(), self.assembly.is_held(len(best.mount_pose))
        left = np.flatnonzero(~held).tolist()
        for _ in range(2):  # what does not fit beside cameras that are not rounded may fit then
            left = [camera for camera in left if not self._rounds(pose, camera)]
        self.unrounded = left
        self.rounding = Candidate(pose, self._value_of(pose), best.iteration, 0)
        if self._progress is not None:
            but = f" but for {len(left)} of {len(pose)} that fit nowhere else" if left else ""
            value = f"objective {self.rounding.training_objective:.4f}"
            self._progress.say(f"{'rounded':<12} {value}  to 5 mm and 0.5 degrees{but}")

    def _rounds(self, pose: np.ndarray, camera: int) -> bool:
        """Round a camera of a rig, [camera, 7], where some of its roundings keeps what the rig keeps."""
        near = roundings(pose[camera], self.cameras.mount.of_single_cameras, self._fits)
        while tried := list(itertools.islice(near, _ROUNDINGS_AT_ONCE)):
            if self._affordable(len(tried)) < len(tried):
                return False
            rigs = np.repeat(pose[None], len(tried), axis=0)
            rigs[:, camera] = tried
            self.pool = self.pool.extended(np.array(tried))
            kept = [rig for rig in rigs if self._stands(rig)]
            if kept:
                pose[:] = min(kept, key=self._value_of)
                return True
        return False

    def _stands(self, rig: np.ndarray) -> bool:
        """Whether a rig of the pool, [camera, 7], keeps constraints, requirements and rules."""
        if self.task.constraints.violation_m(self.cameras.mount.rig(rig)) > 0.0:
            return False
        return self._is_allowed(rig, self.pool.detection_probability[rows_of(rig, self.pool.mount_pose)])

    def _fits(self, mount_pose: np.ndarray) -> bool:
        mount, constraints = self.cameras.mount.of_single_cameras, self.constraints.of_single_cameras
        if constraints.violation_m(mount.rig(mount_pose)) > 0.0:
            return False
        return self.rules is None or bool(self.rules.allowed(mount_pose).all())

    def simplified(self) -> _SimplerRig | None:
        """The rig that is kept with as many numbers as by hand as cost at most `_SIMPLER` together.

        Each number is judged alone, then they go back one after the other, the cheapest first, as long as what is
        missed and all that must be kept allow it. None: there is no rig by hand, or nothing can go back.
        """
        best = self.rounding
        if best is None or not self.hand_rigs or len(self.start) != len(best.mount_pose):
            return None
        mount, pose = self.cameras.mount, best.mount_pose.copy()
        hand = self.assembly.rig(self.assembly.in_order(self.start), like=pose)
        alike = (mount.is_pair(pose) == mount.is_pair(hand)) & (mount.module_of(pose) == mount.module_of(hand))
        differs = np.abs(within_half_a_turn(pose.astype(np.float64) - hand)) > 1.1 * _ROUNDED_BY
        numbers = [tuple(each) for each in np.argwhere(differs & (alike & ~self.assembly.is_held(len(pose)))[:, None])]
        moved = {number: _with_number(pose, hand, number) for number in numbers}
        most, reverted = best.training_objective + _SIMPLER, dict[int, list[str]]()
        values = {number: self._value_if_it_stands(rig, number[0]) for number, rig in moved.items()}
        for number in sorted(numbers, key=lambda each: values[each]):
            tried = _with_number(pose, hand, number)
            if values[number] <= most and self._value_if_it_stands(tried, number[0]) <= most:
                pose = tried
                reverted.setdefault(int(number[0]), []).append(_NUMBERS[number[1]])
        return _SimplerRig(pose, self._value_of(pose), reverted, len(numbers)) if reverted else None

    def _value_if_it_stands(self, rig: np.ndarray, camera: int) -> float:
        """The objective of a rig one of whose cameras is not in the pool yet; infinite where it may not stand so."""
        if not self._fits(rig[camera][None]) or self._affordable(1) < 1:
            return math.inf
        self.pool = self.pool.extended(rig[camera][None], may_see_nothing=True)
        return self._value_of(rig) if self._stands(rig) else math.inf

    def further_cameras(self) -> FurtherCameras | None:
        """What traffic each camera of the pool would add to the best rig, which is in it; None before it is drawn."""
        if self.found is None or len(self.found.pool.mount_pose) == len(self.found.mount_pose):
            return None
        pool, task = self.found.pool, self.task
        rig = rows_of(self.found.mount_pose, pool.mount_pose)
        assert (rig >= 0).all(), "whatever was rendered is in the pool"
        return further_cameras(
            pool.mount_pose,
            pool.detection_probability[:, : task.object_count],
            rig,
            mount=task.cameras.mount,
            constraints=task.constraints,
            weight=task.object_weight,
        )

    def misplaced_miss_rates(self, mount_pose: np.ndarray) -> dict[str, float] | None:
        """What a rig, float [camera, 7], is expected to miss in the scenes of the search.

        ``expected_miss_rate`` with errors of mounting, and ``as_designed``; None for a rig that is not in the pool.
        """
        assert self.found is not None
        pool, task = self.pool, self.task
        row = rows_of(mount_pose, pool.mount_pose)
        if (row < 0).any():
            return None
        designed = [self.designed.detection_probability(mount_pose, scene) for scene in task.scenes]
        share = shares_of(task.object_weight)
        return {
            "expected_miss_rate": expected_miss_rate(pool.detection_probability[row, : task.object_count], share),
            "as_designed": expected_miss_rate(np.concatenate(designed, axis=1), share),
        }

    def position(self) -> dict[str, Any]:
        """All that the search knows between two stages, and the run."""
        of_run = {"iteration": self.iteration, "proven": self._proven}
        return super().position() | of_run | {"candidates": list(self.candidates), "by_hand": self.hand_rigs[:1]}

    def state(self) -> dict[str, np.ndarray]:
        """Everything that `restore` needs: where the present stage began; drawn cameras are in the cache.

        ``iteration`` counts the states that the search comes to again.
        """
        known = self._boundary
        words = {name: known[name] for name in _WORDS}
        words |= {
            "settings": asdict(self.settings),
            "under": None if known["_under"] is None else asdict(known["_under"]),
            "candidates": [
                (each.mount_pose.tolist(), each.training_objective, each.iteration) for each in known["candidates"]
            ],
        }
        words["by_hand"] = [{**vars(each), "mount_pose": each.mount_pose.tolist()} for each in known["by_hand"]]
        state = {"iteration": np.array(self._final_states), "words": np.array(json.dumps(words))}
        state["row_points"] = known["_row_points"]
        if known["places"]:
            state["places"] = np.concatenate(known["places"])
        if known["rig"] is not None:
            state["rig"] = known["rig"]
        if known["price"] is not None:
            state |= named_part("price", {name: np.asarray(value) for name, value in vars(known["price"]).items()})
        return state | (named_part("pool", known["pool"].state()) if len(known["pool"].mount_pose) else {})

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from where another run of the same task was when it gave `state`; this one has taken no step.

        The stage that the other was in is taken again. The settings may be others that do not change how a pool begins:
        rounds, refinements, gap, time.
        """
        what, own = "more states than it comes to", self.settings
        try:
            count = int(state["iteration"])
            self._return_to(state)
        except KeyError as error:
            what = f"no {error.args[0]}"
        except (ValueError, IndexError, TypeError):
            what = "arrays that do not fit together"
        else:
            with contextlib.suppress(StopIteration):
                while self.iteration < count:
                    self.step()
                self.settings = own
                return
        raise InputError(f"checkpoint: expected the state of a search by a pool, got {what}")

    def _return_to(self, state: Mapping[str, np.ndarray]) -> None:
        """Be where a `state` was taken, under its settings."""
        words = json.loads(str(state["words"]))
        self.settings = PoolSearchSettings(**words["settings"])
        self._under = None if words["under"] is None else PoolSearchSettings(**words["under"])
        self._todo = [tuple(each) for each in words["todo"]]
        self.objective, self.bound, self.round = (words[name] for name in ("objective", "bound", "round"))
        self._rng.bit_generator.state = words["rng"]
        if self.rules is not None:
            self.rules.gap_steps, self.rules.near_level, self._rule_rows, self.rules.price_of_gap = words["rules"]
        self.iteration = self._final_states = words["iteration"]
        self._proven = None if words["proven"] is None else tuple(words["proven"])
        self.candidates = [
            Candidate(np.array(pose, np.float32), objective, iteration, 0)
            for pose, objective, iteration in words["candidates"]
        ]
        self.hand_rigs = [
            HandRig(**{**each, "mount_pose": np.array(each["mount_pose"], np.float32)}) for each in words["by_hand"]
        ]
        self._row_points = np.array(state["row_points"], int)
        self._places = [each[None] for each in state["places"]] if "places" in state else []
        self.rig = np.array(state["rig"], np.float32) if "rig" in state else None
        price: dict[str, Any] = dict(part_of(state, "price"))
        price = {name: each if each.ndim else each.item() for name, each in price.items()}
        self.price = Price(**price) if price else None
        if pool := part_of(state, "pool"):
            self.pool = self.pool.restored(pool, self._progress)
        self._pace.begin(self.pool.drawn_count)

    def _terms(self, found: Found) -> dict[str, float]:
        """The expected miss rate, and what else there is: false alarms, points of requirements, a lost camera."""
        robust, points = found.robust, self.task.requirements
        without = {} if robust is None else {"expected_miss_rate_without_camera": robust.without_camera}
        row = rows_of(found.mount_pose, found.pool.mount_pose)
        probability, count = found.pool.detection_probability[row], self.task.object_count
        terms = {"expected_miss_rate": expected_miss_rate(probability[:, :count], shares_of(self.task.object_weight))}
        if self.charge is not None:
            terms["false_alarms"] = float(self._cost(probability).sum())
        if points is not None:
            terms["requirements"] = expected_miss_rate(probability[:, count:], shares_of(points.weight))
        return terms | without

    def _record(self, found: Found, seconds: float) -> IterationRecord:
        if found.stage == "selection":
            self._proven = found.bound, found.pool_cameras
        bound, pool_cameras = self._proven or (None, None)
        return IterationRecord(
            iteration=self.iteration,
            loss=found.objective,
            terms=self._terms(found),
            multipliers={},
            gradient_norm={},
            seconds={"total": seconds},
            training_objective=found.objective,
            best_training_objective=self.best.training_objective,
            stage=found.stage,
            bound=bound,
            pool_cameras=pool_cameras,
            camera_renders=found.camera_renders,
            **rig_fields(self.task.cameras.mount, found.mount_pose),
        )


def workshop_rig(rig: Rig, staying: Collection[str] = ()) -> Rig:
    """A rig with all numbers rounded, in the ego frame; cameras of the names ``staying`` stay as they are."""
    return Rig(each if each.name in staying else _rounded(each) for each in rig.cameras)


def _rounded(camera: RigCamera, ways: tuple[bool, ...] = (False,) * 5) -> RigCamera:
    """A camera with rounded numbers; ``ways``: whether x, y, z, yaw, pitch are rounded to the other side."""
    numbers = np.append(camera.position_m / STEP_M, np.degrees([camera.yaw_rad, camera.pitch_rad]) / STEP_DEG)
    steps = np.round(numbers)
    steps += np.where(ways, np.where(numbers >= steps, 1.0, -1.0), 0.0)
    yaw_rad, pitch_rad = np.radians(steps[3:] * STEP_DEG)
    roll_rad = math.radians(round(math.degrees(camera.roll_rad) / STEP_DEG) * STEP_DEG)
    position_m = np.round(steps[:3] * STEP_M, 6)
    return dataclasses.replace(
        camera, position_m=position_m, yaw_rad=float(yaw_rad), pitch_rad=float(pitch_rad), roll_rad=roll_rad
    )


def roundings(pose: np.ndarray, mount: CameraMount, fits: Callable[[np.ndarray], bool]) -> Iterator[np.ndarray]:
    """Mount poses [7] of a camera, or a pair, with rounded numbers, the nearest first.

    Args:
        pose: As it is.
        mount: What it is on, of single cameras.
        fits: Whether a camera, [1, 7], keeps what it must keep alone.
    """
    cameras = mount.rig(pose[None]).cameras
    is_in_the_middle = mount.is_symmetric and len(cameras) == 1
    low, high = (ends[0] for ends in mount.ends_of(pose[None, [X_M, Y_M]]))
    turns_not = low[[YAW_RAD, PITCH_RAD]] == high[[YAW_RAD, PITCH_RAD]]
    known = set[bytes]()
    for ways in sorted(itertools.product((False, True), repeat=5), key=sum):
        if (is_in_the_middle and (ways[1] or ways[3])) or (turns_not & ways[3:]).any():
            continue
        rounded = _rounded(cameras[0], ways)
        pair = [rounded] if len(cameras) == 1 else [rounded, mirror_image(rounded)]
        rig = Rig(dataclasses.replace(camera, name=f"side_{k}") for k, camera in enumerate(pair))
        found = mount.mount_pose_of_rig(rig)
        if found.tobytes() not in known and fits(found):
            yield found[0]
        known.add(found.tobytes())


def polish_start(task: PoolTask) -> Iterator[tuple[float, np.ndarray]]:
    """Polish the start of a task, without requirements; rules of cameras and pairs are kept if the start keeps them.

    Gives the share of the steps that are taken, and the mount poses of the best rig so far, float32 [camera, 7].
    """
    cameras, rules, constraints = task.cameras, task.rules, task.constraints.of_any_modules
    assert task.start is not None
    start = nearest_rig(task.start, cameras.mount, constraints)
    if rules is not None and not rules.keeps(start, frozen=np.zeros(len(start), bool)):
        rules = None
    kept = {}
    if rules is not None:
        kept["hard_points"] = HardPoints(rules.margins, rules.needed)
        kept["pair_edges"] = rules.pair_edges
        kept["is_allowed"] = lambda pose, _: rules.keeps(pose, frozen=np.zeros(len(pose), bool))
    weights = {"weight": task.object_weight, "charge": task.charge}
    wanted = PolishTask(cameras.mount, constraints, len(task.scenes), **weights, **kept)
    count, radius = WHOLE_POLISH
    detect = partial(cameras.with_jacobian, scenes=task.scenes)
    for taken, step in enumerate(polish(start, detect, wanted, PolishSteps(count, radius))):
        yield taken / count, step.mount_pose
