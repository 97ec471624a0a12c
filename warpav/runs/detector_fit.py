"""Fit the detection probability model of a configuration; keep it, its scores and its figures."""

from __future__ import annotations

import contextlib
import itertools
import logging
import shlex
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.devices import checked_device
from warpav.core.errors import ArgumentError
from warpav.core.progress import NullProgress, Progress
from warpav.detection.camera_mixture import ScalingDetector, Window, mixed_camera, windows_of
from warpav.detection.probability import DetectionProbability, DetectorUse, stored_file
from warpav.detection.probability_fit import (
    BIN_COUNT,
    MONOTONE,
    MONOTONE_FOR_ANY_CAMERA,
    DetectionSamples,
    ProbabilityScores,
    fit_probability,
    random_cameras,
    sample_detections,
    score,
)
from warpav.raster.camera import CameraModel
from warpav.raster.chunks import chunk_view_count
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer
from warpav.runs.config import Config, changed_config
from warpav.runs.mounts import camera_model, free_ranges, roof_surface
from warpav.runs.networks import any_camera_config, any_camera_use, detector_use, load_detector, opened_detector
from warpav.runs.scene_set import load_scenes
from warpav.scene.device_scene import DeviceScene

if TYPE_CHECKING:
    from warpav.detection.detector import Detector
    from warpav.raster.mesh import Mesh
    from warpav.rig.mount_surface import MountSurface
    from warpav.rig.rig import RigCamera

# Embedded scenes for this purpose alone: no experiment takes these seeds, and the shipped detector has not seen them.
TOWN_SEEDS = tuple(range(500_000, 500_050))
TOWN_HELD_OUT = tuple(range(500_050, 500_080))
VIEWS_PER_SCENE = 24
_NOT_FITTED = ("level", "vehicles", "vehicles_share")  # what curves know nothing of
MIN_FIT_SCENES = 20
"""Training scenes of the user's own with which a model can be fitted and evaluated."""

_FITS: weakref.WeakKeyDictionary[Any, dict[str, DetectionProbability]] = weakref.WeakKeyDictionary()
"""What was fitted for detectors that are objects, by what it was fitted for."""

_logger = logging.getLogger(__name__)

# streams of random numbers
_CAMERAS, _FOLDS, _MIXTURE = 11, 12, 13

LONG_S = 30.0
"""A fit that takes longer says how long before it begins [s]."""
_TRIAL_VIEWS = 2


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

    Args:
        config: Detector, camera, scenes.
        detector: The detector, where it is an object and not ``config.detector``.
        ego: The vehicle, where it is an object and not ``config.scenes.ego``.
        camera: The camera that the probability is asked for, where it is not that of ``config``.
        progress: Reports that it has to be fitted, how long that takes and how far it is. Where it shows nothing, a
            warning is logged.

    Returns:
        The model; it counts the pixels that the detector makes of this camera's images.

    Raises:
        InputError: It cannot be fitted or read, or was fitted on test scenes of a result.
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
            return DetectionProbability.find(use, unseen=config.scenes.test_seeds)
        scale = _network_scale(opened_detector(config), camera or camera_model(config))
        return replace(_ensure_for_any_camera(any_camera_config(config), progress), network_scale=scale)
    kept = _FITS.setdefault(detector, {}) if _is_weak(detector) else {}
    if use.identity in kept:
        return kept[use.identity]
    seeds = chosen_seeds(config, None, None)
    lasting = "kept as long as the detector object"
    if not isinstance(detector, ScalingDetector):
        _announce(seeds, "detector and camera", lasting, progress)
        found = fit(config, seeds, detector=detector, ego=ego, camera=camera, progress=progress)
        return kept.setdefault(use.identity, found.model)
    scale = _network_scale(detector, camera or camera_model(config))
    any_use = any_camera_use(config)
    if any_use.identity not in kept:
        _announce(seeds, "detector", lasting, progress)
        found = fit(config, seeds, detector=detector, any_camera=True, progress=progress)
        kept[any_use.identity] = found.model
    return replace(kept[any_use.identity], network_scale=scale)


def fit_config(config: Config, progress: Progress) -> Config:
    """The configuration with embedded scenes where it has too few of its own to fit on, which is said."""
    count = len(config.scenes.train_seeds)
    if config.losses.probability != "fitted" or config.scenes.source == "town" or count >= MIN_FIT_SCENES:
        return config
    progress.say(
        f"detection probability is that of the embedded scenes: to fit it on others takes {MIN_FIT_SCENES}, "
        f"scenes.train_seeds has {count}"
    )
    return town_config(config)


def town_config(config: Config) -> Config:
    """The configuration with embedded scenes for its own."""
    town = {"source": "town", "folder": "null", "recordings": "null", "test_recordings": "null"}
    return changed_config(config, [f"scenes.{name}={value}" for name, value in town.items()])


def sample_camera(
    config: Config, seeds: Sequence[int], model: DetectionProbability, *, progress: Progress
) -> DetectionSamples:
    """What the configured detector finds in views of scenes by the configured camera, anywhere on roof and bonnet.

    Args:
        config: Detector, camera, scenes; of these also their level.
        seeds: Numbers of the scenes.
        model: Of `ensure_fit` for this configuration; says what pixels count.
        progress: Where to show it.

    Raises:
        InputError: A scene or the detector cannot be used.
    """
    source = replace(_camera_source(config, camera_model(config)), network_scale=model.network_scale)
    return _sample_scenes(config, seeds, load_detector(config), None, [source], progress, job="scoring")


def _network_scale(detector: ScalingDetector, camera: CameraModel) -> tuple[float, float]:
    return detector.network_scale(camera.height_px, camera.width_px)


def _ensure_for_any_camera(config: Config, progress: Progress) -> DetectionProbability:
    """The stored fit for any camera, which is made first if there is none.

    Args:
        config: Of `any_camera_config`.
        progress: As in `ensure_fit`.
    """
    use = any_camera_use(config)
    if stored_file(use) is None:
        seeds = chosen_seeds(config, None, None)
        _announce(seeds, "detector", "stored for later runs, with any camera", progress)
        words = ("warpav", "detector", "fit", "--any-camera")
        found = fit(config, seeds, any_camera=True, words=words, progress=progress)
        _write(found.model, use, None)
        _show(found.model.record, progress)
    return DetectionProbability.find(use, unseen=config.scenes.test_seeds)


def _announce(seeds: FitSeeds, of: str, kept: str, progress: Progress) -> None:
    """Say that a fit begins, which takes long, even where progress is off."""
    text = (
        f"detection probability has not been fitted for this {of} yet: fitting it once, in "
        f"{len(seeds.fit) + len(seeds.held_out)} scenes; the fit is {kept}"
    )
    _say(text, "progress=True shows how far it is", progress)


def _say(text: str, hint: str, progress: Progress) -> None:
    """Say something, and where nothing is shown log it as a warning, with a hint."""
    if type(progress) is NullProgress:
        _logger.warning("%s; %s", text, hint)
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
    any_camera: bool = False,
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
        any_camera: Whether to fit for any camera, and not for the configuration's alone.
        progress: Where to show it.

    Returns:
        The file of the model; its figures lie beside it.

    Raises:
        InputError: The input is wrong, or there are too few objects to fit or to evaluate on.
    """
    from warpav.view.figures.statistics import detection_curves, reliability_diagram

    if any_camera:
        config = any_camera_config(config)
    use = any_camera_use(config) if any_camera else detector_use(config)
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
            of = "detector with any camera" if any_camera else "detector, camera"
            progress.say(f"{stored} fits this {of} and source of scenes already and is used as it is")
            _show(model.record, progress)
            return stored
    found = fit(config, seeds, any_camera=any_camera, words=words, progress=progress)
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
    camera: CameraModel | None = None,
    any_camera: bool = False,
    words: Sequence[str] = ("warpav", "detector", "fit"),
    progress: Progress,
) -> Fit:
    """Fit the detection probability of a detector; nothing is written.

    Args:
        config: Detector, camera, scenes.
        seeds: Scenes to fit and to evaluate on.
        detector: The detector, where it is an object and not ``config.detector``.
        ego: The vehicle, where it is an object and not ``config.scenes.ego``.
        camera: The camera, where it is not that of ``config``.
        any_camera: Whether to fit for cameras of all kinds (`warpav.detection.camera_mixture`) instead of that one; the
            detector is a `ScalingDetector`.
        words: The command, for the record.
        progress: Where to show it, and how long it takes if that is long.

    Raises:
        InputError: There are too few objects to fit or to evaluate on.
    """
    began = time.perf_counter()
    name = config.detector.model if detector is None else type(detector).__name__
    detector = load_detector(config) if detector is None else detector
    if any_camera:
        assert isinstance(detector, ScalingDetector)
        sources = [_any_camera_source(config, window, detector, k) for k, window in enumerate(windows_of(detector))]
    else:
        sources = [_camera_source(config, camera or camera_model(config))]
    usual = changed_config(config, [f"scenes.{name}=null" for name in _NOT_FITTED], origin=None)
    samples = _sample_scenes(usual, (*seeds.fit, *seeds.held_out), detector, ego, sources, progress)
    progress.stage("fitting")
    known, unseen = samples.of_seeds(seeds.fit), samples.of_seeds(seeds.held_out)
    try:
        model, penalty = fit_probability(
            known,
            rng=np.random.default_rng([config.run.seed, _FOLDS]),
            monotone=MONOTONE_FOR_ANY_CAMERA if any_camera else MONOTONE,
        )
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
        "fit": {
            "seeds": list(seeds.fit),
            "views_per_scene": sum(each.count for each in sources),
            **_counts(known),
            "penalty": penalty,
        },
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


Draw = Callable[[np.random.Generator, "MountSurface", DeviceScene, int], "list[RigCamera]"]
"""So many cameras on a vehicle in a scene."""


@dataclass(frozen=True, eq=False)
class _Source:
    """Views of one image size that a detector is tried on.

    Attributes:
        model: A camera of that size.
        count: Views in every scene, at least.
        draw: Their cameras.
        stream: Of the random numbers for them.
        network_scale: Pixels of the network's input for one of their images, along x and y.
    """

    model: CameraModel
    count: int
    draw: Draw
    stream: tuple[int, ...]
    network_scale: tuple[float, float] = (1.0, 1.0)


def _camera_source(config: Config, model: CameraModel) -> _Source:
    """Random places and directions of one camera on roof and bonnet."""

    def draw(rng: np.random.Generator, surface: MountSurface, scene: DeviceScene, count: int) -> list[RigCamera]:
        del scene
        return random_cameras(
            rng,
            surface,
            model,
            height_offset_m=config.rig.height_offset_m,
            count=count,
            **vars(free_ranges(config)),
        )

    return _Source(model, VIEWS_PER_SCENE, draw, (_CAMERAS,))


def _any_camera_source(config: Config, window: Window, detector: ScalingDetector, index: int) -> _Source:
    """Cameras of all kinds, seen through a window."""
    near_m = config.camera.near_m

    def draw(rng: np.random.Generator, surface: MountSurface, scene: DeviceScene, count: int) -> list[RigCamera]:
        object_ego_m = scene.upright_box.centre_ego_m.numpy()[: scene.vehicle_count].astype(np.float64)
        return [
            mixed_camera(
                rng,
                window,
                surface=surface,
                ego_bounds_m=scene.ego_bounds_m,
                object_ego_m=object_ego_m,
                near_m=near_m,
            )
            for _ in range(count)
        ]

    model = CameraModel(window.width_px, window.height_px, near_m=near_m)
    return _Source(model, window.count, draw, (_MIXTURE, index), _network_scale(detector, model))


@dataclass(frozen=True, eq=False)
class _Sampler:
    """Tries a detector on the views of a source, so many at once as its renderer has."""

    config: Config
    detector: Detector
    source: _Source
    renderer: Renderer

    @classmethod
    def of(cls, config: Config, detector: Detector, source: _Source, *, at_once: int | None = None) -> _Sampler:
        supersampling = config.camera.supersampling
        if at_once is None:
            at_once = chunk_view_count(source.model, supersampling=supersampling)
        renderer = Renderer(
            [source.model] * min(source.count, at_once),
            supersampling=supersampling,
            occlusion=Occlusion(config.visibility.occlusion),
            device=checked_device(config.device),
        )
        return cls(config, detector, source, renderer)

    def samples(self, scene: DeviceScene, surface: MountSurface, *, seed: int, count: int) -> DetectionSamples:
        """What the detector finds in at least so many views of a scene."""
        config, at_once = self.config, self.renderer.view_count
        rng = np.random.default_rng([config.run.seed, *self.source.stream, seed])
        cameras = self.source.draw(rng, surface, scene, -(-count // at_once) * at_once)
        return DetectionSamples.join(
            [
                sample_detections(
                    self.renderer,
                    scene,
                    cameras[first : first + at_once],
                    self.detector,
                    seed=seed,
                    confidence_min=config.detector.confidence_min,
                    iou_min=config.detector.iou_min,
                    network_scale=self.source.network_scale,
                )
                for first in range(0, len(cameras), at_once)
            ]
        )


def _sample_scenes(
    config: Config,
    seeds: Sequence[int],
    detector: Detector,
    ego: Mesh | None,
    sources: Sequence[_Source],
    progress: Progress,
    job: str = "the fit",
) -> DetectionSamples:
    """What the detector finds of the scenes in the views of some sources; says how long the job takes, if long."""
    device = checked_device(config.device)

    def packed_scenes() -> Iterator[tuple[DeviceScene, MountSurface]]:
        surface = None
        for scene in load_scenes(config, seeds, ego=ego):
            surface = surface or roof_surface(config, scene.ego)
            yield DeviceScene.pack(scene, device=device), surface

    scenes, scene_s = packed_scenes(), 0.0
    known: list[tuple[DeviceScene, MountSurface]] = []
    while len(known) < min(2, len(seeds)):  # the first one also pays for what all need
        began = time.perf_counter()
        known.append(next(scenes))
        scene_s = time.perf_counter() - began
    if known and known[-1][0].vehicle_count > 0:
        seed = seeds[len(known) - 1]
        views_s = sum(_trial_seconds(config, detector, each, *known[-1], seed) for each in sources)
        expected_s = len(seeds) * (scene_s + views_s)
        if expected_s > LONG_S:
            _say(f"{job} takes {_about(expected_s)}", "progress=True shows how far it is", progress)
    samplers = [_Sampler.of(config, detector, source) for source in sources]

    def parts() -> Iterator[DetectionSamples]:
        for seed, (packed, surface) in zip(seeds, itertools.chain(known, scenes), strict=True):
            if packed.vehicle_count == 0:
                yield DetectionSamples.join([])
                continue
            yield DetectionSamples.join(
                [each.samples(packed, surface, seed=seed, count=each.source.count) for each in samplers]
            )

    return DetectionSamples.join(list(progress.steps("sampling scenes", parts(), count=len(seeds))))


def _trial_seconds(
    config: Config, detector: Detector, source: _Source, scene: DeviceScene, surface: MountSurface, seed: int
) -> float:
    """How long the views of a source take in a scene, from a few of them [s]."""
    count = min(_TRIAL_VIEWS, source.count)
    sampler = _Sampler.of(config, detector, source, at_once=count)
    sampler.samples(scene, surface, seed=seed, count=count)  # compiles and allocates
    began = time.perf_counter()
    sampler.samples(scene, surface, seed=seed, count=count)
    return (time.perf_counter() - began) * source.count / count


def _about(seconds: float) -> str:
    """A duration as one says it."""
    if seconds < 90.0:
        return f"about {max(1, round(seconds / 10.0)) * 10} seconds"
    if seconds < 5400.0:
        return f"about {round(seconds / 60.0)} minutes"
    return f"about {seconds / 3600.0:.1f} hours"


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
