"""Fit the detection probability model of a configuration; keep it, its scores and its figures."""

from __future__ import annotations

import contextlib
import logging
import pickle
import shlex
import shutil
import time
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warpav.core.cache import digest, fingerprint, remove_oldest, user_cache_folder
from warpav.core.cores import available_cores
from warpav.core.errors import ArgumentError, InputError
from warpav.core.executor import Executor
from warpav.core.progress import NullProgress, Progress
from warpav.core.warp_setup import checked_device, load_warp
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
from warpav.optimisation.pool_cache import UNREADABLE, read_arrays, write_arrays
from warpav.raster.camera import CameraModel
from warpav.raster.chunks import KeptRenderers, ViewsAtOnce, chunk_view_count, equal_chunks, gpu_view_count
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer
from warpav.runs.config import Config, changed_config
from warpav.runs.mounts import camera_model, camera_models, free_ranges, roof_surface
from warpav.runs.networks import any_camera_config, any_camera_use, detector_use, load_detector, opened_detector
from warpav.runs.scene_set import load_scenes, scene_recipes
from warpav.scene.stored_scene import SceneRecipe, StoredScene
from warpav.scene.traffic.files import content_digest
from warpav.scene.traffic.moments import search_and_test

if TYPE_CHECKING:
    from warpav.detection.detector import Detector
    from warpav.raster.mesh import Mesh
    from warpav.rig.mount_surface import MountSurface
    from warpav.rig.rig import RigCamera
    from warpav.scene.device_scene import DeviceScene

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

_LONG_S = 30.0
"""A fit that takes longer says how long before it begins [s]."""
_SCENES_PER_PROCESS = 8
"""Fewer are sampled sooner than a process starts."""
_GPU_PROCESS_BYTES = 2**32
"""Free on a GPU for every process that samples on it, of which it takes about half."""
_CPU_KEY_BYTES = 2**24
"""Of the views that a core renders at once; more would leave its caches."""
_SAMPLES_BYTES = 2**28
"""What fits that were interrupted may keep on the disk; the oldest go first."""


@dataclass(frozen=True)
class FitSeeds:
    """Which scenes the curves are fitted on, and which the scores come from."""

    fit: tuple[int, ...]
    held_out: tuple[int, ...]


def chosen_seeds(config: Config, fit: tuple[int, ...] | None, held_out: tuple[int, ...] | None) -> FitSeeds:
    """The scenes to use: the given ones, else embedded ones of their own, else three to two of the training scenes."""
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
    """The configuration whose fit is used, which is said where it is one of other scenes.

    Too few scenes of one's own give way to embedded ones. Recordings of one's own give way to those that ship, if these
    have a fit, the others have none, and no recording of the test is among those that the fit has seen.
    """
    count = len(config.scenes.train_seeds)
    if config.losses.probability != "fitted" or config.scenes.source == "town":
        return config
    if count < MIN_FIT_SCENES:
        progress.say(
            f"detection probability is that of the embedded scenes: to fit it on others takes {MIN_FIT_SCENES}, "
            f"scenes.train_seeds has {count}"
        )
        return town_config(config)
    scenes = config.scenes
    if scenes.source != "traffic" or (scenes.recordings, scenes.test_recordings) == (None, None):
        return config
    shipped = changed_config(config, ["scenes.recordings=null", "scenes.test_recordings=null"], origin=None)
    own_uses = [any_camera_use(any_camera_config(config))]
    own_uses += [detector_use(config, camera=each) for each in camera_models(config)]
    (seen, _), (_, tested) = search_and_test(None, None), search_and_test(scenes.recordings, scenes.test_recordings)
    if (
        any(map(stored_file, own_uses))
        or stored_file(any_camera_use(any_camera_config(shipped))) is None
        or set(map(content_digest, seen)) & set(map(content_digest, tested))
    ):
        return config
    progress.say(
        "detection probability is that of the recordings that ship with warpav; to fit it on those of "
        "scenes.recordings run warpav detector fit --any-camera"
    )
    return shipped


def _unseen(config: Config) -> tuple[int, ...]:
    """Scenes of a result that its fit must not have seen, by number.

    Of recordings a number means other moments in the test than in the search, and a fit sees those of the search.
    """
    return () if config.scenes.source == "traffic" else config.scenes.test_seeds


def town_config(config: Config) -> Config:
    """The configuration with embedded scenes for its own."""
    town = {"source": "town", "folder": "null", "recordings": "null", "test_recordings": "null"}
    return changed_config(config, [f"scenes.{name}={value}" for name, value in town.items()])


def sample_camera(
    config: Config, seeds: Sequence[int], model: DetectionProbability, *, progress: Progress
) -> DetectionSamples:
    """What the configured detector finds in views of scenes by the configured camera, anywhere on roof and bonnet."""
    load_detector(config)  # what it cannot do shows at once
    source = _Source(camera_model(config), VIEWS_PER_SCENE, (_CAMERAS,), model.network_scale)
    return _sample_scenes(config, seeds, None, None, [source], progress, job="scoring")


def _network_scale(detector: ScalingDetector, camera: CameraModel) -> tuple[float, float]:
    return detector.network_scale(camera.height_px, camera.width_px)


def _ensure_for_any_camera(config: Config, progress: Progress) -> DetectionProbability:
    """The stored fit for any camera, which is made first if there is none."""
    use = any_camera_use(config)
    if stored_file(use) is None:
        seeds = chosen_seeds(config, None, None)
        _announce(seeds, "detector", "stored for later runs, with any camera", progress)
        words = ("warpav", "detector", "fit", "--any-camera")
        found = fit(config, seeds, any_camera=True, words=words, use=use, progress=progress)
        _write(found.model, use, None)
        _show(found.model.record, progress)
    return DetectionProbability.find(use, unseen=_unseen(config))


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
    """Fit the detection probability of a detector, or take the stored fit, and show how good it is."""
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
    found = fit(config, seeds, any_camera=any_camera, words=words, use=use, progress=progress)
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
    use: DetectorUse | None = None,
    progress: Progress,
) -> Fit:
    """Fit the detection probability of a detector; no model is written."""
    began = time.perf_counter()
    name = config.detector.model if detector is None else type(detector).__name__
    used = load_detector(config) if detector is None else detector
    if any_camera:
        assert isinstance(used, ScalingDetector)
        sources = [_Source.through(window, used, config, k) for k, window in enumerate(windows_of(used))]
    else:
        sources = [_Source(camera or camera_model(config), VIEWS_PER_SCENE, (_CAMERAS,))]
    usual = changed_config(config, [f"scenes.{name}=null" for name in _NOT_FITTED], origin=None)
    samples = _sample_scenes(usual, (*seeds.fit, *seeds.held_out), detector, ego, sources, progress, use=use)
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


@dataclass(frozen=True)
class _Source:
    """Views of one image size that a detector is tried on."""

    model: CameraModel  # A camera of that size
    count: int  # views in every scene, at least
    stream: tuple[int, ...]  # of the random numbers for them
    # Pixels of the network's input for one of their images, along x and y
    network_scale: tuple[float, float] = (1.0, 1.0)
    # What cameras of all kinds are seen through; None: places and directions of the one camera
    window: Window | None = None

    @classmethod
    def through(cls, window: Window, detector: ScalingDetector, config: Config, index: int) -> _Source:
        """Cameras of all kinds, seen through a window."""
        model = CameraModel(window.width_px, window.height_px, near_m=config.camera.near_m)
        return cls(model, window.count, (_MIXTURE, index), _network_scale(detector, model), window)

    def cameras(self, config: Config, scene: DeviceScene, surface: MountSurface, seed: int) -> list[RigCamera]:
        """Their cameras in a scene: a whole number of the chunks of `chunk_view_count`."""
        at_once = min(self.count, chunk_view_count(self.model, supersampling=config.camera.supersampling))
        count = -(-self.count // at_once) * at_once
        rng = np.random.default_rng([config.run.seed, *self.stream, seed])
        if self.window is None:
            offset_m = config.rig.height_offset_m
            free = vars(free_ranges(config))
            return random_cameras(rng, surface, self.model, height_offset_m=offset_m, count=count, **free)
        object_ego_m = scene.upright_box.centre_ego_m.numpy()[: scene.vehicle_count].astype(np.float64)
        return [
            mixed_camera(
                rng,
                self.window,
                surface=surface,
                ego_bounds_m=scene.ego_bounds_m,
                object_ego_m=object_ego_m,
                near_m=config.camera.near_m,
            )
            for _ in range(count)
        ]


@dataclass(frozen=True, eq=False)
class _Sampling:
    """How a detector is tried on scenes; without a detector that is an object it travels to other processes."""

    config: Config  # detector, cameras
    surface: MountSurface  # roof and bonnet
    sources: tuple[_Source, ...]  # the views
    detector: Detector | None  # the detector; None: that of ``config``

    @cached_property
    def _used_detector(self) -> Detector:
        return opened_detector(self.config) if self.detector is None else self.detector

    @cached_property
    def _renderers(self) -> KeptRenderers:
        return KeptRenderers()

    def samples(self, recipe: SceneRecipe, seed: int) -> DetectionSamples:
        """What the detector finds in a scene."""
        scene = StoredScene(recipe, user_cache_folder("packed_scenes"), checked_device(self.config.device))
        found = [self._of_source(each, scene, seed) for each in self.sources if scene.vehicle_count]
        return DetectionSamples.join(found)

    def _of_source(self, source: _Source, scene: DeviceScene, seed: int) -> DetectionSamples:
        cameras = source.cameras(self.config, scene, self.surface, seed)
        supersampling = self.config.camera.supersampling
        device = self.config.device
        if device.startswith("cuda"):
            most = gpu_view_count(len(cameras), source.model, supersampling=supersampling, device=device)
        else:
            key_bytes = _CPU_KEY_BYTES * available_cores()
            most = chunk_view_count(source.model, supersampling=supersampling, key_bytes=key_bytes)
        return ViewsAtOnce(most).run(
            lambda most: self._of_cameras(source, cameras, scene, seed, most), release=self._renderers.clear
        )

    def _of_cameras(
        self, source: _Source, cameras: list[RigCamera], scene: DeviceScene, seed: int, most: int
    ) -> DetectionSamples:
        """What the detector finds in the views of some cameras, at most so many at once."""
        config, size = self.config, len(equal_chunks(len(cameras), most)[0])

        def renderers() -> list[Renderer]:
            return [
                Renderer(
                    [source.model] * size,
                    supersampling=config.camera.supersampling,
                    occlusion=Occlusion(config.visibility.occlusion),
                    device=checked_device(config.device),
                )
            ]

        (renderer,) = self._renderers.of((source, size), renderers)
        return DetectionSamples.join(
            [
                sample_detections(
                    renderer,
                    scene,
                    cameras[first : first + size],
                    self._used_detector,
                    seed=seed,
                    confidence_min=config.detector.confidence_min,
                    iou_min=config.detector.iou_min,
                    network_scale=source.network_scale,
                )
                for first in range(0, len(cameras), size)
            ]
        )


def _samples_of(task: tuple[int, bytes, SceneRecipe, int]) -> DetectionSamples:
    """What a task does in another process."""
    _, sampling, recipe, seed = task
    return _unpickled(sampling).samples(recipe, seed)


@lru_cache(maxsize=1)
def _unpickled(sampling: bytes) -> _Sampling:
    """The one of all tasks, with its detector and the renderers that it keeps."""
    load_warp()
    return pickle.loads(sampling)


def _sample_scenes(
    config: Config,
    seeds: Sequence[int],
    detector: Detector | None,
    ego: Mesh | None,
    sources: Sequence[_Source],
    progress: Progress,
    *,
    job: str = "the fit",
    use: DetectorUse | None = None,
) -> DetectionSamples:
    """What a detector finds of scenes in the views of some sources, on all cores; the numbers are those of one.

    Says how long it takes, if that is long.
    """
    if not seeds:
        return DetectionSamples.join([])
    body = next(load_scenes(config, seeds[:1], ego=ego)).ego
    sampling = _Sampling(config, roof_surface(config, body), tuple(sources), detector)
    recipes = scene_recipes(config, seeds, progress, ego=ego)
    files = [None] * len(seeds) if use is None else _kept_files(use, sampling, recipes, seeds)
    parts = [_read_samples(file) for file in files]
    missing = [k for k, part in enumerate(parts) if part is None]
    count = _process_count(config, len(missing)) if detector is None else 1
    outcomes = _outcomes(sampling, [(recipes[k], seeds[k]) for k in missing], count)
    began = all_began = time.perf_counter()
    try:
        for done, (number, samples) in enumerate(progress.steps("sampling scenes", outcomes, count=len(missing)), 1):
            k = missing[number]
            parts[k] = samples
            _keep_samples(samples, files[k])
            now = time.perf_counter()
            if done == count:  # the first of a process also pays for what all need
                began = now
            expected_s = now - all_began + (len(missing) - done) * (now - began) / count
            if done == 2 * count and expected_s > _LONG_S:
                _say(f"{job} takes {_about(expected_s)}", "progress=True shows how far it is", progress)
    except KeyboardInterrupt:
        with contextlib.suppress(OSError):  # the terminal may be gone
            if use is not None:
                there = sum(part is not None for part in parts)
                progress.say(f"stopped; {there} of {len(seeds)} scenes are kept, and the same command samples the rest")
        raise
    return DetectionSamples.join([part for part in parts if part is not None])


def _process_count(config: Config, scene_count: int) -> int:
    """Processes that are worth their start, and on a GPU have room there."""
    count = min(config.executor.workers or available_cores(), scene_count // _SCENES_PER_PROCESS)
    if config.device.startswith("cuda"):
        room_bytes = config.shared_gpu_count * wp.get_device(config.device).free_memory
        count = min(count, room_bytes // _GPU_PROCESS_BYTES)
    return max(1, count)


def _outcomes(
    sampling: _Sampling, tasks: Sequence[tuple[SceneRecipe, int]], process_count: int
) -> Iterator[tuple[int, DetectionSamples]]:
    """Samples of scenes as they are there, each with the number of its task."""
    if process_count <= 1:
        yield from ((number, sampling.samples(*task)) for number, task in enumerate(tasks))
        return
    config, content = sampling.config, pickle.dumps(sampling)
    needs_gpu = config.device.startswith("cuda") or config.detector.provider != "cpu"
    executor = Executor("process", process_count, gpu_count=config.shared_gpu_count if needs_gpu else 0)
    for outcome in executor.map(_samples_of, [(number, content, *task) for number, task in enumerate(tasks)]):
        if outcome.result is None:
            raise InputError(f"scene {outcome.task[-1]}: {outcome.error}")
        yield outcome.task[0], outcome.result


def _samples_folder(use: DetectorUse) -> Path:
    """Where samples are kept until their fit is stored."""
    *_, cache = use.folders()
    return cache / "samples" / use.identity


def _kept_files(
    use: DetectorUse, sampling: _Sampling, recipes: Sequence[SceneRecipe], seeds: Sequence[int]
) -> list[Path | None]:
    """The file that keeps the samples of each scene, by all that they depend on."""
    import onnxruntime

    config, folder = sampling.config, _samples_folder(use)
    remove_oldest(folder.parent, "*/*.npz", capacity_bytes=_SAMPLES_BYTES)
    made_of = fingerprint(
        config.run.seed,
        sampling.sources,
        config.mount,
        config.device.startswith("cuda"),
        onnxruntime.__version__,
        version("warp-lang"),
        code=(__name__,),
    )
    return [
        folder / f"{digest(made_of, recipe.file_name, seed)}.npz" for recipe, seed in zip(recipes, seeds, strict=True)
    ]


def _read_samples(file: Path | None) -> DetectionSamples | None:
    """What is kept; None where nothing is that can be read."""
    with contextlib.suppress(*UNREADABLE):
        return None if file is None else DetectionSamples(**read_arrays(file)[0])
    return None


def _keep_samples(samples: DetectionSamples, file: Path | None) -> None:
    """Keep what was sampled, where that can be."""
    if file is not None:
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            write_arrays(file, {}, **vars(samples))


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
    problem = ""
    for folder in folders:
        try:
            file = model.write(folder, use)
        except OSError as error:
            problem = error.strerror
            continue
        shutil.rmtree(_samples_folder(use), ignore_errors=True)
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
