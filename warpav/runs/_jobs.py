"""The jobs of ``warpav optimise`` and ``warpav evaluate``: from a configuration to files."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from warpav.core.cache import user_cache_folder
from warpav.core.errors import ArgumentError, InputError, OptionError, WriteError
from warpav.core.executor import Executor
from warpav.core.files import check_parent, json_ready, write_json
from warpav.core.progress import Progress
from warpav.core.warp_setup import checked_device, device_name
from warpav.optimisation import Drawing, IterationRecord, LoadState, ObjectOutcome, PoolRun, SoiledPart
from warpav.rig import Rig, write_rig
from warpav.runs._checkpoint import check_options
from warpav.runs._evaluate import evaluate_on, rule_margins
from warpav.runs._mounts import preset_for
from warpav.runs._optimise import Optimisation, kept_drawing
from warpav.runs._placement import Placement
from warpav.runs._progress import shown_progress
from warpav.runs._result import Result, StageTimer, check_test, complete_folder
from warpav.runs._rig_evaluation import RigEvaluation
from warpav.runs._rig_source import arm_names, find_rig, is_run_folder, is_shipped
from warpav.runs._run_figures import comparison_figures
from warpav.runs._run_folder import EVALUATION_SCHEMA, RunFolder, held_run, new_run_folder
from warpav.runs._scene_set import load_scenes, own_vehicle_digest
from warpav.runs.config import Config, flow_text, placed_config, with_absolute_paths
from warpav.runs.report._content import RunContent, read_content, read_evaluation
from warpav.runs.report._statements import verdict
from warpav.runs.report.report import write_comparison
from warpav.runs.report.tables import comparison_table
from warpav.runs.robustness import load_states_of, soiling_of
from warpav.view import checked_figure

if TYPE_CHECKING:
    from warpav.scene import Scene
    from warpav.view import BrowserComparison, RigsSideBySide

_CHECKPOINT_EVERY = 10
"""Steps of a descent after which its state is written."""


def optimise(
    placement: Placement,
    *,
    folder: str | Path | None = None,
    test: Sequence[Scene] | None = None,
    progress: bool | Progress | None = None,
    iterations: int | None = None,
    seed: int | None = None,
) -> Result:
    """Move the cameras of a rig until the detector is expected to miss fewer road users.

    Gradients of the objective flow to the poses of the cameras through the boundaries of what they see.

    Args:
        placement: Which cameras, in which traffic, for which detector.
        folder: Run folder, written step by step as ``warpav optimise run.out=...`` writes it. The same call goes on
            where a process that wrote it was stopped or killed; one that has ended stays as it is. None: nothing is
            written.
        test: Scenes that the result of ``folder`` is compared on, as of `Result.save`.
        progress: True: a bar in a terminal, lines elsewhere; an object receives what happens; None or False: nothing.
        iterations: Steps of a descent, states of a search by a pool at most; None: ``run.iterations`` of the
            placement's configuration.
        seed: Of every random choice; None: ``run.seed``.

    Raises:
        InputError: The input is wrong: the cameras do not fit on the vehicle, the loss is no longer finite, or
            ``folder`` holds the run of something else, or cannot be written.
        TypeError: ``placement`` is no placement.
    """
    if not isinstance(placement, Placement):
        raise TypeError(f"placement: expected a Placement, got {type(placement).__name__}")
    changes: dict[str, object] = {} if folder is None else {"run.out": str(Path(folder).expanduser())}
    for name, option, value in (("iterations", "run.iterations", iterations), ("seed", "run.seed", seed)):
        if value is not None:
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
                raise TypeError(f"{name}: expected a whole number, got {value!r}")
            if value < (name == "iterations"):
                raise ArgumentError(name, f"expected at least {int(name == 'iterations')}, got {value}")
            changes[option] = int(value)
    if changes:
        placement = placement.with_config(placement.config.replace(changes))
    if folder is not None:
        check_test(placement, test)
    elif test is not None:
        raise ArgumentError("test", "expected none without a folder, which would hold the comparison")
    out = placement.config.run.out if folder is not None else None
    with shown_progress(progress) as shown:
        if out is None:
            placement.prepare(shown)
            optimisation = Optimisation.begin(placement, progress=shown)
            optimisation.run(progress=shown)
            return optimisation.result()
        if (out / "config.yaml").is_file():
            return resume_rig(RunFolder.open(out), placement.config, of=placement, test=test, progress=shown)[0]
        return optimise_rig(placement.config, name=out.name, of=placement, test=test, progress=shown)[1]


def optimise_rig(
    config: Config, *, name: str, progress: Progress, of: Placement | None = None, test: Sequence[Scene] | None = None
) -> tuple[RunFolder, Result, RunContent]:
    """Optimise a rig, compare it with baselines on the test scenes, and leave a run folder.

    ``of`` is the placement of the configuration where it has objects, and ``test`` scenes to compare on, else its own.
    """
    from warpav.sight import coverage  # noqa: F401 (so that its kernel is compiled beside the others)

    timer = StageTimer()
    with contextlib.ExitStack() as held:
        held.enter_context(new_run_folder(config))
        placement = (of or Placement.from_config(config)).prepare(progress)
        timer.end("scenes and detector")
        optimisation = Optimisation.begin(placement, drawing=_drawing(config), progress=progress)
        timer.end("searching for a start")
        folder = RunFolder.create(
            config,
            name=name,
            device=device_name(config.device),
            start=placement.start_rig,
            freeze=placement.parts.freeze,
            own_detector=placement.own_detector,
            hashes=optimisation.identity,
        )
        if config.run.out is None:
            held.enter_context(held_run(folder))
        progress.say(f"{'run folder':<12} {folder.path}")
        return folder, *_run_to_the_end(folder, optimisation, test, timer, progress)


def resume_rig(
    folder: RunFolder,
    config: Config,
    *,
    progress: Progress,
    of: Placement | None = None,
    test: Sequence[Scene] | None = None,
) -> tuple[Result, RunContent]:
    """Go on with a run that was stopped, or that has ended and is given more iterations or time, in its folder.

    ``of`` and ``test`` as of `optimise_rig`.
    """
    from warpav.sight import coverage  # noqa: F401 (as in `optimise_rig`)

    timer = StageTimer()
    with held_run(folder):
        check_options(folder.config(), config, of=of)
        state = folder.checkpoint()
        done = 0 if state is None or "iteration" not in state else int(state["iteration"])
        if config.run.iterations < done:
            raise OptionError("run.iterations", f"expected at least the {done} of the run, got {config.run.iterations}")
        own = folder.environment().get("own_detector")
        if own and (of is None or of.own_detector != own):
            raise InputError(
                f"{folder.path}: run folder: expected one of a detector that is a file, got one of an object of class "
                f"{own}; optimise again, with the rig as `start`"
            )
        folder.remove_drafts()
        placement = (of or Placement.from_config(config)).prepare(progress)
        timer.end("scenes and detector")
        drawing = _drawing(config)
        events = folder.first_events(done)
        if state is None:
            optimisation = Optimisation.begin(placement, drawing=drawing, progress=progress)
        else:
            progress.stage(f"going on after {done} iterations")
            optimisation = Optimisation.resumed(placement, state, events, drawing=drawing, progress=progress)
        timer.end("searching for a start")
        evaluation = folder.evaluation()
        is_over = optimisation.descent.stop_reason is not None or done >= config.run.iterations
        if is_over and evaluation is not None and (folder.path / "report.html").is_file():
            progress.say(f"{folder.path} has ended: {optimisation.descent.stop_reason or f'{done} iterations'}")
            return optimisation.result(), read_content(folder)
        # from here on the folder is written to
        folder.replace_events(events)
        folder.remove_evaluation()
        folder.write_config(with_absolute_paths(config), freeze=placement.parts.freeze)
        folder.note_resumed(done)
        return _run_to_the_end(folder, optimisation, test, timer, progress)


def resume(
    run: str | Path, *, options: Mapping[str, Any] | None = None, progress: bool | Progress | None = None
) -> Result:
    """Go on with a run that was stopped, in its folder, as ``warpav optimise --resume`` does.

    What was computed stays as it is: a run that was stopped and goes on comes to what it would have come to at once.
    One that has ended goes on where ``options`` allow it more.

    Args:
        run: The run folder.
        options: Other values for options that change nothing of what was computed, such as ``{"run.iterations": 200}``
            or ``{"optimiser.pool_rounds": 4}``.
        progress: As of `warpav.optimise`.

    Returns:
        What the whole run has come to.

    Raises:
        InputError: The folder holds no run, another process writes to it, a file of it cannot be used or written, an
            option may not change, or scenes, vehicle, detector or version are others than those of the run.
    """
    folder = RunFolder.open(run)
    overrides = [f"{name}={flow_text(value)}" for name, value in (options or {}).items()]
    with placed_config(folder.path / "config.yaml", overrides) as config, shown_progress(progress) as shown:
        return resume_rig(folder, config, progress=shown)[0]


def _run_to_the_end(
    folder: RunFolder, optimisation: Optimisation, test: Sequence[Scene] | None, timer: StageTimer, progress: Progress
) -> tuple[Result, RunContent]:
    write_rig(optimisation.start, folder.rig_path("initial"))
    with _kept_when_stopped(folder, optimisation, progress):
        optimisation.run(progress=progress, on_step=lambda record: _record_step(folder, optimisation, record))
        result = optimisation.result()
        timer.end("descent")
        return result, complete_folder(folder, result, test, timer=timer, progress=progress)


@contextlib.contextmanager
def _kept_when_stopped(folder: RunFolder, optimisation: Optimisation, progress: Progress) -> Iterator[None]:
    """Keep what a run has reached when the user stops it or the disk is full, and say how to go on."""
    try:
        yield
    except (KeyboardInterrupt, WriteError) as error:
        with contextlib.suppress(*([] if isinstance(error, KeyboardInterrupt) else [WriteError])):  # still full
            _keep_reached(folder, optimisation)
        reached = "what was reached is in {}, for warpav evaluate, inspect and report"
        if not optimisation.records:
            reached = "there is no step yet; the start is in {}, for warpav evaluate and inspect"
        parts = optimisation.placement.parts
        objects = (parts.ego, parts.detector, parts.probability, parts.losses, parts.requirements)
        is_of_files = not parts.has_own_scenes and all(each is None for each in objects)
        resumes = shlex.join(["warpav", "optimise", "--resume", str(folder.path)])
        ways = [resumes] * is_of_files + ["the same call of wa.optimise"]
        text = f"stopped; {reached.format(folder.path)}; {{}} goes on"
        with contextlib.suppress(OSError):  # the terminal may be gone
            progress.say(text.format(ways[0]))
        error.add_note(text.format(" or ".join(ways)))  # in Python most runs show no progress
        raise


def _drawing(config: Config) -> Drawing:
    """Where pools are drawn; what Slurm needs lies beside them, as all machines must see both."""
    of = config.executor
    jobs = user_cache_folder("pools") / "slurm_jobs"
    return kept_drawing(Executor(of.name, of.workers, of.address, of.options, jobs, config.shared_gpu_count))


def _record_step(folder: RunFolder, optimisation: Optimisation, record: IterationRecord) -> None:
    descent = optimisation.descent
    folder.append_event(record)
    if record.stage == "start":  # the best by hand is known now
        write_rig(optimisation.start, folder.rig_path("initial"))
    _write_rigs(folder, optimisation, ("final",) if record.training_objective is None else ("best", "final"))
    every = optimisation.placement.config.run.checkpoint_every
    if every is None:
        every = 1 if isinstance(descent, PoolRun) else _CHECKPOINT_EVERY
    if descent.iteration % every == 0:
        folder.write_checkpoint(optimisation.state())


def _write_rigs(folder: RunFolder, optimisation: Optimisation, roles: Sequence[Literal["best", "final"]]) -> None:
    descent = optimisation.descent
    for role in roles:
        pose = descent.best.mount_pose if role == "best" else descent.mount_pose
        write_rig(optimisation.placement.mount.rig(pose), folder.rig_path(role))


def _keep_reached(folder: RunFolder, optimisation: Optimisation) -> None:
    descent, records = optimisation.descent, optimisation.records
    if descent.iteration != len(records):  # stopped between a step and its record: the last checkpoint stands
        return
    if records:  # the last one may not be there, or in part
        folder.replace_events([json_ready(each) for each in records])
        is_rounded = isinstance(descent, PoolRun) and descent.rounding is not None  # and written
        _write_rigs(folder, optimisation, ("final",) if is_rounded else ("best", "final"))
    folder.write_checkpoint(optimisation.state())
    further = descent.further_cameras() if isinstance(descent, PoolRun) else None
    if further is not None:
        folder.write_further_cameras(further)


def posed_otherwise(
    soiling: tuple[Any, float, float, float] | None, load: Sequence[tuple[float, float]] | None
) -> tuple[SoiledPart | None, dict[str, LoadState]]:
    """What the command line gives as soiling (shape, place, share) and as states of load (pitch, height)."""
    try:
        part = SoiledPart(soiling[0], soiling[1:3], soiling[3]) if soiling else None
    except ArgumentError as error:
        raise ArgumentError("soiling", error.text) from None
    try:
        return part, {f"load {number}": LoadState(*each) for number, each in enumerate(load or (), 1)}
    except ArgumentError as error:
        raise ArgumentError("load", error.text) from None


def measure_rig(
    source: str,
    config: Config,
    *,
    beside: Sequence[str] = (),
    json_file: Path | None,
    soiled: SoiledPart | None = None,
    loads: Mapping[str, LoadState] | None = None,
    progress: Progress,
) -> RunContent:
    """Metrics of a rig on the test scenes, written to a file if there is one."""
    names = arm_names(source, beside)
    check_parent(json_file, "json")
    folder = RunFolder.open(source) if is_run_folder(source) else None
    run, own_detector = (folder and read_evaluation(folder)), (folder and folder.environment().get("own_detector"))
    if own_detector and config.detector.model == "builtin":
        raise OptionError(
            "detector.model",
            f"expected the ONNX file of the run's detector, as {source} was optimised with an object of class "
            f"{own_detector}, got 'builtin'; to evaluate with the shipped one, give {source}/rig_best.yaml",
        )
    placement = Placement.from_config(config).prepare(progress)
    rig = _rig_to_measure(source, placement, progress)
    if soiled or loads:
        try:  # before anything takes long
            placement.mount_pose_of(rig)
        except ArgumentError as error:
            remedy = "set rig.cameras and camera.* to the rig's, or evaluate a run folder"
            option = "load" if soiled is None else "soiling"
            raise ArgumentError(option, f"{error.text}; {remedy}") from None
    name, *others = names
    rigs = {name: rig, **{other: _rig_to_measure(names[other], placement, progress) for other in others}}
    found = _measured_beside(rigs, names, placement, progress)
    measured: dict[str, Any] = {"constraints": {name: placement.objective.constraints.margins(rig)}}
    measured["rules"] = rule_margins(rigs, placement, run)
    scenes = list(load_scenes(config, config.scenes.test_seeds)) if soiled or loads else []
    if soiled is not None:
        measured["soiling"] = soiling_of(rig, scenes, placement, soiled, progress=progress)
    if loads:
        measured["load_states"] = load_states_of(rig, scenes, placement, loads, progress=progress)
    evaluation = found.compared().model_copy(update=measured)
    if json_file is not None:
        write_json(json_file, {"schema": EVALUATION_SCHEMA, **evaluation.to_json()})
        progress.say(f"wrote {json_file}")
    return RunContent(evaluation=evaluation.model_copy(update={"outcomes": None}), config=config)


def _measured_beside(
    rigs: Mapping[str, Rig], names: Mapping[str, str], placement: Placement, progress: Progress
) -> RigEvaluation:
    pairing_rig: dict[str, Rig | None] = dict(rigs)  # that of a run is the rig its search began with
    for name in (name for name, source in names.items() if is_run_folder(source)):
        is_ordered = placement.has_ordered_start
        pairing_rig[name] = placement.frozen_rig if is_ordered else RunFolder.open(names[name]).rig("initial")
    return evaluate_on(rigs, placement.test, placement, pairing_rig=pairing_rig, progress=progress)


def compare_rigs(sources: Sequence[str], config: Config, out: Path, *, again: str, progress: Progress) -> Path:
    """Write a page that stands alone with two or three rigs side by side, on the same test scenes."""
    check_parent(checked_figure(out, (".html",)), "out")
    compared, placement = _side_by_side(sources, config, progress)
    assert compared.evaluation is not None
    return write_comparison(compared, comparison_figures(compared.evaluation, placement, progress), out, again)


def comparison_view(sources: Sequence[str], config: Config, *, progress: Progress) -> BrowserComparison:
    """Two or three rigs in one view for browsers, compared as on the page of `compare_rigs`; not yet served."""
    from warpav.view import BrowserComparison, RigsSideBySide, new_token

    def compared() -> RigsSideBySide:
        found, placement = _side_by_side(sources, config, progress)
        evaluation = found.evaluation
        assert evaluation is not None
        scenes = list(placement.as_seen(list(load_scenes(config, config.scenes.test_seeds))))
        finds = [
            [each.outcome[name] == ObjectOutcome.DETECTED for each in evaluation.objects] for name in evaluation.rigs
        ]
        ends = np.cumsum([len(scene.vehicles) for scene in scenes])
        return RigsSideBySide(
            evaluation.rigs,
            scenes,
            np.split(np.array(finds), ends[:-1], axis=1),
            verdict(found).text,
            comparison_table(found)._repr_html_(),
            device=checked_device(config.device),
        )

    return BrowserComparison(compared, token=new_token(), name=" | ".join(Path(each).stem for each in sources))


def _side_by_side(sources: Sequence[str], config: Config, progress: Progress) -> tuple[RunContent, Placement]:
    if not 2 <= len(sources) <= 3 or len(set(sources)) < len(sources):
        raise InputError(f"command line: expected two or three different rigs, got {shlex.join(sources)}")
    names = arm_names(sources[0], sources[1:])
    if "optimised" in names:  # beside others a run is called by its folder
        own = Path(sources[0]).absolute().name
        names = {(sources[0] if own in names else own): sources[0], **dict(list(names.items())[1:])}
    for source in filter(is_run_folder, sources):
        folder = RunFolder.open(source)
        searched = (of_run := folder.config()).scenes
        if own_vehicle_digest(of_run) != own_vehicle_digest(config):
            text = f"expected {searched.ego or 'none'}, the vehicle of {source}, got {config.scenes.ego or 'none'}"
            raise OptionError("scenes.ego", f"{text}; on another vehicle compare {folder.rig_file()} itself")
        known = {*searched.train_seeds, *(searched.validation_seeds or ())} & {*config.scenes.test_seeds}
        if searched.source == config.scenes.source and known:
            raise OptionError(
                "scenes.test_seeds", f"expected scenes that no run has searched on, got {min(known)} of {source}"
            )
    placement = Placement.from_config(config).prepare(progress)
    rigs = {name: _rig_to_measure(source, placement, progress) for name, source in names.items()}
    found = _measured_beside(rigs, names, placement, progress).compared()
    first = read_evaluation(RunFolder.open(sources[0])) if is_run_folder(sources[0]) else None
    evaluation = found.model_copy(update={"rules": rule_margins(rigs, placement, first)})
    return RunContent(evaluation=evaluation, config=config), placement


def _rig_to_measure(source: str, placement: Placement, progress: Progress) -> Rig:
    """The rig that ``source`` means; a preset stands on the body of the vehicle, with the images of a network."""
    config, ego = placement.config, placement.ego
    if not is_shipped(source):
        rig = find_rig(source, config, ego, say=progress.say)
        placement.add_camera_models(rig, progress)
        return rig
    moved = preset_for(source, config, ego)
    placement.add_camera_models(moved.rig, progress)
    sizes = dict.fromkeys(f"{each.model.width_px} x {each.model.height_px} px" for each in moved.rig.cameras)
    progress.say(
        f"{source} on this vehicle, images of {' and '.join(sizes)}; the camera farthest from its place is "
        f"{moved.moved_m.max():.2f} m off"
    )
    return moved.rig
