"""Pools of single cameras: which of them is how likely to detect which object, the matrix that rigs are chosen from.

`spread_mount_poses` says where the cameras stand, `CameraPool.draw` renders each of them in each scene. What has been
drawn is kept in a cache folder, camera by camera: a pool that was interrupted goes on where it stopped, and a larger
one draws only what is new.
"""

from __future__ import annotations

import contextlib
import itertools
import pickle
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from scipy import sparse

from warpav.core.cores import peak_bytes
from warpav.core.errors import ArgumentError, InputError
from warpav.core.executor import Executor
from warpav.core.progress import NullProgress, Progress
from warpav.optimisation._constraints import Constraints
from warpav.optimisation._mount import MOUNT_POSE_SIZE, X_M, Y_M, YAW_RAD, CameraMount
from warpav.optimisation._pool_cache import SCENES, PoolCache, pose_keys, rows_of
from warpav.optimisation._required_points import RequiredPoints
from warpav.optimisation._single_cameras import SingleCameras
from warpav.scene import DeviceScene

_CHUNK_CAMERAS = 512  # cameras that one task draws in one scene
_POOL_NAME = "scenes seen by the pool"  # what progress calls the cameras that are drawn
_HALF_ABOVE_BYTES = 2**29  # matrices that would be larger than this in single precision are kept in half precision
SLOPE_COST = 2.0  # time of a render with slopes over one of a pool, about
_LEARNT_CAMERAS = 4  # that are drawn in each scene before their time tells anything
_SPREAD_BLOCK = 1024
_SPREAD_TRIES = 2**22
_PAIRS_A_TURN = 3.0
_RULES_TRIES = 40  # cameras that are looked at for each that keeps the design rules, at most


def spread_mount_poses(
    mount: CameraMount,
    constraints: Constraints,
    count: int,
    *,
    seed: int,
    allowed: Callable[[np.ndarray], np.ndarray] | None = None,
) -> np.ndarray:
    """Cameras spread evenly over all that is free: a scrambled Sobol sequence, cut to where cameras may stand.

    Returns mount poses, float32 [camera, 7]; yaws in -pi..pi.

    ``allowed`` says which cameras [camera, 7] keep the design rules; None: all.

    The first n of more cameras are the n cameras of the same seed. Of modules there are equally many, in turns, of
    pairs three for each single one of a symmetric rig, which stands in the middle and has less to choose.
    """
    if count < 1:
        raise ArgumentError("count", f"expected at least 1 camera, got {count}")
    if not mount.is_mixed:
        return _spread(mount, constraints, count, np.random.default_rng(seed), 0, allowed)
    kinds = len(mount.cameras)
    turns = np.ones(kinds) if not mount.is_symmetric else np.where(mount.surface.pairs, _PAIRS_A_TURN, 1.0)
    each = np.ceil(count * turns / turns.sum()).astype(int)
    of_kind = [_spread(mount, constraints, each[k], np.random.default_rng([seed, k]), k, allowed) for k in range(kinds)]
    # in turns, as long as there are some
    turn = np.concatenate([np.arange(len(part)) / turns[k] for k, part in enumerate(of_kind)])
    return np.concatenate(of_kind)[np.argsort(turn, kind="stable")][:count]


def _spread(
    mount: CameraMount,
    constraints: Constraints,
    count: int,
    rng: np.random.Generator,
    module: int,
    allowed: Callable[[np.ndarray], np.ndarray] | None,
) -> np.ndarray:
    from scipy.stats import qmc

    numbers = np.r_[X_M, Y_M, YAW_RAD, np.flatnonzero(mount.is_free)]
    low_m, high_m = mount.surface.bounds_of(module)
    sequence = qmc.Sobol(len(numbers), scramble=True, rng=rng)
    kept, looked_at = np.zeros((0, MOUNT_POSE_SIZE), np.float32), 0
    for _ in range(_SPREAD_TRIES // _SPREAD_BLOCK):
        pose = np.zeros((_SPREAD_BLOCK, MOUNT_POSE_SIZE), np.float32)
        share = sequence.random(_SPREAD_BLOCK)
        pose[:, [X_M, Y_M]] = low_m + share[:, :2] * (high_m - low_m)
        low, high = (each.astype(np.float64) for each in mount.ends_of(pose[:, [X_M, Y_M]]))
        goes_round = np.isinf(low[:, YAW_RAD])
        low[goes_round, YAW_RAD], high[goes_round, YAW_RAD] = -np.pi, np.pi
        others = numbers[2:]
        pose[:, others] = low[:, others] + share[:, 2:] * (high - low)[:, others]
        pose = mount.clipped(pose)
        is_kept = constraints.contains(pose[:, [X_M, Y_M]]) & (mount.module_of(pose) == module)
        pose, step = pose[is_kept][: 4 * count], max(count // 2, 1)
        for few in (pose[first : first + step] for first in range(0, len(pose), step)):
            kept = np.concatenate([kept, few if allowed is None else few[allowed(few)]])
            looked_at += len(few)
            if len(kept) >= count or (allowed is not None and looked_at > _RULES_TRIES * count):
                return kept[:count]
    raise constraints.do_not_fit(1)


@dataclass(frozen=True, eq=False)
class Drawing:
    """Where pools are drawn."""

    executor: Executor | None = None  # where it is done; None: here, with a thread for each core
    cache: Path | None = None  # folder that keeps what is drawn; None: nothing is kept
    chunk_cameras: int = _CHUNK_CAMERAS  # cameras that one task draws in one scene, at least 1


@dataclass(frozen=True, eq=False)
class CameraPool:
    """Single cameras, and the probability that each detects each object of some scenes."""

    mount_pose: np.ndarray  # the cameras as the mount counts them, float32 [camera, 7]
    detection_probability: np.ndarray  # 0..1, [camera, object], the objects scene by scene
    scene_index: np.ndarray  # scene of every object, int32 [object]
    drawn_count: int  # camera renders (one camera in one scene) that were drawn for the pool
    cached_count: int  # camera renders that were found in the cache
    is_drawn: np.ndarray  # which cameras were drawn here, and are in the cache where there is one, bool [camera]
    _source: _Source

    @classmethod
    def empty(
        cls, scenes: Sequence[DeviceScene | RequiredPoints], cameras: SingleCameras, drawing: Drawing | None = None
    ) -> CameraPool:
        """No cameras yet in some scenes; ``drawing`` changes no bit of what joins them."""
        source = _Source(tuple(scenes), cameras, drawing or Drawing())
        none = np.zeros((0, MOUNT_POSE_SIZE), np.float32), np.zeros((0, len(source.scene_index)), np.float32)
        return cls(*none, source.scene_index, 0, 0, np.zeros(0, bool), source)

    def extended(
        self,
        mount_pose: np.ndarray,
        *,
        progress: Progress | None = None,
        name: str = _POOL_NAME,
        may_see_nothing: bool = False,
    ) -> CameraPool:
        """The pool with more cameras behind those that it has; only what it does not have yet is drawn."""
        more = _checked_poses(mount_pose)
        new = more[rows_of(more, self.mount_pose) < 0]
        new = new[np.sort(np.unique(pose_keys(new), return_index=True)[1])]
        drawn, drawn_count, cached_count = self._source.probabilities(new, progress or NullProgress(), name)
        known = np.concatenate([self.mount_pose, new])
        together = np.concatenate([self.mount_pose, more])
        shape = (len(together), len(self.scene_index))
        found = np.empty(shape, np.float16 if 4 * shape[0] * shape[1] > _HALF_ABOVE_BYTES else np.float32)
        found[: len(self.mount_pose)] = self.detection_probability
        row = rows_of(more, known)
        is_new, is_first = row >= len(self.mount_pose), np.zeros(len(row), bool)
        is_first[np.unique(row, return_index=True)[1]] = True
        found[len(self.mount_pose) :][is_new] = drawn[row[is_new] - len(self.mount_pose)]
        found[len(self.mount_pose) :][~is_new] = self.detection_probability[row[~is_new]]
        traffic = [scene for scene in self._source.scenes if not isinstance(scene, RequiredPoints)]
        count = sum(map(self.cameras.column_count, traffic))  # requirements stand behind
        if not (may_see_nothing or found[:, :count].any()):
            objects = sum(scene.vehicle_count for scene in traffic)
            raise InputError(
                f"pool: expected cameras that see something, got {shape[0]} of which none sees any of the {objects} "
                f"objects of {len(traffic)} scenes; check scenes.targets, and where the cameras stand"
            )
        return replace(
            self,
            mount_pose=together,
            detection_probability=found,
            drawn_count=self.drawn_count + drawn_count,
            cached_count=self.cached_count + cached_count,
            is_drawn=np.append(self.is_drawn, is_new & is_first),
        )

    def joined(self, mount_pose: np.ndarray, detection_probability: np.ndarray) -> CameraPool:
        """The pool with cameras behind those that it has that were rendered elsewhere in all its scenes.

        They count as drawn. They are not kept in the cache: with a Jacobian a camera is rendered another way, and its
        probabilities may differ in the last digits.
        """
        pose = _checked_poses(mount_pose)
        dtype = self.detection_probability.dtype
        return replace(
            self,
            mount_pose=np.concatenate([self.mount_pose, pose]),
            detection_probability=np.concatenate(
                [self.detection_probability, np.asarray(detection_probability, dtype)]
            ),
            drawn_count=self.drawn_count + len(pose) * len(self._source.scenes),
            is_drawn=np.append(self.is_drawn, np.zeros(len(pose), bool)),
        )

    @property
    def scenes(self) -> tuple[DeviceScene | RequiredPoints, ...]:
        return self._source.scenes

    @property
    def cameras(self) -> SingleCameras:
        """What drew it, with its renderers and recordings."""
        return self._source.cameras

    def state(self) -> dict[str, np.ndarray]:
        """What `restored` needs besides the cache: of cameras that were not drawn also what they detect, to the bit."""
        kept = np.ascontiguousarray(self.detection_probability[~self.is_drawn])
        bits = sparse.csr_array(kept.view(f"u{kept.itemsize}"))  # most are 0
        return {
            "mount_pose": self.mount_pose,
            "is_drawn": self.is_drawn,
            "counts": np.array([self.drawn_count, self.cached_count, self.detection_probability.itemsize]),
            **{name: getattr(bits, name) for name in ("data", "indices", "indptr")},
        }

    def restored(self, state: Mapping[str, np.ndarray], progress: Progress | None = None) -> CameraPool:
        """The pool that gave `state`, for the same scenes and cameras as this empty one."""
        drawn_count, cached_count, size = (int(each) for each in state["counts"])
        pose, is_drawn = np.asarray(state["mount_pose"], np.float32), np.asarray(state["is_drawn"], bool)
        pool = self.extended(pose[is_drawn], progress=progress, may_see_nothing=True)
        shape = int((~is_drawn).sum()), len(pool.scene_index)
        bits = sparse.csr_array((state["data"], state["indices"], state["indptr"]), shape=shape)
        found = np.empty((len(pose), shape[1]), f"f{size}")
        found[is_drawn], found[~is_drawn] = pool.detection_probability, bits.toarray().view(f"f{size}")
        return replace(
            pool,
            mount_pose=pose,
            detection_probability=found,
            drawn_count=drawn_count,
            cached_count=cached_count,
            is_drawn=is_drawn,
        )


class Pace:
    """How long the camera renders of a search take, which is learnt as they are drawn."""

    def __init__(self) -> None:
        self.begin(0)
        self._seconds = 0.0  # that a render takes; 0: not known

    def begin(self, drawn_count: int) -> None:
        """From now on, with so many renders drawn, time counts."""
        self._since = time.perf_counter(), drawn_count

    def learn(self, pool: CameraPool, *, cost: float = 1.0) -> None:
        """Learn from what was drawn since the last time; what follows costs so many times as much."""
        began, before = self._since
        if pool.drawn_count - before >= len(pool.scenes):
            self._seconds = (time.perf_counter() - began) / (pool.drawn_count - before)
        self._seconds *= cost
        self.begin(pool.drawn_count)

    def left_text(self, pool: CameraPool, planned: int) -> str:
        """How long the rest of so many cameras in each scene takes, in words; empty where it is not known."""
        if pool.drawn_count - self._since[1] >= _LEARNT_CAMERAS * len(pool.scenes):
            self.learn(pool)
        left = planned * len(pool.scenes) - pool.drawn_count - pool.cached_count
        return f", about {_duration(left * self._seconds)} left" if left > 0 and self._seconds else ""

    def forecast(self, pool: CameraPool, of_pool: int, later: int, *, with_points: bool) -> str:
        """How long a search takes that draws so many cameras, and how much memory, in words; its start is drawn."""
        self.learn(pool)
        threads, count = pool.cameras.scenes_at_once, len(pool.scenes)
        seconds = self._seconds * count * (of_pool + SLOPE_COST * later) / threads
        drawing, used = pool.cameras.drawing_bytes(of_pool), peak_bytes()
        memory = 0 if used is None else used + (1 + with_points) * drawing
        memory_text = f" and {(memory + 16 * of_pool * len(pool.scene_index)) / 1e9:.1f} GB of memory" if memory else ""
        time_text = f"about {_duration(seconds)}"
        return f"{time_text}{memory_text} for the search, which draws some {of_pool + later} cameras in {count} scenes"


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100.0 else f"{seconds / 60.0:.0f} min"


_Place = DeviceScene | RequiredPoints | Path


@dataclass(frozen=True)
class _Chunk:
    """A task: some cameras in one scene, or in the files that these lie in."""

    cameras: SingleCameras | Path
    scene: _Place
    scene_number: int  # its place among the scenes
    row: np.ndarray  # the cameras' places among those to be drawn
    mount_pose: np.ndarray  # float32 [camera, 7]


@dataclass(frozen=True, eq=False)
class _Source:
    """Where a pool's numbers come from."""

    scenes: tuple[DeviceScene | RequiredPoints, ...]
    cameras: SingleCameras
    drawing: Drawing

    def __post_init__(self) -> None:
        if not any(scene.vehicle_count for scene in self.scenes):
            raise ArgumentError("scenes", f"expected at least one object, got none in {len(self.scenes)} scenes")
        if self.drawing.chunk_cameras < 1:
            raise ArgumentError("chunk_cameras", f"expected at least 1, got {self.drawing.chunk_cameras}")
        supersampling = self.cameras.supersampling
        if supersampling < 1:
            raise ArgumentError("cameras", f"expected supersampling of at least 1, got {supersampling}")
        if self.drawing.cache is None and self.executor.name in ("ray", "slurm"):
            raise ArgumentError(
                "cache", f"expected a folder that all machines see, with executor {self.executor.name}, got none"
            )

    @cached_property
    def scene_index(self) -> np.ndarray:
        """Scene of every object, int32 [object]."""
        counts = [self.cameras.column_count(scene) for scene in self.scenes]
        return np.repeat(np.arange(len(counts), dtype=np.int32), counts)

    @cached_property
    def executor(self) -> Executor:
        return self.drawing.executor or Executor()

    @cached_property
    def _kept(self) -> PoolCache | None:
        return None if self.drawing.cache is None else PoolCache(self.drawing.cache, self.cameras.identity)

    def probabilities(self, mount_pose: np.ndarray, progress: Progress, name: str) -> tuple[np.ndarray, int, int]:
        """Detection probabilities of some cameras, float32 [camera, object]; how many renders were drawn and cached."""
        ends = np.searchsorted(self.scene_index, np.arange(len(self.scenes) + 1))
        objects = [slice(*pair) for pair in itertools.pairwise(ends)]
        found = np.zeros((len(mount_pose), ends[-1]), np.float32)
        missing = []
        for number, scene in enumerate(self.scenes):
            row = np.arange(len(mount_pose))
            if self._kept is not None:
                is_kept, kept = self._kept.find(scene.fingerprint, self.cameras.column_count(scene), mount_pose)
                found[is_kept, objects[number]] = kept
                row = row[~is_kept]
            missing += [
                (number, row[first : first + self.drawing.chunk_cameras])
                for first in range(0, len(row), self.drawing.chunk_cameras)
            ]
        if len(mount_pose) and not missing:
            progress.stage(f"{name}: all from the cache")
            return found, 0, len(mount_pose) * len(self.scenes)
        with self._travelling({number for number, _ in missing}) as (cameras, scene_of):
            tasks = [_Chunk(cameras, scene_of(number), number, row, mount_pose[row]) for number, row in missing]
            outcomes = self.executor.map(_draw, tasks)
            for outcome in progress.steps(name, outcomes, count=len(tasks)):
                task, scene = outcome.task, self.scenes[outcome.task.scene_number]
                if outcome.error is not None or outcome.result is None:
                    raise InputError(f"pool: {scene.name}: {outcome.error}")
                found[task.row, objects[task.scene_number]] = outcome.result
                if self._kept is not None:
                    self._kept.keep(scene.fingerprint, task.mount_pose, outcome.result)
        if self._kept is not None:
            self._kept.shrink()
        drawn_count = sum(len(row) for _, row in missing)
        return found, drawn_count, len(mount_pose) * len(self.scenes) - drawn_count

    @contextlib.contextmanager
    def _travelling(self, numbers: set[int]) -> Iterator[tuple[SingleCameras | Path, Callable[[int], _Place]]]:
        """The cameras and the scenes as a task takes them: as they are, or in files that each process reads once."""
        if self.executor.name == "serial" or not numbers:
            yield self.cameras, lambda number: self.scenes[number]
            return
        # a process and a worker of Ray have one core each
        is_alone = self.executor.name in ("process", "ray")
        cameras = replace(self.cameras, thread_count=1) if is_alone else self.cameras
        in_files = {number for number in numbers if isinstance(self.scenes[number], DeviceScene)}
        # the cache is seen by all machines
        beside = None if self.executor.name == "process" else self.drawing.cache
        try:
            if beside is not None:
                beside.mkdir(parents=True, exist_ok=True)
            folder = tempfile.TemporaryDirectory(prefix=SCENES if beside else f"warpav-{SCENES}", dir=beside)
        except OSError as error:
            at = beside or tempfile.gettempdir()
            raise InputError(f"{at}: expected a folder to write to, got: {error.strerror}") from None
        with folder as path:
            try:
                (Path(path) / "cameras.pickle").write_bytes(pickle.dumps(cameras))
                for number in in_files:
                    scene = self.scenes[number]
                    assert isinstance(scene, DeviceScene)
                    with (Path(path) / f"{number}.npz").open("wb") as stream:
                        np.savez(stream, **scene.arrays())  # pyright: ignore[reportArgumentType]
            except OSError as error:
                raise InputError(f"{path}: expected room for the scenes, got: {error.strerror}") from None
            yield (
                Path(path) / "cameras.pickle",
                lambda number: Path(path) / f"{number}.npz" if number in in_files else self.scenes[number],
            )


def _draw(chunk: _Chunk) -> np.ndarray:
    """What a task does, maybe in another process."""
    cameras = _read_cameras(chunk.cameras) if isinstance(chunk.cameras, Path) else chunk.cameras
    scene = _read_scene(chunk.scene, cameras.mount.device) if isinstance(chunk.scene, Path) else chunk.scene
    return cameras.detection_probability(chunk.mount_pose, scene)


@lru_cache(maxsize=1)
def _read_cameras(file: Path) -> SingleCameras:
    """The cameras of all tasks of a pool, with the renderers that they keep."""
    return pickle.loads(file.read_bytes())


@lru_cache(maxsize=2)
def _read_scene(file: Path, device: str) -> DeviceScene:
    """A scene of a pool; tasks in one scene follow each other."""
    with np.load(file, allow_pickle=False) as arrays:
        return DeviceScene.of_arrays(dict(arrays), device=device)


def _checked_poses(mount_pose: np.ndarray) -> np.ndarray:
    """Mount poses, float32 [camera, 7]; no negative zeros, as bytes are compared."""
    pose = np.array(mount_pose, np.float32)
    if pose.ndim != 2 or pose.shape[1] != MOUNT_POSE_SIZE or not len(pose):
        raise ArgumentError("mount_pose", f"expected at least one camera [camera, {MOUNT_POSE_SIZE}], got {pose.shape}")
    if not np.isfinite(pose).all():
        raise ArgumentError("mount_pose", f"expected finite numbers, got {pose[~np.isfinite(pose)][0]}")
    return pose + np.float32(0.0)
