"""Fit the detection probability model of a configuration; keep it, its scores and its figures."""

from __future__ import annotations

import contextlib
import logging
import shlex
import time
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.devices import checked_device
from warpav.core.errors import ArgumentError
from warpav.core.progress import NullProgress, Progress
from warpav.detection.probability import DetectionProbability, DetectorUse, stored_file
from warpav.detection.probability_fit import (
    BIN_COUNT,
    DetectionSamples,
    ProbabilityScores,
    fit_probability,
    random_cameras,
    sample_detections,
    score,
)
from warpav.raster.chunks import chunk_view_count
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer
from warpav.runs.config import Config, changed_config
from warpav.runs.mounts import camera_model, free_ranges, roof_surface
from warpav.runs.networks import detector_use, load_detector
from warpav.runs.scene_set import load_scenes
from warpav.scene.device_scene import DeviceScene

if TYPE_CHECKING:
    from warpav.detection.detector import Detector
    from warpav.raster.mesh import Mesh

# Embedded scenes for this purpose alone: no experiment takes these seeds, and the shipped detector has not seen them.
TOWN_SEEDS = tuple(range(500_000, 500_050))
TOWN_HELD_OUT = tuple(range(500_050, 500_080))
VIEWS_PER_SCENE = 24
MIN_FIT_SCENES = 20
"""Training scenes of the user's own with which a model can be fitted and evaluated."""

_FITS: weakref.WeakKeyDictionary[Any, dict[str, DetectionProbability]] = weakref.WeakKeyDictionary()
"""What was fitted for detectors that are objects, by what it was fitted for."""

_logger = logging.getLogger(__name__)

# streams of random numbers
_CAMERAS, _FOLDS = 11, 12


@dataclass(frozen=True)
class FitSeeds:
    """Which scenes the curves are fitted on, and which the scores come from."""

    fit: tuple[int, ...]
    held_out: tuple[int, ...]


def chosen_seeds(config: Config, fit: tuple[int, ...] | None, held_out: tuple[int, ...] | None) -> FitSeeds:
    """The scenes to use: the given ones, else embedded ones of their own, else three to two of the training scenes.

    Raises:
        InputError: A scene is in both parts, or the fit would see a test scene.
    """
    if config.scenes.source == "town":
        usual = FitSeeds(TOWN_SEEDS, TOWN_HELD_OUT)
    else:
        train = config.scenes.train_seeds
        usual = FitSeeds(
            tuple(seed for k, seed in enumerate(train) if k % 5 < 3),
            tuple(seed for k, seed in enumerate(train) if k % 5 >= 3),
        )
    seeds = FitSeeds(usual.fit if fit is None else fit, usual.held_out if held_out is None else held_out)
    shared = sorted(set(seeds.fit) & set(seeds.held_out))
    if shared:
        raise ArgumentError(
            "held_out",
            f"expected scenes that the curves are not fitted on, got {len(shared)} of them, such as {shared[0]}; "
            "change `scenes` or `held_out`",
        )
    tested = sorted(set(seeds.fit) & set(config.scenes.test_seeds))
    if tested:
        raise ArgumentError(
            "scenes",
            f"expected other scenes than scenes.test_seeds, got {len(tested)} of them, such as {tested[0]}; change "
            "`scenes` or scenes.test_seeds",
        )
    if not seeds.held_out:
        raise ArgumentError(
            "scenes.train_seeds",
            f"expected at least 4 scenes to fit and to evaluate, got {len(seeds.fit)}; give `scenes` and `held_out`",
        )
    return seeds


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted model of detection probability, and what it was fitted and evaluated on.

    Attributes:
        model: The model, with its record.
        known: What the detector made of the scenes that it was fitted on.
        unseen: The same of those that it was evaluated on.
        probability: What it says of these, float64 [sighting].
        scores: How good that is.
    """

    model: DetectionProbability
    known: DetectionSamples
    unseen: DetectionSamples
    probability: np.ndarray
    scores: ProbabilityScores


def ensure_fit(
    config: Config,
    *,
    detector: Detector | None = None,
    ego: Mesh | None = None,
    progress: Progress | None = None,
) -> DetectionProbability:
    """The model of detection probability of a detector and its surroundings: the stored one, else fitted and stored.

    Where there are too few scenes of the user's own to fit it on, embedded ones take their place. What is fitted for a
    detector or a vehicle that is an object is kept while the object lives.

    Args:
        config: Detector, camera, scenes.
        detector: The detector, where it is an object and not ``config.detector``.
        ego: The vehicle, where it is an object and not ``config.scenes.ego``.
        progress: Reports that it has to be fitted, and how far that is. Where it shows nothing, a warning is logged:
            a fit takes minutes.

    Raises:
        InputError: It cannot be fitted or read, or was fitted on test scenes of a result.
    """
    progress = progress or NullProgress()
    scene_count = len(config.scenes.train_seeds)
    if config.scenes.source != "town" and scene_count < MIN_FIT_SCENES:
        progress.say(
            f"detection probability is that of the embedded scenes: to fit it on others takes {MIN_FIT_SCENES}, "
            f"scenes.train_seeds has {scene_count}"
        )
        config = changed_config(config, ["scenes.source=town", "scenes.folder=null"])
    use = detector_use(config, ego)
    if detector is not None:
        kept = _FITS.setdefault(detector, {}) if _is_weak(detector) else {}
        if use.identity not in kept:
            seeds = chosen_seeds(config, None, None)
            _announce(seeds, "kept as long as the detector object", progress)
            kept[use.identity] = fit(config, seeds, detector=detector, ego=ego, progress=progress).model
        return kept[use.identity]
    if stored_file(use) is None:
        seeds = chosen_seeds(config, None, None)
        _announce(seeds, "stored for later runs", progress)
        found = fit(config, seeds, ego=ego, progress=progress)
        _write(found.model, use, None)
        _show(found.model.record, progress)
    return DetectionProbability.find(use, unseen=config.scenes.test_seeds)


def _announce(seeds: FitSeeds, kept: str, progress: Progress) -> None:
    """Say that a fit begins, which takes long, even where progress is off."""
    text = (
        "detection probability has not been fitted for this detector and camera yet: fitting it once, in "
        f"{len(seeds.fit) + len(seeds.held_out)} scenes; the fit is {kept}"
    )
    if type(progress) is NullProgress:
        _logger.warning("%s; this takes minutes, and progress=True shows how far it is", text)
    else:
        progress.say(text)


def fit_detector(
    config: Config,
    *,
    words: Sequence[str],
    fit_seeds: tuple[int, ...] | None,
    held_out_seeds: tuple[int, ...] | None,
    out: Path | None,
    again: bool,
    progress: Progress,
) -> Path:
    """Fit the detection probability of a detector, or take the stored fit, and show how good it is.

    Args:
        config: Detector, camera, scenes.
        words: The command, for the record.
        fit_seeds: Scenes to fit; None: see `chosen_seeds`.
        held_out_seeds: Scenes to evaluate on; None: see `chosen_seeds`.
        out: Folder to keep it in; None: beside the detector's file, or in the user's cache.
        again: Whether to fit even if there is a stored fit.
        progress: Where to show it.

    Returns:
        The file of the model; its figures lie beside it.

    Raises:
        InputError: The input is wrong, or there are too few objects to fit or to evaluate on.
    """
    from warpav.view.figures.statistics import detection_curves, reliability_diagram

    use = detector_use(config)
    seeds = chosen_seeds(config, fit_seeds, held_out_seeds)
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ArgumentError("out", f"expected a folder to write to, got {str(out)!r} ({error.strerror})") from None
    stored = stored_file(use) if out is None else _existing(out / use.file_name)
    if stored is not None and not again:
        model = DetectionProbability.read(stored, use=use)
        as_asked = (fit_seeds is None or list(fit_seeds) == model.record["fit"]["seeds"]) and (
            held_out_seeds is None or list(held_out_seeds) == model.record["held_out"]["seeds"]
        )
        if as_asked and not set(model.record["fit"]["seeds"]) & set(config.scenes.test_seeds):
            progress.say(f"{stored} fits this detector, camera and source of scenes already and is used as it is")
            _show(model.record, progress)
            return stored
    found = fit(config, seeds, words=words, progress=progress)
    file = _write(found.model, use, out)
    scores = found.scores
    reliability_diagram(
        scores.bins,
        found.probability,
        found.unseen.is_detected,
        file.with_name(f"{file.stem}_reliability.png"),
        title=f"AUC {scores.auc:.3f}, Brier {scores.brier:.3f}, calibration error {scores.calibration_error:.3f}",
    )
    detection_curves(found.model, found.known.feature, file.with_name(f"{file.stem}_curves.png"))
    _show(found.model.record, progress)
    return file


def fit(
    config: Config,
    seeds: FitSeeds,
    *,
    detector: Detector | None = None,
    ego: Mesh | None = None,
    words: Sequence[str] = ("warpav", "detector", "fit"),
    progress: Progress,
) -> Fit:
    """Fit the detection probability of a detector; nothing is written.

    Args:
        config: Detector, camera, scenes.
        seeds: Scenes to fit and to evaluate on.
        detector: The detector, where it is an object and not ``config.detector``.
        ego: The vehicle, where it is an object and not ``config.scenes.ego``.
        words: The command, for the record.
        progress: Where to show it.

    Raises:
        InputError: There are too few objects to fit or to evaluate on.
    """
    began = time.perf_counter()
    name = config.detector.model if detector is None else type(detector).__name__
    detector = load_detector(config) if detector is None else detector
    samples = _sample_scenes(config, (*seeds.fit, *seeds.held_out), detector, ego, progress)
    progress.stage("fitting")
    known, unseen = samples.of_seeds(seeds.fit), samples.of_seeds(seeds.held_out)
    try:
        model, penalty = fit_probability(known, rng=np.random.default_rng([config.run.seed, _FOLDS]))
    except ValueError as error:
        raise ArgumentError(
            "scenes", f"{error}; give more `scenes`, or other sizes of image", place=f"{name}: detection probability"
        ) from None
    probability = model.of_features(unseen.feature)
    try:
        scores = score(probability, unseen.is_detected)
    except ValueError as error:
        raise ArgumentError("held_out", f"{error}; give more scenes as `held_out`", place=name) from None
    record = {
        "command": shlex.join(words),
        "seconds": round(time.perf_counter() - began, 1),
        "fit": {"seeds": list(seeds.fit), "views_per_scene": VIEWS_PER_SCENE, **_counts(known), "penalty": penalty},
        "held_out": {"seeds": list(seeds.held_out), **_counts(unseen), **asdict(scores)},
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


def _existing(file: Path) -> Path | None:
    return file if file.is_file() else None


def _sample_scenes(
    config: Config, seeds: Sequence[int], detector: Detector, ego: Mesh | None, progress: Progress
) -> DetectionSamples:
    """What the detector finds of the scenes through random cameras on the mount surface."""
    device = checked_device(config.device)
    model = camera_model(config)
    at_once = min(VIEWS_PER_SCENE, chunk_view_count(model, supersampling=config.camera.supersampling))
    renderer = Renderer(
        [model] * at_once,
        supersampling=config.camera.supersampling,
        occlusion=Occlusion(config.visibility.occlusion),
        device=device,
    )

    def parts() -> Iterator[DetectionSamples]:
        surface = None
        for seed, scene in zip(seeds, load_scenes(config, seeds, ego=ego), strict=True):
            surface = surface or roof_surface(config, scene.ego)
            packed = DeviceScene.pack(scene, device=device)
            if packed.vehicle_count == 0:
                yield DetectionSamples.join([])
                continue
            cameras = random_cameras(
                np.random.default_rng([config.run.seed, _CAMERAS, seed]),
                surface,
                model,
                height_offset_m=config.rig.height_offset_m,
                count=-(-VIEWS_PER_SCENE // at_once) * at_once,
                **vars(free_ranges(config)),
            )
            yield DetectionSamples.join(
                [
                    sample_detections(
                        renderer,
                        packed,
                        cameras[first : first + at_once],
                        detector,
                        seed=seed,
                        confidence_min=config.detector.confidence_min,
                        iou_min=config.detector.iou_min,
                    )
                    for first in range(0, len(cameras), at_once)
                ]
            )

    return DetectionSamples.join(list(progress.steps("sampling scenes", parts(), count=len(seeds))))


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
    for folder in folders[:-1]:
        with contextlib.suppress(OSError):
            return model.write(folder, use)
    try:
        return model.write(folders[-1], use)
    except OSError as error:
        raise ArgumentError(
            "out", f"expected a folder to write to, got {error.strerror}; give another as `out`", place=folders[-1]
        ) from None


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
