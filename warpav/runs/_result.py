"""What an optimisation has come to, and how it becomes a run folder."""

from __future__ import annotations

import html
import math
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import ArgumentError
from warpav.core.progress import Progress
from warpav.core.warp_setup import device_name
from warpav.optimisation import (
    BudgetedValue,
    Candidate,
    FurtherCameras,
    IterationRecord,
    MountErrors,
    PoolRun,
    SearchSpace,
    random_search,
    run_search,
    workshop_rig,
)
from warpav.rig import Rig, write_rig
from warpav.runs._checkpoint import identity_of
from warpav.runs._drawn_run import DrawnRun, draws_runs
from warpav.runs._evaluate import evaluate, evaluate_on, highest_rig, requirements_of, rule_margins
from warpav.runs._events import Certificate
from warpav.runs._mounts import preset_for
from warpav.runs._placement import Placement, Stream
from warpav.runs._progress import shown_progress
from warpav.runs._rig_evaluation import GroundTable, Robust, SearchEnd, Simpler, StartAndEnd, ToleranceTable
from warpav.runs._rig_source import read_baselines
from warpav.runs._run_folder import RunFolder
from warpav.runs._scene_set import load_scenes
from warpav.runs.config import BY_HAND, Config, with_absolute_paths
from warpav.runs.robustness import tolerance_on
from warpav.scene import Scene, scene_path, write_scene
from warpav.view import plot

if TYPE_CHECKING:
    from warpav.optimisation import AssignedScene
    from warpav.runs.report._content import RunContent
    from warpav.sight import RequirementResult
    from warpav.thesis import Descent

OPTIMISED, START = "optimised", "start"
"""Names of the rigs of a run where it is compared; a start that is the best by hand is called `BY_HAND`."""

_TOLERANCE_M, _TOLERANCE_RAD = 0.02, math.radians(1.0)
_TOLERANCE_SCENES, _TOLERANCE_DRAWS = 10, 8
"""Errors of mounting of which a run says what they cost, and on how much: some percent of a run's time."""


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """What an optimisation has come to.

    Attributes:
        placement: What it ran on.
        records: What every iteration did.
        pairing_rig: See `warpav.runs._placement.Placement.assigned`.
    """

    placement: Placement
    records: tuple[IterationRecord, ...]
    pairing_rig: Rig | None
    _descent: Descent | PoolRun
    _kept: Candidate
    _state: Callable[[], dict[str, np.ndarray]]  # what a checkpoint holds

    @property
    def rig(self) -> Rig:
        """The rig of the run: the one that was found, or the start where that one is worse."""
        return self.start if self.is_worse_than_start else self.found

    @cached_property
    def start(self) -> Rig:
        """The rig that it started from."""
        return self.placement.mount.rig(self._descent.start)

    @cached_property
    def found(self) -> Rig:
        """The rig that was found, the best or the last as ``optimiser.keep`` says, even where it is worse.

        Of a search by a pool its numbers are rounded as a workshop takes them, unless that breaks a rule.
        """
        pose, descent = self._kept.mount_pose, self._descent
        if not isinstance(descent, PoolRun) or descent.rounding is None:
            return self.placement.mount.rig(pose)
        return self._workshop_rig(pose, descent.unrounded)

    def _workshop_rig(self, pose: np.ndarray, staying: Collection[int]) -> Rig:
        """The rig of mount poses, float32 [camera, 7], rounded but for frozen cameras and those of some rows."""
        mount = self.placement.mount
        rig, stays = mount.rig(pose), np.isin(mount.rows_of_cameras(pose), list(staying))
        names = [camera.name for camera, each in zip(rig.cameras, stays, strict=True) if each]
        return workshop_rig(rig, [*self.placement.parts.freeze, *names])

    @property
    def start_name(self) -> str:
        """What the start is called where rigs are compared."""
        is_by_hand = self.placement.starts_by_hand and (
            bool(self._descent.hand_rigs)
            if isinstance(self._descent, PoolRun)
            else self.placement.config.optimiser.starts == 1
        )
        return BY_HAND if is_by_hand else START

    @property
    def objective(self) -> float:
        """Of `rig`, on all validation scenes (the training scenes if there are none); less is better.

        With ``robust.camera_loss`` it counts what is missed without a camera, with ``robust.mount_error_m`` and
        ``robust.mount_error_deg`` errors of mounting, see `robust`.
        """
        return self.start_objective if self.is_worse_than_start else self.found_objective

    @property
    def start_objective(self) -> float:
        """Of `start`, likewise."""
        return self._descent.start_objective

    @property
    def found_objective(self) -> float:
        """Of `found`, likewise."""
        return self._kept.training_objective

    @property
    def ended(self) -> str | None:
        """Why it ended early; None where it took all iterations."""
        return self._descent.stop_reason

    @cached_property
    def history(self) -> dict[str, list[float]]:
        """Series by name: ``loss``, every loss and constraint, ``seconds``, one number an iteration.

        ``objective`` is on all validation scenes whenever it was measured, the last one of `found` with
        ``optimiser.keep`` last; ``objective_iteration`` are the iterations before which that was. Of a search by a pool
        ``bound``, ``pool_cameras`` and ``camera_renders`` as well, NaN before the first selection.
        """
        records, candidates = self.records, self._descent.candidates
        names = list(dict.fromkeys(name for record in records for name in record.terms))
        found: dict[str, list[float]] = {
            "iteration": [record.iteration for record in records],
            "loss": [record.loss for record in records],
            **{name: [record.terms.get(name, math.nan) for record in records] for name in names},
            "seconds": [record.seconds["total"] for record in records],
        }
        if any(record.stage is not None for record in records):
            for name in ("bound", "pool_cameras", "camera_renders"):
                values = (getattr(record, name) for record in records)
                found[name] = [math.nan if value is None else value for value in values]
        found["objective"] = [candidate.training_objective for candidate in candidates]
        found["objective_iteration"] = [candidate.iteration for candidate in candidates]
        return found

    @cached_property
    def certificate(self) -> Certificate | None:
        """What a search by a pool has proven; None for a descent, and before the first selection."""
        return Certificate.of([asdict(record) for record in self.records], scenes=len(self.placement.search_scenes))

    @property
    def bound(self) -> float | None:
        """No rig of cameras of the pool has a lower expected miss rate on the scenes of the search; None for a descent.

        Of other scenes, and of cameras that the pool does not hold, it says nothing: see `certificate`.
        """
        return None if self.certificate is None else self.certificate.bound

    @property
    def gap(self) -> float | None:
        """Objective less bound; negative where the polish went below what the pool's cameras can reach; None as above.

        The objective is that of `found` on the scenes of the search, before its numbers were rounded.
        """
        return None if self.certificate is None else self.certificate.gap

    @property
    def pool_cameras(self) -> int | None:
        """Cameras of the pool that the bound is over; None for a descent."""
        return None if self.certificate is None else self.certificate.pool_cameras

    @cached_property
    def robust(self) -> dict[str, Any] | None:
        """What the objective is made of, of start and `found`, where it is a robust one; else None."""
        descent, settings = self._descent, self.placement.config.robust
        if not isinstance(descent, PoolRun) or descent.found is None or settings.asked_for is None:
            return None
        rigs = {START: descent.start, OPTIMISED: self._kept.mount_pose}
        values = {name: descent.robust_value(rig) for name, rig in rigs.items()}
        parts = {name: {} if value is None else asdict(value) for name, value in values.items()}
        options = {} if descent.task.robust is None else asdict(descent.task.robust)
        if descent.task.mount_errors is not None:
            options |= {name: getattr(settings, name) for name in ("mount_error_m", "mount_error_deg")}
            parts = {name: (descent.misplaced_miss_rates(rigs[name]) or {}) | part for name, part in parts.items()}
        return {**options, **{name: part or None for name, part in parts.items()}}

    @cached_property
    def further_cameras(self) -> FurtherCameras | None:
        """What each camera of the pool would add to `found`, the one that helps most first; None for a descent."""
        return self._descent.further_cameras() if isinstance(self._descent, PoolRun) else None

    @cached_property
    def simpler(self) -> tuple[Rig, Simpler] | None:
        """The rig that was found with numbers by hand wherever that costs little; see `PoolRun.simplified`."""
        known = self._descent.simplified() if isinstance(self._descent, PoolRun) else None
        if known is None:
            return None
        rig = self._workshop_rig(known.mount_pose, known.by_hand)
        rows = self.placement.mount.rows_of_cameras(known.mount_pose).tolist()
        by_hand = {rig.cameras[rows.index(row)].name: numbers for row, numbers in known.by_hand.items()}
        return rig, Simpler(objective=known.objective, differing=known.differing, by_hand=by_hand)

    @cached_property
    def requirements(self) -> RequirementResult | None:
        """What `rig` meets of what the placement requires near the vehicle; None where it requires nothing."""
        return requirements_of({"rig": self.rig}, self.placement).get("rig")

    @property
    def is_worse_than_start(self) -> bool:
        """Whether it is higher, or no number; then `rig` is the start. A search by a pool keeps the rules instead."""
        return not isinstance(self._descent, PoolRun) and not self.found_objective <= self.start_objective

    def save(
        self, folder: str | Path, *, test: Sequence[Scene] | None = None, progress: bool | Progress | None = None
    ) -> Path:
        """Write the run folder that the command line leaves: iterations, rigs, evaluation, figures, report.

        The result is compared with its start (the best rig by hand), the rig around the highest point, the best of
        ``baselines.random_samples`` random rigs, the presets of ``baselines.presets`` and the rigs of
        ``baselines.rigs``.
        Scenes that are objects are written into the folder. Of a detector that is an object ``env.json`` keeps the
        class alone, so ``warpav evaluate`` asks for its ONNX file.

        Args:
            folder: A folder that does not exist yet, or an empty one.
            test: Scenes to compare on, that no rig was optimised on; None: those of ``scenes.test_seeds``, where the
                scenes of the placement are embedded or files.
            progress: As of `warpav.runs._optimise.optimise`.

        Returns:
            The folder.

        Raises:
            InputError: It cannot be written, or there are no scenes to compare on.
        """
        timer = StageTimer()
        placement = self.placement
        check_test(placement, test)
        path = Path(folder).expanduser()
        config = placement.config.replace({"run.out": str(path)})
        with shown_progress(progress) as shown:
            written = RunFolder.create(
                config,
                name=path.name,
                device=device_name(config.device),
                start=placement.start_rig,
                freeze=placement.parts.freeze,
                own_detector=placement.own_detector,
                hashes=identity_of(placement),
            )
            write_rig(self.start, written.rig_path("initial"))
            for record in self.records:
                written.append_event(record)
            complete_folder(written, self, test, timer=timer, progress=shown)
        return written.path

    def why(self, test: Sequence[Scene] | None = None) -> str:
        """What the rig that was found sees that its start, the best rig by hand, does not, and what it loses; in words.

        Args:
            test: As of `save`.

        Raises:
            InputError: There are no scenes to compare on.
        """
        from warpav.runs.report._content import RunContent
        from warpav.runs.report._statements import why

        check_test(self.placement, test)
        config, rigs = self.placement.config, {OPTIMISED: self.found, self.start_name: self.start}
        evaluation = evaluate(rigs, list(load_scenes(config, "test") if test is None else test), self.placement)
        said = why(RunContent(config=config, start=self.start, result=self.found), evaluation)
        assert said is not None
        return said.text

    def drawn(self, *, scene: Scene | None = None) -> DrawnRun:
        """The result as its plots show it; ``scene`` by default the first test scene."""
        placement = self.placement
        return DrawnRun(
            "result",
            placement.config,
            self.start_name,
            self.start,
            self.rig,
            [asdict(record) for record in self.records],
            lambda: placement.shown if scene is None else next(placement.as_seen([scene])),
            lambda _: placement.mount.surface,
            lambda: self.further_cameras,
        )

    def plot(self, out: str | Path | None = None, **options: Any) -> Any:  # noqa: ANN401
        """Show the result in a window or a notebook, or write its image to a file; see `warpav.view.plot`."""
        return plot(self, out=out, **options)

    def __repr__(self) -> str:
        return f"Result({self._description()})"

    def _repr_html_(self) -> str:
        return f"<b>Result</b>: {html.escape(self._description())}"

    def _description(self) -> str:
        count = len(self.rig.cameras)
        text = f"{count} cameras, {len(self.records)} iterations, objective {self.start_objective:.4f} -> "
        text += f"{self.found_objective:.4f}"
        return f"{text}, worse than its start, so the rig is the start" if self.is_worse_than_start else text


draws_runs(Result)


def check_test(placement: Placement, test: Sequence[Scene] | None) -> None:
    """Make sure that there are scenes to compare rigs on."""
    if test is None and placement.parts.has_own_scenes:
        raise ArgumentError("test", "expected scenes to compare rigs on, as the placement's are objects, got none")


class StageTimer:
    def __init__(self) -> None:
        self._began = self._last = time.perf_counter()
        self._seconds: dict[str, float] = {}

    def end(self, stage: str) -> None:
        """The stage that began with the end of the one before ends now."""
        now = time.perf_counter()
        self._seconds[stage] = now - self._last
        self._last = now

    @property
    def seconds(self) -> dict[str, float]:
        """Of every stage that has ended, and ``total`` up to there."""
        return {**self._seconds, "total": self._last - self._began}


def complete_folder(
    folder: RunFolder, result: Result, given: Sequence[Scene] | None, *, timer: StageTimer, progress: Progress
) -> RunContent:
    """Complete a run folder that has its iterations: rigs, evaluation, figures, report; ``given`` as of `save`."""
    from warpav.runs._run_figures import GROUND_SCENES, RunPictures
    from warpav.runs.report._content import read_content
    from warpav.runs.report.report import write_report
    from warpav.sight import BlindGround

    placement, descent = result.placement, result._descent
    if given is None and placement.test:
        test, first = placement.test, placement.shown
    else:
        own = list(load_scenes(placement.config, "test") if given is None else given)
        test, first = placement.observed(own, progress=progress), own[0]
        if given is not None:
            config = placement.config.replace({"run.out": str(folder.path)})
            config = with_absolute_paths(_with_scenes(config, placement, own, folder))
            folder.write_config(config, freeze=placement.parts.freeze)
    folder.write_checkpoint(result._state())
    write_rig(result.start, folder.rig_path("initial"))
    write_rig(result.rig, folder.rig_path("best"))
    write_rig(placement.mount.rig(descent.candidates[-1].mount_pose), folder.rig_path("final"))
    if result.simpler is not None:
        write_rig(result.simpler[0], folder.rig_path("simpler"))
    if result.further_cameras is not None:
        folder.write_further_cameras(result.further_cameras)

    rigs, pairing_rig = _compared(result, progress)
    compared = evaluate_on(rigs, test, placement, pairing_rig=pairing_rig, progress=progress)
    timer.end("comparison on the test scenes")
    progress.stage("ground that no camera sees")
    ground = BlindGround.of(compared.rigs, [assigned.scene for assigned in test[:GROUND_SCENES]])
    timer.end("ground that no camera sees")
    progress.stage("errors of mounting")
    tolerance = _tolerance(result, test)
    timer.end("errors of mounting")
    constraints = placement.objective.constraints
    measured = {
        "mount_tolerance": tolerance,
        "rig_of_run": result.start_name if result.is_worse_than_start else OPTIMISED,
        "training_objective": StartAndEnd(
            start=_finite(result.start_objective), optimised=_finite(result.found_objective)
        ),
        "descent": SearchEnd(
            iterations=descent.iteration,
            planned=placement.config.run.iterations,
            ended=result.ended,
            kept=result._kept.iteration,
        ),
        "simpler": None if result.simpler is None else result.simpler[1],
        "certificate": None if result.certificate is None else result.certificate.to_json(),
        **({} if result.robust is None else {"robust": Robust(**result.robust)}),
        "constraints": {name: constraints.margins(rig) for name, rig in rigs.items()},
        "rules": rule_margins(rigs, placement, descent.rules if isinstance(descent, PoolRun) else None),
        "ground": GroundTable(**ground.table()),
    }
    evaluation = compared.compared().model_copy(update=measured)
    pictures = placement.config.run.pictures
    if pictures != "none":
        progress.stage("pictures and report")
        drawn = RunPictures(folder, placement, result.start, result.found, test, first, evaluation)
        drawn.draw(progress, full=pictures == "all")
    timer.end("figures")
    evaluation = evaluation.model_copy(update={"seconds": timer.seconds})
    folder.write_evaluation(evaluation.to_json(with_objects=True))
    run = read_content(folder)
    write_report(folder, run)
    return run


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _tolerance(result: Result, test: Sequence[AssignedScene]) -> ToleranceTable | None:
    """What errors of mounting cost the rig that was found; None where that is not known."""
    scenes = [each for each in test if each.scene.vehicle_count][:_TOLERANCE_SCENES]
    if not scenes:
        return None
    given = result.placement.config.robust
    angle_rad = _TOLERANCE_RAD if given.mount_error_deg is None else math.radians(given.mount_error_deg)
    errors = MountErrors(given.mount_error_m or _TOLERANCE_M, angle_rad)
    found = tolerance_on(result.found, scenes, result.placement, errors, sample_count=_TOLERANCE_DRAWS)
    return None if found is None else ToleranceTable(**found.to_json())


def _compared(result: Result, progress: Progress) -> tuple[dict[str, Rig], dict[str, Rig | None]]:
    """The rigs that a result is compared with, itself first, and the rigs that these began as."""
    placement, config = result.placement, result.placement.config
    presets = {name: preset_for(name, config, placement.ego).rig for name in config.baselines.presets or ()}
    others = {**presets, **read_baselines(config)}
    for rig in others.values():
        placement.add_camera_models(rig, progress)
    rigs = {OPTIMISED: result.found, result.start_name: result.start, "highest": highest_rig(placement)}
    pairing_rig: dict[str, Rig | None] = dict.fromkeys(rigs, result.pairing_rig) | {"highest": rigs["highest"]}
    if config.baselines.random_samples:
        rigs["random"], pairing_rig["random"] = _best_of_random(placement, progress), placement.frozen_rig
    return {**rigs, **others}, {**pairing_rig, **others}


def _best_of_random(placement: Placement, progress: Progress) -> Rig:
    config, mount = placement.config, placement.mount
    samples, rng = config.baselines.random_samples, placement.random_numbers(Stream.SEARCH)
    chosen = rng.choice(len(placement.train), min(config.baselines.random_scenes, len(placement.train)), replace=False)
    progress.stage(f"best of {samples} random rigs on {len(chosen)} training scenes")
    space = SearchSpace.over(
        mount,
        placement.objective.camera_count,
        constraints=placement.objective.constraints,
        yaw_rad=placement.yaw_rad,
        yaw_reach_rad=0.0,
    )
    scenes = [placement.train[k] for k in chosen]
    camera_renders = samples * len(scenes) * space.camera_count
    value = BudgetedValue.of(placement.objective, scenes, space, camera_renders_max=camera_renders)
    return mount.rig(run_search(random_search, value, rng).mount_pose)


def _with_scenes(config: Config, placement: Placement, test: Sequence[Scene], folder: RunFolder) -> Config:
    """The configuration of a run whose scenes are objects, and are written into its folder."""
    own = placement.parts.scenes
    scenes = folder.path.absolute() / "scenes"
    scenes.mkdir(exist_ok=True)
    parts = (*(own or ((), ())), test)
    seeds: list[list[int]] = []
    count = 0
    for part in parts:
        for k, scene in enumerate(placement.as_seen(part)):
            write_scene(scene, scene_path(scenes, count + k))
        seeds.append(list(range(count, count + len(part))))
        count += len(part)
    options = {
        "scenes.source": "folder",
        "scenes.folder": str(scenes),
        "scenes.recordings": None,
        "scenes.test_recordings": None,
        "scenes.ego": None,
        "scenes.train_seeds": seeds[0],
        "scenes.validation_seeds": seeds[1] or None,
        "scenes.test_seeds": seeds[2],
    }
    return config.replace(options)
