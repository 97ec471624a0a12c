"""Cameras each by itself: how likely each is to detect each object of a scene, for hundreds of cameras at once.

The numbers are those of `SceneOnTape.detection_probability` without a panorama, bit for bit on the CPU. No gradient is
taken, so no outline is measured, and only pixels that a probability depends on are rendered and get a colour.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from importlib.metadata import version
from typing import Any

import numpy as np
import warp as wp

from warpav.core.cache import digest, fingerprint
from warpav.core.cores import available_cores, gpu_share
from warpav.core.warp_setup import load_warp
from warpav.detection import Fusion, LidarProbability
from warpav.optimisation._camera_jacobians import CameraJacobians, LidarJacobians, placing_slope
from warpav.optimisation._mount import HEIGHT_DELTA_M, LOG_ZOOM, MIRROR, MOUNT_POSE_SIZE, CameraMount
from warpav.optimisation._mount_errors import MountErrors, outside_skin
from warpav.optimisation._required_points import RequiredPoints
from warpav.optimisation._tangent_model import HardPoints, Margins
from warpav.optimisation.losses._scene_on_tape import CameraProbability, ObjectProbability
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.chunks import (
    KEPT_BYTES,
    MAX_CHUNK_VIEWS,
    KeptRenderers,
    ViewsAtOnce,
    beside_each_other,
    chunk_view_count,
    equal_chunks,
    gpu_view_count,
)
from warpav.raster.decide import Occlusion
from warpav.raster.pane import Pane
from warpav.raster.renderer import Renderer
from warpav.raster.scene import Scene as RasterScene
from warpav.scene import DeviceScene
from warpav.sight import Visibility

_CPU_VIEWS = 16  # views that one thread renders at once, at most
_CPU_KEY_BYTES = 2**26
"""Of the views that one thread renders at once: one of 8 MP, four of 1920 x 1080 pixels, all of smaller ones."""
_OUTLINED = 8
"""How much more a view with outlines of all objects takes, as of a LiDAR: more views at once outgrow `KEPT_BYTES`."""
_CUDA_STREAMS = 12
"""Scenes that a GPU renders beside each other for Jacobians, of all who share it: few cameras do not fill it."""
_CUDA_CHUNKS = 8
"""Chunks of `chunk_view_count` that a GPU renders at once, for all who share it; they fill it as no CPU's cache."""


_Kind = tuple[int, Pane | None]
"""Which of the mount's models a camera has, and what of the own vehicle it looks through."""


@dataclass(frozen=True, eq=False)
class SingleCameras:
    """Cameras of one mount, none of which knows of the others."""

    mount: CameraMount  # where they stand, and their models
    probability: ObjectProbability | tuple[ObjectProbability, ...]  # how likely a camera is to detect
    occlusion: Occlusion = Occlusion.EXACT  # what hides an object
    supersampling: int = 1  # samples per pixel along each axis, at least 1
    thread_count: int | None = None  # threads on the CPU; None: as `Renderer` takes. The numbers do not depend on it
    is_mirrored: bool = False  # whether they are the mirror images of a symmetric mount's cameras
    is_fused: bool = False  # whether objects of scenes have the three columns of `Fusion`
    _kept_jacobians: dict[_Kind, CameraJacobians | LidarJacobians] = field(default_factory=dict, init=False, repr=False)
    _renderers: KeptRenderers = field(default_factory=KeptRenderers, kw_only=True, repr=False)
    _at_once: dict[int, ViewsAtOnce] = field(default_factory=dict, init=False, repr=False)

    @property
    def probabilities(self) -> tuple[ObjectProbability, ...]:
        """How likely a camera of each of the mount's models is to detect."""
        return self.probability if isinstance(self.probability, tuple) else (self.probability,)

    def __reduce__(self) -> tuple[Any, ...]:
        """As they travel to another process: without what is on a device."""
        mount = self.mount
        parts = (
            mount.surface,
            mount.cameras if mount.is_mixed else mount.camera,
            mount.height_offset_m,
            mount.device,
            mount.free,
        )
        others = (self.occlusion, self.supersampling, self.thread_count, self.is_mirrored, self.is_fused)
        return _unpacked, (parts, self.probability, *others)

    @property
    def identity(self) -> dict[str, str]:
        """Hashes of all that the probabilities depend on but scenes (with the body) and poses, by what it is."""
        mount, surface = self.mount, self.mount.surface
        cameras = mount.cameras if mount.is_mixed else (mount.camera,)
        detectors: list[object] = []
        for each in self.probabilities:
            detectors += each.identity
        modules = (surface.module_of_zone.tobytes(),) if mount.is_mixed else ()
        modules += (surface.pairs,) if mount.is_symmetric else ()
        modules += (surface.panes,) if any(surface.panes) else ()
        return {
            "vehicle": digest(
                surface.height_m.shape,
                surface.height_m.tobytes(),
                np.asarray(surface.origin_m, np.float64).tobytes(),
                float(surface.cell_m),
                float(mount.height_offset_m),
                *(part.tobytes() for part in (surface.zone_of_cell, surface.plane_m, surface.axes) if surface.zones),
                *modules,
            ),
            "camera": digest(*cameras, self.supersampling, self.occlusion.value),
            "detector": digest(*detectors, *["fused"] * self.is_fused),
            "version": fingerprint(
                version("warp-lang"), wp.get_device(mount.device).is_cuda, code=("warpav.optimisation._single_cameras",)
            ),
        }

    def detection_probability(self, mount_pose: np.ndarray, scene: DeviceScene | RequiredPoints) -> np.ndarray:
        """The probability that each camera detects each object, float32 [camera, object], fused as columns of it."""
        pose = np.ascontiguousarray(mount_pose, np.float32).reshape(-1, MOUNT_POSE_SIZE)
        found = np.zeros((len(pose), self.column_count(scene)), np.float32)
        if found.size == 0:
            return found
        found[:] = self._columns(self._alone(pose, scene), pose, [scene])
        pair = np.flatnonzero(self.mount.is_pair(pose)) if self._finds_pairs else ()
        if len(pair):
            image = self._mirrored.detection_probability(pose[pair] * MIRROR, scene)
            found[pair] = 1.0 - (1.0 - found[pair]) * (1.0 - image)
        return found

    def column_count(self, scene: DeviceScene | RequiredPoints) -> int:
        """Columns that the objects of a scene have."""
        return scene.vehicle_count * (3 if self.is_fused and isinstance(scene, DeviceScene) else 1)

    def triples(self, scenes: Sequence[DeviceScene | RequiredPoints]) -> np.ndarray | None:
        """As of `Fusion`, of scenes, behind which requirements may stand; None: objects have one column each."""
        counts = [scene.vehicle_count for scene in scenes if isinstance(scene, DeviceScene)]
        return Fusion.triples(counts) if self.is_fused else None

    def _columns(
        self, found: np.ndarray, pose: np.ndarray, scenes: Sequence[DeviceScene | RequiredPoints]
    ) -> np.ndarray:
        """What cameras [camera, 7] find in scenes, or its slopes, [camera, object, ...], in their columns."""
        if not self.is_fused:
            return found
        is_lidar = np.array([model.beams is not None for model in self.mount.cameras])[self.mount.module_of(pose)]
        counts = [scene.vehicle_count for scene in scenes if isinstance(scene, DeviceScene)]
        fused = Fusion.columns(found[:, : sum(counts)], is_lidar, counts)
        return np.concatenate([fused, found[:, sum(counts) :]], axis=1)

    def _alone(self, pose: np.ndarray, scene: DeviceScene | RequiredPoints) -> np.ndarray:
        """`detection_probability` of cameras, float32 [camera, 7], of pairs without their mirror images."""
        found = np.zeros((len(pose), scene.vehicle_count), np.float32)
        if isinstance(scene, RequiredPoints):
            for pane, row in self._by_pane(pose):
                found[row] = scene.through(pane).probability(*self.in_ego(pose[row]))
        else:
            for kind, row in self._by_kind(pose):
                found[row] = self._detected(kind, pose[row], scene)
        return found

    def visibility(self, mount_pose: np.ndarray, ghosts: RequiredPoints) -> Visibility:
        """What each camera sees of each point of requirements, of a pair the camera that is not mirrored."""
        share, pixels = np.zeros((2, len(mount_pose), ghosts.vehicle_count))
        for pane, row in self._by_pane(mount_pose):
            seen = ghosts.through(pane).visibility(*self.in_ego(mount_pose[row]))
            share[row], pixels[row] = seen.visible_share, seen.pixels
        return Visibility(share, pixels)

    @property
    def _finds_pairs(self) -> bool:
        """Whether cameras stand for themselves and their mirror images: not on the mirrored side."""
        return self.mount.is_symmetric and not self.is_mirrored

    @cached_property
    def sides(self) -> tuple[SingleCameras, ...]:
        """Those of the vehicle's left side and its middle, and of a symmetric mount their mirror images, all single."""
        if not self._finds_pairs:
            return (self,)
        return replace(self, is_mirrored=True), self._mirrored

    def apart(self, mount_pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The cameras of a rig one by one: mount poses [camera, 7], and the one of `sides` that each belongs to."""
        row = self.mount.rows_of_cameras(mount_pose)
        side = np.append(False, row[1:] == row[:-1]).astype(int)
        return np.where(side[:, None] == 1, mount_pose[row] * MIRROR, mount_pose[row]), side

    @cached_property
    def _mirrored(self) -> SingleCameras:
        """The same on the other side of the vehicle."""
        return replace(self, mount=self.mount.mirrored, is_mirrored=True)

    def _by_kind(self, mount_pose: np.ndarray) -> Iterator[tuple[_Kind, np.ndarray]]:
        """The cameras of each kind, and their rows, int [camera of the kind]."""
        if not self.mount.sees_apart:
            yield (0, None), np.arange(len(mount_pose))
            return
        module_of = self.mount.module_of(mount_pose)
        for pane, of_pane in self._by_pane(mount_pose):
            for module in np.unique(module_of[of_pane]):
                yield (int(module), pane), of_pane[module_of[of_pane] == module]

    def _by_pane(self, mount_pose: np.ndarray) -> Iterator[tuple[Pane | None, np.ndarray]]:
        """The cameras that look through each pane, and their rows, int [camera of the pane]."""
        panes = self.mount.panes_of(mount_pose)
        for pane in dict.fromkeys(panes):
            yield pane, np.array([row for row, each in enumerate(panes) if each == pane])

    def _detected(self, kind: _Kind, pose: np.ndarray, scene: DeviceScene) -> np.ndarray:
        """The probability that cameras of one kind detect each object, float32 [camera, object]."""
        if kind[0] not in self._at_once:  # memory is looked at when it is needed first
            self._at_once[kind[0]] = ViewsAtOnce(self._most_views(kind[0]))
        return self._at_once[kind[0]].run(
            lambda most: self._detected_at_once(kind, pose, scene, most), release=self._renderers.clear
        )

    def _detected_at_once(self, kind: _Kind, pose: np.ndarray, scene: DeviceScene, most: int) -> np.ndarray:
        """`_detected`, at most so many cameras at once."""
        module, pane = kind
        found = np.zeros((len(pose), scene.vehicle_count), np.float32)
        chunks = equal_chunks(len(pose), most)
        renderers = self._maker(module).kept(self._renderers, len(chunks[0]))
        scene.upright_box  # noqa: B018 (found once, before threads ask for it)
        raster = scene.raster.through(pane)  # held, and made once

        def draw(chunk: np.ndarray, renderer: Renderer) -> None:
            found[chunk] = self._drawn(module, pose[chunk], scene, raster, renderer)

        beside_each_other(draw, chunks, renderers)
        return found

    def _drawn(
        self, module: int, mount_pose: np.ndarray, scene: DeviceScene, raster: RasterScene, renderer: Renderer
    ) -> np.ndarray:
        """What as many cameras of one kind as the renderer has views detect, float32 [camera, object]."""
        views = self.mount.place(wp.array(mount_pose, dtype=float, device=self.mount.device), 1)
        content, probability = Content.COVERAGE, self.probabilities[module]
        if isinstance(probability, LidarProbability):
            content = Content.IMAGES if self.occlusion is Occlusion.EXACT else probability.content
        pose = views.position_ego_m, views.camera_from_ego
        frame = renderer.render(raster, *pose, log_focal=views.log_zoom, content=content)
        return probability.detected(frame, scene, *pose).numpy()

    def in_ego(self, pose: np.ndarray) -> tuple[np.ndarray, list[CameraModel]]:
        """Poses of cameras in the ego frame, float64 [camera, 4, 4], and their models."""
        views = self.mount.place(wp.array(pose, dtype=float, device=self.mount.device), 1)
        ego_from_camera = np.tile(np.eye(4), (len(pose), 1, 1))
        ego_from_camera[:, :3, :3] = views.camera_from_ego.numpy().transpose(0, 2, 1)
        ego_from_camera[:, :3, 3] = views.position_ego_m.numpy()
        models = [self.mount.cameras[module] for module in self.mount.module_of(pose)]
        return ego_from_camera, [model.zoomed(float(row[LOG_ZOOM])) for model, row in zip(models, pose, strict=True)]

    def with_jacobian(
        self, mount_pose: np.ndarray, scenes: Sequence[DeviceScene | RequiredPoints]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Probabilities, float64 [camera, object], and their Jacobian to the mount poses [camera, object, 7], or fused.

        Colours and occlusion by more than outlines are held fixed, as in the loss; so the mean product of misses has
        the gradient that `ExpectedMissRate` gives on the tape.
        """
        pose = np.ascontiguousarray(mount_pose, np.float32).reshape(-1, MOUNT_POSE_SIZE)
        probability, jacobian = (self._columns(each, pose, scenes) for each in self._alone_with_jacobian(pose, scenes))
        pair = np.flatnonzero(self.mount.is_pair(pose)) if self._finds_pairs else ()
        if len(pair):
            image, slope_of_image = self._mirrored.with_jacobian(pose[pair] * MIRROR, scenes)
            own = (1.0 - image)[..., None] * jacobian[pair]
            jacobian[pair] = own + (1.0 - probability[pair])[..., None] * slope_of_image * MIRROR
            probability[pair] = 1.0 - (1.0 - probability[pair]) * (1.0 - image)
        return probability, jacobian

    def _alone_with_jacobian(
        self, pose: np.ndarray, scenes: Sequence[DeviceScene | RequiredPoints]
    ) -> tuple[np.ndarray, np.ndarray]:
        """`with_jacobian` of cameras, float32 [camera, 7], of pairs without their mirror images."""
        traffic = [scene for scene in scenes if isinstance(scene, DeviceScene)]
        if len(traffic) == len(scenes) and not self.mount.sees_apart:
            return self._jacobians((0, None)).of(pose, traffic)
        count = sum(scene.vehicle_count for scene in traffic)
        probability, jacobian = np.zeros((len(pose), count)), np.zeros((len(pose), count, MOUNT_POSE_SIZE))
        for kind, row in self._by_kind(pose):
            probability[row], jacobian[row] = self._jacobians(kind).of(pose[row], traffic)
        for ghosts in scenes[len(traffic) :]:
            assert isinstance(ghosts, RequiredPoints), "requirements stand behind all scenes"
            seen, by_pose = self.differentiated(ghosts, pose, RequiredPoints.with_jacobian)
            probability = np.concatenate([probability, seen], axis=1)
            jacobian = np.concatenate([jacobian, by_pose], axis=1)
        return probability, jacobian

    def differentiated(self, ghosts: RequiredPoints, pose: np.ndarray, seen: Callable[..., Margins]) -> Margins:
        """What cameras see of requirements, [camera, point], by a method of these, and its Jacobian to the poses."""
        parts = [(row, *seen(ghosts.through(pane), *self.in_ego(pose[row]))) for pane, row in self._by_pane(pose)]
        row, value, by_view = (np.concatenate(each) for each in zip(*parts, strict=True))
        order = np.argsort(row)
        return value[order], placing_slope(self.mount, pose).chained(by_view[order])

    def _jacobians(self, kind: _Kind) -> CameraJacobians | LidarJacobians:
        """Probabilities and Jacobians of cameras of one kind; kept for the next call."""
        module, pane = kind
        probability = self.probabilities[module]
        if kind not in self._kept_jacobians and isinstance(probability, LidarProbability):
            most, renderers = self._most_views(module), partial(self._maker(module).kept, self._renderers)
            self._kept_jacobians[kind] = LidarJacobians(self.mount, probability, renderers, most, pane)
        elif kind not in self._kept_jacobians:
            assert isinstance(probability, CameraProbability)
            maker, streams = self._maker(module), gpu_share(_CUDA_STREAMS)
            self._kept_jacobians[kind] = CameraJacobians(
                self.mount,
                self.mount.cameras[module],
                probability,
                # recorded launches are bound to the renderers, which therefore are those of the kind
                partial(maker.new, count=streams) if self._is_cuda else partial(maker.kept, self._renderers),
                self._most_views(module, views_max=MAX_CHUNK_VIEWS, renderers=streams),
                pane,
            )
        return self._kept_jacobians[kind]

    @property
    def _is_cuda(self) -> bool:
        return wp.get_device(self.mount.device).is_cuda

    def _most_views(self, module: int, *, views_max: int = _CPU_VIEWS, renderers: int = 1) -> int:
        """Views that each renderer renders at once: as the caches of a core hold, or as fill a GPU and have room."""
        camera = self.mount.cameras[module]
        if self._is_cuda:
            most = gpu_share(_CUDA_CHUNKS) * chunk_view_count(camera, supersampling=self.supersampling)
            device = self.mount.device
            return gpu_view_count(most, camera, supersampling=self.supersampling, device=device, renderers=renderers)
        key_bytes = _CPU_KEY_BYTES // (1 if camera.beams is None else _OUTLINED)
        return min(chunk_view_count(camera, supersampling=self.supersampling, key_bytes=key_bytes), views_max)

    @property
    def scenes_at_once(self) -> int:
        """Threads that draw beside each other."""
        return 1 if self._is_cuda else self.thread_count or available_cores()

    def drawing_bytes(self, count: int) -> int:
        """Memory of the host that drawing so many cameras takes over what those take that were drawn, about."""
        views = sum(each.view_count for each in self._renderers.used)
        if self._is_cuda or not views:
            return 0
        most = max(map(self._most_views, range(len(self.mount.cameras))))
        together = min(count, self.scenes_at_once * most)
        each = self._renderers.held_bytes / views
        return int(max(min(each * min(count, together * len(self.mount.cameras)), KEPT_BYTES), each * together))

    def _maker(self, module: int) -> _RendererMaker:
        return _RendererMaker(
            self.mount.cameras[module], self.supersampling, self.occlusion, self.mount.device, self.thread_count
        )


@dataclass(frozen=True)
class _RendererMaker:
    """What renderers of one of the mount's models are like; knows nothing of who asks, so that no circle is closed."""

    camera: CameraModel
    supersampling: int
    occlusion: Occlusion
    device: str
    thread_count: int | None

    def new(self, view_count: int, count: int) -> list[Renderer]:
        """So many renderers of so many views, which do not share launches over threads."""
        return [
            Renderer(
                [self.camera] * view_count,
                supersampling=self.supersampling,
                occlusion=self.occlusion,
                device=self.device,
                thread_count=1,
            )
            for _ in range(count)
        ]

    def kept(self, renderers: KeptRenderers, view_count: int) -> Sequence[Renderer]:
        """One for each thread, of a GPU one, that others asked for before."""
        is_cuda = wp.get_device(self.device).is_cuda
        count = 1 if is_cuda else self.thread_count or available_cores()
        return renderers.of((self, view_count), lambda: self.new(view_count, count))


def _unpacked(mount: tuple[Any, ...], *others: Any) -> SingleCameras:  # noqa: ANN401
    load_warp()  # before the mount asks for it, which would print what it loads
    surface, camera, height_offset_m, device, free = mount
    return SingleCameras(
        CameraMount(surface, camera=camera, height_offset_m=height_offset_m, device=device, free=free), *others
    )


def hard_points(cameras: SingleCameras, ghosts: RequiredPoints) -> HardPoints | None:
    """The hard points of requirements as a polish of some cameras keeps them met; None where there is none."""
    if not ghosts.is_hard.any():
        return None
    needed = ghosts.ghosts.of_each("cameras")[ghosts.is_hard]
    return HardPoints(lambda mount_pose: _camera_margins(cameras, ghosts, mount_pose), needed)


def _camera_margins(cameras: SingleCameras, ghosts: RequiredPoints, mount_pose: np.ndarray) -> Margins:
    """`RequiredPoints.margins` with the Jacobian to the mount poses; of a pair the greater of its two cameras'.

    What `SingleCameras.with_jacobian` has just rendered of the same cameras is not rendered again.
    """
    pose = np.ascontiguousarray(mount_pose, np.float32)
    own, *mirrored = cameras.sides
    value, jacobian = own.differentiated(ghosts, pose, RequiredPoints.margins)
    pair = np.flatnonzero(cameras.mount.is_pair(pose))
    for side in mirrored if len(pair) else ():
        image, slope = side.differentiated(ghosts, pose[pair] * MIRROR, RequiredPoints.margins)
        is_greater = image > value[pair]
        value[pair] = np.where(is_greater, image, value[pair])
        jacobian[pair] = np.where(is_greater[..., None], slope * MIRROR, jacobian[pair])
    return value, jacobian


@dataclass(frozen=True, eq=False)
class MisplacedCameras(SingleCameras):
    """Cameras of one mount, each with the mean of its probabilities over errors of its mounting.

    Poses are those without errors. Of a pair each of the two has errors of its own. Points of requirements, which are
    met or not, are seen without errors.
    """

    errors: MountErrors = field(kw_only=True)  # of the mounting

    @classmethod
    def of(cls, cameras: SingleCameras, errors: MountErrors) -> MisplacedCameras:
        others = (cameras.occlusion, cameras.supersampling, cameras.thread_count, cameras.is_mirrored, cameras.is_fused)
        return cls(cameras.mount, cameras.probability, *others, errors=errors, _renderers=cameras._renderers)

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpacked_misplaced, (*super().__reduce__(), self.errors)

    @property
    def identity(self) -> dict[str, str]:
        """As of cameras without errors; the errors are part of ``camera``."""
        plain = super().identity
        return {**plain, "camera": digest(plain["camera"], self.errors.draws.tobytes())}

    def _misplaced(self, pose: np.ndarray) -> np.ndarray:
        """Cameras [camera, 7] with each of the errors, float32 [draw, camera, 7]."""
        return outside_skin(pose.astype(np.float64) + self.errors.draws[:, None], pose, self.mount)

    def _alone(self, pose: np.ndarray, scene: DeviceScene | RequiredPoints) -> np.ndarray:
        if isinstance(scene, RequiredPoints):
            return super()._alone(pose, scene)
        misplaced = self._misplaced(pose)
        found = super()._alone(misplaced.reshape(-1, MOUNT_POSE_SIZE), scene)
        return found.reshape(*misplaced.shape[:2], scene.vehicle_count).mean(axis=0, dtype=np.float64)

    def _alone_with_jacobian(
        self, pose: np.ndarray, scenes: Sequence[DeviceScene | RequiredPoints]
    ) -> tuple[np.ndarray, np.ndarray]:
        misplaced = self._misplaced(pose)
        traffic = [scene for scene in scenes if isinstance(scene, DeviceScene)]
        probability, jacobian = super()._alone_with_jacobian(misplaced.reshape(-1, MOUNT_POSE_SIZE), traffic)
        shape = (*misplaced.shape[:2], probability.shape[1])
        # one that ends at the skin stays there when its camera is raised a little
        is_at_skin = misplaced[..., HEIGHT_DELTA_M] == np.float32(-self.mount.height_offset_m)
        is_stopped = is_at_skin & (self.errors.draws[:, None, HEIGHT_DELTA_M] < 0.0)
        jacobian = jacobian.reshape(*shape, MOUNT_POSE_SIZE)
        jacobian[..., HEIGHT_DELTA_M][is_stopped] = 0.0
        probability, jacobian = probability.reshape(shape).mean(axis=0), jacobian.mean(axis=0)
        if len(traffic) == len(scenes):
            return probability, jacobian
        seen, slope = super()._alone_with_jacobian(pose, scenes[len(traffic) :])
        return np.concatenate([probability, seen], axis=1), np.concatenate([jacobian, slope], axis=1)


def _unpacked_misplaced(
    plain: Callable[..., SingleCameras], parts: tuple[Any, ...], errors: MountErrors
) -> MisplacedCameras:
    return MisplacedCameras.of(plain(*parts), errors)
