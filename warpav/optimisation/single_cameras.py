"""Cameras each by itself: how likely each is to detect each object of a scene, for hundreds of cameras at once.

The numbers are those of `SceneOnTape.detection_probability` without a panorama, bit for bit on the CPU. No gradient is
taken, so no outline is measured, and only pixels that a probability depends on are rendered and get a colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from importlib.metadata import version
from queue import SimpleQueue
from typing import Any

import numpy as np
import warp as wp

from warpav.core.executor import available_cores
from warpav.core.fingerprint import digest, fingerprint
from warpav.core.warp_setup import load_warp
from warpav.optimisation.camera_jacobians import CameraJacobians
from warpav.optimisation.losses.scene_on_tape import CameraProbability
from warpav.optimisation.mount import MOUNT_POSE_SIZE, CameraMount
from warpav.raster.buffers import Content
from warpav.raster.chunks import chunk_view_count
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer
from warpav.scene.device_scene import DeviceScene

CPU_VIEWS = 16
"""Views that one thread renders at once."""
CUDA_STREAMS = 12
"""Scenes that a GPU renders beside each other for Jacobians: the few cameras of a rig do not fill it."""
CUDA_CHUNKS = 8
"""Chunks of `chunk_view_count` that a GPU renders at once: it fills with more views than a CPU's caches hold."""


@dataclass(frozen=True, eq=False)
class SingleCameras:
    """Cameras of one mount, none of which knows of the others.

    Attributes:
        mount: Where they stand, and their model.
        probability: How likely a camera is to detect.
        occlusion: What hides an object.
        supersampling: Samples per pixel along each axis, at least 1.
        thread_count: Threads on the CPU; None: as `Renderer` takes. The numbers do not depend on it.
    """

    mount: CameraMount
    probability: CameraProbability
    occlusion: Occlusion = Occlusion.EXACT
    supersampling: int = 1
    thread_count: int | None = None
    _renderers: dict[int, SimpleQueue[Renderer]] = field(default_factory=dict, init=False, repr=False)

    def __reduce__(self) -> tuple[Any, ...]:
        """As they travel to another process: without what is on a device."""
        mount = self.mount
        parts = (mount.surface, mount.camera, mount.height_offset_m, mount.device, mount.free)
        return _unpacked, (parts, self.probability, self.occlusion, self.supersampling, self.thread_count)

    @property
    def identity(self) -> dict[str, str]:
        """Hashes of all that the probabilities depend on, but for scenes and poses, by what it is.

        Of the vehicle the mount surface; its body is part of the scenes.
        """
        mount, model = self.mount, self.probability.model
        surface = mount.surface
        curves = [np.asarray(each, np.float64).tobytes() for each in (model.start, model.step, model.coefficient)]
        return {
            "vehicle": digest(
                surface.height_m.shape,
                surface.height_m.tobytes(),
                np.asarray(surface.origin_m, np.float64).tobytes(),
                float(surface.cell_m),
                float(mount.height_offset_m),
                *(part.tobytes() for part in (surface.zone_of_cell, surface.plane_m, surface.axes) if surface.zones),
            ),
            "camera": digest(mount.camera, self.supersampling, self.occlusion.value),
            "detector": digest(*curves, model.constant, self.probability.probability, *model.network_scale),
            "version": fingerprint(
                version("warp-lang"), wp.get_device(mount.device).is_cuda, code=("warpav.optimisation.single_cameras",)
            ),
        }

    def detection_probability(self, mount_pose: np.ndarray, scene: DeviceScene) -> np.ndarray:
        """The probability that each camera detects each object, float32 [camera, object].

        Args:
            mount_pose: As the mount counts them, float [camera, 7].
            scene: On the mount's device.

        Raises:
            InputError: The images or their supersampling are too large.
        """
        pose = np.ascontiguousarray(mount_pose, np.float32).reshape(-1, MOUNT_POSE_SIZE)
        found = np.zeros((len(pose), scene.vehicle_count), np.float32)
        if found.size == 0:
            return found
        chunk_count = -(-len(pose) // self._most_views)
        view_count = -(-len(pose) // chunk_count)  # chunks of about equal size
        firsts = range(0, len(pose), view_count)
        renderers = self._renderers_of(view_count)
        scene.upright_box  # noqa: B018 (found once, before threads ask for it)

        def draw(first: int) -> None:
            end = min(first + view_count, len(pose))
            # a last chunk that is not full is filled up with its last camera
            chunk = pose[np.minimum(np.arange(first, first + view_count), end - 1)]
            renderer = renderers.get()
            try:
                found[first:end] = self._drawn(chunk, scene, renderer)[: end - first]
            finally:
                renderers.put(renderer)

        if renderers.qsize() == 1 or len(firsts) == 1:
            for first in firsts:
                draw(first)
            return found
        with ThreadPoolExecutor(renderers.qsize()) as threads:
            list(threads.map(draw, firsts))
        return found

    def _drawn(self, mount_pose: np.ndarray, scene: DeviceScene, renderer: Renderer) -> np.ndarray:
        """What as many cameras as the renderer has views detect, float32 [camera, object]."""
        views = self.mount.place(wp.array(mount_pose, dtype=float, device=self.mount.device), 1)
        frame = renderer.render(
            scene.raster,
            views.position_ego_m,
            views.camera_from_ego,
            log_focal=views.log_zoom,
            content=Content.COVERAGE,
        )
        seen = self.probability.model.of_coverage(frame, scene, views.position_ego_m)
        return (self.probability.share_of_box(seen) or seen.probability).numpy()

    def with_jacobian(self, mount_pose: np.ndarray, scenes: Sequence[DeviceScene]) -> tuple[np.ndarray, np.ndarray]:
        """What each camera detects in some scenes, and how that changes as it moves.

        Colours and occlusion by more than outlines are held fixed, as in the loss; so the mean product of misses has
        the gradient that `ExpectedMissRate` gives on the tape.

        Args:
            mount_pose: As the mount counts them, float [camera, 7].
            scenes: On the mount's device; on the CPU one thread takes one of them at a time.

        Returns:
            The probabilities, float64 [camera, object], the objects scene by scene; their Jacobian to the mount poses,
            float64 [camera, object, 7].

        Raises:
            InputError: The images or their supersampling are too large.
        """
        return self._jacobians.of(mount_pose, scenes)

    @cached_property
    def _jacobians(self) -> CameraJacobians:
        is_cuda = wp.get_device(self.mount.device).is_cuda
        count = CUDA_STREAMS if is_cuda else self.thread_count or available_cores()
        return CameraJacobians(self.mount, self.probability, lambda views: self._renderers_for(views, count))

    @property
    def _most_views(self) -> int:
        """Views that are rendered at once: as many as the caches of a core hold, or as a GPU takes."""
        most = chunk_view_count(self.mount.camera, supersampling=self.supersampling)
        return CUDA_CHUNKS * most if wp.get_device(self.mount.device).is_cuda else min(most, CPU_VIEWS)

    def _renderers_of(self, view_count: int) -> SimpleQueue[Renderer]:
        """Renderers of so many views, one for each thread; the last ones that were asked for are kept."""
        if view_count not in self._renderers:
            self._renderers.clear()
            self._renderers[view_count] = renderers = SimpleQueue()
            is_cuda = wp.get_device(self.mount.device).is_cuda
            for renderer in self._renderers_for(view_count, 1 if is_cuda else self.thread_count or available_cores()):
                renderers.put(renderer)
        return self._renderers[view_count]

    def _renderers_for(self, view_count: int, count: int) -> list[Renderer]:
        """New renderers of so many views, which do not share launches over threads."""
        return [
            Renderer(
                [self.mount.camera] * view_count,
                supersampling=self.supersampling,
                occlusion=self.occlusion,
                device=self.mount.device,
                thread_count=1,
            )
            for _ in range(count)
        ]


def _unpacked(mount: tuple[Any, ...], *others: Any) -> SingleCameras:  # noqa: ANN401
    load_warp()  # before the mount asks for it, which would print what it loads
    surface, camera, height_offset_m, device, free = mount
    return SingleCameras(
        CameraMount(surface, camera=camera, height_offset_m=height_offset_m, device=device, free=free), *others
    )
