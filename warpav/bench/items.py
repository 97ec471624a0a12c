"""The three things that the benchmark measures: W1 silhouettes with gradients, W2 depth and objects, W3 colours."""

from __future__ import annotations

import re
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warpav.bench.workload import ROTATION_COUNT, WEIGHT_NAMES, Workload
from warpav.render.device_scene import FIRST_VEHICLE, DeviceScene
from warpav.render.renderer import Renderer
from warpav.rig.camera import CameraModel
from warpav_kernels import benchmark, linearise

# Samples of the key buffers and atlases that one chunk of cameras may have; more cameras are rendered in turn.
MAX_CHUNK_SAMPLES = 1 << 25
SCORED_CAMERAS = 4  # scored poses that are rendered together


@dataclass(frozen=True)
class Timing:
    """How long something took, and what it held.

    Attributes:
        times_ms: Wall time of every repeat, from a scene on the device to a result on the device.
        threads: Threads that worked on it.
        setup_ms: Packing, uploading, allocating and the first run, without compiling.
        compile_ms: Compiling or loading the kernels.
        peak_mib: Most memory so far: of the process on the CPU, of Warp's memory pool on a GPU; None: unknown.
    """

    times_ms: list[float]
    threads: int
    setup_ms: float
    compile_ms: float
    peak_mib: float | None

    @property
    def median_ms(self) -> float:
        """Median of the repeats."""
        return statistics.median(self.times_ms)


class Bench:
    """A workload on a device, ready to be measured."""

    def __init__(self, workload: Workload, scene: DeviceScene, *, device: str = "cpu") -> None:
        """Nothing is rendered yet.

        Args:
            workload: The workload.
            scene: What `pack_workload` made of it, on the device.
            device: Warp device.
        """
        self.workload = workload
        self.scene = scene
        self.device = wp.get_device(device)
        self._renderer: Renderer | None = None
        self._renderer_of: tuple[Any, ...] = ()
        self._images: Any = None  # of the last run: what a recorded run writes into must not be freed

    def time_silhouettes(self, supersampling: int, *, repeat: int) -> Timing:
        """Time W1: forward and backward for all cameras of the workload with white weights.

        Args:
            supersampling: Samples per pixel along each axis.
            repeat: Measured runs, after one that is not measured.
        """
        compile_ms = self._load_kernels()
        weight = wp.array(self.workload.weight["white"], dtype=float, device=self.device)
        passes: list[_SilhouettePass] = []

        def run() -> None:
            if len(chunks) == 1:  # everything stays on the device
                passes[:] = passes or [_SilhouettePass(self, self.workload.pose, chunks[0])]
                passes[0].run(self._render_with(chunks[0], supersampling), weight)
                return
            for chunk in chunks:
                each = _SilhouettePass(self, self.workload.pose[chunk], chunk)
                each.run(self._render_with(chunk, supersampling), weight)

        chunks = list(self._chunks(supersampling))
        return self._time(run, repeat, compile_ms, is_capturable=len(chunks) == 1)

    def score_silhouettes(self, supersampling: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Loss and gradient of W1 at every scored pose, each pose alone, for every weight.

        Args:
            supersampling: Samples per pixel along each axis.

        Returns:
            Gradient to x, z [per m] and yaw [per rad], float64 [pose, 3], and loss, float64 [pose], by weight.
        """
        pose, camera_count = self.workload.scored_pose, len(self.workload.pose)
        gradient = {name: np.zeros(pose.shape) for name in WEIGHT_NAMES}
        loss = {name: np.zeros(len(pose)) for name in WEIGHT_NAMES}
        weight = {n: wp.array(w, dtype=float, device=self.device) for n, w in self.workload.weight.items()}
        for first in range(0, len(pose), SCORED_CAMERAS):
            chosen = np.arange(first, min(first + SCORED_CAMERAS, len(pose)))
            camera = chosen % camera_count
            silhouettes = _SilhouettePass(self, pose[chosen], camera)
            for name in WEIGHT_NAMES:
                found = silhouettes.run(self._render_with(camera, supersampling), weight[name])
                loss[name][chosen] = found.numpy().reshape(-1, ROTATION_COUNT).sum(axis=1, dtype=np.float64)
                gradient[name][chosen] = silhouettes.gradient()
        return gradient, loss

    def time_depth_and_object(self, *, repeat: int) -> Timing:
        """Time W2: depth and object of the nearest surface at every pixel's centre, all views."""
        return self._time_images(lambda renderer: renderer.depth_and_object(self.scene), repeat)

    def time_rgb(self, *, repeat: int) -> Timing:
        """Time W3: colour of the nearest surface at every pixel's centre, all views."""
        return self._time_images(lambda renderer: renderer.rgb(self.scene), repeat)

    def depth_and_object(self) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """W2 in the workload's terms, some views at a time.

        Yields:
            First view; object, integers [view, row, column], -1: none; depth [m], float32, -1 where nothing is.
        """
        object_count = len(self.workload.triangle_count)
        integer = object_type(object_count)
        for first, renderer in self._rendered():
            depth, index = (array.numpy() for array in renderer.depth_and_object(self.scene))
            index = np.where(index >= FIRST_VEHICLE, index - FIRST_VEHICLE, -1).astype(integer)
            yield first, index, np.where(index >= 0, depth, np.float32(-1.0))

    def rgb(self) -> Iterator[tuple[int, np.ndarray]]:
        """W3, some views at a time.

        Yields:
            First view; colour 0..1, float32 [view, row, column, 3], 0 where nothing is.
        """
        for first, renderer in self._rendered():
            yield first, renderer.rgb(self.scene).numpy()

    def _rendered(self) -> Iterator[tuple[int, Renderer]]:
        for chunk in self._chunks(1):
            renderer = self._render_with(chunk, 1)
            views = _SilhouettePass(self, self.workload.pose[chunk], chunk).place()
            renderer.render(self.scene, *views)
            yield ROTATION_COUNT * int(chunk[0]), renderer

    def _time_images(self, resolve: Callable[[Renderer], Any], repeat: int) -> Timing:
        compile_ms = self._load_kernels()
        chunks = list(self._chunks(1))
        views = [_SilhouettePass(self, self.workload.pose[chunk], chunk).place() for chunk in chunks]

        def run() -> None:
            for chunk, placed in zip(chunks, views, strict=True):
                renderer = self._render_with(chunk, 1)
                renderer.render(self.scene, *placed)
                self._images = resolve(renderer)

        return self._time(run, repeat, compile_ms, is_capturable=len(chunks) == 1)

    def _chunks(self, supersampling: int) -> Iterator[np.ndarray]:
        """Cameras that are rendered together."""
        samples = ROTATION_COUNT * (self.workload.size_px * supersampling) ** 2
        count = max(1, MAX_CHUNK_SAMPLES // samples)
        for first in range(0, len(self.workload.pose), count):
            yield np.arange(first, min(first + count, len(self.workload.pose)))

    def _render_with(self, camera: np.ndarray, supersampling: int) -> Renderer:
        """A renderer for these cameras' views; the last one is kept, and its buffers, while the lenses are the same."""
        models = self.workload.models(camera.tolist())
        wanted = (supersampling, *models)
        if self._renderer is None or self._renderer_of != wanted:
            self._renderer = None  # its buffers go before new ones come
            self._renderer = Renderer(models, supersampling=supersampling, device=self.device.alias)
            self._renderer_of = wanted
        return self._renderer

    def _load_kernels(self) -> float:
        """Compile or load all kernels; returns the time that this took [ms]."""
        began = time.perf_counter()
        Renderer([CameraModel(8, 8)], device=self.device.alias)
        for module in (benchmark, linearise):
            wp.load_module(module, device=self.device)
        return 1000.0 * (time.perf_counter() - began)

    def _time(self, run: Callable[[], None], repeat: int, compile_ms: float, *, is_capturable: bool) -> Timing:
        began = time.perf_counter()
        run()
        again = run
        if self.device.is_cuda and is_capturable:
            with wp.ScopedCapture(device=self.device) as capture:
                run()
            assert capture.graph is not None
            again = partial(wp.capture_launch, capture.graph)
            again()
        wp.synchronize_device(self.device)
        setup_ms = 1000.0 * (time.perf_counter() - began)
        times_ms = []
        for _ in range(repeat):
            began = time.perf_counter()
            again()
            wp.synchronize_device(self.device)
            times_ms.append(1000.0 * (time.perf_counter() - began))
        threads = self._renderer.thread_count if self._renderer is not None and self.device.is_cpu else 1
        return Timing(times_ms, threads, setup_ms, compile_ms, self.peak_mib())

    def peak_mib(self) -> float | None:
        """Most memory so far [MiB]: of the process on the CPU, of Warp's memory pool on a GPU."""
        if self.device.is_cuda:
            return wp.get_mempool_used_mem_high(self.device) / 2**20
        return peak_process_mib()


class _SilhouettePass:
    """W1 for some cameras: what stays on the device between runs, and the way from poses to a gradient."""

    def __init__(self, bench: Bench, pose: np.ndarray, camera: np.ndarray) -> None:
        """Poses [camera, 3] of cameras with the heights of the workload's cameras ``camera``."""
        self._bench, self._device, workload = bench, bench.device, bench.workload
        self._pose = wp.array(pose.astype(np.float32), dtype=wp.vec3, device=self._device)
        self._pose.grad = self._gradient = wp.zeros_like(self._pose)
        self._height_m = wp.array(workload.height_m[camera].astype(np.float32), dtype=float, device=self._device)
        self._vehicle_weight = wp.array(workload.vehicle_weight.astype(np.float32), dtype=float, device=self._device)
        self._ones = wp.full(ROTATION_COUNT * len(pose), 1.0, dtype=float, device=self._device)

    def place(self) -> tuple[wp.array, wp.array]:
        """Centres and rotations of all views; recorded on the active tape."""
        view_count = len(self._ones)
        position_ego_m = wp.zeros(view_count, dtype=wp.vec3, device=self._device, requires_grad=True)
        camera_from_ego = wp.zeros(view_count, dtype=wp.mat33, device=self._device, requires_grad=True)
        wp.launch(
            benchmark.place_level_cameras_kernel,
            dim=(len(self._pose), ROTATION_COUNT),
            inputs=[self._pose, self._height_m],
            outputs=[position_ego_m, camera_from_ego],
            device=self._device,
        )
        return position_ego_m, camera_from_ego

    def run(self, renderer: Renderer, weight: wp.array) -> wp.array:
        """Loss of every view, float [view]; its gradient to the poses is left in `gradient`."""
        scene, is_visible = self._bench.scene, self._bench.workload.is_visible
        self._gradient.zero_()
        tape = wp.Tape()
        with tape:
            views = self.place()
        renderer.render(scene, *views, layers_only=not is_visible)
        measures = renderer.weighted_area(scene, weight, visible=is_visible)
        with tape:
            area = measures.on_tape(*views)
            loss = wp.zeros(len(self._ones), dtype=float, device=self._device, requires_grad=True)
            wp.launch(
                benchmark.sum_target_areas_kernel,
                dim=len(self._ones),
                inputs=[area, self._vehicle_weight],
                outputs=[loss],
                device=self._device,
            )
        tape.backward(grads={loss: self._ones})
        return loss

    def gradient(self) -> np.ndarray:
        """Gradient of the last run to x, z [per m] and yaw [per rad], float64 [camera, 3]."""
        return self._gradient.numpy().astype(np.float64)


def object_type(object_count: int) -> np.dtype:
    """The smallest signed integers that hold -1 and the number of every object."""
    return np.dtype(next(t for t in (np.int8, np.int16, np.int32) if object_count <= np.iinfo(t).max))


def peak_process_mib() -> float | None:
    """Most memory that this process has had resident [MiB]; None where the system does not tell."""
    status = Path("/proc/self/status")
    if status.is_file():  # what getrusage says there counts the process that started this one
        found = re.search(r"VmHWM:\s*(\d+) kB", status.read_text())
        if found:
            return int(found[1]) / 2**10
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)
