"""Polish: move all cameras of a rig at once until the expected miss rate of all scenes settles.

Every step renders each camera once in every scene, with the Jacobian of its probability to detect each object. The
rig's expected miss rate is then known around the present poses, not as one slope but object by object, and with the
kinks that earlier steps have come across (`tangent_model`). This model is minimised under the constraints within a
radius, and the rig that it finds is the next.

The radius shrinks on a schedule, and a step is taken even where the objective rises, unless it rises by much. With
images of some hundred pixels the objective is rough at the length of a step: a method that takes only what is better,
as trust regions do, ends on the first bump, far above what can be had.

Source: the model is a composite one, exact to first order, as in Gauss-Newton methods (Nocedal and Wright 2006, chapter
10); docs/decisions/search.md has it beside Adam and L-BFGS-B.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from threadpoolctl import threadpool_limits

from warpav.detection import expected_miss_rate, false_alarm_cost
from warpav.optimisation._camera_loss import SOFTNESS, RobustObjective
from warpav.optimisation._constraints import Constraints
from warpav.optimisation._mount import HEIGHT_DELTA_M, LOG_ZOOM, PITCH_RAD, X_M, Y_M, YAW_RAD, CameraMount
from warpav.optimisation._tangent_model import REACH, TANGENTS, HardPoints, Margins, Rendered, TangentModel

Detected = tuple[np.ndarray, np.ndarray]
"""The probability that each camera detects each object [camera, object], and its Jacobian [camera, object, 7]."""

_Inequalities = tuple[np.ndarray, np.ndarray]  # ``spare + slope . move >= 0``: float [row] and [row, camera, 7]

_STEP_UNIT = {X_M: 0.2, Y_M: 0.2, YAW_RAD: 0.2, PITCH_RAD: 0.1, HEIGHT_DELTA_M: 0.1, LOG_ZOOM: 0.1}
"""How far a number of a mount pose may move in a step of radius 1 [m, rad, 1]."""
_RADIUS_FIRST, _RADIUS_LAST = 0.4, 0.03
"""Of the first and of the last step, in `_STEP_UNIT`: 8 cm and 6 mm."""
_RISE_MAX = 0.15  # how much higher than the best an objective may be, relatively, for the steps to go on from there


@dataclass(frozen=True, eq=False)
class _PolishStep:
    """What a step of the polish came to."""

    mount_pose: np.ndarray  # the best rig so far, float32 [camera, 7]; it satisfies all constraints
    objective: float  # its expected miss rate, or robust objective
    tried_objective: float  # that of the rig that the step tried
    promised: float  # what the model expected of that rig
    radius: float  # within which it was sought, in `_STEP_UNIT`
    camera_renders: int  # camera renders (one camera in one scene) so far


@dataclass(frozen=True, eq=False)
class PolishTask:
    """What rigs are polished for."""

    mount: CameraMount  # says what is free, and how far; frozen cameras stay
    constraints: Constraints  # what every rig satisfies
    scene_count: int  # camera renders that a camera costs
    weight: np.ndarray | None = None  # of each object, at least 0; None: all alike
    robust: RobustObjective | None = None  # what is minimised; None: the expected miss rate
    charge: np.ndarray | None = None  # for false alarms at each object, see `false_alarm_cost`; None: nothing
    hard_points: HardPoints | None = None  # points that steps keep met as far as tangents tell
    # what a step of some reach [camera, 7] must leave between the cameras of a rig [camera, 7]
    pair_edges: Callable[[np.ndarray, np.ndarray], _Inequalities] | None = None
    # whether a rig [camera, 7] whose cameras detect so much [camera, object] is one
    is_allowed: Callable[[np.ndarray, np.ndarray], bool] | None = None


@dataclass(frozen=True)
class PolishSteps:
    """How a polish steps."""

    count: int = 20  # steps after the start, at least 1, over which the radius shrinks
    radius: float = _RADIUS_FIRST  # of the first step, in `_STEP_UNIT`; smaller where the rig is nearly polished
    tolerance: float = 1e-4  # relative gain that the model must promise for another step
    camera_renders_max: int | None = None  # camera renders that may be spent, the first among them


def polish(
    mount_pose: np.ndarray, detect: Callable[[np.ndarray], Detected], task: PolishTask, steps: PolishSteps | None = None
) -> Iterator[_PolishStep]:
    """Steps of shrinking radius; fewer where the model sees no gain any more or the next would cost too much.

    From ``mount_pose``, float [camera, 7], or the nearest rig that satisfies the constraints; ``detect`` renders
    cameras in all scenes, of every step those that moved. The start comes first.
    """
    steps = steps or PolishSteps()
    mount, constraints, robust, hard_points = task.mount, task.constraints, task.robust, task.hard_points
    pose = nearest_rig(np.asarray(mount_pose, np.float32), mount, constraints)
    problem = _Problem(mount, constraints, pose)
    probability, jacobian = detect(pose)
    margins = None if hard_points is None else hard_points.margins(pose)
    count = probability.shape[1]
    shares = np.ones(count) if task.weight is None else np.asarray(task.weight, np.float64)
    shares = shares / shares.sum()
    size = 1 + mount.is_pair(pose).astype(int)
    rig_value = None if robust is None else partial(robust.value_and_slope, size=size, softness=SOFTNESS)

    def value_of(found: np.ndarray) -> float:
        value = expected_miss_rate(found, shares) if robust is None else robust.of_rig(found, shares, size).objective
        return value + float(false_alarm_cost(found, task.charge).sum())

    objective = value_of(probability)
    renders = len(pose) * task.scene_count
    yield _PolishStep(pose, objective, objective, objective, 0.0, renders)
    moving = len(pose) if mount.frozen is None else int((~mount.frozen.is_frozen).sum())
    step_count = steps.count
    if steps.camera_renders_max is not None and moving:
        step_count = min(step_count, (steps.camera_renders_max - renders) // (moving * task.scene_count))
    best = here = Rendered(pose, probability, jacobian, objective, margins)
    rendered = [here]
    refused: list[tuple[np.ndarray, Margins]] = []
    for length in _radii(steps.radius, step_count):
        reach = REACH * length * step_unit(mount)
        model = TangentModel(here, shares, earlier=rendered, reach=reach, rig_value=rig_value, charge=task.charge)
        edges = list[_Inequalities]()
        if hard_points is not None and here.margins is not None:
            found = hard_points.edges(here.mount_pose, here.margins, problem.reach(length), refused)
            edges.append((found.spare, found.slope(len(pose))))
        if task.pair_edges is not None:
            edges.append(task.pair_edges(here.mount_pose, problem.reach(length)))
        tried = nearest_rig(problem.minimised(model, here.mount_pose, length, edges), mount, constraints)
        promised = model.value(tried.astype(np.float64) - here.mount_pose)
        if promised > model.value(np.zeros_like(here.jacobian[:, 0])) - steps.tolerance * here.objective:
            here = best
            continue
        moved = np.flatnonzero((tried != here.mount_pose).any(axis=1))
        probability, jacobian = here.probability.copy(), here.jacobian.copy()
        probability[moved], jacobian[moved] = detect(tried[moved])
        renders += len(moved) * task.scene_count
        if hard_points is not None and here.margins is not None:
            margins = (here.margins[0].copy(), here.margins[1].copy())
            margins[0][moved], margins[1][moved] = hard_points.margins(tried[moved])
        here = Rendered(tried, probability, jacobian, value_of(probability), margins)
        rendered.append(here)
        tried_objective = here.objective
        if task.is_allowed is not None and not task.is_allowed(here.mount_pose, here.probability):
            if here.margins is not None:
                refused = [*refused, (here.mount_pose, here.margins)][-TANGENTS:]
            here = best
        elif here.objective < best.objective:
            best = here
        elif here.objective > best.objective * (1.0 + _RISE_MAX):
            here = best
        yield _PolishStep(best.mount_pose, best.objective, tried_objective, promised, length, renders)


def _radii(first: float, count: int) -> np.ndarray:
    """A cosine from the first radius to the last."""
    share = 0.5 * (1.0 + np.cos(np.pi * np.arange(count) / max(count, 1)))
    return _RADIUS_LAST + (first - _RADIUS_LAST) * share


def nearest_rig(mount_pose: np.ndarray, mount: CameraMount, constraints: Constraints) -> np.ndarray:
    """The nearest rig that satisfies the constraints and the free ranges, float32 [camera, 7]."""
    near = mount.within(np.asarray(mount_pose, np.float32)).astype(np.float64)
    near[:, [X_M, Y_M]] = constraints.project(near[:, [X_M, Y_M]], near[:, HEIGHT_DELTA_M])
    return mount.within(near.astype(np.float32))


def step_unit(mount: CameraMount) -> np.ndarray:
    """How far each number of a mount pose may move at radius 1, 0 where it is not free, float64 [7]."""
    is_free = mount.is_free.copy()
    is_free[[X_M, Y_M, YAW_RAD]] = True
    unit = np.zeros(len(is_free))
    unit[list(_STEP_UNIT)] = list(_STEP_UNIT.values())
    return np.where(is_free, unit, 0.0)


class _Problem:
    """The free numbers of a rig as one vector, and what they must satisfy."""

    def __init__(self, mount: CameraMount, constraints: Constraints, mount_pose: np.ndarray) -> None:
        self.constraints = constraints
        unit = np.tile(step_unit(mount), (len(mount_pose), 1))
        self.is_free = unit > 0.0
        if mount.frozen is not None:
            self.is_free[mount.frozen.is_frozen] = False
        self.unit = unit[self.is_free]
        self.low, self.high = (end[self.is_free] for end in mount.ends_of(mount_pose[:, [X_M, Y_M]]))

    def free_of(self, pose: np.ndarray) -> np.ndarray:
        return np.asarray(pose, np.float64)[self.is_free]

    def pose_of(self, pose: np.ndarray, free: np.ndarray) -> np.ndarray:
        """A pose whose free numbers are others, float64 [camera, 7]."""
        result = np.array(pose, np.float64)
        result[self.is_free] = free
        return result

    def reach(self, radius: float) -> np.ndarray:
        """How far each number may move in a step, float64 [camera, 7]."""
        return self.pose_of(np.zeros(self.is_free.shape), radius * self.unit)

    def slack_m(self, pose: np.ndarray) -> np.ndarray:
        return self.constraints.slack_m(pose[:, [X_M, Y_M]], pose[:, HEIGHT_DELTA_M])

    def slack_slope(self, pose: np.ndarray) -> np.ndarray:
        """How the slack changes with the free numbers, float64 [constraint, free number]."""
        by_place = self.constraints.slack_slope(pose[:, [X_M, Y_M]], pose[:, HEIGHT_DELTA_M])
        slope = np.zeros((len(by_place), *self.is_free.shape))
        slope[..., [X_M, Y_M, HEIGHT_DELTA_M]] = by_place
        return slope[:, self.is_free]

    @threadpool_limits.wrap(limits=1, user_api="blas")  # more threads only wait for one another, the longer the busier
    def minimised(
        self, model: TangentModel, pose: np.ndarray, radius: float, edges: Sequence[_Inequalities] = ()
    ) -> np.ndarray:
        """The rig with the lowest modelled objective within a radius of a rig, constraints and edges, [camera, 7]."""
        from scipy.optimize import minimize

        here, unit = self.free_of(pose), self.unit
        low = np.maximum(-radius, (self.low - here) / unit)
        high = np.minimum(radius, (self.high - here) / unit)

        def objective(scaled: np.ndarray) -> tuple[float, np.ndarray]:
            value, gradient = model.value_and_gradient(self.pose_of(np.zeros(pose.shape), scaled * unit))
            return 100.0 * value, 100.0 * self.free_of(gradient) * unit

        def moved(scaled: np.ndarray) -> np.ndarray:
            return self.pose_of(pose, here + scaled * unit)

        slack = {
            "type": "ineq",
            "fun": lambda scaled: self.slack_m(moved(scaled)),
            "jac": lambda scaled: self.slack_slope(moved(scaled)) * unit,
        }
        constraints = [slack]
        for spare, of_pose in edges:
            if len(spare):
                slope = of_pose[:, self.is_free] * unit
                constraints.append(
                    {
                        "type": "ineq",
                        "fun": lambda scaled, a=spare, b=slope: a + b @ scaled,
                        "jac": lambda _, b=slope: b,
                    }
                )
        found = minimize(
            objective,
            np.clip(np.zeros(len(here)), low, high),
            jac=True,
            method="SLSQP",
            bounds=np.c_[low, high],
            constraints=constraints,
            options={"maxiter": 60, "ftol": 1e-8},
        )
        scaled = np.clip(np.nan_to_num(found.x), low, high)
        return moved(scaled)
