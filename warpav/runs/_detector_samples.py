"""What a detector finds in views of scenes: the samples on which its detection probability is fitted or scored."""

from __future__ import annotations

import contextlib
import logging
import pickle
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warpav.core.cache import digest, fingerprint, remove_oldest, user_cache_folder
from warpav.core.cores import available_cores, available_processes
from warpav.core.errors import InputError
from warpav.core.executor import Executor
from warpav.core.progress import NullProgress, Progress
from warpav.core.warp_setup import checked_device, load_warp
from warpav.detection import (
    DetectionProbability,
    DetectionSamples,
    DetectorUse,
    ScalingDetector,
    Window,
    mixed_camera,
    random_cameras,
    sample_detections,
)
from warpav.optimisation import UNREADABLE, read_arrays, write_arrays
from warpav.raster.camera import CameraModel
from warpav.raster.chunks import KeptRenderers, ViewsAtOnce, chunk_view_count, equal_chunks, gpu_view_count
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer
from warpav.runs._mounts import camera_model, free_ranges, roof_surface
from warpav.runs._networks import load_detector, opened_detector
from warpav.runs._scene_set import load_scenes, scene_recipes
from warpav.runs.config import Config
from warpav.scene import SceneRecipe, StoredScene

if TYPE_CHECKING:
    from warpav.detection import Detector
    from warpav.raster.mesh import Mesh
    from warpav.rig import MountSurface, RigCamera
    from warpav.scene import DeviceScene

VIEWS_PER_SCENE = 24

_logger = logging.getLogger(__name__)

# streams of random numbers
_CAMERAS, FOLDS, _MIXTURE = 11, 12, 13

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


def sample_camera(
    config: Config, seeds: Sequence[int], model: DetectionProbability, *, progress: Progress
) -> DetectionSamples:
    """What the configured detector finds in views of scenes by the configured camera, anywhere on roof and bonnet."""
    load_detector(config)  # what it cannot do shows at once
    source = Source.of_camera(camera_model(config), model.network_scale)
    return sample_scenes(config, seeds, None, None, [source], progress, job="scoring")


@dataclass(frozen=True)
class Source:
    """Views of one image size that a detector is tried on."""

    model: CameraModel  # A camera of that size
    count: int  # views in every scene, at least
    stream: tuple[int, ...]  # of the random numbers for them
    # Pixels of the network's input for one of their images, along x and y
    network_scale: tuple[float, float] = (1.0, 1.0)
    # What cameras of all kinds are seen through; None: places and directions of the one camera
    window: Window | None = None

    @classmethod
    def of_camera(cls, model: CameraModel, network_scale: tuple[float, float] = (1.0, 1.0)) -> Source:
        """Places and directions of one camera."""
        return cls(model, VIEWS_PER_SCENE, (_CAMERAS,), network_scale)

    @classmethod
    def through(cls, window: Window, detector: ScalingDetector, config: Config, index: int) -> Source:
        """Cameras of all kinds, seen through a window."""
        model = CameraModel(window.width_px, window.height_px, near_m=config.camera.near_m)
        return cls(model, window.count, (_MIXTURE, index), network_scale_of(detector, model), window)

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
    sources: tuple[Source, ...]  # the views
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

    def _of_source(self, source: Source, scene: DeviceScene, seed: int) -> DetectionSamples:
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
        self, source: Source, cameras: list[RigCamera], scene: DeviceScene, seed: int, most: int
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
    _, sampling, recipe, seed = task
    return _unpickled(sampling).samples(recipe, seed)


@lru_cache(maxsize=1)
def _unpickled(sampling: bytes) -> _Sampling:
    """The one of all tasks, with its detector and the renderers that it keeps."""
    load_warp()
    return pickle.loads(sampling)


def sample_scenes(
    config: Config,
    seeds: Sequence[int],
    detector: Detector | None,
    ego: Mesh | None,
    sources: Sequence[Source],
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
                say_or_warn(f"{job} takes {_about(expected_s)}", "progress=True shows how far it is", progress)
    except KeyboardInterrupt:
        with contextlib.suppress(OSError):  # the terminal may be gone
            if use is not None:
                there = sum(part is not None for part in parts)
                progress.say(f"stopped; {there} of {len(seeds)} scenes are kept, and the same command samples the rest")
        raise
    return DetectionSamples.join([part for part in parts if part is not None])


def _process_count(config: Config, scene_count: int) -> int:
    """Processes that are worth their start, and on a GPU have room there."""
    count = min(config.executor.workers or available_processes(), scene_count // _SCENES_PER_PROCESS)
    if config.device.startswith("cuda"):
        room_bytes = config.shared_gpu_count * wp.get_device(config.device).free_memory
        count = min(count, room_bytes // _GPU_PROCESS_BYTES)
    return max(1, count)


def _outcomes(
    sampling: _Sampling, tasks: Sequence[tuple[SceneRecipe, int]], process_count: int
) -> Iterator[tuple[int, DetectionSamples]]:
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


def samples_folder(use: DetectorUse) -> Path:
    """Where samples are kept until their fit is stored."""
    *_, cache = use.folders()
    return cache / "samples" / use.identity


def _kept_files(
    use: DetectorUse, sampling: _Sampling, recipes: Sequence[SceneRecipe], seeds: Sequence[int]
) -> list[Path | None]:
    """The file that keeps the samples of each scene, by all that they depend on."""
    import onnxruntime

    config, folder = sampling.config, samples_folder(use)
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
    with contextlib.suppress(*UNREADABLE):
        return None if file is None else DetectionSamples(**read_arrays(file)[0])
    return None


def _keep_samples(samples: DetectionSamples, file: Path | None) -> None:
    if file is not None:
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            write_arrays(file, {}, **vars(samples))


def _about(seconds: float) -> str:
    if seconds < 90.0:
        return f"about {max(1, round(seconds / 10.0)) * 10} seconds"
    if seconds < 5400.0:
        return f"about {round(seconds / 60.0)} minutes"
    return f"about {seconds / 3600.0:.1f} hours"


def say_or_warn(text: str, hint: str, progress: Progress) -> None:
    """Say something, and where nothing is shown log it as a warning, with a hint."""
    if type(progress) is NullProgress:
        _logger.warning("%s; %s", text, hint)
    else:
        progress.say(text)


def network_scale_of(detector: ScalingDetector, camera: CameraModel) -> tuple[float, float]:
    return detector.network_scale(camera.height_px, camera.width_px)
