"""Poses of views as users have them, and as kernels take them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpav.core.errors import InputError
from warpav_kernels.raster import linearise

_RIGID_TOLERANCE = 1e-3  # a rotation times its transpose may differ from the identity by so much


class ViewPoses(NamedTuple):
    """Poses of views, and their focal lengths, as the kernels take them; on one device."""

    position_world_m: wp.array  # camera centres [m], vec3 [view]
    camera_from_world: wp.array  # rotations from world axes to camera axes, mat33 [view]
    log_focal: wp.array | None = None  # logarithms of the focal lengths over the cameras', float [view]; None: 0


def view_poses(
    camera_from_world: Any,  # noqa: ANN401 (NumPy, Warp, or anything with DLPack)
    view_count: int,
    device: wp.Device,
    *,
    log_focal: wp.array | np.ndarray | None = None,
) -> ViewPoses:
    """Poses from matrices [view, 4, 4]; on the active tape, if there is one. Gradients flow to Warp arrays only."""
    if isinstance(camera_from_world, ViewPoses):
        if log_focal is None:
            return camera_from_world
        return camera_from_world._replace(log_focal=_focals(log_focal, view_count, device))
    matrix = _matrices(camera_from_world, view_count, device)
    if not device.is_capturing:
        check_rigid(matrix.numpy())
    requires_grad = matrix.requires_grad
    position, rotation = (
        wp.empty(view_count, dtype=dtype, device=device, requires_grad=requires_grad)  # pyright: ignore[reportArgumentType]
        for dtype in (wp.vec3, wp.mat33)
    )
    wp.launch(linearise.split_pose_kernel, dim=view_count, inputs=[matrix], outputs=[position, rotation], device=device)
    return ViewPoses(position, rotation, _focals(log_focal, view_count, device))


def _matrices(given: Any, view_count: int, device: wp.Device) -> wp.array:  # noqa: ANN401 (anything)
    """The matrices as mat44 [view] on the device."""
    name = "camera_from_world"
    if not isinstance(given, wp.array):
        if getattr(given, "requires_grad", False):
            raise InputError(
                f"{name}: expected an array without a gradient of another library, got {type(given).__name__}; "
                "warpav.raster.torch has functions with gradients for PyTorch"
            )
        if hasattr(given, "__dlpack__") and not isinstance(given, np.ndarray):
            given = wp.from_dlpack(given)
        else:
            try:
                array = np.asarray(given, np.float32)
            except (TypeError, ValueError) as error:
                raise TypeError(f"{name}: expected numbers [{view_count}, 4, 4], got {type(given).__name__}") from error
            given = wp.array(array, dtype=float, device=device) if array.shape == (view_count, 4, 4) else array
    is_matrix = isinstance(given, wp.array) and given.dtype is wp.mat44
    wanted = (view_count,) if is_matrix else (view_count, 4, 4)
    if tuple(given.shape) != wanted:
        shape = [*given.shape, *((4, 4) if is_matrix else ())]
        raise InputError(f"{name}: expected one pose for each view, [{view_count}, 4, 4], got {shape}")
    if given.device != device:
        raise InputError(f"{name}: expected an array on {device}, where the scene is, got one on {given.device}")
    if is_matrix:
        return given
    if given.dtype is wp.float64:
        given = wp.array(given.numpy().astype(np.float32), dtype=float, device=device)
    if given.dtype is not wp.float32:
        raise TypeError(f"{name}: expected floats, got {given.dtype.__name__}")
    return _as_matrices(given.contiguous())


def _as_matrices(given: wp.array) -> wp.array:
    """The same memory as mat44 [view], gradient included."""
    gradient = None if given.grad is None else _as_matrices(given.grad)
    result = wp.array(ptr=given.ptr, dtype=wp.mat44, shape=given.shape[0], device=given.device, grad=gradient)
    result._ref = given  # keeps the memory
    return result


def check_rigid(matrix: np.ndarray) -> None:
    """Raise `InputError` for poses [view, 4, 4] that are not finite, or no rotation and translation."""
    bad = ~np.isfinite(matrix).all(axis=(1, 2))
    if bad.any():
        raise InputError(f"camera_from_world: expected finite numbers, got NaN or infinity in view {np.argmax(bad)}")
    rotation = matrix[:, :3, :3].astype(np.float64)
    off = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = (off > _RIGID_TOLERANCE) | (np.linalg.det(rotation) < 0.0)
    bad |= np.abs(matrix[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1) > _RIGID_TOLERANCE
    if bad.any():
        v = int(np.argmax(bad))
        raise InputError(
            "camera_from_world: expected rotations and translations, which map world to camera coordinates, got "
            f"{np.round(matrix[v], 4).tolist()} in view {v}"
        )


def _focals(log_focal: wp.array | np.ndarray | None, view_count: int, device: wp.Device) -> wp.array | None:
    if log_focal is None:
        return None
    if not isinstance(log_focal, wp.array):
        log_focal = wp.array(np.asarray(log_focal, np.float32), dtype=float, device=device)
    if log_focal.shape != (view_count,) or log_focal.device != device:
        raise InputError(
            f"log_focal: expected one number for each of {view_count} views on {device}, got "
            f"{list(log_focal.shape)} on {log_focal.device}"
        )
    return log_focal
