"""The renderer: owns the buffers of a set of views and the order of launches. It decides, then it measures."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum

import numpy as np
import warp as wp

from warpav.render.device_scene import DeviceScene
from warpav.rig.camera import CameraModel
from warpav_kernels import hide, linearise, measure, rasterise, shade, view

VISIBLE_AREA = int(measure.VISIBLE_AREA)
AMODAL_AREA = int(measure.AMODAL_AREA)
BOX_AREA = int(measure.BOX_AREA)
LEFT, RIGHT = int(measure.LEFT), int(measure.RIGHT)
TOP, BOTTOM = int(measure.TOP), int(measure.BOTTOM)
MEASURE_COUNT = int(measure.MEASURE_COUNT)

# Threads that share one cluster of triangles on a GPU; a CPU launch is one loop, where lanes would only cost.
CUDA_LANES = 64

# Places in the atlas are 32-bit integers.
MAX_ATLAS_SAMPLES = 2**31 - 1


def _available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Occlusion(Enum):
    """What hides a vehicle."""

    EXACT = "exact"  # whatever surface is nearest in the joint render
    PAIRWISE = "pairwise"  # the thesis: nearer vehicles by median depth, and the ego vehicle


@dataclass(frozen=True)
class Measures:
    """Measures of every vehicle in every view and their Jacobians, on the device.

    The last axis is VISIBLE_AREA, AMODAL_AREA, BOX_AREA [px^2], LEFT, RIGHT, TOP, BOTTOM [px].

    Attributes:
        value: float [view, vehicle, measure].
        per_shift: Jacobian to the view's centre in ego axes [1/m], vec3 [view, vehicle, measure].
        per_spin: Jacobian to a small rotation about the camera's axes [1/rad], vec3 [view, vehicle, measure].
        position_ego_m: Centres at which it was rendered, vec3 [view].
        camera_from_ego: Rotations at which it was rendered, mat33 [view].
    """

    value: wp.array
    per_shift: wp.array
    per_spin: wp.array
    position_ego_m: wp.array
    camera_from_ego: wp.array

    def on_tape(self, position_ego_m: wp.array, camera_from_ego: wp.array) -> wp.array:
        """The measures as a function of the poses, recorded on the active tape; float [view, vehicle, measure].

        The value is the rendered one, the gradient to the poses is the Jacobian (first order around the rendered
        poses).
        """
        result = wp.empty_like(self.value, requires_grad=True)
        wp.launch(
            linearise.linearise_measures_kernel,
            dim=self.value.shape[:2],
            inputs=[
                position_ego_m,
                camera_from_ego,
                self.position_ego_m,
                self.camera_from_ego,
                self.value,
                self.per_shift,
                self.per_spin,
            ],
            outputs=[result],
            device=self.value.device,
        )
        return result


class Renderer:
    """Renders a fixed number of views of equal size, one scene at a time, into buffers that it owns.

    Call `render`, then any of `measure`, `rgb`, `depth_and_object`, `visible_mask`; they describe the last render.
    """

    def __init__(
        self,
        models: Sequence[CameraModel],
        *,
        supersampling: int = 1,
        occlusion: Occlusion = Occlusion.EXACT,
        device: str = "cpu",
        thread_count: int | None = None,
    ) -> None:
        """Buffers for the given views.

        Args:
            models: Camera model of every view; all of one image size.
            supersampling: Samples per pixel along each axis, at least 1.
            occlusion: What hides a vehicle in `measure` and `visible_mask`.
            device: Warp device.
            thread_count: Threads over views on the CPU; None takes the number of cores, at most 8.

        Raises:
            ValueError: No views, views of different sizes, or supersampling below 1.
        """
        if not models or len({(model.width_px, model.height_px) for model in models}) != 1:
            raise ValueError("a renderer needs at least one view, and all views need the same size")
        if supersampling < 1:
            raise ValueError(f"supersampling must be at least 1, got {supersampling}")
        self.view_count = len(models)
        self.width_px, self.height_px = models[0].width_px, models[0].height_px
        self.supersampling = supersampling
        self.occlusion = occlusion
        self.device = wp.get_device(device)
        guard = int(view.GUARD)
        self._width = self.width_px * supersampling + 2 * guard
        self._height = self.height_px * supersampling + 2 * guard
        self._focal_px = wp.array([model.focal_px for model in models], dtype=float, device=self.device)
        self._near_m = wp.array([model.near_m for model in models], dtype=float, device=self.device)
        self._view = wp.zeros(self.view_count, dtype=view.View, device=self.device)  # pyright: ignore[reportArgumentType]
        self._position_ego_m = wp.zeros(self.view_count, dtype=wp.vec3, device=self.device)
        self._camera_from_ego = wp.zeros(self.view_count, dtype=wp.mat33, device=self.device)
        self._key = wp.zeros((self.view_count, self._height, self._width), dtype=wp.int64, device=self.device)
        self._layer_bits = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._hiding_bits = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._sample_count = wp.zeros(1, dtype=wp.int64, device=self.device)
        self._no_box = wp.zeros((0, 0), dtype=wp.vec4, device=self.device)
        self._threads = None
        if self.device.is_cpu:
            thread_count = thread_count or min(_available_cores(), 8)
            if thread_count > 1 and self.view_count > 1:
                self._threads = ThreadPoolExecutor(thread_count)
        self._thread_count = thread_count or 1
        # load before threads launch, so that no two of them compile the same module
        for module in (view, rasterise, hide, measure, shade):
            wp.load_module(module, device=self.device)

    def _over_views(self, count: int, launch: Callable[[int, int], object]) -> None:
        """Call ``launch(first, count)`` for chunks of views: all at once on a GPU, spread over threads on the CPU.

        Every view's outputs are its own, so threads never write the same element (CPU atomics are not atomic).
        """
        if self._threads is None:
            launch(0, count)
            return
        chunk = -(-count // (2 * self._thread_count))
        firsts = range(0, count, chunk)
        for _ in self._threads.map(lambda first: launch(first, min(chunk, count - first)), firsts):
            pass

    def render(
        self, scene: DeviceScene, position_ego_m: wp.array, camera_from_ego: wp.array, *, layers_only: bool = False
    ) -> None:
        """Decide which surface every sample sees, and what every vehicle covers alone. Nothing is taped.

        Args:
            scene: The scene, on this renderer's device.
            position_ego_m: Camera centres [m], vec3 [view].
            camera_from_ego: Rotations from ego to camera axes, mat33 [view].
            layers_only: Leave the environment out (for measures of vehicles alone).

        Raises:
            ValueError: The silhouettes together do not fit into one buffer.
        """
        device = self.device
        wp.copy(self._position_ego_m, position_ego_m)
        wp.copy(self._camera_from_ego, camera_from_ego)
        wp.launch(
            view.place_views_kernel,
            dim=self.view_count,
            inputs=[self._position_ego_m, self._camera_from_ego, self._focal_px, self._near_m, self.supersampling],
            outputs=[self._view],
            device=device,
            record_tape=False,
        )
        layers = (self.view_count, scene.layer_count)
        self._rectangle = wp.zeros(layers, dtype=wp.vec4i, device=device)
        self._offset = wp.zeros(layers, dtype=wp.int32, device=device)
        wp.launch(
            rasterise.bound_layers_kernel,
            dim=layers,
            inputs=[self._view, scene.layer_bounds_ego_m, self._width, self._height],
            outputs=[self._rectangle],
            device=device,
            record_tape=False,
        )
        wp.launch(
            rasterise.place_layers_kernel,
            dim=1,
            inputs=[self._rectangle],
            outputs=[self._offset, self._sample_count],
            device=device,
            record_tape=False,
        )
        sample_count = int(self._sample_count.numpy()[0])
        if sample_count > MAX_ATLAS_SAMPLES:
            raise ValueError(
                f"the silhouettes of {scene.vehicle_count} vehicles in {self.view_count} views of {self._width} x "
                f"{self._height} samples need {sample_count} samples, more than {MAX_ATLAS_SAMPLES}; render fewer views"
            )
        if sample_count > self._layer_bits.size:
            room = sample_count + sample_count // 4
            self._layer_bits = wp.zeros(room, dtype=wp.int32, device=device)
            self._hiding_bits = wp.zeros(room, dtype=wp.int32, device=device)
        self._key.zero_()
        self._layer_bits.zero_()
        lanes = 1 if device.is_cpu else CUDA_LANES
        self._over_views(
            self.view_count,
            lambda first, count: wp.launch(
                rasterise.scatter_triangles_kernel,
                dim=(count, scene.cluster_count, lanes),
                inputs=[
                    self._view, scene.triangles, self._rectangle, self._offset, first, int(layers_only), lanes,
                ],
                outputs=[self._key, self._layer_bits],
                device=device,
                record_tape=False,
            ),
        )  # fmt: skip
        self._hiding_bits.zero_()
        if scene.vehicle_count and not layers_only:
            self._hide(scene)

    def _hide(self, scene: DeviceScene) -> None:
        layers = [self._rectangle, self._offset]
        if self.occlusion is Occlusion.EXACT:
            self._over_views(
                self.view_count,
                lambda first, count: wp.launch(
                    hide.hide_by_nearest_surface_kernel,
                    dim=(count, scene.vehicle_count),
                    inputs=[self._key, scene.triangle_object, scene.layer_object, *layers, first],
                    outputs=[self._hiding_bits],
                    device=self.device,
                    record_tape=False,
                ),
            )
            return
        is_hidden_by = wp.zeros(
            (self.view_count, scene.vehicle_count, scene.vehicle_count), dtype=wp.int32, device=self.device
        )

        def launch(first: int, count: int) -> None:
            wp.launch(
                hide.order_overlapping_layers_kernel,
                dim=(count, scene.vehicle_count, scene.vehicle_count),
                inputs=[*layers, self._layer_bits, scene.vehicle_count, first],
                outputs=[is_hidden_by],
                device=self.device,
                record_tape=False,
            )
            wp.launch(
                hide.hide_by_ordered_layers_kernel,
                dim=(count, scene.vehicle_count),
                inputs=[*layers, self._layer_bits, is_hidden_by, scene.ego_layer, first],
                outputs=[self._hiding_bits],
                device=self.device,
                record_tape=False,
            )

        self._over_views(self.view_count, launch)

    def measure(self, scene: DeviceScene, box_px: wp.array | None = None) -> Measures:
        """Areas and extents of every vehicle in every view, with Jacobians to the views' poses.

        Args:
            scene: The scene of the last `render`.
            box_px: Box per view and vehicle (left, top, right, bottom [px]) for BOX_AREA, vec4 [view, vehicle]; None:
                no box.

        Returns:
            Fresh arrays, so several scenes can stay on one tape.
        """
        shape = (self.view_count, scene.vehicle_count)
        if box_px is None:
            box_px = wp.zeros(shape, dtype=wp.vec4, device=self.device)
        full = (*shape, MEASURE_COUNT)
        result = Measures(
            value=wp.zeros(full, dtype=float, device=self.device),
            per_shift=wp.zeros(full, dtype=wp.vec3, device=self.device),
            per_spin=wp.zeros(full, dtype=wp.vec3, device=self.device),
            position_ego_m=wp.clone(self._position_ego_m, requires_grad=False),
            camera_from_ego=wp.clone(self._camera_from_ego, requires_grad=False),
        )
        self._over_views(
            self.view_count,
            lambda first, count: wp.launch(
                measure.measure_objects_kernel,
                dim=(count, scene.vehicle_count),
                inputs=[
                    self._view, self._rectangle, self._offset, self._layer_bits, self._hiding_bits, box_px,
                    self._width, self._height, self.supersampling, first,
                ],
                outputs=[result.value, result.per_shift, result.per_spin],
                device=self.device,
                record_tape=False,
            ),
        )  # fmt: skip
        return result

    def rgb(self, scene: DeviceScene, shown_view: Sequence[int] | None = None) -> wp.array:
        """Colour images 0..1 of the chosen views (None: all), vec3 [image, row, column]; no gradient."""
        shown = list(range(self.view_count)) if shown_view is None else list(shown_view)
        image = wp.zeros((len(shown), self.height_px, self.width_px), dtype=wp.vec3, device=self.device)
        shown_array = wp.array(shown, dtype=wp.int32, device=self.device)
        sky = [wp.vec3(*(np.asarray(colour) / 255.0)) for colour in (scene.sky.horizon_rgb, scene.sky.zenith_rgb)]
        self._over_views(
            len(shown),
            lambda first, count: wp.launch(
                shade.resolve_rgb_kernel,
                dim=(count, self.height_px, self.width_px),
                inputs=[
                    self._view, scene.triangles, scene.vertex_rgb, *sky, self._key, shown_array, self.supersampling,
                    first,
                ],
                outputs=[image],
                device=self.device,
                record_tape=False,
            ),
        )  # fmt: skip
        return image

    def depth_and_object(self, scene: DeviceScene) -> tuple[wp.array, wp.array]:
        """Depth along the optical axis [m] (+inf: nothing) and object index (-1: nothing), each [view, row, column]."""
        shape = (self.view_count, self.height_px, self.width_px)
        depth_m = wp.zeros(shape, dtype=float, device=self.device)
        object_index = wp.zeros(shape, dtype=wp.int32, device=self.device)
        self._over_views(
            self.view_count,
            lambda first, count: wp.launch(
                shade.resolve_depth_kernel,
                dim=(count, self.height_px, self.width_px),
                inputs=[self._key, scene.triangle_object, self.supersampling, first],
                outputs=[depth_m, object_index],
                device=self.device,
                record_tape=False,
            ),
        )
        return depth_m, object_index

    def visible_masks(self, scene: DeviceScene, shown_view: Sequence[int]) -> list[list[tuple[int, int, np.ndarray]]]:
        """Non-occluded silhouettes on the host, cropped: for each view and vehicle (left, top, mask), in samples.

        ``left`` and ``top`` are the crop's first column and row in samples of the image (supersampling per pixel); the
        mask is bool [row, column], cut to the image.
        """
        guard = int(view.GUARD)
        rectangle, offset = self._rectangle.numpy(), self._offset.numpy()
        visible = (self._layer_bits.numpy() != 0) & (self._hiding_bits.numpy() == 0)
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
