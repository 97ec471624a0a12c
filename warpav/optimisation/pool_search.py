"""The search for a rig: render a pool of cameras, select a rig with a proven bound, polish it, price further cameras.

The pool makes the choice global: a few hundred single cameras stand for every rig that can be made of them, and an
integer programme finds the best one and proves how far off it can be. The gradient makes it exact: `polish` moves all
cameras of the chosen rig at once, on all scenes, below what the pool itself can reach. Then the duals of the selection
price cameras that the pool does not have: gradient ascent looks for those that would lower the bound most, they and the
polished ones join the pool, and the selection has the next word.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from scipy import sparse

from warpav.core.errors import ArgumentError
from warpav.core.executor import Executor
from warpav.core.progress import Progress
from warpav.optimisation.constraints import Constraints
from warpav.optimisation.mount import HEIGHT_DELTA_M, X_M, Y_M, CameraMount
from warpav.optimisation.polish import SUREST, expected_miss_rate, nearest_rig, polish, trust_unit
from warpav.optimisation.pool import CameraPool, spread_mount_poses
from warpav.optimisation.selection.price import Price
from warpav.optimisation.selection.select import Selection, select
from warpav.optimisation.single_cameras import SingleCameras
from warpav.scene.device_scene import DeviceScene

Stage = Literal["start", "selection", "polish", "pricing", "settled"]
PRICED_STEPS = 3
"""Steps of the ascent of the prices."""
_SAME = 1e-6  # the polish and the pool round differently


@dataclass(frozen=True)
class PoolSearchSettings:
    """How much the search looks at.

    Attributes:
        pool_cameras: Single cameras of the first pool, at least as many as the rig has.
        rounds: How often further cameras are priced, at most.
        priced_cameras: Cameras that a round adds at most.
        gap: Objective less bound at which a selection ends, an expected miss rate.
        selection_time_s: When a selection ends at the latest [s].
        camera_renders_max: Camera renders (one camera, one scene) that may be spent; None: as many as it takes.
        polishes: Whether selected rigs are polished.
    """

    pool_cameras: int = 128
    rounds: int = 2
    priced_cameras: int = 16
    gap: float = 5e-4
    selection_time_s: float = 20.0
    camera_renders_max: int | None = None
    polishes: bool = True


@dataclass(frozen=True, eq=False)
class Found:
    """The state of a search: at every moment the best rig, and what is proven.

    Attributes:
        mount_pose: The best rig so far, which satisfies all constraints, float32 [camera, 7].
        objective: Its expected miss rate on the scenes of the search.
        bound: No rig of cameras of the pool is below it; 0 before the first selection. It says nothing of cameras that
            the pool does not have.
        stage: What has just been done; ``settled`` where nothing is left to do.
        camera_renders: Camera renders so far, those that were found in the cache not among them.
        pool_cameras: Cameras of the pool.
        seconds: Wall time so far [s].
        price: What further cameras would bring; None before the first relaxation.
        round: Of pricing, from 0.
    """

    mount_pose: np.ndarray
    objective: float
    bound: float
    stage: Stage
    camera_renders: int
    pool_cameras: int
    seconds: float
    price: Price | None = field(repr=False, default=None)
    round: int = 0

    @property
    def gap(self) -> float:
        """Objective less bound; negative where the polish has gone below what the pool can reach."""
        return self.objective - self.bound


def pool_search(
    cameras: SingleCameras,
    scenes: Sequence[DeviceScene],
    constraints: Constraints,
    camera_count: int,
    *,
    start: np.ndarray | None = None,
    settings: PoolSearchSettings | None = None,
    seed: int = 0,
    executor: Executor | None = None,
    cache: Path | None = None,
    progress: Progress | None = None,
) -> Iterator[Found]:
    """Search for the rig with the lowest expected miss rate; whoever stops listening keeps the best so far.

    Args:
        cameras: What the cameras are, and how likely one is to detect.
        scenes: The scenes, on the device of the mount.
        constraints: Where cameras may stand; frozen cameras are part of every rig.
        camera_count: Cameras of the rig, frozen ones among them.
        start: A rig whose cameras join the pool, so that the result is not worse, float [camera, 7]; it is brought to
            the nearest one that satisfies the constraints. None: there is none.
        settings: How much to look at.
        seed: Of the pool and of the selection.
        executor: Where the pool is drawn.
        cache: Folder that keeps what is drawn; None: nothing is kept.
        progress: Shows the drawing of the pool.

    Yields:
        Every state that the search comes to; objectives never rise.

    Raises:
        InputError: The pool sees nothing, or the cameras do not fit.
    """
    options = (start, settings or PoolSearchSettings(), seed, executor, cache, progress)
    state = None
    for state in _states(cameras, scenes, constraints, camera_count, *options):
        yield state
    assert state is not None
    yield replace(state, stage="settled")


def _states(
    cameras: SingleCameras,
    scenes: Sequence[DeviceScene],
    constraints: Constraints,
    camera_count: int,
    start: np.ndarray | None,
    settings: PoolSearchSettings,
    seed: int,
    executor: Executor | None,
    cache: Path | None,
    progress: Progress | None,
) -> Iterator[Found]:
    if settings.pool_cameras < camera_count:
        raise ArgumentError("pool_cameras", f"expected at least the rig's {camera_count}, got {settings.pool_cameras}")
    began = time.perf_counter()
    mount = cameras.mount
    rig_of = _Assembly(mount, camera_count)
    spread = spread_mount_poses(mount, constraints, settings.pool_cameras, seed=seed)
    known: np.ndarray | None = None
    if start is not None:
        start = nearest_rig(start, mount, constraints)
        known = np.arange(camera_count)
        spread = np.concatenate([start[~rig_of.is_frozen], spread])
    pose = np.concatenate([rig_of.frozen, spread])
    pool = CameraPool.draw(pose, scenes=scenes, cameras=cameras, executor=executor, cache=cache, progress=progress)
    further = 0  # camera renders of the polish and of the pricing
    best: np.ndarray | None = None
    objective = np.inf

    def found(stage: Stage, selection: Selection | None, number: int) -> Found:
        assert best is not None
        return Found(
            best,
            objective,
            selection.bound if selection else 0.0,
            stage,
            pool.drawn_count + further,
            len(pool.mount_pose),
            time.perf_counter() - began,
            selection.price if selection else None,
            number,
        )

    def is_spent(more: int = 0) -> bool:
        limit = settings.camera_renders_max
        return limit is not None and pool.drawn_count + further + more > limit

    if start is not None and known is not None:
        best = start
        objective = expected_miss_rate(pool.detection_probability[known])
        yield found("start", None, 0)
    for number in range(settings.rounds + 1):
        selection = select(
            np.minimum(pool.detection_probability, SUREST),
            camera_count,
            conflict=too_near(pool.mount_pose, constraints),
            required=np.arange(len(rig_of.frozen)),
            start=known,
            gap=settings.gap,
            time_limit_s=settings.selection_time_s,
            seed=seed,
        )
        chosen = rig_of.rig(pool.mount_pose[selection.cameras])
        is_news = number == 0 or selection.objective < objective - _SAME
        if best is None or selection.objective < objective - _SAME:
            best, objective = chosen, selection.objective
        yield found("selection", selection, number)
        if not is_news:
            return
        before = further
        steps = polish(
            chosen,
            lambda moved: cameras.with_jacobian(moved, scenes),
            mount=mount,
            constraints=constraints,
            scene_count=len(scenes),
            camera_renders_max=None
            if settings.camera_renders_max is None
            else settings.camera_renders_max - pool.drawn_count - further,
        )
        for step in steps if settings.polishes else ():
            further = before + step.camera_renders
            if step.objective < objective:
                best, objective = step.mount_pose, step.objective
                yield found("polish", selection, number)
        if number == settings.rounds or selection.price is None or is_spent(len(scenes) * settings.priced_cameras):
            return
        priced, renders = _priced(cameras, scenes, constraints, pool, selection.price, settings)
        further += renders
        first_new = len(pool.mount_pose)
        polished = chosen if best is None else best
        pool = pool.extended(np.concatenate([polished[~rig_of.is_frozen], priced]))
        known = np.concatenate(
            [np.arange(len(rig_of.frozen)), first_new + np.arange(camera_count - len(rig_of.frozen))]
        )
        yield found("pricing", selection, number)


def _priced(
    cameras: SingleCameras,
    scenes: Sequence[DeviceScene],
    constraints: Constraints,
    pool: CameraPool,
    price: Price,
    settings: PoolSearchSettings,
) -> tuple[np.ndarray, int]:
    """Cameras that promise to lower the bound, float32 [camera, 7], and the camera renders of looking for them.

    From the cheapest cameras of the pool the reduced cost is followed downhill along its exact slope.
    """
    cost = price.reduced_cost(np.minimum(np.asarray(pool.detection_probability, np.float64), SUREST))
    pose = pool.mount_pose[np.argsort(cost, kind="stable")[: settings.priced_cameras]]
    mount, unit = cameras.mount, trust_unit(cameras.mount)
    length = np.full(len(pose), 0.5)
    lowest, kept, slope = np.full(len(pose), np.inf), pose, np.zeros(pose.shape)
    renders = 0
    tried = pose
    for _ in range(PRICED_STEPS):
        probability, jacobian = cameras.with_jacobian(tried, scenes)
        renders += len(pose) * len(scenes)
        probability = np.minimum(probability, SUREST)
        cost = price.reduced_cost(probability)
        is_lower = cost < lowest
        length = np.where(is_lower, length, 0.4 * length)
        kept = np.where(is_lower[:, None], tried, kept)
        downhill = -np.einsum("co,cok->ck", price.reduced_cost_slope(probability), jacobian) * unit
        slope = np.where(is_lower[:, None], downhill, slope)
        lowest = np.minimum(cost, lowest)
        norm = np.maximum(np.abs(slope).max(axis=1, keepdims=True), 1e-12)
        tried = np.clip(kept + length[:, None] * slope / norm * unit, mount.low, mount.high)
        tried[:, [X_M, Y_M]] = constraints.nearest_place(tried[:, [X_M, Y_M]])
        tried = tried.astype(np.float32)
    return tried, renders


class _Assembly:
    """Rigs of a mount, some of whose cameras may be frozen: their own come first in a pool, and keep their places."""

    def __init__(self, mount: CameraMount, camera_count: int) -> None:
        frozen = mount.frozen
        self.is_frozen = np.zeros(camera_count, bool) if frozen is None else frozen.is_frozen
        self.frozen = (
            np.zeros((0, 7), np.float32) if frozen is None else frozen.mount_pose[frozen.is_frozen].astype(np.float32)
        )

    def rig(self, pose: np.ndarray) -> np.ndarray:
        """The rig of chosen cameras, the frozen ones first among them, float32 [camera, 7]."""
        result = np.empty((len(self.is_frozen), 7), np.float32)
        count = len(self.frozen)
        result[self.is_frozen], result[~self.is_frozen] = pose[:count], pose[count:]
        return result


def too_near(mount_pose: np.ndarray, constraints: Constraints) -> sparse.csr_array:
    """Which cameras stand too near to each other to be in one rig, bool [camera, camera]; frozen pairs may."""
    from scipy.spatial import KDTree

    place = mount_pose[:, [X_M, Y_M]].astype(np.float64)
    point_m = np.c_[place, constraints.surface.height_at_m(place) + mount_pose[:, HEIGHT_DELTA_M]]
    pair = KDTree(point_m).query_pairs(constraints.min_spacing_m, output_type="ndarray")
    held = 0 if constraints.frozen is None else int(constraints.frozen.is_frozen.sum())
    pair = pair[pair.max(axis=1, initial=-1) >= held]
    count = len(mount_pose)
    return sparse.csr_array((np.ones(len(pair), bool), (pair[:, 0], pair[:, 1])), shape=(count, count))
