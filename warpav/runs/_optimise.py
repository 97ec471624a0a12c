"""The optimiser on a placement: where it starts, its steps, and what comes of them."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.cache import user_cache_folder
from warpav.core.errors import ArgumentError, InputError
from warpav.core.executor import Executor
from warpav.core.progress import Progress
from warpav.optimisation import (
    CameraPool,
    Drawing,
    IterationRecord,
    NotFiniteError,
    PoolRun,
    PoolSearchSettings,
    PoolTask,
    SearchSpace,
    by_hand,
    highest_mount_pose,
    mount_pose_by_hand,
    named_part,
    part_of,
    random_mount_pose,
    single_cameras_of,
)
from warpav.rig import HAND_RIGS, Rig
from warpav.runs._checkpoint import check_identity, identity_of
from warpav.runs._placement import Placement, Stream
from warpav.runs._result import Result
from warpav.runs._rig_source import find_rig, start_changes
from warpav.runs.config import BY_HAND, Config

if TYPE_CHECKING:
    from warpav.thesis import Descent


def rig_by_hand(name: str, placement: Placement, *, angle_deg: float | None = None) -> Rig:
    """A rig of a placement's cameras as an engineer would draw it by hand, in the ego frame.

    Args:
        name: ``corners``: pairs at the corners, then cameras ahead, behind, left and right; ``cross``: evenly round;
            ``edge``: at the edge of the mount surface; ``highest``: around its highest point. ``best``: the best of
            all that a hand would try, these with several angles, pitches and places and those of known vehicles, on
            the scenes of the placement; a search begins with it.
        placement: Gives number and model of the cameras, vehicle and constraints.
        angle_deg: Of ``corners``: half the angle between the cameras of a pair [deg], 0..90; None: 44.

    Raises:
        InputError: There is no such rig, an angle that it does not have, or no place for one of its cameras.
    """
    if name not in (names := ("best", *HAND_RIGS)):
        raise ArgumentError("name", f"expected one of {', '.join(names)}, got {name!r}")
    if angle_deg is not None and not (name == "corners" and 0.0 < angle_deg < 90.0):
        raise ArgumentError("angle_deg", f"expected 0 to 90 with corners, none with others, got {angle_deg:g}")
    if name != "best":
        return find_rig(name, placement.config, placement.ego, corner_deg=angle_deg)
    if not searches_by_pool(placement):
        placement = placement.with_config(placement.config.replace({"rig.start": BY_HAND}))
        return placement.mount.rig(_named_start(placement, by_pool=False))
    search = Optimisation.begin(placement).descent
    assert isinstance(search, PoolRun)
    search.try_by_hand()
    return placement.mount.rig(search.hand_rigs[0].mount_pose)


def searches_by_pool(placement: Placement) -> bool:
    """Whether the search of a placement is the one by a pool, as ``optimiser.search`` says."""
    search = placement.config.optimiser.search
    return search == "pool" or (search == "auto" and single_cameras_of(placement.objective) is not None)


def pool_search_settings(config: Config) -> PoolSearchSettings:
    """How much a search by a pool looks at, as configured."""
    optimiser = config.optimiser
    return PoolSearchSettings(
        optimiser.pool_cameras,
        optimiser.pool_rounds,
        gap=optimiser.pool_gap,
        refinements=optimiser.pool_refinements,
        selection_time_s=optimiser.selection_time_s,
    )


def kept_drawing(executor: Executor | None = None) -> Drawing:
    """Pools drawn by an executor, or here, and kept in the user's cache."""
    return Drawing(executor, user_cache_folder("pools"))


def _named_start(placement: Placement, *, by_pool: bool) -> np.ndarray:
    """The rig that ``rig.start`` says without being one, [camera, 7]; a search by a pool looks for the best by hand."""
    name, mount, constraints = placement.config.rig.start, placement.mount, placement.objective.constraints
    count = placement.objective.camera_count if placement.limits is None else placement.limits.count[1]
    if name != "random":
        if name == BY_HAND and not by_pool:
            scenes = placement.validation

            def values_of(rigs: Sequence[np.ndarray]) -> list[float]:
                return [placement.objective.evaluate(rig, scenes).objective for rig in rigs]

            return by_hand(mount, constraints, count, values_of)[0].mount_pose
        with contextlib.suppress(InputError) if name == BY_HAND else contextlib.nullcontext():
            first = "corners" if count >= 4 else "cross"
            if name == "highest":
                return highest_mount_pose(constraints, placement.objective.camera_count)
            return mount_pose_by_hand(first if name == BY_HAND else name, mount, constraints, count)
    rng = placement.random_numbers(Stream.START)
    return random_mount_pose(constraints, placement.segregation.yaw_rad, rng=rng)


class Optimisation:
    """One run of the optimiser, step by step."""

    def __init__(
        self, placement: Placement, descent: Descent | PoolRun, pairing_rig: Rig | None, starts: Sequence[np.ndarray]
    ) -> None:
        """A run before its first step; ``starts`` are those of its descents, the first one's first."""
        self.placement = placement
        self.descent = descent
        self.pairing_rig = pairing_rig
        self.records: list[IterationRecord] = []
        self._starts = starts

    @classmethod
    def begin(
        cls,
        placement: Placement,
        *,
        start: np.ndarray | None = None,
        further_starts: Sequence[np.ndarray] = (),
        pairing_rig: Rig | None = None,
        drawing: Drawing | None = None,
        pool: PoolSearchSettings | None = None,
        known_pool: CameraPool | None = None,
        progress: Progress | None = None,
    ) -> Optimisation:
        """Find the rig to start from; ``drawing`` says where a pool is drawn and kept, by default here."""
        config, mount, objective = placement.config, placement.mount, placement.objective
        by_pool = searches_by_pool(placement)
        further = list(further_starts)
        if start is None:
            given, whole = placement.parts.start, placement.start_rig
            if given is not None and whole is not None:
                start = mount.mount_pose_of_rig(whole, as_configured=True)
                if progress is not None and (changed := start_changes(given, mount.rig(start))):
                    progress.say(f"rig.start: {changed}")
            else:
                start = _named_start(placement, by_pool=by_pool)
            start = start.astype(np.float32)  # as the optimiser keeps it: a start that stays the best is the same rig
            pairing_rig = placement.frozen_rig if placement.has_ordered_start else mount.rig(start)
            if config.optimiser.starts > 1 and not by_pool:
                from warpav.thesis import evaluate_starts

                if progress is not None:
                    progress.stage(f"best of {config.optimiser.starts} rigs to start from")
                space = SearchSpace.over(
                    mount, config.rig.cameras, constraints=objective.constraints, yaw_rad=placement.yaw_rad
                )
                rng = placement.random_numbers(Stream.STARTS)
                found = evaluate_starts(
                    objective, placement.validation, space, config.optimiser.starts, rng, known=start
                )
                # those without a finite value are no starts; then some are taken twice
                start, *further = [found[k % len(found)].mount_pose for k in range(config.optimiser.descents)]
        if by_pool:
            task = PoolTask.of(
                objective,
                placement.search_scenes,
                start=start,
                limits=placement.limits,
                requirements=placement.test_points,
                rules=placement.rules,
                starts_by_hand=placement.starts_by_hand,
                robust=config.robust.objective,
                mount_errors=config.robust.mount_errors,
            )
            searched = PoolRun(
                task,
                pool_search_settings(config) if pool is None else pool,
                seed=config.run.seed,
                drawing=kept_drawing() if drawing is None else drawing,
                progress=progress,
                pool=known_pool,
            )
            return cls(placement, searched, pairing_rig, [start])
        from warpav.thesis import Descent

        descent = Descent(
            objective,
            placement.assigned(placement.train, pairing_rig),
            config.optimiser,
            start,
            placement.random_numbers(Stream.BATCHES),
            iterations=config.run.iterations,
            batch_size=config.run.batch_size,
            validation=placement.assigned(placement.validation, pairing_rig),
            further_starts=further,
        )
        return cls(placement, descent, pairing_rig, [start, *further])

    @classmethod
    def resumed(
        cls,
        placement: Placement,
        state: Mapping[str, np.ndarray],
        events: Sequence[Mapping[str, Any]],
        *,
        drawing: Drawing | None = None,
        progress: Progress | None = None,
    ) -> Optimisation:
        """A run that goes on from where another of the same placement was when it gave `state`."""
        starts = state.get("start_poses")
        if starts is None or "identity" not in state:
            raise InputError("checkpoint: expected one that a run can go on from, got one of an earlier version")
        check_identity(json.loads(str(state["identity"])), identity_of(placement))
        start, *further = (np.array(each, np.float32) for each in starts)
        pairing_rig = placement.frozen_rig if placement.has_ordered_start else placement.mount.rig(start)
        starts = {"start": start, "further_starts": further, "pairing_rig": pairing_rig}
        run = cls.begin(placement, **starts, drawing=drawing, progress=progress)
        run.descent.restore(part_of(state, "search"))
        run.records = [IterationRecord(**event) for event in events]
        return run

    @cached_property
    def identity(self) -> dict[str, str]:
        """Hashes of what the run depends on besides its options, taken once."""
        return identity_of(self.placement)

    def state(self) -> dict[str, np.ndarray]:
        """Everything that `resumed` needs, as arrays of numbers and text; ``iteration`` is the number of steps."""
        state = self.descent.state()
        return {
            "iteration": state["iteration"],
            "identity": np.array(json.dumps(self.identity)),
            "start_poses": np.array(self._starts),
            **named_part("search", state),
        }

    @property
    def start(self) -> Rig:
        return self.placement.mount.rig(self.descent.start)

    def run(self, *, progress: Progress, on_step: Callable[[IterationRecord], None] | None = None) -> None:
        """Take all steps, or as many as are of use."""
        config, descent = self.placement.config, self.descent
        count = None if isinstance(descent, PoolRun) else config.run.iterations
        try:
            for record in progress.iterations(self._steps(), count=count, min_spacing_m=config.rig.min_spacing_m):
                if on_step is not None:
                    on_step(record)
        except NotFiniteError:
            progress.say(f"ended after {descent.iteration} iterations: {descent.stop_reason}")

    def _steps(self) -> Iterator[IterationRecord]:
        """The steps that are left; each is known before anybody is told of it."""
        while self.descent.iteration < self.placement.config.run.iterations and self.descent.stop_reason is None:
            self.records.append(self.descent.step())
            yield self.records[-1]

    def result(self) -> Result:
        """What it has come to; the last look at all validation scenes is taken here."""
        found = self.descent.finish()
        return Result(self.placement, tuple(self.records), self.pairing_rig, self.descent, found, self.state)
