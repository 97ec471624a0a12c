"""Renderers: a fixed number of views whose buffers are used from render to render, or for a single frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from warpav.core.errors import InputError
from warpav.raster.buffers import Buffers, Content, RenderState
from warpav.raster.camera import CameraModel
from warpav.raster.cameras import Cameras
from warpav.raster.decide import Occlusion, decide
from warpav.raster.frame import Frame
from warpav.raster.poses import view_poses
from warpav.raster.scene import Scene
from warpav_kernels.raster import coverage, extent, hide, image_flow, layers, measure, rasterise, shade, view, window


class Renderer:
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
        """Buffers for the given views.

        Args:
            models: Camera model of every view; all of one image size.
            supersampling: Samples per pixel along each axis, at least 1.
            occlusion: What hides an object in `Frame.measure` and `Frame.visible_masks`.
            device: Warp device.
            thread_count: Threads over views on the CPU; None takes the number of cores, at most 8.
            foreground_layer: Whether `Frame.unblocked_area` will be asked for.

        Raises:
            InputError: No views, views of different sizes, supersampling that is no whole number from 1 on, or views of
                too many samples.
        """
        self._buffers = Buffers(
            models,
            supersampling=supersampling,
            device=device,
            thread_count=thread_count,
            has_foreground=foreground_layer,
        )
        self.occlusion = occlusion
        self._foreground_layer = foreground_layer
        # load before threads launch, so that no two of them compile the same module
        for module in (view, layers, rasterise, hide, coverage, measure, extent, window, shade, image_flow):
            wp.load_module(module, device=self.device)

    @property
    def device(self) -> wp.Device:
        """Where the buffers are."""
        return self._buffers.device

    @property
    def view_count(self) -> int:
        """Number of views."""
        return self._buffers.view_count

    @property
    def thread_count(self) -> int:
        """Threads over views on the CPU."""
        return self._buffers.thread_count

    @property
    def held_bytes(self) -> int:
        """Memory that its buffers hold on the device; they grow with what is rendered."""
        return self._buffers.held_bytes

    @property
    def generation(self) -> int:
        """Grows when arrays that recorded launches refer to have moved; such recordings are void."""
        return self._buffers.generation

    @property
    def is_recordable(self) -> bool:
        """Whether the launches of the last render can be recorded: not where the host had to look at zooms."""
        return self._buffers.is_recordable

    @property
    def state(self) -> RenderState | None:
        """What the last render has left in the buffers; None before the first.

        A replay of recorded launches sets again what was held when they were recorded, and frames of then are not
        stale any more.
        """
        return self._buffers.state

    @state.setter
    def state(self, state: RenderState | None) -> None:
        self._buffers.state = state

    def set_lenses(self, models: Sequence[CameraModel]) -> None:
        """Give every view another camera model of the same image size; the next `render` uses it.

        Raises:
            InputError: Another number of models, or of another size.
        """
        self._buffers.set_lenses(models)

    def render(
        self,
        scene: Scene,
        position_world_m: wp.array,
        camera_from_world: wp.array,
        *,
        log_focal: wp.array | None = None,
        content: Content = Content.ALL,
    ) -> Frame:
        """Decide which surface every sample sees, and what every object covers alone. Nothing is taped.

        Args:
            scene: The scene, on this renderer's device.
            position_world_m: Camera centres [m], vec3 [view].
            camera_from_world: Rotations from world to camera axes, mat33 [view].
            log_focal: Logarithm of each view's focal length over its lens's, float [view]; None: 0.
            content: What is wanted of the render.

        Raises:
            InputError: Not one pose for every view, a scene or poses on another device, or silhouettes that together do
                not fit into one buffer.
        """
        if not isinstance(scene, Scene):
            raise TypeError(f"scene: expected a raster.Scene, got {type(scene).__name__}")
        if scene.device != self.device:
            raise InputError(f"scene: expected one on {self.device}, the renderer's device, got one on {scene.device}")
        self._buffers.place_views(position_world_m, camera_from_world, log_focal)
        state = decide(self._buffers, scene, content, self.occlusion, foreground_layer=self._foreground_layer)
        self._buffers.state = state
        return Frame(self._buffers, state, has_foreground_layer=self._foreground_layer)

    @property
    def needed_samples(self) -> wp.array:
        """How many samples the renders since the last `grew` have needed at most, int64 [1], always the same array."""
        return self._buffers.needed_samples

    def grew(self, needed_samples: int | None = None) -> bool:
        """Whether a render since the last call needed more samples than there was room for, and had to leave some out.

        If so, there is room now, and the render has to be done again. Only recorded launches need this question.

        Args:
            needed_samples: The number in `needed_samples`, where it has been fetched already; None: it is fetched,
                which waits for the device.

        Raises:
            InputError: The silhouettes together do not fit into one buffer.
        """
        return self._buffers.grew(needed_samples)

    def kept_image(self, count: int) -> wp.array:
        """An array for ``into`` of `Frame.colours`, the same one at every call, vec3 [image, row, column]."""
        return self._buffers.kept("image", (count, self._buffers.height_px, self._buffers.width_px), wp.vec3)


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
        cameras.models,
        supersampling=samples,
        device=str(scene.device),
        foreground_layer=scene.foreground_layer >= 0,
    )
    return renderer.render(scene, poses.position_world_m, poses.camera_from_world, log_focal=poses.log_focal)
