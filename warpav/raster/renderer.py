"""Renderers: a fixed number of views whose buffers are used from render to render, or for a single frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from warpav.core.errors import InputError
from warpav.raster.buffers import Buffers, Content
from warpav.raster.camera import CameraModel, Cameras
from warpav.raster.decide import Occlusion, decide
from warpav.raster.frame import Frame
from warpav.raster.poses import view_poses
from warpav.raster.scene import Scene
from warpav_kernels import raster as kernels
from warpav_kernels.raster import coverage, extent, hide, window


class Renderer(Buffers):
    """Renders a fixed number of views of equal size, one scene at a time, into buffers that it owns.

    `render` returns a `Frame`, which reads these buffers and is stale after the next `render`.
    """

    def __init__(
        self,
        models: Sequence[CameraModel],
        *,
        supersampling: int = 1,
        occlusion: Occlusion = Occlusion.EXACT,
        device: str = "cpu",
        thread_count: int | None = None,
        foreground_layer: bool = False,
    ) -> None:
        """Buffers for the given views; kernels are loaded before threads launch, so that no two compile the same."""
        super().__init__(
            models,
            supersampling=supersampling,
            device=device,
            thread_count=thread_count,
            has_foreground=foreground_layer,
        )
        self.occlusion = occlusion
        drawing = (kernels.place_views_kernel, kernels.place_layers_kernel, kernels.scatter_triangles_kernel)
        for kernel in (*drawing, kernels.measure_areas_kernel, kernels.resolve_depth_kernel):
            wp.load_module(kernel.module, device=self.device)  # pyright: ignore[reportFunctionMemberAccess]
        for module in (hide, coverage, extent, window):
            wp.load_module(module, device=self.device)

    def render(
        self,
        scene: Scene,
        position_world_m: wp.array,
        camera_from_world: wp.array,
        *,
        log_focal: wp.array | None = None,
        content: Content = Content.ALL,
    ) -> Frame:
        """Decide which surface every sample sees, and what every object covers alone. Nothing is taped."""
        if not isinstance(scene, Scene):
            raise TypeError(f"scene: expected a raster.Scene, got {type(scene).__name__}")
        if scene.device != self.device:
            raise InputError(f"scene: expected one on {self.device}, the renderer's device, got one on {scene.device}")
        self.place_views(position_world_m, camera_from_world, log_focal)
        self.state = decide(self, scene, content, self.occlusion)
        return Frame(self, self.state)

    def kept_image(self, count: int) -> wp.array:
        """An array for ``into`` of `Frame.colours`, the same one at every call, vec3 [image, row, column]."""
        return self.kept("image", (count, self.height_px, self.width_px), wp.vec3)


def render(
    scene: Scene,
    cameras: Cameras,
    camera_from_world: Any,  # noqa: ANN401 (NumPy, Warp, or anything with DLPack)
    samples: int = 1,
    *,
    log_focal: wp.array | np.ndarray | None = None,
) -> Frame:
    """Render a scene through some cameras into a frame that owns its buffers. Nothing is taped.

    Args:
        scene: The scene; the render happens on its device.
        cameras: One camera for each view.
        camera_from_world: Poses [view, 4, 4]: rigid transformations from world coordinates [m] to camera coordinates (x
            right, y down, z forward). NumPy, Warp on the scene's device, or anything with DLPack.
        samples: Samples per pixel along each axis, at least 1.
        log_focal: Logarithms of the focal lengths over the cameras', float [view]; None: 0.

    Raises:
        InputError: Not one pose for each camera, poses that are not rigid or not finite, or on another device.
        TypeError: Something else than a scene and cameras.
    """
    for name, value, kind in (("scene", scene, Scene), ("cameras", cameras, Cameras)):
        if not isinstance(value, kind):
            raise TypeError(f"{name}: expected a raster.{kind.__name__}, got {type(value).__name__}")
    poses = view_poses(camera_from_world, len(cameras), scene.device, log_focal=log_focal)
    renderer = Renderer(
        cameras.models, supersampling=samples, device=str(scene.device), foreground_layer=scene.foreground_layer >= 0
    )
    return renderer.render(scene, poses.position_world_m, poses.camera_from_world, log_focal=poses.log_focal)
