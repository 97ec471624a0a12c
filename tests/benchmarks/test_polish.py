"""The polish against Adam and L-BFGS-B: the same starting rigs, constraints, exact Jacobians and camera renders.

Left out of the ordinary run; ``pytest tests/benchmarks/test_polish.py --benchmark-only --benchmark-json FILE`` runs it.
Its extra figures are the mean expected miss rates that the methods end with, from rigs selected out of pools of 64
cameras in 20 town scenes; every method may render its cameras 20 times.
"""

import contextlib

import numpy as np
import pytest
from scipy.optimize import minimize

from tests.benchmarks.test_speed import town_cameras
from tests.optimisation.calls import draw, polish, select
from warpav.detection.miss_rate import SUREST, expected_miss_rate
from warpav.optimisation.constraints import ZoneAndSpacing
from warpav.optimisation.mount import FreeRanges
from warpav.optimisation.polish import nearest_rig, step_unit
from warpav.optimisation.pool_search import too_near

RIG, RENDERS, SEEDS = 4, 20, (0, 1, 2, 3)
FREE = {"x, y, yaw": None, "and pitch": FreeRanges(pitch_rad=(np.radians(-10.0), np.radians(30.0)))}


class Work:
    """Town scenes, and the rig that the selection chooses of a pool."""

    def __init__(self, free, seed):
        self.cameras, pose, self.scenes = town_cameras(64, seeds=range(300 + 20 * seed, 320 + 20 * seed), free=free)
        self.mount = self.cameras.mount
        self.constraints = ZoneAndSpacing(self.mount.surface, camera_count=RIG)
        pool = draw(pose, scenes=self.scenes, cameras=self.cameras)
        found = select(pool.detection_probability, RIG, conflict=too_near(pose, self.constraints), time_limit_s=10.0)
        self.start, self.objective = pose[found.cameras], found.objective

    def feasible(self, pose):
        return nearest_rig(np.asarray(pose, np.float32), self.mount, self.constraints)

    def value_and_gradient(self, pose):
        """The expected miss rate and its gradient by the mount poses, [camera, 7]."""
        probability, jacobian = self.cameras.with_jacobian(np.asarray(pose, np.float32), self.scenes)
        missed = 1.0 - np.minimum(np.asarray(probability, np.float64), SUREST)
        others = np.prod(missed, axis=0) / missed
        return expected_miss_rate(probability), -np.einsum("co,cok->ck", others, jacobian) / missed.shape[1]


def by_polish(work):
    *_, last = polish(
        work.start,
        lambda pose: work.cameras.with_jacobian(pose, work.scenes),
        mount=work.mount,
        constraints=work.constraints,
        scene_count=1,
        camera_renders_max=RENDERS * RIG,
    )
    return last.objective


def by_adam(work):
    """3 cm, 1.5 degrees, cosine; every step is brought to the nearest feasible rig."""
    rate = step_unit(work.mount) * np.array([0.15, 0.15, 0.13, 0.26, 0.3, 0.3, 0.3])
    pose = work.feasible(work.start).astype(np.float64)
    first, second, best = np.zeros_like(pose), np.zeros_like(pose), np.inf
    for step in range(RENDERS):
        value, gradient = work.value_and_gradient(pose)
        best = min(best, value)
        first, second = 0.9 * first + 0.1 * gradient, 0.99 * second + 0.01 * gradient**2
        down = first / (1 - 0.9 ** (step + 1)) / (np.sqrt(second / (1 - 0.99 ** (step + 1))) + 1e-12)
        share = 0.5 * (1.0 + np.cos(np.pi * step / RENDERS))
        pose = work.feasible(pose - share * rate * down).astype(np.float64)
    return best


def by_lbfgs(work):
    """SciPy's L-BFGS-B; what it tries is brought to the nearest feasible rig before it is rendered."""
    unit = np.tile(step_unit(work.mount), (RIG, 1))
    is_free, values = unit > 0.0, []
    start = work.feasible(work.start).astype(np.float64)

    class SpentError(Exception):
        pass

    def objective(scaled):
        if len(values) == RENDERS:
            raise SpentError
        pose = start.copy()
        pose[is_free] += scaled * unit[is_free]
        value, gradient = work.value_and_gradient(work.feasible(pose))
        values.append(value)
        return 100.0 * value, 100.0 * (gradient * unit)[is_free]

    with contextlib.suppress(SpentError):
        minimize(objective, np.zeros(is_free.sum()), jac=True, method="L-BFGS-B", options={"maxiter": 200})
    return min(values)


@pytest.mark.parametrize("free", FREE)
def test_polish_against_other_descents(benchmark, free):
    rows = []

    def run():
        for seed in SEEDS:
            work = Work(FREE[free], seed)
            rows.append([work.objective, by_polish(work), by_adam(work), by_lbfgs(work)])

    benchmark.pedantic(run, rounds=1)
    mean = np.mean(rows, axis=0).round(5).tolist()
    benchmark.extra_info["expected_miss_rate"] = dict(zip(("start", "polish", "adam", "lbfgs"), mean, strict=True))
