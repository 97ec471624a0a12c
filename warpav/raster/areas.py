"""Measure: areas, extents and solid angles of every object in every view, with their Jacobians to the views."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import warp as wp

from warpav.core.errors import InputError
from warpav.raster.buffers import FIRST, Buffers
from warpav.raster.poses import ViewPoses
from warpav.raster.scene import Scene
from warpav_kernels import raster as kernels
from warpav_kernels.raster import calibration, coverage, extent, linearise, window

VISIBLE_AREA = int(kernels.VISIBLE_AREA)
AMODAL_AREA = int(kernels.AMODAL_AREA)
BOX_AREA = int(kernels.BOX_AREA)
LEFT, RIGHT = int(kernels.LEFT), int(kernels.RIGHT)
TOP, BOTTOM = int(kernels.TOP), int(kernels.BOTTOM)
MEASURE_COUNT = int(kernels.MEASURE_COUNT)
AREA_COUNT, EXTENT_COUNT = int(kernels.AREA_COUNT), int(kernels.EXTENT_COUNT)


@dataclass(frozen=True)
class Measures:
    """Measures of every object in every view and their Jacobians, on the device.

    The last axis is VISIBLE_AREA, AMODAL_AREA, BOX_AREA [px^2], LEFT, RIGHT, TOP, BOTTOM [px] for `Frame.measure`, the
    last four of them for `Frame.extents`, and one element [px^2] for `Frame.weighted_area`.

    Attributes:
        value: float [view, object, measure].
        jac_translation: Jacobian to the view's centre in world axes [1/m], vec3 [view, object, measure].
        jac_rotation: Jacobian to a small rotation about the camera's axes [1/rad], vec3 [view, object, measure]: with
            its vector s, the rotation R from world to camera axes becomes ``R + [s]x R``.
        jac_log_focal: Jacobian to the logarithm of the focal lengths, float [view, object, measure].
        position_world_m: Centres at which it was rendered, vec3 [view].
        camera_from_world: Rotations at which it was rendered, mat33 [view].
        log_focal: Logarithms of focal lengths over the lenses' at which it was rendered, float [view].
    """

    value: wp.array
    jac_translation: wp.array
    jac_rotation: wp.array
    jac_log_focal: wp.array
    position_world_m: wp.array
    camera_from_world: wp.array
    log_focal: wp.array

    @property
    def jacobian(self) -> wp.array:
        """All Jacobians in one array, float [view, object, measure, 7]: translation, rotation, log focal length."""
        return self._jacobian(0, self.value.shape[2])

    def _jacobian(self, first: int, count: int) -> wp.array:
        result = wp.empty((*self.value.shape[:2], count, 7), dtype=float, device=self.value.device)
        wp.launch(
            kernels.gather_jacobian_kernel,
            dim=result.shape[:3],
            inputs=[self.jac_translation, self.jac_rotation, self.jac_log_focal, first],
            outputs=[result],
            device=result.device,
            record_tape=False,
        )
        return result

    def on_tape(
        self, position_world_m: wp.array, camera_from_world: wp.array, log_focal: wp.array | None = None
    ) -> wp.array:
        """The measures as a function of the views, recorded on the active tape; float [view, object, measure].

        The value is the rendered one, the gradient is the Jacobian (first order around what was rendered).

        Args:
            position_world_m: Camera centres [m], vec3 [view].
            camera_from_world: Rotations from world to camera axes, mat33 [view].
            log_focal: Logarithm of each view's focal length over its lens's, float [view]; None: as rendered.
        """
        device = self.value.device
        result = wp.empty(self.value.shape, dtype=float, device=device, requires_grad=True)
        wp.launch(
            linearise.linearise_measures_kernel,
            dim=len(self.value),
            inputs=[
                position_world_m,
                camera_from_world,
                self.position_world_m,
                self.camera_from_world,
                self.log_focal if log_focal is None else log_focal,
                self.log_focal,
                self.value,
                self.jac_translation,
                self.jac_rotation,
                self.jac_log_focal,
            ],
            outputs=[result],
            device=device,
        )
        return result

    def at(self, poses: ViewPoses | None) -> Self:
        """The same with a value that is a function of the poses, see `on_tape`; unchanged for None."""
        return self if poses is None else replace(self, value=self.on_tape(*poses))


def part_of(array: wp.array, place: int | slice) -> Any:  # noqa: ANN401 (an array; Warp's stubs say that it may be indexed)
    """A part of the third axis, gradient included; Warp itself cannot cut arrays without objects."""
    if array.size:
        return array[:, :, place]
    shape = [*array.shape[:2], *([len(range(array.shape[2])[place])] if isinstance(place, slice) else [])]
    return wp.empty((*shape, *array.shape[3:]), dtype=array.dtype, device=array.device)


@dataclass(frozen=True)
class Areas:
    """Areas of every object in every view.

    Attributes:
        measures: What they are taken from.
    """

    measures: Measures

    @property
    def visible(self) -> wp.array:
        """What of it nothing hides, inside the image [px^2], float [view, object]."""
        return part_of(self.measures.value, VISIBLE_AREA)

    @property
    def amodal(self) -> wp.array:
        """The object as if it stood alone, inside the image [px^2], float [view, object]."""
        return part_of(self.measures.value, AMODAL_AREA)

    @property
    def jacobian(self) -> wp.array:
        """Jacobian of the visible area, float [view, object, 7].

        In order: to the camera's centre in world axes (3) [px^2/m]; to a small rotation about the camera's axes, x
        right, y down, z forward (3) [px^2/rad], which turns the rotation R from world to camera axes into
        ``R + [s]x R``; to the logarithm of the focal lengths [px^2].
        """
        return part_of(self.measures._jacobian(VISIBLE_AREA, 1), 0)

    @property
    def amodal_jacobian(self) -> wp.array:
        """Jacobian of the amodal area, float [view, object, 7]; see `jacobian`."""
        return part_of(self.measures._jacobian(AMODAL_AREA, 1), 0)


@dataclass(frozen=True)
class WindowMeasures(Measures):
    """Solid angle [sr] of every object in every view inside the view's window, with Jacobians, on the device.

    As `Measures`, with one element on the last axis.
    """

    jac_window: wp.array  # jacobian to the window [sr/rad], vec4 [view, object]
    window_rad: wp.array  # windows with which it was measured, vec4 [view]

    def on_tape(
        self,
        position_world_m: wp.array,
        camera_from_world: wp.array,
        log_focal: wp.array | None = None,
        window_rad: wp.array | None = None,
    ) -> wp.array:
        """The solid angles as a function of views and windows, recorded on the active tape; float [view, object, 1].

        Args:
            position_world_m: Camera centres [m], vec3 [view].
            camera_from_world: Rotations from world to camera axes, mat33 [view].
            log_focal: Logarithm of each view's focal length over its lens's, float [view]; None: as rendered.
            window_rad: The windows, as in `Frame.window_area`, vec4 [view]; None: those that were measured.
        """
        still = super().on_tape(position_world_m, camera_from_world, log_focal)
        if window_rad is None:
            return still
        result = wp.empty_like(still, requires_grad=True)
        wp.launch(
            linearise.linearise_window_kernel,
            dim=len(still),
            inputs=[window_rad, self.window_rad, still, self.jac_window],
            outputs=[result],
            device=still.device,
        )
        return result


@dataclass(frozen=True)
class Coverage:
    """What every object covers in every view, without Jacobians, on the device."""

    value: wp.array
    solid_angle_sr: wp.array
    visible_sr: wp.array


def measure_coverage(buffers: Buffers, scene: Scene) -> Coverage:
    pairs = (buffers.view_count, scene.object_count)
    result = Coverage(
        buffers.zeros((*pairs, MEASURE_COUNT), float),
        buffers.zeros((*pairs, 1), float),
        buffers.zeros((*pairs, 1), float),
    )
    rows, columns = buffers.lanes
    covered = buffers.kept("coverage", (*pairs, rows * columns), coverage.Coverage)
    buffers.launch_views(
        coverage.measure_coverage_kernel,
        (buffers.view_count, scene.object_count, rows * columns),
        inputs=[buffers.view, buffers.layers, buffers.hiding, buffers.width, buffers.height, FIRST, rows, columns],
        outputs=[covered],
    )
    buffers.launch(
        coverage.sum_coverage_kernel,
        pairs,
        inputs=[covered, buffers.width, buffers.height, buffers.supersampling],
        outputs=[result.value, result.solid_angle_sr, result.visible_sr],
    )
    return result


def measure_calibration(buffers: Buffers, scene: Scene) -> wp.array:
    size = int(calibration.CALIBRATION_SIZE)
    kind = wp.array([int(kernels.VISIBLE), int(kernels.ALONE)], dtype=wp.int32, device=buffers.device)
    jacobian = buffers.zeros((buffers.view_count, scene.object_count, len(kind), size), float)
    buffers.launch_views(
        calibration.measure_calibration_kernel,
        (buffers.view_count, scene.object_count, len(kind)),
        inputs=[
            buffers.view, scene.triangles, buffers.layers, buffers.hiding, kind, buffers.width, buffers.height,
            buffers.supersampling, FIRST,
        ],
        outputs=[jacobian],
    )  # fmt: skip
    return jacobian


def measure_contrast(buffers: Buffers, scene: Scene, value: wp.array) -> wp.array:
    """See `Frame.contrast`."""
    pairs = (buffers.view_count, scene.object_count)
    if value.shape != (*pairs, MEASURE_COUNT):
        raise InputError(f"value: expected measures of shape {(*pairs, MEASURE_COUNT)}, got {value.shape}")
    contrast = buffers.zeros(pairs, float)
    buffers.launch_views(
        kernels.measure_contrast_kernel,
        (buffers.view_count, scene.object_count),
        inputs=[
            buffers.view, scene.triangles, scene.vertex_rgb, *scene.background_rgb, buffers.key, scene.layer_body,
            value, buffers.width_px, buffers.height_px, buffers.supersampling, FIRST,
        ],
        outputs=[contrast],
    )  # fmt: skip
    return contrast


def measure_all(buffers: Buffers, scene: Scene, box_px: wp.array | None, into: Measures | None) -> Measures:
    pairs = (buffers.view_count, scene.object_count)
    if box_px is None:
        box_px = buffers.kept("no box", pairs, wp.vec4)
    if box_px.shape != pairs:
        raise InputError(f"box_px must be {pairs}, got {box_px.shape}")
    result = _measures(buffers, scene, MEASURE_COUNT, into)
    farthest = buffers.kept("farthest", (*pairs, EXTENT_COUNT), wp.int32)
    farthest.zero_()
    rows, columns = buffers.lanes
    derivative = buffers.kept("derivative", (*pairs, AREA_COUNT, rows * columns), kernels.BoundaryDerivative)
    buffers.launch_views(
        kernels.measure_areas_kernel,
        (buffers.view_count, scene.object_count, rows * columns),
        inputs=[
            buffers.view, scene.triangles, buffers.layers, buffers.hiding, box_px, buffers.width, buffers.height,
            buffers.supersampling, FIRST, rows, columns,
        ],
        outputs=[derivative, farthest],
    )  # fmt: skip
    _sum(buffers, scene, derivative, result)
    buffers.launch(
        extent.measure_extents_kernel,
        (*pairs, EXTENT_COUNT),
        inputs=[buffers.view, buffers.layers, farthest, buffers.width, buffers.height, buffers.supersampling],
        outputs=[result.value, result.jac_translation, result.jac_rotation, result.jac_log_focal],
    )
    return result


def checked_weight(buffers: Buffers, scene: Scene, weight_image: wp.array) -> tuple[wp.array, int, int]:
    """Weights as [image, row, column], and by how many images views and objects are apart (`Frame.weighted_area`)."""
    size = (buffers.height_px, buffers.width_px)
    views, objects = buffers.view_count, scene.object_count
    if weight_image.dtype is not wp.float32:
        raise InputError(f"weight_image must hold float32, got {weight_image.dtype.__name__}")
    if weight_image.shape == (views, objects, *size):
        return weight_image.contiguous().reshape((views * objects, *size)), objects, 1
    if weight_image.shape == (views, *size):
        return weight_image, 1, 0
    if weight_image.shape != size:
        raise InputError(
            f"weight_image must be {size}, {(views, *size)} or {(views, objects, *size)}, got {weight_image.shape}"
        )
    return weight_image.reshape((1, *size)), 0, 0


def measure_weighted(
    buffers: Buffers,
    scene: Scene,
    weight: tuple[wp.array, int, int],
    *,
    kind: int,
    hiding: Any,  # noqa: ANN401 (a struct)
    into: Measures | None,
) -> Measures:
    """See `Frame.weighted_area` and `Frame.unblocked_area`; ``weight`` is `checked_weight`'s."""
    result = _measures(buffers, scene, 1, into)
    rows, columns = buffers.lanes
    derivative = buffers.kept(
        "weighted derivative", (buffers.view_count, scene.object_count, 1, rows * columns), kernels.BoundaryDerivative
    )
    buffers.launch_views(
        kernels.measure_weighted_area_kernel,
        (buffers.view_count, scene.object_count, rows * columns),
        inputs=[
            buffers.view, scene.triangles, buffers.layers, hiding, *weight, kind, buffers.width, buffers.height,
            buffers.supersampling, FIRST, rows, columns,
        ],
        outputs=[derivative],
    )  # fmt: skip
    _sum(buffers, scene, derivative, result)
    return result


def weigh_visible(buffers: Buffers, scene: Scene, weight: tuple[wp.array, int, int]) -> wp.array:
    """See `Frame.weighted_coverage`; ``weight`` is `checked_weight`'s."""
    lanes = buffers.row_lanes
    weighted = buffers.zeros((buffers.view_count, lanes, scene.object_count), float)
    buffers.launch_views(
        coverage.weigh_keys_kernel,
        (buffers.view_count, lanes),
        inputs=[buffers.key, scene.triangles, buffers.scissor, *weight, buffers.supersampling, FIRST, lanes],
        outputs=[weighted],
    )
    value = weighted.numpy().sum(axis=1)[..., None] / np.float32(buffers.supersampling**2)
    return wp.array(value, dtype=float, device=buffers.device)


def measure_window(
    buffers: Buffers,
    scene: Scene,
    window_rad: wp.array | None,
    *,
    softness_rad: float,
    kind: int,
    into: WindowMeasures | None,
) -> WindowMeasures:
    """See `Frame.window_area`."""
    if window_rad is None:
        window_rad = buffers.all_directions
    if window_rad.shape != (buffers.view_count,):
        raise InputError(
            f"window_rad must have one window for each of {buffers.view_count} views, got {window_rad.shape}"
        )
    if not softness_rad > 0.0:
        raise InputError(f"softness_rad must be positive, got {softness_rad}")
    pairs = (buffers.view_count, scene.object_count)
    if into is None:
        into = WindowMeasures(
            **vars(_measures(buffers, scene, 1, None)),
            jac_window=buffers.zeros(pairs, wp.vec4),
            window_rad=wp.clone(window_rad, requires_grad=False),
        )
    else:
        _measures(buffers, scene, 1, into)
        wp.copy(into.window_rad, window_rad)
    rows, columns = buffers.lanes
    derivative = buffers.kept("weighted derivative", (*pairs, 1, rows * columns), kernels.BoundaryDerivative)
    window_derivative = buffers.kept("window derivative", (*pairs, rows * columns), wp.vec4)
    buffers.launch_views(
        window.measure_window_kernel,
        (buffers.view_count, scene.object_count, rows * columns),
        inputs=[
            buffers.view, scene.triangles, buffers.layers, buffers.hiding, into.window_rad, softness_rad, kind,
            buffers.width, buffers.height, FIRST, rows, columns,
        ],
        outputs=[derivative, window_derivative],
    )  # fmt: skip
    _sum(buffers, scene, derivative, into, is_in_px=False)
    buffers.launch(window.sum_window_derivatives_kernel, pairs, inputs=[window_derivative], outputs=[into.jac_window])
    return into


def _measures(buffers: Buffers, scene: Scene, count: int, into: Measures | None) -> Measures:
    """Room for measures, or ``into`` if it has that, with the views of the render."""
    shape = (buffers.view_count, scene.object_count, count)
    if into is not None:
        if into.value.shape != shape:
            raise InputError(f"into: the measures to write over must be {shape}, got {into.value.shape}")
        wp.copy(into.position_world_m, buffers.position_world_m)
        wp.copy(into.camera_from_world, buffers.camera_from_world)
        wp.copy(into.log_focal, buffers.log_focal)
        return into
    return Measures(
        value=buffers.zeros(shape, float),
        jac_translation=buffers.zeros(shape, wp.vec3),
        jac_rotation=buffers.zeros(shape, wp.vec3),
        jac_log_focal=buffers.zeros(shape, float),
        position_world_m=wp.clone(buffers.position_world_m, requires_grad=False),
        camera_from_world=wp.clone(buffers.camera_from_world, requires_grad=False),
        log_focal=wp.clone(buffers.log_focal, requires_grad=False),
    )


def _sum(buffers: Buffers, scene: Scene, derivative: wp.array, result: Measures, *, is_in_px: bool = True) -> None:
    """Sum what the lanes have measured into the first measures of ``result``; ``is_in_px``: from samples."""
    derivative = buffers.grouped(derivative)
    buffers.launch(
        kernels.sum_derivatives_kernel,
        (buffers.view_count, scene.object_count, derivative.shape[2]),
        inputs=[buffers.view, derivative, buffers.supersampling if is_in_px else 1],
        outputs=[result.value, result.jac_translation, result.jac_rotation, result.jac_log_focal],
    )
