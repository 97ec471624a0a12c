"""The three things that the benchmark measures: W1 silhouettes with gradients, W2 depth and objects, W3 colours."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warpav.core.cores import peak_bytes
from warpav.experiments.bench._workload import ROTATION_COUNT, WEIGHT_NAMES, Truth, Workload, workload_objects
from warpav.raster.areas import Measures
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.chunks import MAX_CHUNK_VIEWS, chunk_view_count, record_graph, render_in_chunks
from warpav.raster.frame import Frame
from warpav.raster.renderer import Renderer
from warpav.raster.scene import Scene
from warpav.scene import triangle_caster
from warpav_kernels.placement import benchmark
from warpav_kernels.raster import linearise

_MAX_SILHOUETTE_SAMPLES = 1 << 26  # of the images of silhouettes that are measured together
_SCORED_AT_ONCE = 4  # poses


@dataclass(frozen=True)
class Timing:
    times_ms: list[float]
    threads: int
    setup_ms: float
    compile_ms: float
    peak_mib: float | None


class Bench:
    def __init__(self, workload: Workload, scene: Scene, *, device: str = "cpu") -> None:
        self.workload = workload
        self.scene = scene
        self.device = wp.get_device(device)

    def time_silhouettes(self, supersampling: int, *, repeat: int) -> Timing:
        """Time W1: forward and backward for all cameras of the workload with white weights."""
        compile_ms = self._load_kernels()
        began = time.perf_counter()
        workload = self.workload
        camera = np.arange(len(workload.pose))
        weight = wp.array(workload.weight["white"], dtype=float, device=self.device)
        at_once = min(self._cameras_at_once(supersampling), len(camera))
        silhouettes = _Silhouettes(self, at_once, supersampling)
        firsts = range(0, len(camera), at_once)
        silhouettes.put(workload.pose[:at_once], camera[:at_once])

        def run() -> None:
            for first in firsts:
                if len(firsts) > 1:
                    silhouettes.put(workload.pose[first : first + at_once], camera[first : first + at_once])
                silhouettes.run(weight)

        return self._time(run, repeat, silhouettes.renderer, began, compile_ms, is_capturable=len(firsts) == 1)

    def score_silhouettes(self, supersampling: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Gradient of W1 to x, z [per m] and yaw [per rad], float64 [pose, 3], and loss, by weight, pose by pose."""
        pose, camera_count = self.workload.scored_pose, len(self.workload.pose)
        gradient = {name: np.zeros(pose.shape) for name in WEIGHT_NAMES}
        loss = {name: np.zeros(len(pose)) for name in WEIGHT_NAMES}
        weight = {n: wp.array(w, dtype=float, device=self.device) for n, w in self.workload.weight.items()}
        at_once = min(self._cameras_at_once(supersampling), _SCORED_AT_ONCE)
        silhouettes = _Silhouettes(self, at_once, supersampling)
        for first in range(0, len(pose), at_once):
            chosen = np.arange(first, min(first + at_once, len(pose)))
            silhouettes.put(pose[chosen], chosen % camera_count)
            for name in WEIGHT_NAMES:
                loss[name][chosen], gradient[name][chosen] = silhouettes.run(weight[name]).on_host(len(chosen))
        return gradient, loss

    def time_depth_and_object(self, *, repeat: int) -> Timing:
        """Time W2: depth and object of the nearest surface at every pixel's centre, all views."""
        return self._time_images(lambda frame, into: frame.depths_and_ids(into=into), repeat)

    def time_rgb(self, *, repeat: int) -> Timing:
        """Time W3: colour of the nearest surface at every pixel's centre, all views."""
        return self._time_images(lambda frame, into: frame.colours(into=into), repeat)

    def depth_and_object(self) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """W2 some views at a time: the first view; objects [view, row, column], -1: none; depths [m], -1: nothing."""
        integer = object_type(len(self.workload.triangle_count))
        images = None
        for chunk, frame in self._rendered():
            count = chunk.stop - chunk.start
            images = frame.depths_and_ids(into=images)
            depth, index = (array.numpy()[:count] for array in images)
            index = workload_objects(index, self.workload.vehicle_count).astype(integer)
            yield chunk.start, index, np.where(index >= 0, depth, np.float32(-1.0))

    def rgb(self) -> Iterator[tuple[int, np.ndarray]]:
        """W3 some views at a time: the first view, and colours 0..1, float32 [view, row, column, 3], 0: nothing."""
        image = None
        for chunk, frame in self._rendered():
            image = frame.colours(into=image)
            yield chunk.start, image.numpy()[: chunk.stop - chunk.start].copy()

    def peak_mib(self) -> float | None:
        """Most memory so far [MiB]: of the process on the CPU, of Warp's memory pool on a GPU."""
        if self.device.is_cuda:
            return wp.get_mempool_used_mem_high(self.device) / 2**20
        peak = peak_bytes()
        return None if peak is None else peak / 2**20

    def _models(self) -> list[CameraModel]:
        return self.workload.models(range(len(self.workload.pose)))

    def _placed(self) -> tuple[wp.array, wp.array]:
        workload = self.workload
        pose = wp.array(workload.pose.astype(np.float32), dtype=wp.vec3, device=self.device)
        height_m = wp.array(workload.height_m.astype(np.float32), dtype=float, device=self.device)
        return _place_cameras(pose, height_m)

    def _rendered(self, renderer: Renderer | None = None) -> Iterator[tuple[slice, Frame]]:
        """All views at one sample per pixel, some at a time."""
        position_ego_m, camera_from_ego = (array.numpy() for array in self._placed())
        return render_in_chunks(
            self.scene, self._models(), position_ego_m, camera_from_ego, renderer=renderer, content=Content.IMAGES
        )

    def _time_images(self, resolve: Callable[[Frame, Any], object], repeat: int) -> Timing:
        compile_ms = self._load_kernels()
        began = time.perf_counter()
        models = self._models()
        at_once = min(chunk_view_count(models[0]), len(models))
        renderer = Renderer(models[:at_once], device=self.device.alias)
        views = self._placed()
        images: object = None  # one set, written over from chunk to chunk and run to run

        def run() -> None:
            nonlocal images
            if at_once == len(models):
                images = resolve(renderer.render(self.scene, *views, content=Content.IMAGES), images)
                return
            for _, frame in self._rendered(renderer):
                images = resolve(frame, images)

        return self._time(run, repeat, renderer, began, compile_ms, is_capturable=at_once == len(models))

    def _cameras_at_once(self, supersampling: int) -> int:
        """Cameras whose silhouettes are measured together; more are measured in turn."""
        if self.workload.is_visible:
            view_count = chunk_view_count(self._models()[0], supersampling=supersampling)
        else:  # no keys: the silhouettes alone, which fill a small part of the images
            samples = (self.workload.size_px * supersampling) ** 2
            view_count = min(MAX_CHUNK_VIEWS, _MAX_SILHOUETTE_SAMPLES // samples)
        return max(1, view_count // ROTATION_COUNT)

    def _load_kernels(self) -> float:
        """Compile or load all kernels; returns the time that this took [ms]."""
        began = time.perf_counter()
        Renderer([CameraModel(8, 8)], device=self.device.alias)
        for module in (benchmark, linearise):
            wp.load_module(module, device=self.device)
        return 1000.0 * (time.perf_counter() - began)

    def _time(
        self,
        run: Callable[[], None],
        repeat: int,
        renderer: Renderer,
        began: float,
        compile_ms: float,
        *,
        is_capturable: bool,
    ) -> Timing:
        """Run once, then ``repeat`` times with a clock; on a GPU as one recorded graph."""
        run()
        again = run
        if self.device.is_cuda and is_capturable:
            again = partial(wp.capture_launch, record_graph(run, self.device))
            again()
        wp.synchronize_device(self.device)
        setup_ms = 1000.0 * (time.perf_counter() - began)
        times_ms = []
        for _ in range(repeat):
            began = time.perf_counter()
            again()
            wp.synchronize_device(self.device)
            times_ms.append(1000.0 * (time.perf_counter() - began))
        return Timing(times_ms, renderer.thread_count, setup_ms, compile_ms, self.peak_mib())


class _Silhouettes:
    """W1 for a fixed number of cameras: what stays on the device from run to run, from poses to a gradient."""

    def __init__(self, bench: Bench, camera_count: int, supersampling: int) -> None:
        workload, device = bench.workload, bench.device
        self._workload, self._scene, self._device = workload, bench.scene, device
        self._camera_count = camera_count
        self.renderer = Renderer(workload.models([0] * camera_count), supersampling=supersampling, device=device.alias)
        self._pose = wp.zeros(camera_count, dtype=wp.vec3, device=device, requires_grad=True)
        self._gradient = wp.zeros(camera_count, dtype=wp.vec3, device=device)
        self._pose.grad = self._gradient
        self._height_m = wp.zeros(camera_count, dtype=float, device=device)
        self._measures: Measures | None = None
        self._vehicle_weight = wp.array(workload.vehicle_weight.astype(np.float32), dtype=float, device=device)
        self._ones = wp.full(ROTATION_COUNT * camera_count, 1.0, dtype=float, device=device)
        self._loss = wp.zeros(ROTATION_COUNT * camera_count, dtype=float, device=device, requires_grad=True)

    def put(self, pose: np.ndarray, camera: np.ndarray) -> None:
        """Set poses [camera, 3], and the rest of the workload's cameras; the last pose fills what is left."""
        chosen = np.minimum(np.arange(self._camera_count), len(pose) - 1)
        self._pose.assign(pose[chosen].astype(np.float32))
        self._height_m.assign(self._workload.height_m[camera[chosen]].astype(np.float32))
        self.renderer.set_lenses(self._workload.models(camera[chosen].tolist()))

    def run(self, weight: wp.array) -> _Silhouettes:
        """Loss and gradient for one weight image; `on_host` gets them."""
        self._gradient.zero_()
        tape = wp.Tape()
        with tape:
            views = _place_cameras(self._pose, self._height_m)
        frame = self.renderer.render(
            self._scene, *views, content=Content.ALL if self._workload.is_visible else Content.OBJECTS
        )
        self._measures = frame.weighted_area(weight, visible=self._workload.is_visible, into=self._measures)
        with tape:
            area = self._measures.on_tape(*views)
            wp.launch(
                benchmark.sum_target_areas_kernel,
                dim=len(self._loss),
                inputs=[area, self._vehicle_weight],
                outputs=[self._loss],
                device=self._device,
            )
        tape.backward(grads={self._loss: self._ones})
        return self

    def on_host(self, camera_count: int) -> tuple[np.ndarray, np.ndarray]:
        """Loss, float64 [camera], and gradient to x, z [per m] and yaw [per rad], float64 [camera, 3], of the first."""
        loss = self._loss.numpy().astype(np.float64).reshape(-1, ROTATION_COUNT).sum(axis=1)
        return loss[:camera_count], self._gradient.numpy()[:camera_count].astype(np.float64)


def _place_cameras(pose: wp.array, height_m: wp.array) -> tuple[wp.array, wp.array]:
    """Views of level cameras at x, z [m], yaw [rad] of the workload's world: centres and rotations, on the tape."""
    view_count, device = ROTATION_COUNT * len(pose), pose.device
    position_ego_m = wp.zeros(view_count, dtype=wp.vec3, device=device, requires_grad=True)
    camera_from_ego = wp.zeros(view_count, dtype=wp.mat33, device=device, requires_grad=True)
    wp.launch(
        benchmark.place_level_cameras_kernel,
        dim=(len(pose), ROTATION_COUNT),
        inputs=[pose, height_m],
        outputs=[position_ego_m, camera_from_ego],
        device=device,
    )
    return position_ego_m, camera_from_ego


def object_type(object_count: int) -> np.dtype:
    """The smallest signed integers that hold -1 and the number of every object."""
    return np.dtype(next(t for t in (np.int8, np.int16, np.int32) if object_count <= np.iinfo(t).max))


def time_embree(workload: Workload, *, repeat: int) -> dict[str, list[float]]:
    """Wall times of every repeat [ms], by item."""
    scene = triangle_caster(workload.vertex_m[workload.triangle])
    times_ms: dict[str, list[float]] = {"w2": [], "w3": []}
    for number in range(repeat + 1):
        cast_s = shade_s = 0.0
        for origin_m, direction in view_rays(workload):
            began = time.perf_counter()
            hit = scene.run(origin_m, direction, output=1)
            cast_s += time.perf_counter() - began
            began = time.perf_counter()
            _hit_rgb(workload, hit)
            shade_s += time.perf_counter() - began
        if number > 0:
            times_ms["w2"].append(1000.0 * cast_s)
            times_ms["w3"].append(1000.0 * (cast_s + shade_s))
    return times_ms


def embree_truth(workload: Workload) -> Truth:
    """Objects and depths of all views by embree, without gradients: for lenses that no truth file knows."""
    scene = triangle_caster(workload.vertex_m[workload.triangle])
    shape = (workload.size_px, workload.size_px)
    near_m = np.repeat(workload.near_m, ROTATION_COUNT)
    index, depth_m = [], []
    for view, (origin_m, direction) in enumerate(view_rays(workload)):
        hit = scene.run(origin_m, direction, output=1)
        is_hit = (hit["primID"] >= 0) & (direction != 0.0).any(axis=1)
        index.append(np.where(is_hit, workload.triangle_object[hit["primID"]], -1).reshape(shape))
        depth_m.append(np.where(is_hit, hit["tfar"] + near_m[view], -1.0).reshape(shape))
    views = np.arange(len(index))
    return Truth("embree", {}, {}, views, np.stack(index), np.stack(depth_m).astype(np.float32))


def view_rays(workload: Workload) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Rays of every view in turn, in the workload's world: origins on the near plane [m], and directions of depth 1.

    Both float32 [ray, 3], rows of the image one behind the other; directions of 0 where the lens sees nothing.
    """
    size = workload.size_px
    row, column = np.mgrid[0:size, 0:size] + 0.5
    models = workload.models(range(len(workload.pose)))
    for camera, (x_m, z_m, yaw_rad) in enumerate(workload.pose):
        ray = np.nan_to_num(models[ROTATION_COUNT * camera].rays(np.stack([column, row], axis=-1)).reshape(-1, 3))
        centre_m = np.array([x_m, workload.height_m[camera], z_m])
        for rotation in range(ROTATION_COUNT):
            angle_rad = yaw_rad + rotation * 0.5 * math.pi
            forward = np.array([math.sin(angle_rad), 0.0, math.cos(angle_rad)])
            left = np.array([math.cos(angle_rad), 0.0, -math.sin(angle_rad)])
            direction = ray @ np.stack([-left, [0.0, -1.0, 0.0], forward])
            origin_m = centre_m + workload.near_m[camera] * direction
            yield origin_m.astype(np.float32), direction.astype(np.float32)


def _hit_rgb(workload: Workload, hit: dict[str, np.ndarray]) -> np.ndarray:
    """Vertex colours interpolated at the hits of rays, float32 [ray, 3]; 0 where nothing is hit."""
    seen = np.flatnonzero(hit["primID"] >= 0)
    corner_rgb = workload.vertex_rgb[workload.triangle[hit["primID"][seen]]]
    u, v = hit["u"][seen, None], hit["v"][seen, None]
    rgb = np.zeros((len(hit["primID"]), 3), np.float32)
    rgb[seen] = (1.0 - u - v) * corner_rgb[:, 0] + u * corner_rgb[:, 1] + v * corner_rgb[:, 2]
    return rgb
