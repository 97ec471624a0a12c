"""Cameras each by itself: how likely each is to detect each object of a scene, for hundreds of cameras at once.

The numbers are those of `SceneOnTape.detection_probability` without a panorama, bit for bit on the CPU. No gradient is
taken, so no outline is measured, and only pixels that a probability depends on are rendered and get a colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from importlib.metadata import version
from queue import SimpleQueue
from typing import Any

import numpy as np
import warp as wp

from warpav.core.executor import available_cores
from warpav.core.fingerprint import digest, fingerprint
from warpav.core.warp_setup import load_warp
from warpav.detection.probability import Appearance, whole_solid_angle
from warpav.optimisation.losses.scene_on_tape import CameraProbability
from warpav.optimisation.mount import MOUNT_POSE_SIZE, CameraMount
from warpav.raster.buffers import Content
from warpav.raster.chunks import chunk_view_count
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer
from warpav.scene.device_scene import DeviceScene, UprightBoxes

CPU_VIEWS = 16
"""Views that one thread renders at once."""
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
            ),
            "camera": digest(mount.camera, self.supersampling, self.occlusion.value),
            "detector": digest(*curves, model.constant, self.probability.probability),
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
        pose = np.ascontiguousarray(mount_pose, np.float32).reshape(-1, MOUNT_POSE_SIZE)
        slope = _placing_slope(self.mount, pose)
        renderers = self._renderers_of(len(pose))
        views = self.mount.place(wp.array(pose, dtype=float, device=self.mount.device), 1)

        def drawn(scene: DeviceScene) -> _Shown:
            renderer = renderers.get()
            try:
                poses = views.position_ego_m, views.camera_from_ego
                frame = renderer.render(scene.raster, *poses, log_focal=views.log_zoom)
                return _Shown.of(Appearance.of(frame, scene))
            finally:
                renderers.put(renderer)

        peopled = [scene for scene in scenes if scene.vehicle_count > 0]
        if not peopled:
            return np.zeros((len(pose), 0)), np.zeros((len(pose), 0, MOUNT_POSE_SIZE))
        if renderers.qsize() == 1:
            shown = [drawn(scene) for scene in peopled]
        else:
            with ThreadPoolExecutor(renderers.qsize()) as threads:
                shown = list(threads.map(drawn, peopled))
        # Warp has one tape for all threads, so what needs one comes after them, for all scenes at once
        return self._differentiated(_Shown.together(shown), views.position_ego_m.numpy(), slope)

    def _differentiated(
        self, shown: _Shown, position_ego_m: np.ndarray, slope: _PlacingSlope
    ) -> tuple[np.ndarray, np.ndarray]:
        """Probabilities and Jacobian of what cameras at some places [camera, 3] are shown."""
        device = self.mount.device
        whole_sr, whole_slope = _whole_and_slope(position_ego_m, shown.box, device)
        # every probability is a function of its own pair's measures alone, so one backward pass gives all slopes
        values = (shown.measures["value"], shown.in_frame["value"], whole_sr)
        leaves = [wp.array(each, dtype=float, device=device, requires_grad=True) for each in values]
        with wp.Tape() as tape:
            seen = self.probability.model.of_measures(
                leaves[0],
                leaves[1],
                leaves[2],
                wp.array(shown.contrast, dtype=float, device=device),
                width_px=self.mount.camera.width_px,
                height_px=self.mount.camera.height_px,
            )
            found = self.probability.share_of_box(seen) or seen.probability
        tape.backward(grads={found: wp.ones_like(found)})
        by_measure, by_in_frame, by_whole = (_gradient_of(each) for each in leaves)

        def chained(name: str) -> np.ndarray:
            """The slope of the probability to what a Jacobian is taken to, [camera, object, ...]."""
            return np.einsum("vkm,vkm...->vk...", by_measure, shown.measures[name]) + np.einsum(
                "vkm,vkm...->vk...", by_in_frame, shown.in_frame[name]
            )

        by_position = chained("jac_translation") + by_whole[..., None] * whole_slope
        jacobian = (
            np.einsum("vki,vij->vkj", by_position, slope.position)
            + np.einsum("vki,vij->vkj", chained("jac_rotation"), slope.rotation)
            + chained("jac_log_focal")[..., None] * slope.log_zoom[:, None]
        )
        return found.numpy().astype(np.float64), jacobian

    @property
    def _most_views(self) -> int:
        """Views that are rendered at once: as many as the caches of a core hold, or as a GPU takes."""
        most = chunk_view_count(self.mount.camera, supersampling=self.supersampling)
        return CUDA_CHUNKS * most if wp.get_device(self.mount.device).is_cuda else min(most, CPU_VIEWS)

    def _renderers_of(self, view_count: int) -> SimpleQueue[Renderer]:
        """Renderers of so many views, one for each thread; the last ones that were asked for are kept."""
        if view_count not in self._renderers:
            self._renderers.clear()
            is_cuda = wp.get_device(self.mount.device).is_cuda
            self._renderers[view_count] = renderers = SimpleQueue()
            for _ in range(1 if is_cuda else self.thread_count or available_cores()):
                renderers.put(
                    Renderer(
                        [self.mount.camera] * view_count,
                        supersampling=self.supersampling,
                        occlusion=self.occlusion,
                        device=self.mount.device,
                        thread_count=1,
                    )
                )
        return self._renderers[view_count]


@dataclass(frozen=True, eq=False)
class _PlacingSlope:
    """How the views of cameras move with their mount poses, float64.

    Attributes:
        position: Of the centres [m], [camera, 3, 7].
        rotation: Of the small rotation about the camera's axes [rad], [camera, 3, 7].
        log_zoom: Of the log zoom, [camera, 7].
    """

    position: np.ndarray
    rotation: np.ndarray
    log_zoom: np.ndarray


def _placing_slope(mount: CameraMount, mount_pose: np.ndarray) -> _PlacingSlope:
    """The Jacobian of `CameraMount.place`, by one backward pass for each number of a view."""
    pose = wp.array(mount_pose, dtype=float, device=mount.device, requires_grad=True)
    with wp.Tape() as tape:
        views = mount.place(pose, 1)
    rows = []
    for array, size in ((views.position_ego_m, 3), (views.camera_from_ego, 9), (views.log_zoom, 1)):
        for number in range(size):
            seed = np.zeros((len(mount_pose), size), np.float32)
            seed[:, number] = 1.0
            shaped = seed.reshape(array.numpy().shape)
            tape.zero()
            tape.backward(grads={array: wp.array(shaped, dtype=array.dtype, device=mount.device)})
            rows.append(_gradient_of(pose))
    slope = np.stack(rows, axis=1)
    # with the vector s the rotation R becomes R + [s]x R
    turned = slope[:, 3:12].reshape(-1, 3, 3, MOUNT_POSE_SIZE)
    skew = np.einsum("vijn,vkj->vikn", turned, views.camera_from_ego.numpy().astype(np.float64))
    spin = 0.5 * np.stack(
        [skew[:, 2, 1] - skew[:, 1, 2], skew[:, 0, 2] - skew[:, 2, 0], skew[:, 1, 0] - skew[:, 0, 1]], axis=1
    )
    return _PlacingSlope(slope[:, :3], spin, slope[:, 12])


_MEASURED = ("value", "jac_translation", "jac_rotation", "jac_log_focal")


@dataclass(frozen=True, eq=False)
class _Shown:
    """What cameras are shown of the objects of one or more scenes, on the host; as `Appearance` has it.

    Attributes:
        measures: Measures and their Jacobians by name, float32 [camera, object, measure, ...].
        in_frame: Likewise of the solid angle in the image [sr].
        contrast: Of colours, float32 [camera, object].
        box: Centre, half size [m] and direction of every object's upright box, float32 [object, 3], [object, 3] and
            [object, 2].
    """

    measures: dict[str, np.ndarray]
    in_frame: dict[str, np.ndarray]
    contrast: np.ndarray
    box: tuple[np.ndarray, np.ndarray, np.ndarray]

    @classmethod
    def of(cls, appearance: Appearance) -> _Shown:
        count = appearance.contrast.shape[1]
        box = appearance.box
        return cls(
            {name: getattr(appearance.measures, name).numpy() for name in _MEASURED},
            {name: getattr(appearance.in_frame, name).numpy() for name in _MEASURED},
            appearance.contrast.numpy(),
            (box.centre_ego_m.numpy()[:count], box.half_size_m.numpy()[:count], box.along.numpy()[:count]),
        )

    @classmethod
    def together(cls, shown: Sequence[_Shown]) -> _Shown:
        """Those of several scenes, the objects scene by scene."""
        return cls(
            {name: np.concatenate([each.measures[name] for each in shown], axis=1) for name in _MEASURED},
            {name: np.concatenate([each.in_frame[name] for each in shown], axis=1) for name in _MEASURED},
            np.concatenate([each.contrast for each in shown], axis=1),
            (
                np.concatenate([each.box[0] for each in shown]),
                np.concatenate([each.box[1] for each in shown]),
                np.concatenate([each.box[2] for each in shown]),
            ),
        )


def _whole_and_slope(
    position_ego_m: np.ndarray, box: tuple[np.ndarray, np.ndarray, np.ndarray], device: str
) -> tuple[np.ndarray, np.ndarray]:
    """Solid angle of every object's box [sr], and how it changes with a camera's centre [sr/m].

    It depends on centre less place alone, so its gradient to the centre is that to the place with the other sign; and a
    centre has a gradient of its own for every object.

    Returns:
        float32 [camera, object] and float64 [camera, object, 3].
    """
    count = len(box[0])
    centre = wp.array(box[0], dtype=wp.vec3, device=device, requires_grad=True)
    boxes = UprightBoxes(
        centre, wp.array(box[1], dtype=wp.vec3, device=device), wp.array(box[2], dtype=wp.vec2, device=device)
    )
    whole_sr, slope = [], []
    for place_m in position_ego_m:
        place = wp.array(place_m[None], dtype=wp.vec3, device=device)
        with wp.Tape() as tape:
            found = whole_solid_angle(place, boxes, vehicle_count=count)
        tape.backward(grads={found: wp.ones_like(found)})
        whole_sr.append(found.numpy()[0])
        slope.append(-_gradient_of(centre))
        tape.zero()
    return np.array(whole_sr), np.array(slope)


def _gradient_of(array: wp.array) -> np.ndarray:
    assert array.grad is not None
    return array.grad.numpy().astype(np.float64)


def _unpacked(mount: tuple[Any, ...], *others: Any) -> SingleCameras:  # noqa: ANN401
    load_warp()  # before the mount asks for it, which would print what it loads
    surface, camera, height_offset_m, device, free = mount
    return SingleCameras(
        CameraMount(surface, camera=camera, height_offset_m=height_offset_m, device=device, free=free), *others
    )
