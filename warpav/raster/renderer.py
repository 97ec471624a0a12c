"""The renderer: owns the buffers of a set of views and the order of launches. It decides, then it measures."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import warp as wp

from warpav.raster.camera import CameraModel
from warpav.raster.device_scene import DeviceScene
from warpav.raster.lens import Lens
from warpav_kernels.raster import (
    extent,
    hide,
    image_flow,
    layers,
    lens,
    linearise,
    measure,
    outline,
    rasterise,
    shade,
    trace,
    view,
    window,
)

VISIBLE_AREA = int(measure.VISIBLE_AREA)
AMODAL_AREA = int(measure.AMODAL_AREA)
BOX_AREA = int(measure.BOX_AREA)
LEFT, RIGHT = int(measure.LEFT), int(measure.RIGHT)
TOP, BOTTOM = int(measure.TOP), int(measure.BOTTOM)
MEASURE_COUNT = int(measure.MEASURE_COUNT)
AREA_COUNT, EXTENT_COUNT = int(measure.AREA_COUNT), int(measure.EXTENT_COUNT)

LENS_KINDS = {
    Lens.PINHOLE: int(lens.PINHOLE),
    Lens.BROWN_CONRADY: int(lens.BROWN_CONRADY),
    Lens.FISHEYE: int(lens.FISHEYE),
    Lens.PANORAMA: int(lens.PANORAMA),
}

# How a launch is spread over threads: on the CPU it is one loop, where more threads would only cost.
CUDA_CLUSTER_LANES = 64  # share one cluster of triangles
CUDA_MEASURE_LANES = (16, 32)  # rows and columns of threads that share the samples of one object in one view
CUDA_SUM_LANES = 16  # of them are summed first
CUDA_ROW_LANES = 128  # share one row of an image
FLOW_LANES, CUDA_FLOW_LANES = (64, 1), (64, 32)  # rows and columns of threads that share the flow of one image
CUDA_STRIP_GROUPS, CUDA_STRIP_LANES = 8192, 32  # fill large triangles
CUDA_STRIPS = 1 << 18  # room in their queue

# Warp's arrays have strides of 32 bits, in bytes; see `_reserve_samples` and `rgb`.
MAX_ATLAS_SAMPLES = (2**31 - 1) // 8
WIDE_RAD = 50.0
"""Half the size of a window that holds all directions, whatever its softness."""

MAX_VIEW_SAMPLES = 2**27


def _lens_of(model: CameraModel) -> Any:  # noqa: ANN401 (a struct, which is no type to a checker)
    """The model's lens as the kernels take it."""
    result = lens.Lens()
    result.kind = LENS_KINDS[model.lens]
    result.limit, result.edge = model.shape.limit, model.shape.edge
    result.distortion = lens.vec8(*model.shape.coefficients)
    return result


def _sky_rgb(scene: DeviceScene) -> list[wp.vec3]:
    """Colours 0..1 of the horizon and the zenith."""
    return [wp.vec3(*(np.asarray(colour) / 255.0)) for colour in (scene.sky.horizon_rgb, scene.sky.zenith_rgb)]


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Content(Enum):
    """What a render holds."""

    ALL = "all"  # images, and every vehicle alone
    IMAGES = "images"  # depth, objects and colours only
    VEHICLES = "vehicles"  # every vehicle alone only: nothing is hidden, and there are no images


class Occlusion(Enum):
    """What hides a vehicle."""

    EXACT = "exact"  # whatever surface is nearest in the joint render
    PAIRWISE = "pairwise"  # the thesis: nearer vehicles by median depth, and the ego vehicle


@dataclass(frozen=True)
class Held:
    """What a render has left in the buffers of its renderer.

    Attributes:
        scene: The scene.
        content: What of it.
        rectangle: Samples of every layer, vec4i [view, layer].
        offset: Their places in the atlas, int32 [view, layer].
    """

    scene: DeviceScene
    content: Content
    rectangle: wp.array
    offset: wp.array


@dataclass(frozen=True)
class Measures:
    """Measures of every vehicle in every view and their Jacobians, on the device.

    The last axis is VISIBLE_AREA, AMODAL_AREA, BOX_AREA [px^2], LEFT, RIGHT, TOP, BOTTOM [px] for `Renderer.measure`;
    it has one element [px^2] for `Renderer.weighted_area`.

    Attributes:
        value: float [view, vehicle, measure].
        per_shift: Jacobian to the view's centre in ego axes [1/m], vec3 [view, vehicle, measure].
        per_spin: Jacobian to a small rotation about the camera's axes [1/rad], vec3 [view, vehicle, measure].
        per_zoom: Jacobian to the logarithm of the focal lengths, float [view, vehicle, measure].
        position_ego_m: Centres at which it was rendered, vec3 [view].
        camera_from_ego: Rotations at which it was rendered, mat33 [view].
        log_zoom: Logarithms of focal lengths over the lenses' at which it was rendered, float [view].
    """

    value: wp.array
    per_shift: wp.array
    per_spin: wp.array
    per_zoom: wp.array
    position_ego_m: wp.array
    camera_from_ego: wp.array
    log_zoom: wp.array

    def on_tape(
        self, position_ego_m: wp.array, camera_from_ego: wp.array, log_zoom: wp.array | None = None
    ) -> wp.array:
        """The measures as a function of the views, recorded on the active tape; float [view, vehicle, measure].

        The value is the rendered one, the gradient is the Jacobian (first order around what was rendered).

        Args:
            position_ego_m: Camera centres [m], vec3 [view].
            camera_from_ego: Rotations from ego to camera axes, mat33 [view].
            log_zoom: Logarithm of each view's focal length over its lens's, float [view]; None: as rendered.
        """
        device = self.value.device
        result = wp.empty_like(self.value, requires_grad=True)
        wp.launch(
            linearise.linearise_measures_kernel,
            dim=len(self.value),
            inputs=[
                position_ego_m,
                camera_from_ego,
                self.position_ego_m,
                self.camera_from_ego,
                self.log_zoom if log_zoom is None else log_zoom,
                self.log_zoom,
                self.value,
                self.per_shift,
                self.per_spin,
                self.per_zoom,
            ],
            outputs=[result],
            device=device,
        )
        return result


@dataclass(frozen=True)
class WindowMeasures(Measures):
    """Solid angle [sr] of every vehicle in every view inside the view's window, with Jacobians, on the device.

    As `Measures`, with one element on the last axis.

    Attributes:
        per_window: Jacobian to the window [sr/rad], vec4 [view, vehicle].
        window_rad: Windows with which it was measured, vec4 [view].
    """

    per_window: wp.array
    window_rad: wp.array

    def on_tape(
        self,
        position_ego_m: wp.array,
        camera_from_ego: wp.array,
        log_zoom: wp.array | None = None,
        window_rad: wp.array | None = None,
    ) -> wp.array:
        """The solid angles as a function of views and windows, recorded on the active tape; float [view, vehicle, 1].

        Args:
            position_ego_m: Camera centres [m], vec3 [view].
            camera_from_ego: Rotations from ego to camera axes, mat33 [view].
            log_zoom: Logarithm of each view's focal length over its lens's, float [view]; None: as rendered.
            window_rad: The windows, as in `Renderer.window_area`, vec4 [view]; None: those that were measured.
        """
        still = super().on_tape(position_ego_m, camera_from_ego, log_zoom)
        if window_rad is None:
            return still
        result = wp.empty_like(still, requires_grad=True)
        wp.launch(
            linearise.linearise_window_kernel,
            dim=len(still),
            inputs=[window_rad, self.window_rad, still, self.per_window],
            outputs=[result],
            device=still.device,
        )
        return result


class Renderer:
    """Renders a fixed number of views of equal size, one scene at a time, into buffers that it owns.

    Call `render`, then any of `measure`, `weighted_area`, `rgb`, `depth_and_object`, `visible_masks`; they describe the
    last render.
    """

    def __init__(
        self,
        models: Sequence[CameraModel],
        *,
        supersampling: int = 1,
        occlusion: Occlusion = Occlusion.EXACT,
        device: str = "cpu",
        thread_count: int | None = None,
        ego_blockage: bool = False,
    ) -> None:
        """Buffers for the given views.

        Args:
            models: Camera model of every view; all of one image size.
            supersampling: Samples per pixel along each axis, at least 1.
            occlusion: What hides a vehicle in `measure` and `visible_masks`.
            device: Warp device.
            thread_count: Threads over views on the CPU; None takes the number of cores, at most 8.
            ego_blockage: Whether `unblocked_area` will be asked for.

        Raises:
            ValueError: No views, views of different sizes, supersampling that is no whole number from 1 on, or views of
                more than `MAX_VIEW_SAMPLES` samples.
        """
        if not models or len({(model.width_px, model.height_px) for model in models}) != 1:
            raise ValueError("a renderer needs at least one view, and all views need the same size")
        if supersampling < 1 or supersampling != int(supersampling):
            raise ValueError(f"supersampling must be a whole number of at least 1, got {supersampling}")
        self.view_count = len(models)
        self.width_px, self.height_px = models[0].width_px, models[0].height_px
        self.supersampling = supersampling
        self.occlusion = occlusion
        self.ego_blockage = ego_blockage
        self.device = wp.get_device(device)
        guard = int(view.GUARD)
        self._width = self.width_px * supersampling + 2 * guard
        self._height = self.height_px * supersampling + 2 * guard
        if self._width * self._height > MAX_VIEW_SAMPLES:
            raise ValueError(
                f"{self.width_px} x {self.height_px} pixels with supersampling {supersampling} are more than "
                f"{MAX_VIEW_SAMPLES} samples; lower the size or the supersampling"
            )
        self._intrinsics_px = self._zeros(self.view_count, wp.vec4)
        self._near_m = self._zeros(self.view_count, float)
        self._lens = self._zeros(self.view_count, lens.Lens)
        self._models: list[CameraModel] = []
        self._traced: list[int] = []  # views whose lenses are no pinholes
        self.generation = 0  # of the buffers that grow; recordings of launches end with it
        self.set_lenses(models)
        self._view = self._zeros(self.view_count, view.View)
        self._position_ego_m = self._zeros(self.view_count, wp.vec3)
        self._camera_from_ego = self._zeros(self.view_count, wp.mat33)
        self._log_zoom = self._zeros(self.view_count, float)
        self._key = self._zeros((0, 0, 0), wp.int64)
        self._sample_count = self._zeros(1, wp.int64)
        self._needed_samples = self._zeros(1, wp.int64)
        self._strip = self._zeros(0 if self.device.is_cpu else CUDA_STRIPS, wp.vec4i)
        self._strip_count = self._zeros(1, wp.int32)
        if ego_blockage:
            self._ones = wp.full((1, self.height_px, self.width_px), 1.0, dtype=float, device=self.device)
        self._all_directions = wp.full(
            self.view_count, wp.vec4(0.0, 0.0, WIDE_RAD, WIDE_RAD), dtype=wp.vec4, device=self.device
        )
        self._held: Held | None = None
        self._has_key = False
        self._buffers: dict[tuple[str, tuple[int, ...]], wp.array] = {}
        self._shown: dict[tuple[int, ...], wp.array] = {}
        self._layers = layers.Layers()
        self._hiding = outline.Hiding()
        self._ego_hiding = outline.Hiding()  # what the ego vehicle's silhouette alone hides
        self._reserve_samples(0)
        self._lanes = (1, 1) if self.device.is_cpu else CUDA_MEASURE_LANES
        self._flow_lanes = FLOW_LANES if self.device.is_cpu else CUDA_FLOW_LANES
        self._threads = None
        if self.device.is_cpu:
            thread_count = thread_count or min(available_cores(), 8)
            if thread_count > 1 and self.view_count > 1:
                self._threads = ThreadPoolExecutor(thread_count)
        self.thread_count = thread_count or 1
        # load before threads launch, so that no two of them compile the same module
        for module in (view, layers, rasterise, hide, measure, extent, window, shade, image_flow):
            wp.load_module(module, device=self.device)

    def _zeros(self, shape: int | tuple[int, ...], dtype: object) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self.device)  # pyright: ignore[reportArgumentType, reportReturnType]

    def set_lenses(self, models: Sequence[CameraModel]) -> None:
        """Give every view another camera model of the same image size; the next `render` uses it.

        Raises:
            ValueError: Another number of models, or of another size.
        """
        size = (self.width_px, self.height_px)
        if len(models) != self.view_count or any((model.width_px, model.height_px) != size for model in models):
            raise ValueError(f"expected {self.view_count} camera models of {size[0]} x {size[1]} pixels")
        if list(models) == self._models:
            return
        self._models = list(models)
        intrinsics_px = [model.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]] for model in models]
        self._intrinsics_px.assign(np.array(intrinsics_px, np.float32))
        self._near_m.assign(np.array([model.near_m for model in models], np.float32))
        wp.copy(self._lens, wp.array([_lens_of(model) for model in models], dtype=lens.Lens, device=self.device))
        traced = [i for i, model in enumerate(models) if model.lens is not Lens.PINHOLE]
        if traced != self._traced:
            wp.load_module(trace, device=self.device)  # takes seconds to compile, so only where it is needed
            self._traced = traced
            self._traced_view = wp.array(traced, dtype=wp.int32, device=self.device)
            self.generation += 1

    def _kept(self, name: str, shape: tuple[int, ...], dtype: object) -> wp.array:
        """A buffer for one purpose and shape, the same from call to call; its contents are old."""
        key = (name, shape)
        if key not in self._buffers:
            self._buffers[key] = self._zeros(shape, dtype)
        return self._buffers[key]

    def _reserve_samples(self, sample_count: int) -> None:
        """Atlas with room for a number of samples, and a quarter more."""
        room = sample_count + sample_count // 4
        self._layers.inverse_depth_bits = self._zeros(room, wp.int32)
        self._layers.reach_key = self._zeros((4, room), wp.int64)
        for hiding, size in ((self._hiding, room), (self._ego_hiding, room if self.ego_blockage else 0)):
            hiding.bits = self._zeros(size, wp.int32)
            hiding.source = self._zeros(size, wp.int32)
        self._capacity = room
        self.generation += 1

    def _over_views(self, count: int, launch: Callable[[int, int], object]) -> None:
        """Call ``launch(first, count)`` for chunks of views: all at once on a GPU, spread over threads on the CPU.

        Every view's outputs are its own, so threads never write the same element (CPU atomics are not atomic).
        """
        if self._threads is None:
            launch(0, count)
            return
        chunk = -(-count // (2 * self.thread_count))
        firsts = range(0, count, chunk)
        for _ in self._threads.map(lambda first: launch(first, min(chunk, count - first)), firsts):
            pass

    def _launch(self, kernel: Callable, dim: int | tuple[int, ...], *, inputs: list, outputs: list) -> None:
        """Launch a kernel that is never taped."""
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device, record_tape=False)

    def render(
        self,
        scene: DeviceScene,
        position_ego_m: wp.array,
        camera_from_ego: wp.array,
        *,
        log_zoom: wp.array | None = None,
        content: Content = Content.ALL,
    ) -> None:
        """Decide which surface every sample sees, and what every vehicle covers alone. Nothing is taped.

        Args:
            scene: The scene, on this renderer's device.
            position_ego_m: Camera centres [m], vec3 [view].
            camera_from_ego: Rotations from ego to camera axes, mat33 [view].
            log_zoom: Logarithm of each view's focal length over its lens's, float [view]; None: 0.
            content: What is wanted of the render.

        Raises:
            ValueError: Not one pose for every view, or the silhouettes together do not fit into one buffer.
        """
        given = {"position_ego_m": position_ego_m, "camera_from_ego": camera_from_ego, "log_zoom": log_zoom}
        for name, array in given.items():
            if array is not None and array.shape != (self.view_count,):
                raise ValueError(f"{name} must be one for each of {self.view_count} views, got {array.shape}")
        wp.copy(self._position_ego_m, position_ego_m)
        wp.copy(self._camera_from_ego, camera_from_ego)
        if log_zoom is None:
            self._log_zoom.zero_()
        else:
            wp.copy(self._log_zoom, log_zoom)
        self._launch(
            view.place_views_kernel,
            self.view_count,
            inputs=[
                self._position_ego_m, self._camera_from_ego, self._intrinsics_px, self._near_m, self._lens,
                self._log_zoom, self.supersampling,
            ],
            outputs=[self._view],
        )  # fmt: skip
        # the ego vehicle is the last layer; exact occlusion does not need its silhouette
        layer_count = scene.vehicle_count
        if content is Content.IMAGES:
            layer_count = 0
        elif content is Content.ALL and (self.occlusion is Occlusion.PAIRWISE or self.ego_blockage):
            layer_count = scene.layer_count
        self._place_layers(scene, layer_count)
        self._held = Held(scene, content, self._layers.rectangle, self._layers.offset)
        self._has_key = content is not Content.VEHICLES
        if self._has_key:
            if self._key.size == 0:
                self._key = self._zeros((self.view_count, self._height, self._width), wp.int64)
            self._key.zero_()
        self._layers.inverse_depth_bits.zero_()
        self._layers.reach_key.zero_()
        self._hiding.bits.zero_()
        self._strip_count.zero_()
        sizes = [layer_count, self._width, self._height]
        lanes = 1 if self.device.is_cpu else CUDA_CLUSTER_LANES
        self._over_views(
            self.view_count,
            lambda first, count: self._launch(
                rasterise.scatter_triangles_kernel,
                (count, scene.cluster_count, lanes),
                inputs=[self._view, scene.triangles, *sizes, first, int(self._has_key), lanes],
                outputs=[self._key, self._layers, self._strip, self._strip_count],
            ),
        )
        if self._strip.size:
            self._launch(
                rasterise.fill_strips_kernel,
                (CUDA_STRIP_GROUPS, CUDA_STRIP_LANES),
                inputs=[
                    self._view, scene.triangles, *sizes, int(self._has_key), self._strip, self._strip_count,
                    CUDA_STRIP_GROUPS, CUDA_STRIP_LANES,
                ],
                outputs=[self._key, self._layers],
            )  # fmt: skip
        if self._traced:
            self._trace(scene, layer_count)
        if scene.vehicle_count and content is Content.ALL:
            self._hide(scene)

    def _trace(self, scene: DeviceScene, layer_count: int) -> None:
        """Fill the buffers of the views whose lenses are no pinholes, by ray queries."""
        mesh, traced, count = scene.mesh.id, self._traced_view, len(self._traced)
        if self._has_key:
            self._over_views(
                count,
                lambda first, count: self._launch(
                    trace.trace_keys_kernel,
                    (count, self._height, self._width),
                    inputs=[self._view, mesh, traced, first],
                    outputs=[self._key],
                ),
            )
        if layer_count == 0:
            return
        rows, columns = self._lanes

        def launch(first: int, count: int) -> None:
            dim = (count, layer_count, rows * columns)
            self._launch(
                trace.trace_layers_kernel,
                dim,
                inputs=[
                    self._view, scene.triangles, mesh, scene.layer_object, traced, self._key, int(self._has_key),
                    first, rows, columns,
                ],
                outputs=[self._layers],
            )  # fmt: skip
            self._launch(
                trace.trace_reaches_kernel,
                dim,
                inputs=[self._view, mesh, scene.layer_object, traced, first, rows, columns],
                outputs=[self._layers],
            )

        self._over_views(count, launch)

    def _place_layers(self, scene: DeviceScene, layer_count: int) -> None:
        """Rectangles and places of the first layers; the atlas grows where it is too small."""
        shape = (self.view_count, layer_count)
        self._layers.rectangle = self._kept("rectangle", shape, wp.vec4i)
        self._layers.offset = self._kept("offset", shape, wp.int32)
        for _ in range(2):
            self._sample_count.zero_()
            self._launch(
                layers.place_layers_kernel,
                shape,
                inputs=[self._view, scene.layer_bounds_ego_m, self._width, self._height, self._capacity],
                outputs=[self._layers.rectangle, self._layers.offset, self._sample_count, self._needed_samples],
            )
            # a recording cannot be asked; see `grew`
            if self.device.is_capturing or not self.grew():
                return

    def grew(self) -> bool:
        """Whether a render since the last call needed more samples than there was room for, and had to leave some out.

        If so, there is room now, and the render has to be done again. Only recorded launches need this question; it
        waits for the device.

        Raises:
            ValueError: The silhouettes together do not fit into one buffer.
        """
        needed = int(self._needed_samples.numpy()[0])
        if needed <= self._capacity:
            return False
        limit = MAX_ATLAS_SAMPLES // 5 * 4  # there is room for a quarter more
        if needed > limit:
            raise ValueError(
                f"the silhouettes in {self.view_count} views of {self._width} x {self._height} samples need {needed} "
                f"samples, more than {limit}; render fewer views"
            )
        self._reserve_samples(needed)
        return True

    def _hide(self, scene: DeviceScene) -> None:
        hiding = [self._hiding.bits, self._hiding.source]
        if self.occlusion is Occlusion.EXACT:
            rows, columns = self._lanes
            self._over_views(
                self.view_count,
                lambda first, count: self._launch(
                    hide.hide_by_nearest_surface_kernel,
                    (count, scene.vehicle_count, rows * columns),
                    inputs=[self._key, scene.triangles, scene.layer_object, self._layers, first, rows, columns],
                    outputs=hiding,
                ),
            )
            return
        is_hidden_by = self._kept("order", (self.view_count, scene.vehicle_count, scene.vehicle_count), wp.int32)
        is_hidden_by.zero_()
        self._over_views(
            self.view_count,
            lambda first, count: self._launch(
                hide.order_overlapping_layers_kernel,
                (count, scene.vehicle_count, scene.vehicle_count),
                inputs=[self._layers, scene.vehicle_count, first],
                outputs=[is_hidden_by],
            ),
        )
        self._hide_by_layers(scene, is_hidden_by, self._hiding)

    def _hide_by_layers(self, scene: DeviceScene, is_hidden_by: wp.array, hiding: Any) -> None:  # noqa: ANN401 (a struct)
        """Hide vehicles by the silhouettes of the vehicles that ``is_hidden_by`` names, and of the ego vehicle."""
        self._over_views(
            self.view_count,
            lambda first, count: self._launch(
                hide.hide_by_ordered_layers_kernel,
                (count, scene.vehicle_count),
                inputs=[self._layers, is_hidden_by, scene.ego_layer, first],
                outputs=[hiding.bits, hiding.source],
            ),
        )

    def measure(self, scene: DeviceScene, box_px: wp.array | None = None, *, into: Measures | None = None) -> Measures:
        """Areas and extents of every vehicle in every view, with Jacobians to the views' poses and focal lengths.

        Args:
            scene: The scene of the last `render`.
            box_px: Box per view and vehicle (left, top, right, bottom [px]) for BOX_AREA, vec4 [view, vehicle]; None:
                no box.
            into: An earlier result to write over; None: fresh arrays, so several scenes can stay on one tape.

        Raises:
            ValueError: Another scene, or without its vehicles, or an array of another shape.
        """
        self._require(scene, Content.VEHICLES)
        if box_px is None:
            box_px = self._kept("no box", (self.view_count, scene.vehicle_count), wp.vec4)
        if box_px.shape != (self.view_count, scene.vehicle_count):
            raise ValueError(f"box_px must be {(self.view_count, scene.vehicle_count)}, got {box_px.shape}")
        result = self._measures(scene, MEASURE_COUNT, into)
        pairs = (self.view_count, scene.vehicle_count)
        farthest = self._kept("farthest", (*pairs, EXTENT_COUNT), wp.int32)
        farthest.zero_()
        rows, columns = self._lanes
        flow = self._kept("flow", (*pairs, AREA_COUNT, rows * columns), measure.Flow)
        self._over_views(
            self.view_count,
            lambda first, count: self._launch(
                measure.measure_areas_kernel,
                (count, scene.vehicle_count, rows * columns),
                inputs=[
                    self._view, scene.triangles, self._layers, self._hiding, box_px, self._width, self._height,
                    self.supersampling, first, rows, columns,
                ],
                outputs=[flow, farthest],
            ),
        )  # fmt: skip
        self._sum_flow(scene, flow, result)
        self._launch(
            extent.measure_extents_kernel,
            (*pairs, EXTENT_COUNT),
            inputs=[self._view, self._layers, farthest, self._width, self._height, self.supersampling],
            outputs=[result.value, result.per_shift, result.per_spin, result.per_zoom],
        )
        return result

    def weighted_area(
        self, scene: DeviceScene, weight_image: wp.array, *, visible: bool, into: Measures | None = None
    ) -> Measures:
        """Area of every vehicle in every view, each pixel weighted, with Jacobians.

        Args:
            scene: The scene of the last `render`.
            weight_image: Weight of every pixel, float [row, column] for all views or [view, row, column]; no gradient
                flows to it.
            visible: Whether to leave out what other surfaces hide; else each vehicle counts as if it stood alone.
            into: An earlier result to write over; None: fresh arrays.

        Returns:
            Measures with one element on the last axis, in weight x px^2.

        Raises:
            ValueError: Another scene, or without what is asked for, or an array of another shape.
        """
        self._require(scene, Content.ALL if visible else Content.VEHICLES)
        size = (self.height_px, self.width_px)
        if weight_image.shape not in (size, (self.view_count, *size)):
            raise ValueError(f"weight_image must be {size} or {(self.view_count, *size)}, got {weight_image.shape}")
        if weight_image.dtype is not wp.float32:
            raise ValueError(f"weight_image must hold float32, got {weight_image.dtype.__name__}")
        if weight_image.ndim == 2:
            weight_image = weight_image.reshape((1, *size))
        kind = int(outline.VISIBLE if visible else outline.ALONE)
        return self._weighted_area(scene, weight_image, kind, self._hiding, into)

    def unblocked_area(self, scene: DeviceScene, *, into: Measures | None = None) -> Measures:
        """Area of every vehicle alone outside the ego vehicle's silhouette, in every view, with Jacobians.

        The ego vehicle counts as nearest everywhere, and nothing else hides, whatever hides vehicles in `measure`.

        Args:
            scene: The scene of the last `render`.
            into: An earlier result to write over; None: fresh arrays.

        Returns:
            Measures with one element on the last axis [px^2].

        Raises:
            ValueError: Another scene, a render without vehicles and images, or a renderer without ``ego_blockage``.
        """
        self._require(scene, Content.ALL)
        if not self.ego_blockage:
            raise ValueError("unblocked_area needs a renderer that was made with ego_blockage=True")
        self._ego_hiding.bits.zero_()
        nobody = self._kept("no order", (self.view_count, scene.vehicle_count, scene.vehicle_count), wp.int32)
        self._hide_by_layers(scene, nobody, self._ego_hiding)
        return self._weighted_area(scene, self._ones, int(outline.VISIBLE), self._ego_hiding, into)

    def _weighted_area(
        self,
        scene: DeviceScene,
        weight_image: wp.array,
        kind: int,
        hiding: Any,  # noqa: ANN401 (a struct)
        into: Measures | None,
    ) -> Measures:
        result = self._measures(scene, 1, into)
        rows, columns = self._lanes
        flow = self._kept("weighted flow", (self.view_count, scene.vehicle_count, 1, rows * columns), measure.Flow)
        self._over_views(
            self.view_count,
            lambda first, count: self._launch(
                measure.measure_weighted_area_kernel,
                (count, scene.vehicle_count, rows * columns),
                inputs=[
                    self._view, scene.triangles, self._layers, hiding, weight_image, kind, self._width,
                    self._height, self.supersampling, first, rows, columns,
                ],
                outputs=[flow],
            ),
        )  # fmt: skip
        self._sum_flow(scene, flow, result)
        return result

    def window_area(
        self,
        scene: DeviceScene,
        window_rad: wp.array | None = None,
        *,
        softness_rad: float = 1.0,
        visible: bool,
        into: WindowMeasures | None = None,
    ) -> WindowMeasures:
        """Solid angle of every vehicle in every view inside a soft window of directions, with Jacobians.

        The window is the field of view of a camera that looks elsewhere from the same place, with logistic edges; e.g.
        four views to the ahead, left, rear and right, summed, are a panorama over which a camera's yaw, pitch and field
        of view move, and what is outside still pulls. With azimuth a and elevation e of a direction from the window's
        centre, half width w, half height h, softness t, and s the logistic function, a direction counts

            s((w + a) / t) s((w - a) / t) s((h + e) / t) s((h - e) / t).

        Args:
            scene: The scene of the last `render`.
            window_rad: Per view in its own axes: azimuth of the window's centre, counted like yaw from the optical axis
                to the left; its elevation, upwards; half width; half height [rad], vec4 [view]. None: all directions,
                so that everything in the image counts.
            softness_rad: t, positive.
            visible: Whether to leave out what other surfaces hide; else each vehicle counts as if it stood alone.
            into: An earlier result to write over; None: fresh arrays.

        Raises:
            ValueError: There is not one window per view, or ``softness_rad`` is not positive.
        """
        self._require(scene, Content.ALL if visible else Content.VEHICLES)
        if window_rad is None:
            window_rad = self._all_directions
        if window_rad.shape != (self.view_count,):
            raise ValueError(
                f"window_rad must have one window for each of {self.view_count} views, got {window_rad.shape}"
            )
        if not softness_rad > 0.0:
            raise ValueError(f"softness_rad must be positive, got {softness_rad}")
        pairs = (self.view_count, scene.vehicle_count)
        if into is None:
            into = WindowMeasures(
                **vars(self._measures(scene, 1, None)),
                per_window=self._zeros(pairs, wp.vec4),
                window_rad=wp.clone(window_rad, requires_grad=False),
            )
        else:
            self._measures(scene, 1, into)
            wp.copy(into.window_rad, window_rad)
        kind = int(outline.VISIBLE if visible else outline.ALONE)
        rows, columns = self._lanes
        flow = self._kept("weighted flow", (*pairs, 1, rows * columns), measure.Flow)
        window_flow = self._kept("window flow", (*pairs, rows * columns), wp.vec4)
        self._over_views(
            self.view_count,
            lambda first, count: self._launch(
                window.measure_window_kernel,
                (count, scene.vehicle_count, rows * columns),
                inputs=[
                    self._view, scene.triangles, self._layers, self._hiding, into.window_rad, softness_rad, kind,
                    self._width, self._height, first, rows, columns,
                ],
                outputs=[flow, window_flow],
            ),
        )  # fmt: skip
        self._sum_flow(scene, flow, into, is_in_px=False)
        self._launch(window.sum_window_flow_kernel, pairs, inputs=[window_flow], outputs=[into.per_window])
        return into

    def _measures(self, scene: DeviceScene, count: int, into: Measures | None) -> Measures:
        shape = (self.view_count, scene.vehicle_count, count)
        if into is not None:
            if into.value.shape != shape:
                raise ValueError(f"the measures to write over must be {shape}, got {into.value.shape}")
            wp.copy(into.position_ego_m, self._position_ego_m)
            wp.copy(into.camera_from_ego, self._camera_from_ego)
            wp.copy(into.log_zoom, self._log_zoom)
            return into
        return Measures(
            value=self._zeros(shape, float),
            per_shift=self._zeros(shape, wp.vec3),
            per_spin=self._zeros(shape, wp.vec3),
            per_zoom=self._zeros(shape, float),
            position_ego_m=wp.clone(self._position_ego_m, requires_grad=False),
            camera_from_ego=wp.clone(self._camera_from_ego, requires_grad=False),
            log_zoom=wp.clone(self._log_zoom, requires_grad=False),
        )

    def _sum_flow(self, scene: DeviceScene, flow: wp.array, result: Measures, *, is_in_px: bool = True) -> None:
        """Sum what the lanes have measured into the first measures of ``result``; ``is_in_px``: from samples."""
        flow = self._grouped(flow)
        self._launch(
            measure.sum_flow_kernel,
            (self.view_count, scene.vehicle_count, flow.shape[2]),
            inputs=[self._view, flow, self.supersampling if is_in_px else 1],
            outputs=[result.value, result.per_shift, result.per_spin, result.per_zoom],
        )

    def _grouped(self, flow: wp.array) -> wp.array:
        """Sums over groups of neighbouring lanes; the same flow where there are few."""
        *sums, lanes = flow.shape
        if lanes <= CUDA_SUM_LANES:
            return flow
        group_flow = self._kept("group flow", (*sums, lanes // CUDA_SUM_LANES), measure.Flow)
        self._launch(measure.sum_lanes_kernel, group_flow.shape, inputs=[flow, CUDA_SUM_LANES], outputs=[group_flow])
        return group_flow

    @property
    def held(self) -> Held | None:
        """What the last render has left in the buffers; None before the first.

        A replay of recorded launches sets again what was held when they were recorded.
        """
        return self._held

    @held.setter
    def held(self, held: Held | None) -> None:
        self._held = held
        if held is not None:
            self._layers.rectangle, self._layers.offset = held.rectangle, held.offset

    def _require(self, scene: DeviceScene, content: Content) -> None:
        """Check that the last render holds what is asked for."""
        if self._held is None or self._held.content not in (content, Content.ALL):
            held = "nothing" if self._held is None else self._held.content.value
            raise ValueError(f"the last render holds {held} only; render with content {content.value} first")
        if self._held.scene is not scene:
            raise ValueError(f"the last render shows another scene, {self._held.scene.name}; render {scene.name} first")

    def rgb(
        self, scene: DeviceScene, shown_view: Sequence[int] | None = None, *, into: wp.array | None = None
    ) -> wp.array:
        """Colour images 0..1 of the chosen views (None: all), vec3 [image, row, column]; no gradient.

        ``into`` is an earlier result to write over; None: a fresh array.

        Raises:
            ValueError: ``into`` has another shape.
        """
        self._require(scene, Content.IMAGES)
        shown = self._shown_views(shown_view)
        lanes = 1 if self.device.is_cpu else CUDA_ROW_LANES
        image = self._image(len(shown), wp.vec3, into)
        self._over_views(
            len(shown),
            lambda first, count: self._launch(
                shade.resolve_rgb_kernel,
                (count, self.height_px, lanes),
                inputs=[
                    self._view, scene.triangles, scene.vertex_rgb, *_sky_rgb(scene), self._key, shown,
                    self.supersampling, first, lanes,
                ],
                outputs=[image],
            ),
        )  # fmt: skip
        return image

    def kept_image(self, count: int) -> wp.array:
        """An array for ``into`` of `rgb`, the same one whenever it is asked for, vec3 [image, row, column]."""
        return self._kept("image", (count, self.height_px, self.width_px), wp.vec3)

    def rgb_on_tape(
        self,
        tape: wp.Tape,
        scene: DeviceScene,
        position_ego_m: wp.array,
        camera_from_ego: wp.array,
        *,
        log_zoom: wp.array | None = None,
        shown_view: Sequence[int] | None = None,
    ) -> wp.array:
        """The images of `rgb` as a function of the views, recorded on a tape; vec3 [image, row, column].

        The backward pass adds to the gradients of the three arguments what the static scene's flow through the images
        makes of the images' gradient: with colours I, gradient A and neighbouring samples p and q,
        ``dL = sum of (I_p - I_q) . (A_p + A_q) / 2 x flow from p to q of the nearer surface`` (see `image_flow`). It
        reads this render's buffers, so it has to run before the next `render`.

        Args:
            tape: The tape; it need not be active.
            scene: The scene of the last `render`.
            position_ego_m: Camera centres of the last `render` [m], vec3 [view]; no gradient unless it requires one.
            camera_from_ego: Rotations of the last `render`, mat33 [view]; the same.
            log_zoom: Logarithms of focal lengths of the last `render` over the lenses', float [view]; the same.
            shown_view: The views to show; None: all.

        Raises:
            ValueError: The render holds no images; in the backward pass: there has been another one since.
        """
        image = self.rgb(scene, shown_view)
        image.requires_grad = True
        shown = self._shown_views(shown_view)
        lanes = self._flow_lanes

        def launch(first: int, count: int, flow: wp.array) -> None:
            self._launch(
                image_flow.flow_colours_kernel,
                (count, math.prod(lanes)),
                inputs=[
                    self._view, scene.triangles, scene.vertex_rgb, *_sky_rgb(scene), self._key, shown, image.grad,
                    self.supersampling, first, *lanes,
                ],
                outputs=[flow],
            )  # fmt: skip

        self._record_flow(tape, image, shown, (position_ego_m, camera_from_ego, log_zoom), launch)
        return image

    def depth_and_object(
        self, scene: DeviceScene, *, into: tuple[wp.array, wp.array] | None = None
    ) -> tuple[wp.array, wp.array]:
        """Depth [m] (+inf: nothing) and object index (-1: nothing), each [view, row, column].

        Depth lies along the optical axis; of a fisheye or a panorama it is distance. ``into`` is an earlier result to
        write over; None: fresh arrays.

        Raises:
            ValueError: ``into`` has another shape.
        """
        return self._depth_and_object(scene, float("inf"), into)

    def _image(self, count: int, dtype: object, into: wp.array | None) -> wp.array:
        shape = (count, self.height_px, self.width_px)
        if into is not None and into.shape != shape:
            raise ValueError(f"the images to write over must be {shape}, got {into.shape}")
        return self._zeros(shape, dtype) if into is None else into

    def _depth_and_object(
        self, scene: DeviceScene, sky_depth_m: float, into: tuple[wp.array, wp.array] | None = None
    ) -> tuple[wp.array, wp.array]:
        self._require(scene, Content.IMAGES)
        lanes = 1 if self.device.is_cpu else CUDA_ROW_LANES
        depth_m = self._image(self.view_count, float, into[0] if into else None)
        object_index = self._image(self.view_count, wp.int32, into[1] if into else None)
        self._over_views(
            self.view_count,
            lambda first, count: self._launch(
                shade.resolve_depth_kernel,
                (count, self.height_px, lanes),
                inputs=[self._key, scene.triangles, sky_depth_m, self.supersampling, first, lanes],
                outputs=[depth_m, object_index],
            ),
        )
        return depth_m, object_index

    def depth_on_tape(
        self,
        tape: wp.Tape,
        scene: DeviceScene,
        position_ego_m: wp.array,
        camera_from_ego: wp.array,
        *,
        sky_depth_m: float,
        log_zoom: wp.array | None = None,
    ) -> wp.array:
        """The depths of `depth_and_object` as a function of the views, recorded on a tape [m], [view, row, column].

        As `rgb_on_tape`; besides, the depths themselves change as the views move: every sample adds its gradient times
        the change of the depth of the point that it sees. The value is the depth at the sample nearest to a pixel's
        centre; the gradient is that of the mean over the pixel, whose expectation is the same and which is smoother.

        Args:
            tape: The tape; it need not be active.
            scene: The scene of the last `render`.
            position_ego_m: Camera centres of the last `render` [m], vec3 [view]; no gradient unless it requires one.
            camera_from_ego: Rotations of the last `render`, mat33 [view]; the same.
            sky_depth_m: Depth that counts where nothing is hit [m]; finite, since outlines move against it.
            log_zoom: Logarithms of focal lengths of the last `render` over the lenses', float [view]; the same.

        Raises:
            ValueError: The render holds no images, or ``sky_depth_m`` is not finite; in the backward pass: there has
                been another render since.
        """
        if not math.isfinite(sky_depth_m):
            raise ValueError(f"sky_depth_m must be finite, got {sky_depth_m}")
        depth_m, _ = self._depth_and_object(scene, sky_depth_m)
        depth_m.requires_grad = True
        lanes = self._flow_lanes

        def launch(first: int, count: int, flow: wp.array) -> None:
            self._launch(
                image_flow.flow_depths_kernel,
                (count, math.prod(lanes)),
                inputs=[self._view, self._key, depth_m.grad, sky_depth_m, self.supersampling, first, *lanes],
                outputs=[flow],
            )

        self._record_flow(tape, depth_m, self._shown_views(None), (position_ego_m, camera_from_ego, log_zoom), launch)
        return depth_m

    def _record_flow(
        self,
        tape: wp.Tape,
        image: wp.array,
        shown: wp.array,
        moved: tuple[wp.array, wp.array, wp.array | None],
        launch: Callable[[int, int, wp.array], None],
    ) -> None:
        """Record that ``launch(first, count, flow)`` turns the gradient to some images into that to their views."""
        held = self._held
        wanted = [array for array in moved if array is not None and array.requires_grad]
        gradients = [
            array.grad
            if array is not None and array.requires_grad
            else self._kept(f"unwanted {dtype.__name__}", (self.view_count,), dtype)
            for array, dtype in zip(moved, (wp.vec3, wp.mat33, float), strict=True)
        ]

        def backward() -> None:
            if self._held is not held:
                raise ValueError("the renderer has rendered again; run the backward pass of its images before that")
            flow = self._kept("image flow", (len(image), 1, 1, math.prod(self._flow_lanes)), measure.Flow)
            self._over_views(len(image), lambda first, count: launch(first, count, flow))
            self._launch(
                image_flow.add_view_gradient_kernel,
                self.view_count,
                inputs=[self._view, shown, self._grouped(flow), self.supersampling],
                outputs=gradients,
            )

        if wanted:
            tape.record_func(backward, [image, *wanted])

    def _shown_views(self, shown_view: Sequence[int] | None) -> wp.array:
        """Views by number (None: all) on the device, the same array from call to call."""
        shown = tuple(range(self.view_count)) if shown_view is None else tuple(shown_view)
        if any(not 0 <= v < self.view_count for v in shown):
            raise ValueError(f"views must be 0..{self.view_count - 1}, got {list(shown)}")
        if shown not in self._shown:
            self._shown[shown] = wp.array(shown, dtype=wp.int32, device=self.device)
        return self._shown[shown]

    def visible_masks(self, scene: DeviceScene, shown_view: Sequence[int]) -> list[list[tuple[int, int, np.ndarray]]]:
        """Non-occluded silhouettes on the host, cropped: for each view and vehicle (left, top, mask), in samples.

        ``left`` and ``top`` are the crop's first column and row in samples of the image (supersampling per pixel); the
        mask is bool [row, column], cut to the image.
        """
        self._require(scene, Content.ALL)
        guard = int(view.GUARD)
        rectangle, offset = self._layers.rectangle.numpy(), self._layers.offset.numpy()
        visible = (self._layers.inverse_depth_bits.numpy() != 0) & (self._hiding.bits.numpy() == 0)
        masks = []
        for v in shown_view:
            row_of_masks = []
            for vehicle in range(scene.vehicle_count):
                left, top, columns, rows = (int(value) for value in rectangle[v, vehicle])
                first = int(offset[v, vehicle])
                mask = visible[first : first + rows * columns].reshape(rows, columns)
                # cut the guard band off
                cut_left, cut_top = max(guard - left, 0), max(guard - top, 0)
                mask = mask[cut_top : self._height - guard - top, cut_left : self._width - guard - left]
                row_of_masks.append((left + cut_left - guard, top + cut_top - guard, mask))
            masks.append(row_of_masks)
        return masks
