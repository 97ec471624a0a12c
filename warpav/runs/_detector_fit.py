"""Fit the detection probability model of a configuration, keep it, and score it on any scenes."""

from __future__ import annotations

import contextlib
import shlex
import shutil
import time
import weakref
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from warpav.core.errors import ArgumentError
from warpav.core.files import check_folder, write_json, write_text, writing
from warpav.core.progress import NullProgress, Progress
from warpav.core.table import Table
from warpav.detection import (
    BIN_COUNT,
    MONOTONE,
    MONOTONE_FOR_ANY_CAMERA,
    DetectionProbability,
    DetectionSamples,
    DetectorUse,
    ProbabilityScores,
    ScalingDetector,
    fit_lidar_curve,
    fit_probability,
    read_findings,
    score,
    stored_file,
    windows_of,
)
from warpav.optimisation import LEVEL, Estimate
from warpav.raster.camera import CameraModel
from warpav.runs._detector_samples import (
    FOLDS,
    Source,
    network_scale_of,
    sample_camera,
    sample_scenes,
    samples_folder,
    say_or_warn,
)
from warpav.runs._mounts import camera_model, camera_models
from warpav.runs._networks import (
    any_camera_config,
    any_camera_use,
    detector_use,
    load_detector,
    networks_in,
    opened_detector,
)
from warpav.runs._progress import shown_progress
from warpav.runs._scene_set import places_of
from warpav.runs._terminal import drawn
from warpav.runs.config import Config
from warpav.scene import LEVELS, recordings_of
from warpav.scene.traffic.files import content_digest
from warpav.scene.traffic.moments import search_and_test

if TYPE_CHECKING:
    from warpav.detection import Detector
    from warpav.raster.mesh import Mesh

# Embedded scenes for this purpose alone: no experiment takes these seeds, and the shipped detector has not seen them.
_TOWN_SEEDS = tuple(range(500_000, 500_050))
_TOWN_HELD_OUT = tuple(range(500_050, 500_080))
_MIN_FIT_SCENES = 20  # training scenes of the user's own with which a model can be fitted and evaluated
_FEW = 0.05  # of the objects; a weak detector finds several times as many

_FITS: weakref.WeakKeyDictionary[Any, dict[str, DetectionProbability]] = weakref.WeakKeyDictionary()
"""What was fitted for detectors that are objects, by what it was fitted for."""


def lidar_options(table: Path) -> str:
    """The options that say how many points a LiDAR needs, fitted to a table of what its detector found."""
    curve = fit_lidar_curve(*read_findings(table))
    halves = (f"lidar.{name}={half:.3g}" for name, half in curve.points_for_half.items())
    return " ".join([*halves, f"lidar.steepness={curve.steepness:.3g}"])


def chosen_seeds(
    config: Config, fit: Sequence[int] | None = None, held_out: Sequence[int] | None = None
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The scenes to fit on, and to score on: those given, else embedded ones, else three to two of the training's."""
    usual = [_TOWN_SEEDS, _TOWN_HELD_OUT]
    if config.scenes.source != "town":
        train = list(enumerate(config.scenes.train_seeds))
        usual = [tuple(seed for k, seed in train if (k % 5 < 3) == is_fit) for is_fit in (True, False)]
    fit, held_out = (tuple(own if given is None else given) for own, given in zip(usual, (fit, held_out), strict=True))
    shared = sorted(set(fit) & set(held_out))
    if shared:
        raise ArgumentError(
            "held_out",
            f"expected scenes that the curves are not fitted on, got {len(shared)} of them, such as {shared[0]}; "
            "change `scenes` or `held_out`",
        )
    tested = sorted(set(fit) & set(config.scenes.test_seeds))
    if tested:
        raise ArgumentError(
            "scenes",
            f"expected other scenes than scenes.test_seeds, got {len(tested)} of them, such as {tested[0]}; change "
            "`scenes` or scenes.test_seeds",
        )
    if not held_out:
        raise ArgumentError(
            "scenes.train_seeds",
            f"expected at least 4 scenes to fit and to evaluate, got {len(fit)}; give `scenes` and `held_out`",
        )
    return fit, held_out


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted model of detection probability, and what it was fitted and evaluated on."""

    model: DetectionProbability  # the model, with its record
    known: DetectionSamples  # what the detector made of the scenes that it was fitted on
    unseen: DetectionSamples  # the same of those that it was evaluated on
    probability: np.ndarray  # what it says of these, float64 [sighting]
    scores: ProbabilityScores  # how good that is


def ensure_fit(
    config: Config,
    *,
    detector: Detector | None = None,
    ego: Mesh | None = None,
    camera: CameraModel | None = None,
    progress: Progress | None = None,
) -> DetectionProbability:
    """The model of detection probability of a detector in a camera.

    It is the stored fit for this very camera, vehicle and range of poses, if there is one; else the stored fit for any
    camera; else that is made and stored. A detector that is an object and no `ScalingDetector` is fitted for the very
    camera, as nobody knows what it makes of images of another size.

    Where there are too few scenes of the user's own to fit it on, embedded ones take their place. What is fitted for a
    detector that is an object is kept while the object lives. Where ``losses.probability`` is a share of the object,
    which stands in for the probability, no detector is asked.
    """
    if config.losses.probability != "fitted":
        return DetectionProbability.unfitted()
    progress = progress or NullProgress()
    if camera == camera_model(config):
        camera = None
    config = fit_config(config, progress)
    use = detector_use(config, ego, camera)
    if detector is None:
        if stored_file(use) is not None:
            return DetectionProbability.find(use, unseen=_unseen(config))
        scale = network_scale_of(opened_detector(config), camera or camera_model(config))
        return replace(_ensure_for_any_camera(any_camera_config(config), progress), network_scale=scale)
    kept = _FITS.setdefault(detector, {}) if _is_weak(detector) else {}
    if use.identity in kept:
        return kept[use.identity]
    lasting = "kept as long as the detector object"
    if not isinstance(detector, ScalingDetector):
        _announce(config, "detector and camera", lasting, progress)
        found = fit(config, detector=detector, ego=ego, camera=camera, progress=progress)
        return kept.setdefault(use.identity, found.model)
    scale = network_scale_of(detector, camera or camera_model(config))
    any_use = any_camera_use(config)
    if any_use.identity not in kept:
        _announce(config, "detector", lasting, progress)
        found = fit(config, detector=detector, any_camera=True, progress=progress)
        kept[any_use.identity] = found.model
    return replace(kept[any_use.identity], network_scale=scale)


def fit_config(config: Config, progress: Progress) -> Config:
    """The configuration whose fit is used, which is said where it is one of other scenes.

    Too few scenes of one's own give way to embedded ones. Recordings of one's own give way to those that ship, if these
    have a fit, the others have none, and no recording of the test is among those that the fit has seen.
    """
    count = len(config.scenes.train_seeds)
    if config.losses.probability != "fitted" or config.scenes.source == "town":
        return config
    if count < _MIN_FIT_SCENES:
        progress.say(
            f"detection probability is that of the embedded scenes: to fit it on others takes {_MIN_FIT_SCENES}, "
            f"scenes.train_seeds has {count}"
        )
        return _config_of(config, "town")
    scenes = config.scenes
    if scenes.source not in ("traffic", "places") or (
        scenes.source == "traffic" and (scenes.recordings, scenes.test_recordings) == (None, None)
    ):
        return config
    shipped = _config_of(config, "traffic")
    seen = set(map(content_digest, search_and_test(None, None)[0]))
    if scenes.source == "places":
        own_uses = []
        tested = [file for place in places_of(config)[2] for file in recordings_of(place)]
    else:
        own_uses = [any_camera_use(any_camera_config(config))]
        own_uses += [detector_use(config, camera=each) for each in camera_models(config)]
        _, tested = search_and_test(scenes.recordings, scenes.test_recordings)
    if (
        any(map(stored_file, own_uses))
        or stored_file(any_camera_use(any_camera_config(shipped))) is None
        or seen.intersection(map(content_digest, tested))
    ):
        if scenes.source == "traffic":
            return config
        progress.say("detection probability is that of the embedded scenes: the test has recordings of the other fit")
        return _config_of(config, "town")
    progress.say(
        "detection probability is that of the recordings that ship with warpav; to fit it on those of "
        f"scenes.{'places' if scenes.source == 'places' else 'recordings'} run warpav detector fit --any-camera"
    )
    return shipped


def _unseen(config: Config) -> tuple[int, ...]:
    """Scenes of a result that its fit must not have seen, by number.

    Of recordings a number means other moments in the test than in the search, and a fit sees those of the search.
    """
    return () if config.scenes.source in ("traffic", "places") else config.scenes.test_seeds


def _config_of(config: Config, source: str) -> Config:
    """The configuration with embedded scenes, or those of the recordings that ship, for its own."""
    names = ("folder", "recordings", "test_recordings", "places", "selection_places", "test_places")
    return config.replace({"scenes.source": source, **{f"scenes.{name}": None for name in names}})


def _ensure_for_any_camera(config: Config, progress: Progress) -> DetectionProbability:
    """The stored fit for any camera, which is made first if there is none."""
    use = any_camera_use(config)
    if stored_file(use) is None:
        _announce(config, "detector", "stored for later runs, with any camera", progress)
        found = fit(config, any_camera=True, use=use, progress=progress)
        _write(found.model, use, None)
        _show(found.model.record, progress)
    return DetectionProbability.find(use, unseen=_unseen(config))


def _announce(config: Config, of: str, kept: str, progress: Progress) -> None:
    """Say that a fit begins, which takes long, even where progress is off."""
    text = (
        f"detection probability has not been fitted for this {of} yet: fitting it once, in "
        f"{sum(map(len, chosen_seeds(config)))} scenes; the fit is {kept}"
    )
    say_or_warn(text, "progress=True shows how far it is", progress)


def fit_detector(
    config: Config,
    *,
    words: Sequence[str],
    fit_seeds: tuple[int, ...] | None,
    held_out_seeds: tuple[int, ...] | None,
    out: Path | None,
    again: bool,
    any_camera: bool = False,
    progress: Progress,
) -> Path:
    """Fit the detection probability of a detector, or take the stored fit, and show how good it is."""
    from warpav.view import detection_curves

    if any_camera:
        config = any_camera_config(config)
    use = any_camera_use(config) if any_camera else detector_use(config)
    seeds = chosen_seeds(config, fit_seeds, held_out_seeds)
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ArgumentError("out", f"expected a folder to write to, got {str(out)!r} ({error.strerror})") from None
    stored = stored_file(use) if out is None else out / use.file_name
    if stored is not None and stored.is_file() and not again:
        model = DetectionProbability.read(stored, use=use)
        as_asked = (fit_seeds is None or list(fit_seeds) == model.record["fit"]["seeds"]) and (
            held_out_seeds is None or list(held_out_seeds) == model.record["held_out"]["seeds"]
        )
        if as_asked and not set(model.record["fit"]["seeds"]) & set(config.scenes.test_seeds):
            of = "detector with any camera" if any_camera else "detector, camera"
            progress.say(f"{stored} fits this {of} and source of scenes already and is used as it is")
            _show(model.record, progress)
            return stored
    found = fit(config, *seeds, any_camera=any_camera, use=use, progress=progress)
    model = replace(found.model, record={**found.model.record, "command": shlex.join(words)})
    file = _write(model, use, out)
    _draw_reliability(found.scores, found.probability, found.unseen.is_detected, file.with_name(file.stem))
    detection_curves(model, found.known, file.with_name(f"{file.stem}_curves.png"))
    _show(model.record, progress)
    return file


def fit(
    config: Config,
    scenes: Sequence[int] | None = None,
    held_out: Sequence[int] | None = None,
    *,
    detector: Detector | None = None,
    ego: Mesh | None = None,
    camera: CameraModel | None = None,
    any_camera: bool = False,
    use: DetectorUse | None = None,
    progress: bool | Progress | None = None,
) -> Fit:
    """Fit how probably a detector finds what a view shows, for ``Placement(..., probability=fitted.model)``.

    Args:
        config: Gives the detector (``detector.model``), the camera and the source of the scenes.
        scenes: Seeds of the scenes to fit on; None: 50 embedded ones, of another source 3/5 of ``scenes.train_seeds``.
        held_out: Seeds of others to evaluate the fit on; None: 30 embedded ones, or the rest.
        detector: An object instead of ``detector.model``; ``ego``, ``camera`` likewise, the vehicle in its frame [m].
        any_camera: Whether to fit for cameras of all sizes and fields of view.
        use: What the fit is for, for which samples are kept.
        progress: As of `warpav.optimise`.

    Returns:
        ``model``, a function of eight features of a view, for each kind of road user; ``known`` and ``unseen``, the
        objects that it was fitted and evaluated on, with ``feature`` [object, 8], ``is_detected`` and ``kind``
        [object]; ``probability`` of the unseen, 0..1; ``scores``: ``auc``, ``calibration_error``, ``bins``.

    Raises:
        InputError: Scenes are too few, serve two purposes or are those of the test, or the detector finds none or all.
    """
    began = time.perf_counter()
    seeds, unseen_seeds = chosen_seeds(config, scenes, held_out)
    name = config.detector.model if detector is None else type(detector).__name__
    used = load_detector(config) if detector is None else detector
    if any_camera:
        assert isinstance(used, ScalingDetector)
        sources = [Source.through(window, used, config, k) for k, window in enumerate(windows_of(used))]
    else:
        sources = [Source.of_camera(camera or camera_model(config))]
    levels = list(LEVELS) if config.scenes.source == "town" else None  # curves know nothing of level and fleet
    usual = config.replace({"scenes.level": levels, "scenes.vehicles": None, "scenes.vehicles_share": None})
    with shown_progress(progress) as shown:
        samples = sample_scenes(usual, (*seeds, *unseen_seeds), detector, ego, sources, shown, use=use)
        shown.stage("fitting")
    known, unseen = samples.of_seeds(seeds), samples.of_seeds(unseen_seeds)
    try:
        model, penalty = fit_probability(
            known,
            rng=np.random.default_rng([config.run.seed, FOLDS]),
            monotone=MONOTONE_FOR_ANY_CAMERA if any_camera else MONOTONE,
        )
    except ValueError as error:
        raise ArgumentError(
            "scenes", f"{error}; give more `scenes`, or other sizes of image", place=f"{name}: detection probability"
        ) from None
    if known.is_detected.mean() < _FEW:
        advice = (
            "does warpav detector check show boxes in images of its own kind, is it exported for one image at a time?"
        )
        text = f"{name} finds {_counts(known)['detected']} of {len(known)} objects, fewer than {_FEW:.0%}; {advice}"
        say_or_warn(f"warning: {text}", "the fit is kept as it is", shown)
    probability = model.of_features(unseen.feature, unseen.kind)
    try:
        scores = score(probability, unseen.is_detected)
    except ValueError as error:
        raise ArgumentError("held_out", f"{error}; give more scenes as `held_out`", place=name) from None
    record = {
        "command": "warpav detector fit" + " --any-camera" * any_camera,
        "seconds": round(time.perf_counter() - began, 1),
        "fit": {
            "seeds": list(seeds),
            "views_per_scene": sum(each.count for each in sources),
            **_counts(known),
            "penalty": penalty,
        },
        "held_out": {"seeds": list(unseen_seeds), **_counts(unseen), **asdict(scores)},
    }
    return Fit(replace(model, record=record), known, unseen, probability, scores)


def _is_weak(detector: object) -> bool:
    """Whether a fit can be kept for as long as an object lives."""
    try:
        weakref.ref(detector)
        hash(detector)
    except TypeError:
        return False
    return True


def _counts(samples: DetectionSamples) -> dict[str, int]:
    return {"objects": len(samples), "detected": int(samples.is_detected.sum())}


def _write(model: DetectionProbability, use: DetectorUse, out: Path | None) -> Path:
    """Write the model into the folder asked for, else beside its detector, else into the user's cache.

    What warpav ships is never written beside: an installed package stays as it is.
    """
    if out is not None:
        folders = [out]
    else:
        beside, cache = use.folders()
        folders = [cache] if beside.is_relative_to(Path(__file__).resolve().parents[1]) else [beside, cache]
    problem = ""
    for folder in folders:
        try:
            file = model.write(folder, use)
        except OSError as error:
            problem = error.strerror
            continue
        shutil.rmtree(samples_folder(use), ignore_errors=True)
        return file
    raise ArgumentError(
        "out", f"expected a folder to write to, got {problem}; give another as `out`", place=folders[-1]
    )


def _show(record: Any, progress: Progress) -> None:  # noqa: ANN401 (JSON)
    fit, held_out = record["fit"], record["held_out"]
    for name, part in (("fitted on", fit), ("evaluated on", held_out)):
        progress.say(
            f"{name} {part['objects']} objects in views of {len(part['seeds'])} scenes, {part['detected']} detected"
        )
    progress.say(
        f"AUC {held_out['auc']:.3f}, Brier score {held_out['brier']:.4f} (of the base rate "
        f"{held_out['brier_base_rate']:.4f}), "
        f"expected calibration error {held_out['calibration_error']:.4f} ({BIN_COUNT} bins of equal number)"
    )


# -------------------------------------------------------------------------------------- scores on other scenes

_SCORES_SCHEMA = 1
_RESAMPLES = 999
_HEADS = ("detector", "image px", "objects", "detected", "predicted", "AUC", "Brier (base rate)", "calibration error")
_HEADS = (*_HEADS, "of the fit's own scenes: AUC, error")


@dataclass(frozen=True, eq=False)
class _FitScores:
    """The detection probability of a detector against what the detector finds."""

    data: dict[str, Any]  # for the file
    scores: ProbabilityScores
    probability: np.ndarray  # what the fit says, float64 [object]
    is_detected: np.ndarray  # bool [object]


def score_detectors(
    config: Config,
    *,
    panel: Path | None,
    fitted_on: Literal["town", "own"],
    seeds: tuple[int, ...] | None,
    out: Path | None,
    progress: Progress,
) -> None:
    """Score the fits of the configured detector, or of all networks of a folder; show the scores and write them.

    What has no stored fit is fitted first, as a run would.
    """
    if out is not None:
        check_folder(out, "out")
    seeds = config.scenes.test_seeds if seeds is None else seeds
    configs = {Path(config.detector.model).stem: config}
    if panel is not None:
        configs = networks_in(panel, config)
    found = []
    for name, each in configs.items():
        progress.say(f"{name}: {len(seeds)} scenes")
        found.append(_scores_of(name, each, _config_of(each, "town") if fitted_on == "town" else each, seeds, progress))
    title = "Detection probability against what detectors find"
    table = Table.of(
        _HEADS,
        [_cells(each) for each in found],
        "Objects of which a view shows some pixel; detected: their share; predicted: their mean probability. 95 % "
        f"intervals resample scenes. Calibration error: {BIN_COUNT} bins of equal number.",
    )
    progress.say(title)
    progress.show(drawn(table))
    if out is None:
        return
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    source = {"source": config.scenes.source, "level": config.scenes.model_dump()["level"], "seeds": list(seeds)}
    detectors = [each.data for each in found]
    content = {"schema": _SCORES_SCHEMA, "scenes": source, "fitted_on": fitted_on, "detectors": detectors}
    write_json(out / "scores.json", content)
    write_text(out / "scores.md", f"**{title}**\n\n{table.markdown()}")
    for each in found:
        _draw_reliability(each.scores, each.probability, each.is_detected, out / each.data["name"], each.data["name"])
    progress.say(f"wrote {out}")


def _scores_of(name: str, config: Config, fit_config: Config, seeds: tuple[int, ...], progress: Progress) -> _FitScores:
    model = ensure_fit(fit_config, progress=progress)
    shared = sorted(set(model.record.get("fit", {}).get("seeds", [])) & set(seeds))
    if shared and fit_config.scenes.source == config.scenes.source:
        raise ArgumentError(
            "scenes", f"expected scenes that {name} was not fitted on, got {len(shared)} of them, such as {shared[0]}"
        )
    samples = sample_camera(config, seeds, model, progress=progress)
    probability = model.of_features(samples.feature, samples.kind)
    try:
        scores = score(probability, samples.is_detected)
    except ValueError as error:
        raise ArgumentError("scenes", f"{error}; give more `scenes`", place=name) from None
    held_out = model.record.get("held_out", {})
    kept = ("auc", "brier", "brier_base_rate", "calibration_error")
    data = {
        "name": name,
        "width_px": config.camera.width_px,
        "height_px": config.camera.height_px,
        "objects": len(samples),
        "detected": int(samples.is_detected.sum()),
        "predicted": float(probability.mean()),
        **_estimates(scores, probability, samples, len(seeds)),
        "scores": scores,
        "of_fit": {key: held_out[key] for key in kept if key in held_out},  # empty where the fit does not tell
    }
    return _FitScores(data, scores, probability, samples.is_detected)


def _estimates(
    scores: ProbabilityScores, probability: np.ndarray, samples: DetectionSamples, count: int
) -> dict[str, Estimate]:
    """AUC and calibration error with percentile intervals over resampled scenes; noise makes an error larger than 0."""
    members = [np.flatnonzero(samples.seed == seed) for seed in np.unique(samples.seed)]
    names = ("auc", "calibration_error")
    rng = np.random.default_rng(0)
    drawn = []
    for _ in range(_RESAMPLES if len(members) > 1 else 0):
        chosen = np.concatenate([members[k] for k in rng.integers(0, len(members), len(members))])
        with contextlib.suppress(ValueError):  # all of them were detected, or none
            again = score(probability[chosen], samples.is_detected[chosen])
            drawn.append([getattr(again, name) for name in names])
    ends: list[tuple[float | None, float | None]] = [(None, None)] * 2
    if drawn:
        ends = np.quantile(np.array(drawn), [0.5 - LEVEL / 2.0, 0.5 + LEVEL / 2.0], axis=0).T.tolist()
    return {name: Estimate(getattr(scores, name), ends[k][0], ends[k][1], count) for k, name in enumerate(names)}


def _cells(found: _FitScores) -> list[str]:
    def text(number: Estimate) -> str:
        interval = "" if number.low is None else f" [{number.low:.3f}, {number.high:.3f}]"
        return f"{number.value:.3f}{interval}"

    data, of_fit = found.data, found.data["of_fit"]
    return [
        data["name"],
        f"{data['width_px']} x {data['height_px']}",
        str(data["objects"]),
        f"{data['detected'] / data['objects']:.3f}",
        f"{data['predicted']:.3f}",
        text(data["auc"]),
        f"{found.scores.brier:.4f} ({found.scores.brier_base_rate:.4f})",
        text(data["calibration_error"]),
        f"{of_fit['auc']:.3f}, {of_fit['calibration_error']:.3f}" if of_fit else "-",
    ]


def _draw_reliability(
    scores: ProbabilityScores, probability: np.ndarray, is_detected: np.ndarray, stem: Path, name: str = ""
) -> None:
    from warpav.view import reliability_diagram

    text = f"AUC {scores.auc:.3f}, Brier {scores.brier:.3f}, calibration error {scores.calibration_error:.3f}"
    file = stem.with_name(f"{stem.name}_reliability.png")
    title = f"{name}: {text}" if name else text
    reliability_diagram(scores.bins, probability, is_detected, file, title=title)
