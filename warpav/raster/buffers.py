"""What a renderer keeps on its device from render to render: views, keys, the atlas of layers, and how launches run."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpav.core.cores import available_cores
from warpav.core.errors import InputError
from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens, image_table
from warpav.raster.scene import Scene
from warpav_kernels import raster as kernels

_LENS_KINDS = {
    Lens.PINHOLE: (int(kernels.PINHOLE), 0),
    Lens.BROWN_CONRADY: (int(kernels.BROWN_CONRADY), 0),
    Lens.FISHEYE: (int(kernels.FISHEYE), 0),
    Lens.EUCM: (int(kernels.FISHEYE), int(kernels.EUCM)),
    Lens.DOUBLE_SPHERE: (int(kernels.FISHEYE), int(kernels.DOUBLE_SPHERE)),
    Lens.PANORAMA: (int(kernels.PANORAMA), 0),
    Lens.EQUIRECTANGULAR: (int(kernels.PANORAMA), int(kernels.SPHERE)),
}
"""Kind and formula of every lens in the kernels."""

GUARD = int(kernels.GUARD)

# How a launch is spread over threads: on the CPU it is one loop, where more threads would only cost.
_CUDA_CLUSTER_LANES = 32  # share one cluster of triangles
_CUDA_MEASURE_LANES = (16, 32)  # rows and columns of threads that share the samples of one object in one view
_CUDA_SUM_LANES = 16  # of them are summed first
_CUDA_ROW_LANES = 128  # share one row of an image
_FLOW_LANES, _CUDA_FLOW_LANES = (64, 1), (64, 32)  # rows and columns of threads that share the flow of one image
CUDA_STRIP_GROUPS, CUDA_STRIP_LANES = 8192, 32  # fill large triangles
_CUDA_STRIPS = 1 << 18, 1 << 22  # room in their queue, at least and at most
_CUDA_STRIP_SAMPLES = 64  # there is room for a strip in so many samples of the views

# Warp's arrays have strides of 32 bits, in bytes; see `Buffers.reserve_samples`.
_MAX_ATLAS_SAMPLES = (2**31 - 1) // 8
_MAX_VIEW_SAMPLES = 2**27

_REACH_STEP_RAD = math.radians(3.0)  # zooms whose images end at nearly the same angle from the axis share a table

_WIDE_RAD = 50.0  # half the size of a window that holds all directions, whatever its softness


FIRST = object()
"""Stands for the first view of a chunk among the inputs of a kernel."""


class Content(Enum):
    """What a render holds."""

    ALL = "all"  # images, and every object alone
    IMAGES = "images"  # depth, ids and colours only
    OBJECTS = "objects"  # every object alone only: nothing is hidden, and there are no images
    COVERAGE = "coverage"  # what objects cover, what hides them and what is around them: no outlines and no images
    MEASURES = "measures"  # the same with outlines: all that is measured of objects, but no images


@dataclass(frozen=True, eq=False)
class RenderState:
    """What one render has left in the buffers; equal only to itself."""

    scene: Scene  # the scene
    content: Content  # what of it
    is_exact: bool  # whether the nearest surface hides
    rectangle: wp.array  # samples of every layer, vec4i [view, layer]
    offset: wp.array  # their places in the atlas, int32 [view, layer]


@cache
def _threads(count: int) -> ThreadPoolExecutor:
    """Threads that renderers share."""
    return ThreadPoolExecutor(count, thread_name_prefix="raster")


class Buffers:
    """The buffers of a fixed number of views of equal size."""

    def __init__(
        self,
        models: Sequence[CameraModel],
        *,
        supersampling: int,
        device: str,
        thread_count: int | None,
        has_foreground: bool,
    ) -> None:
        """Room for the given views, arguments as in `Renderer`."""
        if not models or len({(model.width_px, model.height_px) for model in models}) != 1:
            raise InputError("models: a renderer needs at least one view, and all views need the same size")
        if supersampling < 1 or supersampling != int(supersampling):
            raise InputError(f"supersampling must be a whole number of at least 1, got {supersampling}")
        self.device = wp.get_device(device)
        self.view_count = len(models)
        self.width_px, self.height_px = models[0].width_px, models[0].height_px
        self.supersampling = int(supersampling)
        # samples of a row of the grid, with its guard band, and rows
        self.width = self.width_px * self.supersampling + 2 * GUARD
        self.height = self.height_px * self.supersampling + 2 * GUARD
        if self.width * self.height > _MAX_VIEW_SAMPLES:
            raise InputError(
                f"{self.width_px} x {self.height_px} pixels with supersampling {supersampling} are more than "
                f"{_MAX_VIEW_SAMPLES} samples; lower the size or the supersampling"
            )
        self.has_foreground = has_foreground  # whether its silhouette is wanted even where the occlusion does without
        self.ones = wp.full((1, self.height_px, self.width_px), 1.0, dtype=float, device=self.device)
        self.all_directions = wp.full(
            self.view_count, wp.vec4(0.0, 0.0, _WIDE_RAD, _WIDE_RAD), dtype=wp.vec4, device=self.device
        )
        self._intrinsics_px = self.zeros(self.view_count, wp.vec4)
        self._near_m = self.zeros(self.view_count, float)
        self.lens = self.zeros(self.view_count, kernels.Lens)
        self._models: list[CameraModel] = []
        self._kept: dict[tuple[str, tuple[int, ...]], wp.array] = {}
        self._shown: dict[tuple[int, ...], wp.array] = {}
        self.bent: list[int] = []  # the views whose lenses are no pinholes
        self.rays = kernels.Rays()
        self.rays.ray = self.zeros((0, 3, self.height, self.width), float)
        self.rays.set_of_view = self._no_set = wp.full(self.view_count, -1, dtype=wp.int32, device=self.device)
        self._rays_of: list[tuple[int, CameraModel, float]] = []
        self._view_of_set = self._no_set
        self._are_rays_placed = True
        self.is_recordable = True  # the last render: on the CPU the host looks at zooms of bent lenses
        self.generation = 0  # grows when arrays that recorded launches refer to have moved
        self.set_lenses(models)
        self.view = self.zeros(self.view_count, kernels.View)  # of the last render, as the following
        self.position_world_m = self.zeros(self.view_count, wp.vec3)
        self.camera_from_world = self.zeros(self.view_count, wp.mat33)
        self.log_focal = self.zeros(self.view_count, float)
        # which part of every view's grid is rendered: first column, first row, and those after the last
        self.scissor = self.zeros(self.view_count, wp.vec4i)
        # nearest surface of every sample, [view, row, column]; empty until a render asks for images
        self.key = self.zeros((0, 0, 0), wp.int64)
        self._sample_count = self.zeros(1, wp.int64)
        self.needed_samples = self.zeros(1, wp.int64)  # at most, of the renders since the last `grew`
        least, most = _CUDA_STRIPS
        strips = min(max(self.view_count * self.height * self.width // _CUDA_STRIP_SAMPLES, least), most)
        # queue of the large triangles' parts; empty on the CPU
        self.strip = self.zeros(0 if self.device.is_cpu else strips, wp.vec4i)
        self.strip_count = self.zeros(1, wp.int32)
        self.layers = kernels.Layers()
        self.hiding, self.foreground_hiding = kernels.Hiding(), kernels.Hiding()
        self._has_outlines = False  # whether there is room for their crossings
        self.reserve_samples(0)
        self._state: RenderState | None = None
        self.lanes = (1, 1) if self.device.is_cpu else _CUDA_MEASURE_LANES
        self.cluster_lanes = 1 if self.device.is_cpu else _CUDA_CLUSTER_LANES
        self.row_lanes = 1 if self.device.is_cpu else _CUDA_ROW_LANES
        self.flow_lanes = _FLOW_LANES if self.device.is_cpu else _CUDA_FLOW_LANES
        self.thread_count = 1
        if self.device.is_cpu:
            self.thread_count = thread_count or min(available_cores(), 8)
        self._threads = _threads(self.thread_count) if self.thread_count > 1 and self.view_count > 1 else None

    def zeros(self, shape: int | tuple[int, ...], dtype: object) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self.device)  # pyright: ignore[reportArgumentType, reportReturnType]

    def kept(self, name: str, shape: tuple[int, ...], dtype: object) -> wp.array:
        """A buffer for one purpose and shape, the same from call to call; its contents are old."""
        key = (name, shape)
        if key not in self._kept:
            self._kept[key] = self.zeros(shape, dtype)
        return self._kept[key]

    @property
    def held_bytes(self) -> int:
        """Memory of all arrays that have a number for each sample, or are kept for one purpose; grows with renders."""
        atlas, rays = self.layers, self.rays
        arrays = [self.key, self.ones, self.strip, atlas.inverse_depth_bits, atlas.crossing_key, *self._kept.values()]
        arrays += [each for hiding in (self.hiding, self.foreground_hiding) for each in (hiding.bits, hiding.source)]
        arrays += [rays.ray, rays.block, rays.block_row] if self._rays_of else []
        return sum(each.capacity for each in arrays)

    def image(self, count: int, dtype: object, into: wp.array | None) -> wp.array:
        """A fresh array of images, or ``into`` if that has their shape."""
        shape = (count, self.height_px, self.width_px)
        if into is not None and into.shape != shape:
            raise InputError(f"into: expected images of shape {shape}, got {into.shape}")
        return self.zeros(shape, dtype) if into is None else into

    def shown_views(self, shown_view: Sequence[int] | None) -> wp.array:
        """Views by number (None: all) on the device, the same array from call to call."""
        shown = tuple(range(self.view_count)) if shown_view is None else tuple(shown_view)
        if any(not 0 <= v < self.view_count for v in shown):
            raise InputError(f"views must be 0..{self.view_count - 1}, got {list(shown)}")
        if shown not in self._shown:
            self._shown[shown] = wp.array(shown, dtype=wp.int32, device=self.device)
        return self._shown[shown]

    def launch(self, kernel: Callable, dim: int | tuple[int, ...], *, inputs: list, outputs: list) -> None:
        """Launch a kernel that is never taped."""
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device, record_tape=False)

    def launch_views(self, kernel: Callable, dim: tuple[int, ...], *, inputs: list, outputs: list) -> None:
        """Launch a kernel that is never taped over views, the first of ``dim``; `FIRST` stands for a chunk's first."""
        place = next(i for i, each in enumerate(inputs) if each is FIRST)
        self.over_views(
            dim[0],
            lambda first, count: self.launch(
                kernel, (count, *dim[1:]), inputs=[*inputs[:place], first, *inputs[place + 1 :]], outputs=outputs
            ),
        )

    def over_views(self, count: int, launch: Callable[[int, int], object]) -> None:
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

    def set_lenses(self, models: Sequence[CameraModel]) -> None:
        """Give every view another camera model of the same image size; the next render uses it."""
        size = (self.width_px, self.height_px)
        if len(models) != self.view_count or any((model.width_px, model.height_px) != size for model in models):
            raise InputError(f"models: expected {self.view_count} camera models of {size[0]} x {size[1]} pixels")
        if list(models) == self._models:
            return
        bent = [i for i, model in enumerate(models) if model.lens is not Lens.PINHOLE]
        # recorded launches do not place rays again
        self.generation += int({i: models[i] for i in bent} != {i: self._models[i] for i in self.bent})
        self._models = list(models)
        intrinsics_px = [model.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]] for model in models]
        self._intrinsics_px.assign(np.array(intrinsics_px, np.float32))
        self._near_m.assign(np.array([model.near_m for model in models], np.float32))
        wp.copy(self.lens, wp.array([lens_of(model) for model in models], dtype=kernels.Lens, device=self.device))
        if bent != self.bent:
            on_gpu = (kernels.trace_keys_kernel, kernels.scatter_bent_crossings_kernel)
            drawing = (kernels.scatter_bent_triangles_kernel,) if self.device.is_cpu else on_gpu
            for kernel in (kernels.place_rays_kernel, *drawing):  # takes seconds, so only where it is needed
                wp.load_module(kernel.module, device=self.device)  # pyright: ignore[reportFunctionMemberAccess]
            self.bent = bent
            self.bent_view = wp.array(bent, dtype=wp.int32, device=self.device)

    def place_views(self, position_world_m: wp.array, camera_from_world: wp.array, log_focal: wp.array | None) -> None:
        """Set the poses of the views, and their focal lengths."""
        given = {"position_world_m": position_world_m, "camera_from_world": camera_from_world, "log_focal": log_focal}
        for name, array in given.items():
            if array is None:
                continue
            if array.shape != (self.view_count,):
                raise InputError(f"{name} must be one for each of {self.view_count} views, got {array.shape}")
            if array.device != self.device:
                raise InputError(
                    f"{name}: expected an array on {self.device}, the renderer's device, got {array.device}"
                )
        wp.copy(self.position_world_m, position_world_m)
        wp.copy(self.camera_from_world, camera_from_world)
        if log_focal is None:
            self.log_focal.zero_()
        else:
            wp.copy(self.log_focal, log_focal)
        is_zoomed = log_focal is not None
        self.is_recordable = not (is_zoomed and self.bent and self.device.is_cpu)
        if self.bent:
            self._reserve_rays(is_zoomed=is_zoomed)
        self.launch(
            kernels.place_views_kernel,
            self.view_count,
            inputs=[
                self.position_world_m, self.camera_from_world, self._intrinsics_px, self._near_m, self.lens,
                self.log_focal, self.rays.ray, self.rays.set_of_view if self.bent else self._no_set, self.supersampling,
                self.width, self.height,
            ],
            outputs=[self.view],
        )  # fmt: skip
        if self.bent:
            self._place_rays(is_zoomed=is_zoomed)

    def _reserve_rays(self, *, is_zoomed: bool) -> None:
        """Room for the rays of the views that are no pinholes: views of one lens and zoom share them.

        A GPU is not asked what the zooms are, so that launches can be recorded: there views that may be zoomed have
        rays of their own.
        """
        is_known = self.device.is_cpu or not is_zoomed
        zoom = self.log_focal.numpy()[self.bent].tolist() if is_zoomed and is_known else [0.0] * len(self.bent)
        if not is_known:
            zoom = self.bent
        rays_of = [(v, self._models[v], each) for v, each in zip(self.bent, zoom, strict=True)]
        if rays_of == self._rays_of:
            return
        self._rays_of, self._are_rays_placed = rays_of, False
        self.generation += 1
        of_view = [each[1:] for each in rays_of]
        tables_of = [(model.shape, _reach_rad(model, each) if is_known else math.pi) for model, each in of_view]
        sets, tables = list(dict.fromkeys(of_view)), list(dict.fromkeys(tables_of))
        set_of_view, table_of_view = np.full((2, self.view_count), -1, np.int32)
        set_of_view[self.bent] = [sets.index(each) for each in of_view]
        table_of_view[self.bent] = [tables.index(each) for each in tables_of]
        rays, count, block = self.rays, len(sets), int(kernels.BLOCK)
        rays.set_of_view = wp.array(set_of_view, dtype=wp.int32, device=self.device)
        rays.table_of_view = wp.array(table_of_view, dtype=wp.int32, device=self.device)
        rays.table = wp.array([image_table(*each) for each in tables], dtype=wp.vec2, device=self.device)
        rays.ray = self.zeros((count, 3, self.height, self.width), float)
        rays.factor = self.zeros((count, 4, max(self.height, self.width)), float)
        # a GPU does not draw by blocks
        blocks = (-(-self.height // block), -(-self.width // block)) if self.device.is_cpu else (0, 0)
        rays.block = self.zeros((count, 4, *blocks), float)
        rays.block_row = self.zeros((count, 7, math.prod(blocks), block), float)
        rays.widest_cosine = self.zeros(count, float)
        rays.is_flat = self.zeros(count, wp.int32)
        self._view_of_set = wp.array(
            [self.bent[of_view.index(each)] for each in sets], dtype=wp.int32, device=self.device
        )

    def _place_rays(self, *, is_zoomed: bool) -> None:
        """The rays of the views that are no pinholes, and what bounds them, unless they are there."""
        if self._are_rays_placed and (self.device.is_cpu or not is_zoomed):
            return
        self._are_rays_placed = True
        rays, view_of_set = self.rays, self._view_of_set
        count, _, rows, columns = rays.block.shape
        rays.widest_cosine.fill_(1.0)
        rays.is_flat.fill_(1)
        self.launch(
            kernels.place_rays_kernel,
            (count, self.height, self.width),
            inputs=[self.view, view_of_set],
            outputs=[rays.ray, rays.factor],
        )
        self.launch(
            kernels.bound_rays_kernel,
            (count, self.height),
            inputs=[rays.ray],
            outputs=[rays.widest_cosine, rays.is_flat],
        )
        self.launch(
            kernels.place_blocks_kernel, (count, rows, columns), inputs=[rays.ray], outputs=[rays.block, rays.block_row]
        )

    def reserve_samples(self, sample_count: int) -> None:
        """Atlas with room for a number of samples, and a quarter more; the old one goes first."""
        for room in (0, sample_count + sample_count // 4):
            self.layers.inverse_depth_bits = self.zeros(room, wp.int32)
            self.layers.crossing_key = self.zeros((4, room if self._has_outlines else 0), wp.int64)
            for hiding, size in ((self.hiding, room), (self.foreground_hiding, room if self.has_foreground else 0)):
                hiding.bits = self.zeros(size, wp.int32)
                hiding.source = self.zeros(size, wp.int32)
            self._capacity = room
        self.generation += 1

    def place_layers(self, scene: Scene, layer_count: int, *, is_whole: bool, has_outlines: bool) -> None:
        """Rectangles and places of the first layers; the atlas grows where it is too small.

        The scissors are the whole grids, or with ``is_whole`` False what holds the objects and their surroundings.
        Crossings of outlines, three quarters of the atlas, have room from the first render on that asks for them.
        """
        if has_outlines and not self._has_outlines:
            self._has_outlines = True
            self.reserve_samples(self._capacity * 4 // 5)
        shape = (self.view_count, layer_count)
        self.layers.rectangle = self.kept("rectangle", shape, wp.vec4i)
        self.layers.offset = self.kept("offset", shape, wp.int32)
        for _ in range(2):
            self._sample_count.zero_()
            self.launch(
                kernels.place_layers_kernel,
                shape,
                inputs=[self.view, scene.layer_bounds_world_m, self.width, self.height, self._capacity],
                outputs=[self.layers.rectangle, self.layers.offset, self._sample_count, self.needed_samples],
            )
            # a recording cannot be asked; see `grew`
            if self.device.is_capturing or not self.grew():
                break
        self.launch(
            kernels.place_scissors_kernel,
            self.view_count,
            inputs=[
                self.layers.rectangle, scene.object_count, int(is_whole), self.width, self.height, self.supersampling,
            ],
            outputs=[self.scissor],
        )  # fmt: skip

    def grew(self, needed_samples: int | None = None) -> bool:
        """Whether a render since the last call needed more samples than there was room for, and had to leave some out.

        If so, there is room now, and the render has to be done again. Only recorded launches need this question.
        """
        needed = int(self.needed_samples.numpy()[0]) if needed_samples is None else needed_samples
        if needed <= self._capacity:
            return False
        limit = _MAX_ATLAS_SAMPLES // 5 * 4  # there is room for a quarter more
        if needed > limit:
            raise InputError(
                f"the silhouettes in {self.view_count} views of {self.width} x {self.height} samples need {needed} "
                f"samples, more than {limit}; render fewer views"
            )
        self.reserve_samples(needed)
        return True

    @property
    def state(self) -> RenderState | None:
        """What the last render has left, None before the first; a replay of recorded launches sets it again."""
        return self._state

    @state.setter
    def state(self, state: RenderState | None) -> None:
        self._state = state
        if state is not None:
            self.layers.rectangle, self.layers.offset = state.rectangle, state.offset

    def grouped(self, derivative: wp.array) -> wp.array:
        """Sums over groups of neighbouring lanes; the same array where there are few."""
        *sums, lanes = derivative.shape
        if lanes <= _CUDA_SUM_LANES:
            return derivative
        groups = self.kept("group derivative", (*sums, lanes // _CUDA_SUM_LANES), kernels.BoundaryDerivative)
        self.launch(kernels.sum_lanes_kernel, groups.shape, inputs=[derivative, _CUDA_SUM_LANES], outputs=[groups])
        return groups


def _reach_rad(model: CameraModel, log_zoom: float) -> float:
    """Angle from the axis beyond which a zoomed Brown-Conrady lens has no image, in steps [rad]; of others pi."""
    if model.lens is not Lens.BROWN_CONRADY:
        return math.pi
    fx, fy, cx, cy = model.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
    corner_px = np.array([(x, y) for x in (-1, model.width_px + 1) for y in (-1, model.height_px + 1)], np.float64)
    ray = model.shape.ray((corner_px - [cx, cy]) / [fx * math.exp(log_zoom), fy * math.exp(log_zoom)])
    if not np.isfinite(ray).all():
        return math.pi
    return _REACH_STEP_RAD * (1 + math.ceil(math.atan(np.linalg.norm(ray[:, :2], axis=1).max()) / _REACH_STEP_RAD))


def lens_of(model: CameraModel) -> Any:  # noqa: ANN401 (a struct, which is no type to a checker)
    """The model's lens as the kernels take it."""
    result = kernels.Lens()
    result.kind, result.formula = _LENS_KINDS[model.lens]
    result.limit, result.edge = model.shape.limit, model.shape.edge
    result.distortion = kernels.vec8(*model.shape.coefficients)
    return result
