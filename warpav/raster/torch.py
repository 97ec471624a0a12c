"""The rasteriser for PyTorch: areas and images as differentiable functions of poses and focal lengths.

Needs the extra ``torch``. Every function renders once and keeps that frame for its backward pass; its gradients are
those of `warpav.raster.Frame`. A pose is a tensor of floats on the scene's device:

- [view, 4, 4]: ``camera_from_world``, a rotation and a translation [m];
- [view, 6]: a rotation vector [rad] and a translation [m], ``camera_from_world = (exp [r]x, t)``.

``log_focal`` [view] is the logarithm of the focal lengths over the cameras'. There are no second derivatives.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import warp as wp

try:
    import torch
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("warpav.raster.torch needs PyTorch: pip install 'warpav[torch]'", name="torch") from error

from warpav.core.errors import InputError
from warpav.raster.camera import Cameras
from warpav.raster.frame import Frame
from warpav.raster.poses import ViewPoses, check_rigid
from warpav.raster.renderer import render
from warpav.raster.scene import Scene

_Draw = Callable[[Frame, ViewPoses], wp.array]


def visible_area(
    scene: Scene, cameras: Cameras, pose: torch.Tensor, *, log_focal: torch.Tensor | None = None, samples: int = 1
) -> torch.Tensor:
    """Area of every object that nothing hides [px^2], [view, object].

    Args:
        scene: The scene.
        cameras: One camera for each view.
        pose: Poses, see the module.
        log_focal: Focal lengths, see the module; None: the cameras'.
        samples: Samples per pixel along each axis.

    Raises:
        InputError: Poses of another shape or device, or that are not finite or not rigid.
        TypeError: Something else than a tensor of floats.
    """
    return _rendered(scene, cameras, pose, log_focal, samples, lambda frame, poses: frame.areas(poses).visible)


def amodal_area(
    scene: Scene, cameras: Cameras, pose: torch.Tensor, *, log_focal: torch.Tensor | None = None, samples: int = 1
) -> torch.Tensor:
    """Area of every object as if it stood alone [px^2], [view, object]; arguments as `visible_area`."""
    return _rendered(scene, cameras, pose, log_focal, samples, lambda frame, poses: frame.areas(poses).amodal)


def silhouette(
    scene: Scene,
    cameras: Cameras,
    pose: torch.Tensor,
    *,
    log_focal: torch.Tensor | None = None,
    samples: int = 1,
    visible: bool = True,
) -> torch.Tensor:
    """Share of every pixel that each object covers, 0..1, [view, object, row, column].

    Args are those of `visible_area`; ``visible`` False shows each object as if it stood alone.
    """
    return _rendered(
        scene, cameras, pose, log_focal, samples, lambda frame, poses: frame.silhouettes(poses, visible=visible)
    )


def depth(
    scene: Scene,
    cameras: Cameras,
    pose: torch.Tensor,
    *,
    background_m: float,
    log_focal: torch.Tensor | None = None,
    samples: int = 1,
) -> torch.Tensor:
    """Depth images [m], [view, row, column]; ``background_m`` where nothing is hit. Others as `visible_area`."""
    return _rendered(
        scene, cameras, pose, log_focal, samples, lambda frame, poses: frame.depths(poses, background_m=background_m)
    )


def rgb(
    scene: Scene, cameras: Cameras, pose: torch.Tensor, *, log_focal: torch.Tensor | None = None, samples: int = 1
) -> torch.Tensor:
    """Colour images 0..1, [view, row, column, 3]; arguments as `visible_area`."""
    return _rendered(scene, cameras, pose, log_focal, samples, lambda frame, poses: frame.colours(poses))


def _rendered(
    scene: Scene, cameras: Cameras, pose: torch.Tensor, log_focal: torch.Tensor | None, samples: int, draw: _Draw
) -> torch.Tensor:
    for name, value, kind in (("scene", scene, Scene), ("cameras", cameras, Cameras)):
        if not isinstance(value, kind):
            raise TypeError(f"{name}: expected a raster.{kind.__name__}, got {type(value).__name__}")
    count = len(cameras)
    _check("pose", pose, scene, ((count, 4, 4), (count, 6)))
    if log_focal is None:
        log_focal = torch.zeros(count, dtype=pose.dtype, device=pose.device)
    _check("log_focal", log_focal, scene, ((count,),))
    rotation, translation = _rotation_and_translation(pose)
    position = -(rotation.transpose(1, 2) @ translation[:, :, None])[:, :, 0]
    return _Rendered.apply(position, rotation, log_focal, scene, cameras, samples, draw)  # pyright: ignore[reportReturnType]


def _check(name: str, value: Any, scene: Scene, shapes: tuple[tuple[int, ...], ...]) -> None:  # noqa: ANN401 (anything)
    if not isinstance(value, torch.Tensor) or not value.is_floating_point():
        what = value.dtype if isinstance(value, torch.Tensor) else type(value).__name__
        raise TypeError(f"{name}: expected a tensor of floats, got {what}")
    if tuple(value.shape) not in shapes:
        wanted = " or ".join(str(list(shape)) for shape in shapes)
        raise InputError(f"{name}: expected {wanted}, one for each camera, got {list(value.shape)}")
    if value.device != torch.device(wp.device_to_torch(scene.device)):
        raise InputError(f"{name}: expected a tensor on {scene.device}, where the scene is, got one on {value.device}")
    if not torch.isfinite(value).all():
        raise InputError(f"{name}: expected finite numbers, got NaN or infinity")


def _rotation_and_translation(pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    if pose.ndim == 3:
        check_rigid(pose.detach().cpu().numpy())
        return pose[:, :3, :3], pose[:, :3, 3]
    x, y, z = pose[:, :3].unbind(dim=1)
    zero = torch.zeros_like(x)
    spin = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
    return torch.linalg.matrix_exp(spin), pose[:, 3:]


class _Rendered(torch.autograd.Function):
    """What ``draw`` makes of a render, on a Warp tape of its own."""

    @staticmethod
    def forward(ctx: Any, position: torch.Tensor, rotation: torch.Tensor, log_focal: torch.Tensor, *args: Any) -> Any:  # noqa: ANN401
        scene, cameras, samples, draw = args
        with _stream(position):
            ctx.poses = ViewPoses(
                wp.from_torch(position.detach().float().contiguous(), dtype=wp.vec3, requires_grad=True),
                wp.from_torch(rotation.detach().float().contiguous(), dtype=wp.mat33, requires_grad=True),
                wp.from_torch(log_focal.detach().float().contiguous(), dtype=wp.float32, requires_grad=True),
            )
            frame = render(scene, cameras, ctx.poses, samples)
            ctx.tape = wp.Tape()
            with ctx.tape:
                ctx.result = draw(frame, ctx.poses)
            return wp.to_torch(ctx.result, requires_grad=False).to(position.dtype, copy=True)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Any) -> Any:  # noqa: ANN401  # pyright: ignore[reportIncompatibleMethodOverride]
        (gradient,) = gradients
        with _stream(gradient):
            ctx.tape.zero()
            given = wp.from_torch(gradient.detach().float().contiguous(), dtype=ctx.result.dtype, requires_grad=False)
            ctx.tape.backward(grads={ctx.result: given})
            found = [wp.to_torch(array.grad, requires_grad=False).to(gradient.dtype, copy=True) for array in ctx.poses]
        return *found, None, None, None, None


def _stream(tensor: torch.Tensor) -> contextlib.AbstractContextManager:
    """Where PyTorch runs what comes before and after."""
    if not tensor.is_cuda:
        return contextlib.nullcontext()
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(tensor.device)))
